"""Makes recordings for the tests of this room: the loop in one process, the real writer.

The arm is the plant's exact model and every node's step is the one that node processes run; only
the transport between them is missing. The gains are closed-form ones (observer and controller take
out energy where they measure and act), so that no solver is needed.
"""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from deploy import Deployment, deploy
from node.sweep import NodeSweep
from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from plant.noise import SensorNoise
from recorder.writer import RecordingWriter
from wire.artefact import (
    Arm,
    Certificate,
    GainsArtefact,
    OperatorFactors,
    PolynomialMatrix,
    Setpoint,
    write_artefact,
)
from wire.channels import FORMAT_VERSION, SHAPE_POINTS, label, node_channels, plant_channels
from wire.messages import PLANT
from wire.run_config import DisturbanceConfig, NoiseConfig, RunConfig, dumps

Array = npt.NDArray[np.float64]

ARM = Arm("test", 1.0, 0.025, 5e3, 1.1e3, 0.02)
BYTES_PER_MESSAGE = 71
"""Made up: these recordings were never on a wire."""


def constant(*rows: tuple[float, ...]) -> PolynomialMatrix:
    return PolynomialMatrix([[[value] for value in row] for row in rows])


def make_artefact(gain_per_s: float = 0.6) -> GainsArtefact:
    """Setpoints "straight" and "bent" (kappa_e = 2 (1 - s)^2); the gains only take out energy."""
    mass = ARM.mass_per_length_kg_per_m
    observer = OperatorFactors(
        n0=constant((0.0, 0.0), (-gain_per_s, 0.0), (0.0, 0.0), (0.0, -gain_per_s)),
        n1a=constant((0.0,), (1e-3,), (0.0,), (0.0,)),
        n1b=constant((0.0, 1.0)),
        n2a=constant((0.0,), (1e-3,), (0.0,), (0.0,)),
        n2b=constant((0.0, -1.0)),
    )
    controller = OperatorFactors(
        n0=constant((0.0, -0.3 * mass, 0.0, 0.0)),
        n1a=constant((0.02,)),
        n1b=constant((0.0, 0.0, 0.0, 0.01)),
        n2a=constant((0.02,)),
        n2b=constant((0.0, 0.0, 0.0, 0.01)),
    )
    certificate = Certificate(
        outcome="certified",
        certified_gamma=0.1414,
        achieved_gamma=0.135,
        open_loop_gamma=2.33,
        optimum_gamma=0.111,
        decay_per_s=0.01,
        gain_norm=14.1,
        smallest_eigenvalue_p=1.0,
        largest_eigenvalue_lpi=0.0,
        equality_residual=0.0,
        gram_sizes=[8],
        equalities=0,
        iterations=0,
        solver="none",
        solver_status="closed form",
        seconds=0.0,
    )
    setpoints = []
    for name, strength in (("straight", 0.0), ("bent", 2.0)):
        # (1 - s)^2 = 1/3 P0 - 1/2 P1 + 1/6 P2 in x = 2 s - 1; the load -(EI kappa'/cos)' holds it.
        curvature = [strength / 3.0, -strength / 2.0, strength / 6.0]
        s = np.linspace(0.0, 1.0, 400)
        angle = strength * (1.0 - (1.0 - s) ** 3) / 3.0
        force = ARM.bending_stiffness_n_m2 * 2.0 * strength * (1.0 - s) / np.cos(angle)
        series = np.polynomial.Legendre.fit(s, force, 12, domain=[0.0, 1.0])
        setpoints.append(
            Setpoint(
                name=name,
                curvature_per_m=curvature,
                strain=[0.0],
                feedforward_n_per_m=(-series.deriv()).coef.tolist(),
                tip_m=[float(np.mean(np.cos(angle))), float(np.mean(np.sin(angle)))],
                observer=observer,
                controller=controller,
                observer_certificate=certificate,
                controller_certificate=certificate,
            )
        )
    return GainsArtefact(ARM, {"noise": 0.1, "effort": 0.1}, setpoints, {"octarm": "test"})


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


def run_config(scenario: Scenario, deployment: Deployment, sha256: str) -> RunConfig:
    index = deployment.setpoint_names.index(scenario.setpoint)
    return RunConfig(
        run_id="simulated",
        nodes=scenario.nodes,
        spacing=scenario.spacing,
        faces_m=tuple(deployment.faces_m.tolist()),
        tick_s=scenario.tick_s,
        ticks=scenario.ticks,
        seed=scenario.seed,
        setpoint=scenario.setpoint,
        setpoint_names=deployment.setpoint_names,
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
    )


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
    artefact = artefact or make_artefact()
    attached = path.with_suffix(".gains.json")
    sha256 = write_artefact(artefact, attached)
    deployment = deploy(artefact, scenario.nodes, scenario.tick_s, scenario.spacing)
    run = run_config(scenario, deployment, sha256)
    n, index = run.nodes, run.setpoint_index
    factors = [node.setpoints[index] for node in deployment.nodes]
    layout = {
        i: node_channels(i, n, factors[i].forward_received, factors[i].backward_received)
        for i in range(n)
    }
    layout[PLANT] = plant_channels(n)
    growing = path.with_suffix(".growing")
    writer = RecordingWriter(growing, run.tick_s, layout, flush_s=math.inf)
    writer.head(
        {
            "format_version": str(FORMAT_VERSION),
            "run": dumps(run),
            "artefact_sha256": sha256,
            "seed": str(run.seed),
            "versions": json.dumps({"octarm": "test"}),
            "epoch_ns": "0",
        },
        {"gains.json": attached.read_text()},
    )
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
    sweeps = [NodeSweep(node, index) for node in deployment.nodes]
    wall = np.random.default_rng(run.seed)
    equilibrium = deployment.dense[index].out_offset.reshape(n, 5)
    for k in range(run.ticks):
        measured = plant.measure() + noise.sample(k, n)
        rows = node_rows(sweeps, measured, wall)
        tip, truth = plant.tip(), plant.truth()
        mean = np.diff(run.faces_m) @ (truth - equilibrium[:, :4])
        rows[PLANT] = [
            *truth.ravel().tolist(),
            *tip.tolist(),
            float(np.hypot(*(tip - setpoint.tip_m))),
            *plant.energy(),
            float(mean[1]),
            float(mean[3]),
            *plant.shape_at(np.linspace(0.0, artefact.arm.length_m, SHAPE_POINTS)).ravel().tolist(),
            3.1e8 + 1e6 * k,
            float(np.round(1e6 * wall.lognormal(-0.8, 0.3))),
            1e5,
        ]
        command = np.array([rows[i][6] for i in range(n)])
        writer.tick(k, {s: row for s, row in rows.items() if (k, s) not in skip})
        plant.advance(command, k)
    writer.event(run.ticks, "info", "finished", "every tick was done")
    writer.flush()
    if not close:
        shutil.copy(growing, path)
    writer.close(summary(run))
    if close:
        growing.replace(path)
    return run


def node_rows(
    sweeps: list[NodeSweep], measured: Array, wall: np.random.Generator
) -> dict[int, list[float]]:
    """One tick of all nodes; their telemetry rows, and their states advanced."""
    n = len(sweeps)
    inputs = [sweep.input(y).copy() for sweep, y in zip(sweeps, measured, strict=True)]
    forward = [np.zeros(0)]
    for i in range(n - 1):
        forward.append(sweeps[i].forward(inputs[i], forward[i]).copy())
    backward = [np.zeros(0)]
    for i in range(n - 1, 0, -1):
        backward.insert(0, sweeps[i].backward(inputs[i], backward[0]).copy())
    rows: dict[int, list[float]] = {}
    for i, sweep in enumerate(sweeps):
        instants = 2 + (i > 0) + (i < n - 1)
        rows[i] = [
            *measured[i].tolist(),
            *sweep.estimate.tolist(),
            sweep.command,
            *forward[i].tolist(),
            *backward[i].tolist(),
            *wall.integers(0, 10**6, instants).astype(float).tolist(),
        ]
        sweep.accept(sweep.output(inputs[i], forward[i], backward[i]))
    return rows


def summary(run: RunConfig) -> dict[str, str]:
    """Final counters as the recorder writes them."""
    n, ticks = run.nodes, run.ticks
    messages = 2 * (n - 1) * ticks
    totals = {
        "ticks_recorded": ticks,
        "ticks_lost": 0,
        "nodes_reporting": n,
        "neighbour_messages": messages,
        "neighbour_bytes": messages * BYTES_PER_MESSAGE,
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
