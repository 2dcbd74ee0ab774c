"""Makes recordings for the tests of this room: the loop in one process, the real writer.

The arm is the plant's exact model and every node's step is the one that node processes run; only
the transport between them is missing. The gains are closed-form ones (observer and controller take
out energy where they measure and act), so that no solver is needed.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
from closed_form import artefact

from deploy import Deployment, SegmentGrid, deploy
from deploy.node_configs import node_configs
from deploy.path import References, make_references
from node.scheduling import Sectors
from node.sweep import NodeSweep
from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from plant.noise import SensorNoise
from recorder.writer import RecordingWriter
from wire.artefact import GainsArtefact, write_artefact
from wire.channels import (
    DEGRADED,
    FORMAT_VERSION,
    NODES_ATTACHMENT,
    SHAPE_POINTS,
    WELL,
    label,
    node_channels,
    plant_channels,
)
from wire.config_json import dumps
from wire.messages import PLANT
from wire.run_config import (
    DisturbanceConfig,
    LegConfig,
    LinkConfig,
    NodeConfig,
    NoiseConfig,
    PaceConfig,
    RunConfig,
    SchedulingConfig,
)

Array = npt.NDArray[np.float64]

LINKS = LinkConfig((), (), None, deadline_s=5.0, epoch_ns=0, cpu=None, fifo=None)
BYTES_PER_MESSAGE = 71
"""Made up: these recordings were never on a wire."""


def make_artefact(gain_per_s: float = 0.6) -> GainsArtefact:
    """Setpoints "straight" and "bent" (kappa_e = 2 (1 - s)^2)."""
    return artefact(gain_per_s=gain_per_s, coupling=0.02, name="bent", strength=2.0)


@dataclass(frozen=True)
class Scenario:
    """What to simulate."""

    nodes: int = 5
    ticks: int = 120
    tick_s: float = 0.1
    seed: int = 3
    setpoint: str = "bent"
    initial: str = "chapter"
    disturbance: str = "none"
    noise: tuple[float, float] = (1e-5, 1e-4)
    """Standard deviations of v_y in m/s and of the curvature in 1/m."""
    spacing: str = "equispaced"
    first_hold_s: float = 0.0
    legs: tuple[LegConfig, ...] = ()
    bump_s: float = 2.0
    late: frozenset[int] = frozenset()
    """Ticks that have no sweep; with any, the run is one in real time."""
    realtime: bool = False


def scheduling(artefact: GainsArtefact, scenario: Scenario) -> SchedulingConfig:
    """Sectors of the setpoints that are visited, in the order of their tips' angles, boundaries midway."""
    names = {scenario.setpoint, *(n for leg in scenario.legs for n in (*leg.through, leg.to))}
    angles = sorted(
        (math.degrees(math.atan2(one.tip_m[1], one.tip_m[0])), index)
        for index, one in enumerate(artefact.setpoints)
        if one.name in names
    )
    return SchedulingConfig(
        setpoints=tuple(index for _, index in angles),
        boundaries_deg=tuple(0.5 * (a + b) for (a, _), (b, _) in pairwise(angles)),
        hysteresis_deg=1.0,
        bump_s=scenario.bump_s,
    )


def run_config(
    scenario: Scenario, artefact: GainsArtefact, deployment: Deployment, sha256: str
) -> RunConfig:
    index = deployment.setpoint_names.index(scenario.setpoint)
    return RunConfig(
        run_id="simulated",
        scenario="simulated",
        nodes=scenario.nodes,
        spacing=scenario.spacing,
        faces_m=tuple(deployment.faces_m.tolist()),
        tick_s=scenario.tick_s,
        ticks=scenario.ticks,
        seed=scenario.seed,
        setpoint=scenario.setpoint,
        setpoint_names=deployment.setpoint_names,
        first_hold_s=scenario.first_hold_s,
        legs=scenario.legs,
        scheduling=scheduling(artefact, scenario),
        control=True,
        initial=scenario.initial,
        disturbance=DisturbanceConfig(scenario.disturbance, 1.0),
        noise=NoiseConfig(*scenario.noise),
        plant_cells=max(40, 4 * scenario.nodes),
        artefact_path="test.gains.json",
        artefact_sha256=sha256,
        initial_estimates=tuple(
            tuple(node.initial_estimate[index].tolist()) for node in deployment.nodes
        ),
        initial_commands_n_per_m=tuple(
            float(node.initial_command[index]) for node in deployment.nodes
        ),
        energy_weights=tuple(tuple(row) for row in deployment.energy_weights.tolist()),
        segments_per_process=1,
        pace=PaceConfig(scenario.tick_s, 30 if scenario.realtime else 3)
        if scenario.late or scenario.realtime
        else None,
    )


@dataclass(frozen=True)
class Stage:
    """All that a simulation needs, and the file that it grows into."""

    run: RunConfig
    artefact: GainsArtefact
    deployment: Deployment
    references: References
    configs: list[NodeConfig]
    plant: ArmPlant
    noise: SensorNoise
    writer: RecordingWriter

    def plant_row(
        self,
        tick: int,
        *,
        late: bool = False,
        sweep_ns: float = 0.0,
        health: Sequence[float] | None = None,
        passive: bool = False,
        command: Array | None = None,
    ) -> list[float]:
        """The plant's row of a tick, before the arm moves in it."""
        run, plant = self.run, self.plant
        tip, truth = plant.tip(), plant.truth()
        mean = np.diff(run.faces_m) @ (truth - self.references.states(tick)[:, :4])
        wanted = self.references.plant.at(tick)[:2]
        shape_at = np.linspace(0.0, self.artefact.arm.length_m, SHAPE_POINTS)
        return [
            *truth.ravel().tolist(),
            *tip.tolist(),
            float(np.hypot(*(tip - wanted))),
            *wanted.tolist(),
            *plant.energy(),
            float(mean[1]),
            float(mean[3]),
            *plant.shape_at(shape_at).ravel().tolist(),
            *([float(WELL)] * run.nodes if health is None else health),
            float(passive),
            0.0 if command is None else plant.load_potential(command),
            float(late),
            3.1e8 + 1e6 * tick,
            3.1e8 + 1e6 * tick,
            sweep_ns,
            1e5,
        ]


def stage(growing: Path, attached: Path, scenario: Scenario, artefact: GainsArtefact) -> Stage:
    """Everything before the first tick; the recording grows at `growing`."""
    sha256 = write_artefact(artefact, attached)
    deployment = deploy(artefact, scenario.nodes, scenario.tick_s, scenario.spacing)
    run = run_config(scenario, artefact, deployment, sha256)
    n, index = run.nodes, run.setpoint_index
    layout = {
        i: node_channels(i, n, node.forward_received, node.backward_received)
        for i, node in enumerate(deployment.nodes)
    }
    layout[PLANT] = plant_channels(n)
    setpoint = artefact.setpoints[index]
    plant = ArmPlant(
        PlantParameters(
            arm=artefact.arm,
            faces_m=run.faces_m,
            tick_s=run.tick_s,
            initial=initial_shape(run.initial, setpoint, artefact.arm.length_m),
            disturbance=DisturbanceSpec(run.disturbance.name, run.disturbance.amplitude),
            cells=run.plant_cells,
        )
    )
    noise = SensorNoise(run.seed, run.noise.velocity_y_m_per_s, run.noise.curvature_per_m)
    references = make_references(
        artefact,
        SegmentGrid(deployment.faces_m),
        run.tick_s,
        run.setpoint,
        run.first_hold_s,
        run.legs,
    )
    writer = RecordingWriter(growing, run.tick_s, layout, flush_s=math.inf)
    configs = node_configs(run, deployment, references, lambda _: LINKS)
    writer.head(
        {
            "format_version": str(FORMAT_VERSION),
            "run": dumps(run),
            "artefact_sha256": sha256,
            "seed": str(run.seed),
            "versions": json.dumps({"octarm": "test"}),
            "epoch_ns": "0",
        },
        {
            "gains.json": attached.read_text(),
            NODES_ATTACHMENT: f"[{','.join(map(dumps, configs))}]",
        },
    )
    return Stage(run, artefact, deployment, references, list(configs), plant, noise, writer)


def write_recording(
    path: Path,
    scenario: Scenario = Scenario(),
    artefact: GainsArtefact | None = None,
    *,
    close: bool = True,
    skip: frozenset[tuple[int, int]] = frozenset(),
) -> RunConfig:
    """Simulate and record; `skip` holds the (tick, sender) whose rows are lost; `close`
    is False for a recorder that was killed after its last flush."""
    growing = path.with_suffix(".growing")
    made = stage(growing, path.with_suffix(".gains.json"), scenario, artefact or make_artefact())
    run, plant, writer = made.run, made.plant, made.writer
    n, index = run.nodes, run.setpoint_index
    sweeps = [
        NodeSweep(
            node,
            index,
            reference=made.references.nodes[i],
            sectors=Sectors.of(run.scheduling),
            fade=math.exp(-run.tick_s / run.scheduling.bump_s),
        )
        for i, node in enumerate(made.deployment.nodes)
    ]
    wall = np.random.default_rng(run.seed)
    command = np.array([sweep.command for sweep in sweeps])
    for k in range(run.ticks):
        late = k in scenario.late
        rows: dict[int, list[float]] = {}
        if not late:
            if k - 1 in scenario.late:
                for sweep in sweeps:
                    sweep.skip_to(k)
            command = np.array([sweep.command for sweep in sweeps])
            rows = node_rows(sweeps, plant.measure() + made.noise.sample(k, n), wall)
        sweep_ns = (
            0.0 if k + 1 in scenario.late else float(np.round(1e6 * wall.lognormal(-0.8, 0.3)))
        )
        rows[PLANT] = made.plant_row(k, late=late, sweep_ns=sweep_ns, command=command)
        writer.tick(k, {s: row for s, row in rows.items() if (k, s) not in skip})
        plant.advance(command, k)
    writer.event(run.ticks, "info", "finished", "every tick was done")
    writer.flush()
    if not close:
        shutil.copy(growing, path)
    writer.close(summary(run, len(scenario.late)))
    if close:
        growing.replace(path)
    return run


def node_rows(
    sweeps: list[NodeSweep], measured: Array, wall: np.random.Generator
) -> dict[int, list[float]]:
    """One tick of all nodes; their telemetry rows, and their states advanced."""
    n = len(sweeps)
    for sweep, y in zip(sweeps, measured, strict=True):
        sweep.input(y)
    c = np.zeros(0)
    for sweep in sweeps:
        c = sweep.forward(c)
    d = np.zeros(0)
    for sweep in reversed(sweeps):
        d = sweep.backward(d)
    rows: dict[int, list[float]] = {}
    for i, sweep in enumerate(sweeps):
        instants = 2 + (i > 0) + (i < n - 1)
        row = sweep.row.now(sweep.reference)
        row[-instants - len(DEGRADED) : -len(DEGRADED)] = wall.integers(0, 10**6, instants)
        rows[i] = row.tolist()
        sweep.accept(sweep.output())
    return rows


def summary(run: RunConfig, late: int) -> dict[str, str]:
    """Final counters as the recorder writes them."""
    n, ticks = run.nodes, run.ticks - late
    messages = 2 * (n - 1) * ticks
    totals = {
        "ticks_recorded": run.ticks,
        "ticks_lost": 0,
        "late_ticks": late,
        "nodes_reporting": n,
        "neighbour_messages": messages,
        "neighbour_bytes": messages * BYTES_PER_MESSAGE,
        "passed_messages": 0,
        "neighbour_messages_sent": messages,
        "measurement_messages": n * ticks,
        "measurement_bytes": n * ticks * 40,
        "command_messages": n * ticks,
        "command_bytes": n * ticks * 30,
        "rejected_messages": 0,
    }
    out = {name: str(value) for name, value in totals.items()}
    for i in range(n):
        flows = {
            "forward_received": (i > 0, i - 1),
            "forward_sent": (i < n - 1, i),
            "backward_received": (i < n - 1, i),
            "backward_sent": (i > 0, i - 1),
        }
        counters = {"rejected_messages": 0}
        for name, (there, link) in flows.items():
            counters[f"{name}_messages"] = ticks * there
            counters[f"{name}_bytes"] = ticks * there * BYTES_PER_MESSAGE
            counters[f"{name}_crc32"] = (1000 + link) * there
        out[f"node/{label(i, n)}"] = json.dumps(counters)
    return out
