"""Is the controller inside octarm's own step section 4's formula? A recording of `octarm run` is asked.

The deployed step makes estimate and command in one exchange (theory, section 5), so c and d carry both. What
it says of the command alone is u = K (xh + h b u): K by a double sum over the nodes' states at their own
places, applied to the estimate with what the command itself does to it within the tick (implicit Euler).
Computed here from the artefact's coefficients and the recorded numbers only, by pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from analysis.recording import read_recording
from chapter.section4 import Rule, pairs
from wire.artefact import OperatorFactors, PolynomialMatrix
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

STATES = 4
V_Y = 1


@dataclass(frozen=True)
class Agreement:
    """Largest differences of the recorded commands, relative to the largest of them."""

    implicit: float
    """From K (xh + h b u)."""
    explicit: float
    """From K xh, the same double sum on the estimate alone."""
    midpoint: float
    """From the corrected rule of section 4 on the estimate, all components of a node taken to be at its
    middle."""
    ticks: int
    nodes: int
    messages_per_tick: float
    numbers: tuple[int, int]
    """In a forward and in a backward sum in the middle of the arm, without what the scheduling adds."""


def staggered(factors: OperatorFactors, faces_m: Array) -> Array:
    """K as a matrix (N, 4 N): every state's dual cell times the kernel between its place and the command's,
    the cell cut
    at the command's place; K_0 on the state interpolated there (`deploy.operators` in words)."""
    count, length = len(faces_m) - 1, float(faces_m[-1])
    middles = 0.5 * (faces_m[1:] + faces_m[:-1])
    outer = faces_m[1:]
    places = (outer, outer, middles, faces_m[:-1])
    ends = np.append(middles, length)
    cells = (
        (middles, ends[1:]),
        (middles, ends[1:]),
        (faces_m[:-1], outer),
        (np.append(0.0, middles[:-1]), middles),
    )
    known = (0.0, 0.0, length, length)  # v(0), e(L), k(L) are zero
    K = np.zeros((count, count, STATES))
    for component in range(STATES):
        zero_at = known[component]
        points = np.append(places[component], zero_at)
        order = np.argsort(points)
        for j in range(count):
            unit = np.zeros(count + 1)
            unit[j] = 1.0
            value = np.interp(outer, points[order], unit[order])
            K[:, j, component] += _values(factors.n0, outer, length)[:, 0, component] * value
            low, high = cells[component][0][j], cells[component][1][j]
            at = np.array([places[component][j]])
            for a, b, widths in (
                (factors.n1a, factors.n1b, np.clip(np.minimum(high, outer) - low, 0.0, None)),
                (factors.n2a, factors.n2b, np.clip(high - np.maximum(low, outer), 0.0, None)),
            ):
                kernel = _values(a, outer, length)[:, 0] @ _values(b, at, length)[0, :, component]
                K[:, j, component] += widths * kernel
    return K.reshape(count, STATES * count)


def _values(matrix: PolynomialMatrix, s_m: Array, length_m: float) -> Array:
    vander = legendre.legvander(2.0 * s_m / length_m - 1.0, matrix.array.shape[2] - 1)
    return np.asarray(np.einsum("rcd,sd->src", matrix.array, vander))


def agreement(path: Path) -> Agreement:
    """Ask a recording of `octarm run` that rests at one setpoint. UsageError if it moves, or is not of a
    whole run."""
    recording = read_recording(path)
    run, arm = recording.configuration, recording.artefact.arm
    received, done = recording.counter("neighbour_messages"), recording.sweeps()
    if run.legs or arm.actuator != "transverse" or received is None or not done:
        raise UsageError(
            f"recording {path}: expected a whole run that rests, with a transverse load"
        )
    controller = recording.artefact.setpoints[run.setpoint_index].controller
    rest = recording.references.states(0)
    estimate = recording.estimates - rest[:, :STATES]
    commands = recording.commands - rest[:, STATES]
    K = staggered(controller, np.asarray(run.faces_m))
    moved = estimate.copy()
    moved[:, :, V_Y] += run.tick_s * commands / arm.mass_per_length_kg_per_m
    by_rule = pairs(controller, arm.length_m, run.nodes, Rule.MIDPOINT)[:, 0]
    flat = (recording.ticks, STATES * run.nodes)

    def worst(wanted: Array) -> float:
        return float(np.abs(commands - wanted)[1:].max() / np.abs(commands).max())

    middle = recording.deployment.nodes[run.nodes // 2].setpoints[run.setpoint_index]
    return Agreement(
        implicit=worst(moved.reshape(flat) @ K.T),
        explicit=worst(estimate.reshape(flat) @ K.T),
        midpoint=worst(np.einsum("inm,knm->ki", by_rule, estimate)),
        ticks=recording.ticks,
        nodes=run.nodes,
        messages_per_tick=received / done,
        numbers=(middle.forward_received, middle.backward_received),
    )
