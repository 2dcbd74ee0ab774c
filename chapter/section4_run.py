"""Real node processes run u = K x by section 4's formula: W = V = I, the chapter's factors, 2 (N - 1)
messages a tick.

Between a gains artefact and a recording. Everything is what `octarm run` does, but for the numbers that the
nodes are given: instead of observer and controller in one step a node's state x_i is what it measures, (v_y,
k), and its next command is K_0 x_i and the two sums. The estimate that it records is the measurement. Nothing
of the gain that acts on v_x and e, which no node measures, is used. The recording carries the artefact and its
certificates as every recording does; they are of the designed gains, not of this loop.

`python -m chapter.section4_run GAINS DIRECTORY NODES TICKS RULE`
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording, read_recording
from chapter.section4 import Nodes, Rule, columns, nodes, pairs
from deploy import Deployment, SegmentGrid
from deploy.deployment import node_factors, offsets
from supervise.conductor import Conductor
from supervise.endpoints import choose
from supervise.options import RunOptions
from supervise.plan import make_plan, new_run_id, prepare
from supervise.view import View
from wire.artefact import GainsArtefact
from wire.errors import ExitCode, OctarmError
from wire.factors import INPUTS, OUTPUTS, STATES, SweepFactors

Array = npt.NDArray[np.float64]

MEASURED = [1, 3]
"""Of a node's state: v_y and k."""
Y = [5, 6]
"""Where a node's input has them as measured."""


def sweep_factors(hold: Nodes, i: int, in_offset: Array, out_offset: Array) -> SweepFactors:
    """Node i's formula in the form that node processes run: out = D in + P c + U d, c_next = W c + Q in, ..."""
    rank1, rank2 = hold.K1b.shape[1], hold.K2b.shape[1]
    first, last = i == 0, i == hold.count - 1
    received, sent = (0 if first else rank1), (0 if last else rank1)
    back_received, back_sent = (0 if last else rank2), (0 if first else rank2)
    D, Q, R = (np.zeros((rows, INPUTS)) for rows in (OUTPUTS, sent, back_sent))
    P, U = np.zeros((OUTPUTS, received)), np.zeros((OUTPUTS, back_received))
    D[MEASURED, Y] = 1.0
    D[STATES, Y] = hold.own_matrix(i)[0]
    if sent:
        Q[:, Y] = hold.K1b[i]
    if back_sent:
        R[:, Y] = hold.K2b[i]
    if received:
        P[STATES] = hold.length_m * hold.K1a[i][0]
    if back_received:
        U[STATES] = hold.length_m * hold.K2a[i][0]
    W, V = np.eye(sent, received), np.eye(back_sent, back_received)
    return SweepFactors(D, P, Q, W, U, R, V, in_offset, out_offset)


def with_formula(deployment: Deployment, artefact: GainsArtefact, rule: Rule) -> Deployment:
    """The deployment with section 4's numbers in the nodes' hands."""
    grid = SegmentGrid(deployment.faces_m)
    per_setpoint = []
    for setpoint in artefact.setpoints:
        factors = columns(setpoint.controller, MEASURED)
        hold = nodes(factors, grid.length_m, grid.nodes, rule)
        start, end = offsets(artefact.arm, setpoint, grid)
        per_setpoint.append([sweep_factors(hold, i, start[i], end[i]) for i in range(grid.nodes)])
    return replace(
        deployment,
        nodes=tuple(
            node_factors(i, [one[i] for one in per_setpoint], grid) for i in range(grid.nodes)
        ),
    )


def run(gains: Path, directory: Path, count: int, ticks: int, rule: Rule) -> Path:
    """Run the arm with `count` node processes, plant and recorder; returns the recording.

    Must be called in a process's main thread. Raises OctarmError if the run does not end as it should.
    """
    options = RunOptions(gains=gains, nodes=count, ticks=ticks, out=directory)
    prepared = prepare(options)
    prepared = replace(
        prepared, deployment=with_formula(prepared.deployment, prepared.artefact, rule)
    )
    endpoints = choose(count, options.transport, None, None, tls=False)
    directory.mkdir(parents=True, exist_ok=True)
    try:
        plan = make_plan(prepared, endpoints, new_run_id(), directory.absolute())
        with Conductor(plan, View(ticks)) as conductor:
            outcome = conductor.run()
    finally:
        endpoints.close()
    if outcome.exit_code is not ExitCode.OK:
        raise OctarmError(f"the run ended with {outcome.exit_code!r}: {outcome.message}")
    return directory / "recording.mcap"


def run_apart(gains: Path, directory: Path, count: int, ticks: int, rule: Rule) -> Path:
    """`run` in a process of its own. Raises OctarmError with what it said if it fails."""
    arguments = [
        str(gains.absolute()),
        str(directory.absolute()),
        str(count),
        str(ticks),
        str(rule),
    ]
    return recorded(["-m", __name__, *arguments], directory, "the run of section 4")


def recorded(arguments: Sequence[str], directory: Path, what: str) -> Path:
    """The recording that Python, started with these arguments beside launcher.py, leaves in the directory.

    Raises OctarmError with what it said if `what` fails.
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=Path(__file__).resolve().parents[1],
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    if done.returncode != 0:
        raise OctarmError(f"{what} failed:\n{done.stderr}")
    return directory / "recording.mcap"


@dataclass(frozen=True, eq=False)
class Seen:
    """What a recording of such a run says."""

    ticks: int
    commands: Array
    """(K, N), N/m, less the load that holds the setpoint: u_i(k)."""
    by_double_sum: Array
    """(K, N): the same by `section4.pairs` of what was measured a tick before; row 0 is zero."""
    sums_error: float
    """Largest relative difference of a received sum from the direct sum over the nodes before it."""
    messages_per_tick: float
    numbers: tuple[int, int]
    """In a forward and in a backward sum, without what the scheduling adds."""
    tip_error_m: Array
    """(K,)."""

    @property
    def error(self) -> float:
        """Largest difference of commands and double sum, relative to the largest command."""
        difference = np.abs(self.commands - self.by_double_sum)[1:].max()
        return float(difference / np.abs(self.by_double_sum).max())


def look(path: Path, rule: Rule) -> Seen:
    """Read the recording and compute every command again."""
    recording = read_recording(path)
    run_ = recording.configuration
    artefact = recording.artefact
    controller = columns(artefact.setpoints[run_.setpoint_index].controller, MEASURED)
    rest = np.stack([recording.references.states(k) for k in range(recording.ticks)])
    x = recording.measurements - rest[:, :, MEASURED]
    length = artefact.arm.length_m
    wanted = np.zeros((recording.ticks, run_.nodes))
    kernel = pairs(controller, length, run_.nodes, rule)[:, 0]
    wanted[1:] = np.einsum("inm,knm->ki", kernel, x[:-1])
    received = recording.counter("neighbour_messages")
    done = recording.sweeps()
    if received is None or done is None:
        raise OctarmError(f"recording {path}: it has no final counters")
    hold = nodes(controller, length, run_.nodes, rule)
    ranks = hold.K1b.shape[1], hold.K2b.shape[1]
    return Seen(
        ticks=recording.ticks,
        commands=recording.commands - rest[:, :, STATES],
        by_double_sum=wanted,
        sums_error=_sums_error(recording, hold, x),
        messages_per_tick=received / done,
        numbers=ranks,
        tip_error_m=recording.tip_error_m,
    )


def received_sums(recording: Recording, rank: int, which: str) -> Array:
    """(K, N - 1, rank): c of nodes 1 .. N - 1 ("c"), or d of nodes 0 .. N - 2 ("d")."""
    count = recording.nodes
    channel, at = (
        ("forward_sum", range(1, count)) if which == "c" else ("backward_sum", range(count - 1))
    )
    fields = tuple(f"{which}{r}" for r in range(rank))
    topics = [f"/node/{i:02d}/{channel}" for i in at]
    return np.stack(
        [recording.table(topic).by_tick(fields, recording.ticks) for topic in topics], axis=1
    )


def _sums_error(recording: Recording, hold: Nodes, x: Array) -> float:
    """x: (K, N, inputs). Cumulated from the same end, each from its own products."""
    worst = 0.0
    for which, factor in (("c", hold.K1b), ("d", hold.K2b)):
        terms = np.einsum("nrm,knm->knr", factor, x)
        direct = np.stack(
            [
                terms[:, :i].sum(axis=1) if which == "c" else terms[:, i:].sum(axis=1)
                for i in range(1, hold.count)
            ],
            axis=1,
        )
        got = received_sums(recording, factor.shape[1], which)
        worst = max(worst, float(np.abs(got - direct).max() / np.abs(direct).max()))
    return worst


def main() -> None:
    """The command line."""
    gains, directory, count, ticks, rule = sys.argv[1:]
    run(Path(gains), Path(directory), int(count), int(ticks), Rule(rule))


if __name__ == "__main__":
    main()
