"""The closed loop in one process, for studies: exact plant, deployed step, the numbers of a run.

Between `deploy` (one dense matrix a tick) and the studies of this folder. What a run cannot be asked for
can be had here: another arm than the one that the gains were made for, sensors and actuators that are
dead, measurements that come late, other feedback.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy import DenseStep, Deployment, deploy
from plant.disturbance import DisturbanceSpec
from plant.initial import InitialShape, initial_shape
from plant.model import ArmPlant, PlantParameters
from plant.noise import SensorNoise
from wire.artefact import Arm, GainsArtefact
from wire.errors import UsageError
from wire.run_config import NoiseConfig

Array = npt.NDArray[np.float64]

DISTURBANCE = DisturbanceSpec("chapter")
"""What the default run has: the chapter's."""
NOISE = NoiseConfig(velocity_y_m_per_s=1e-4, curvature_per_m=1e-3)
"""What the default run has."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """One simulated run; row k is the start of tick k, as in a recording. SI units.

    K ticks were finite; n nodes. Everything is absolute, not a deviation from the setpoint.
    """

    tick_s: float
    faces_m: Array
    """(n + 1,)."""
    energy_weights: Array
    """(n, 4), see `deploy.Deployment`."""
    equilibrium: Array
    """(n, 5): (x_e, u_e) of the setpoint at every node."""
    truth: Array
    """(K, n, 4): (v_x, v_y, e, k) of the plant at the nodes' places."""
    measurements: Array
    """(K, n, 2): what the nodes received, noise, delay and dead sensors included."""
    estimates: Array
    """(K, n, 4)."""
    commands_n_per_m: Array
    """(K, n): what the nodes commanded."""
    applied_n_per_m: Array
    """(K, n): what the plant felt; differs where actuators are dead."""
    tip_m: Array
    """(K, 2)."""
    tip_error_m: Array
    """(K,) distance of the tip from the setpoint's in the artefact; a run's is from the shape that it holds."""
    shapes_m: Array
    """(K, p, 2): positions at the arclengths asked for."""
    plant_state: Array
    """The plant's state at the end, see `ArmPlant.state`."""
    diverged_at: int | None
    """The tick at which a number was not finite any more, where the simulation stopped; None if none."""

    @property
    def times_s(self) -> Array:
        """(K,) start of each tick."""
        return np.arange(len(self.tip_error_m), dtype=np.float64) * self.tick_s


def simulate(
    artefact: GainsArtefact,
    *,
    setpoint: str,
    ticks: int,
    nodes: int = 10,
    tick_s: float = 0.1,
    spacing: str | Sequence[float] = "equispaced",
    plant_arm: Arm | None = None,
    plant_cells: int | None = None,
    initial: str | InitialShape = "chapter",
    disturbance: DisturbanceSpec = DISTURBANCE,
    noise: NoiseConfig = NOISE,
    seed: int = 1,
    delay_ticks: int = 0,
    dead_sensors: Sequence[int] = (),
    dead_actuators: Sequence[int] = (),
    feedback: Array | None = None,
    step: DenseStep | None = None,
    shape_at_m: Sequence[float] = (),
    deployment: Deployment | None = None,
) -> Simulation:
    """Run the deployed observer and controller of a setpoint around the exact plant.

    plant_arm: the arm that moves, if it is not the artefact's; the gains, the model in the observer and the
    holding load stay the artefact's. delay_ticks: the nodes get the measurement of that many ticks ago, and
    the first one until there is such. dead_sensors: nodes whose two sensors give no voltage, so they read
    0 m/s and 0 1/m, absolute and without noise (at a curved setpoint that is not "no deviation").
    dead_actuators: nodes whose load is 0 N/m, the holding load included, while the observer believes the
    command. feedback: (n, 4n), u(k) - u_e = feedback (xh(k) - x_e) flattened node by node, in the place
    of the artefact's controller; zeros leave the holding load. step: another tick altogether in the place of
    the deployed one, with the same inputs and outputs. shape_at_m: arclengths whose positions are
    kept. deployment: of the same artefact, nodes, tick and spacing, if it is there already; saves its time.

    Raises UsageError for a setpoint, node or number that does not exist or fit.
    """
    deployed = deployment or deploy(artefact, nodes, tick_s, spacing)
    n, index = len(deployed.nodes), artefact.setpoint_index(setpoint)
    if ticks < 1 or delay_ticks < 0:
        raise UsageError(
            f"simulation: expected at least 1 tick and a delay of at least 0, got {ticks}, {delay_ticks}"
        )
    working = np.ones((n, 2))
    working[_nodes("dead_sensors", dead_sensors, n)] = 0.0
    acting = np.ones(n)
    acting[_nodes("dead_actuators", dead_actuators, n)] = 0.0
    target = artefact.setpoints[index]
    length = artefact.arm.length_m
    plant = ArmPlant(
        PlantParameters(
            arm=plant_arm or artefact.arm,
            faces_m=tuple(deployed.faces_m.tolist()),
            tick_s=deployed.tick_s,
            initial=initial_shape(initial, target, length) if isinstance(initial, str) else initial,
            disturbance=disturbance,
            cells=plant_cells,
        )
    )
    sensors = SensorNoise(seed, noise.velocity_y_m_per_s, noise.curvature_per_m)
    step = step or deployed.dense[index]
    if feedback is not None:
        step = with_feedback(step, feedback)
    points = np.asarray(shape_at_m, dtype=np.float64)
    truth, measurements = np.empty((ticks, n, 4)), np.empty((ticks, n, 2))
    states, applied = np.empty((ticks, n, 5)), np.empty((ticks, n))
    tip, shapes = np.empty((ticks, 2)), np.empty((ticks, points.size, 2))
    equilibrium = step.out_offset.reshape(n, 5)
    state, sampled = equilibrium.copy(), np.empty((ticks, n, 2))
    done = ticks
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(ticks):
            sampled[k] = (plant.measure() + sensors.sample(k, n)) * working
            measurements[k] = sampled[max(k - delay_ticks, 0)]
            truth[k], tip[k] = plant.truth(), plant.tip()
            if points.size:
                shapes[k] = plant.shape_at(points)
            states[k] = state
            applied[k] = state[:, 4] * acting
            if not (math.isfinite(float(truth[k].sum())) and math.isfinite(float(state.sum()))):
                done = k
                break
            plant.advance(applied[k], k)
            state = step(np.concatenate([state, measurements[k]], axis=1))
    error = tip[:done] - np.asarray(target.tip_m)
    return Simulation(
        tick_s=deployed.tick_s,
        faces_m=deployed.faces_m,
        energy_weights=deployed.energy_weights,
        equilibrium=equilibrium,
        truth=truth[:done],
        measurements=measurements[:done],
        estimates=states[:done, :, :4],
        commands_n_per_m=states[:done, :, 4],
        applied_n_per_m=applied[:done],
        tip_m=tip[:done],
        tip_error_m=np.hypot(error[:, 0], error[:, 1]),
        shapes_m=shapes[:done],
        plant_state=plant.state,
        diverged_at=None if done == ticks else done,
    )


def with_feedback(step: DenseStep, feedback: Array) -> DenseStep:
    """The same observer with another static feedback (n, 4n) of the new estimate, SI units."""
    M = step.M.reshape(-1, 5, step.M.shape[1]).copy()
    n = len(M)
    if feedback.shape != (n, 4 * n):
        raise UsageError(f"feedback: expected shape ({n}, {4 * n}), got {feedback.shape}")
    M[:, 4] = feedback @ M[:, :4].reshape(4 * n, -1)
    return DenseStep(M.reshape(step.M.shape), step.in_offset, step.out_offset)


def _nodes(what: str, indices: Sequence[int], n: int) -> list[int]:
    for i in indices:
        if not 0 <= i < n:
            raise UsageError(f"{what}: expected nodes 0..{n - 1}, got {i}")
    return list(indices)
