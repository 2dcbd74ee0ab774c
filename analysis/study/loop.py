"""The whole loop as a linear map over one tick, around the exact arm where it comes to rest.

Between `plant.model`, which is differentiated, and the studies: stability is the spectral radius of this map,
performance its H-infinity norm. It sees what the design leaves out: tension and strain of the held shape, the
finer grid, the tick, the delay, what is broken.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy import DenseStep, Deployment, Place, SegmentGrid
from deploy.arm import make_arm_modes, sample
from design.arm_file import time_unit_s
from design.channel import Channel
from plant.disturbance import NO_DISTURBANCE, DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import Arm, GainsArtefact, Setpoint
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

STEP = 1e-6
"""Central differences: of positions in m and velocities in m/s."""
LOAD_STEP = 1e-5
"""Of commands and loads in N/m."""
SETTLED_M = 1e-9
"""The search for the place of rest ends when it moves the arm by less."""
MOST_SEARCHES = 12
GROWTH_PER_S = 1e-4
"""Growth up to this rate is that of a loop that hardly moves, as in `deploy.stability`."""


@dataclass(frozen=True)
class Case:
    """How the loop differs from the one that the gains were made for."""

    name: str = "nominal"
    plant_arm: Arm | None = None
    """The arm that moves; None is the artefact's."""
    delay_ticks: int = 0
    dead_sensors: tuple[int, ...] = ()
    dead_actuators: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class SampledArm:
    """An arm over one tick with held commands: x(k+1) = transition x + force u + load w, SI deviations."""

    transition: Array
    """(m, m)."""
    force: Array
    """(m, n): of the commands in N/m."""
    load: Array
    """(m, 1): of a uniform transverse load in N/m, held over the tick."""
    truth: Array
    """(4n, m): (v_x, v_y, e, k) at the nodes' places, node by node."""

    @property
    def sense(self) -> Array:
        """(2n, m): (v_y, k) of every node."""
        nodes = self.force.shape[1]
        return self.truth.reshape(nodes, 4, -1)[:, [1, 3]].reshape(2 * nodes, -1)


@dataclass(frozen=True, eq=False)
class Rest:
    """Where the loop comes to rest without noise and disturbance."""

    plant_state: Array
    """(m,), see `ArmPlant.state`."""
    node_state: Array
    """(5n,): estimates and commands, absolute."""
    tip_m: Array
    """(2,)."""
    arm: SampledArm
    """Linearised there."""


def exact_arm(parameters: PlantParameters, state: Array, command: Array) -> SampledArm:
    """Differentiate one tick of the exact plant at a state (m,) under a command (n,)."""
    quiet, up, down = (
        ArmPlant(dataclasses.replace(parameters, disturbance=disturbance))
        for disturbance in (
            NO_DISTURBANCE,
            DisturbanceSpec("step", LOAD_STEP),
            DisturbanceSpec("step", -LOAD_STEP),
        )
    )

    def seen(x: Array) -> Array:
        quiet.state = x
        return quiet.truth().ravel()

    def moved(x: Array, u: Array, plant: ArmPlant = quiet) -> Array:
        plant.state = x
        plant.advance(u, 0)
        return plant.state

    states = STEP * np.eye(len(state))
    loads = LOAD_STEP * np.eye(len(command))
    return SampledArm(
        transition=_columns([moved(state + d, command) - moved(state - d, command) for d in states])
        / (2.0 * STEP),
        force=_columns([moved(state, command + d) - moved(state, command - d) for d in loads])
        / (2.0 * LOAD_STEP),
        load=_columns([moved(state, command, up) - moved(state, command, down)])
        / (2.0 * LOAD_STEP),
        truth=_columns([seen(state + d) - seen(state - d) for d in states]) / (2.0 * STEP),
    )


def _columns(vectors: list[Array]) -> Array:
    return np.stack(vectors, axis=1)


def find_rest(
    deployment: Deployment,
    step: DenseStep,
    setpoint: Setpoint,
    arm: Arm,
    case: Case,
    plant_cells: int | None = None,
    guess: tuple[Array, Array] | None = None,
) -> Rest | None:
    """Newton's method on "one tick changes nothing"; None if that finds no place.

    arm: the artefact's; the one of the case moves. guess: states (m,) of the plant and (5n,) of the nodes to
    begin from, in the place of the setpoint's. A delay does not matter here.
    """
    n = len(deployment.nodes)
    parameters = PlantParameters(
        arm=case.plant_arm or arm,
        faces_m=tuple(deployment.faces_m.tolist()),
        tick_s=deployment.tick_s,
        initial=initial_shape("setpoint", setpoint, arm.length_m),
        cells=plant_cells,
    )
    plant = ArmPlant(parameters)
    sensors, actuators = masks(case, n)
    x, s = guess or (plant.state, step.out_offset)
    still = dataclasses.replace(case, delay_ticks=0)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_SEARCHES):
            command = s[4::5] * actuators
            linear = exact_arm(parameters, x, command)
            plant.state = x
            y = plant.measure() * sensors
            plant.advance(command, 0)
            ahead = step(np.concatenate([s.reshape(n, 5), y], axis=1)).ravel()
            residual = np.concatenate([plant.state - x, ahead - s])
            matrix = closed_loop(linear, step, still)
            if not (np.isfinite(matrix).all() and np.isfinite(residual).all()):
                return None
            change = np.linalg.solve(np.eye(len(matrix)) - matrix, residual)
            x, s = x + change[: len(x)], s + change[len(x) :]
            largest = float(np.max(np.abs(change[: len(x) // 2])))
            if largest < SETTLED_M:
                plant.state = x
                return Rest(x, s, plant.tip(), linear)
            if largest > 10.0 * arm.length_m:
                return None
    return None


def masks(case: Case, nodes: int) -> tuple[Array, Array]:
    """What works: of the sensors (n, 2) and of the actuators (n,), 1 or 0."""
    sensors, actuators = np.ones((nodes, 2)), np.ones(nodes)
    sensors[list(case.dead_sensors)] = 0.0
    actuators[list(case.dead_actuators)] = 0.0
    return sensors, actuators


def linear_arm(arm: Arm, setpoint: Setpoint, deployment: Deployment) -> SampledArm:
    """The design's linear arm on a finer grid, exact in time (`deploy.arm`); only for the radius."""
    grid = SegmentGrid(deployment.faces_m)
    modes = make_arm_modes(arm, setpoint.curvature_per_m, grid)
    transition, force, sense = sample(modes, deployment.tick_s)
    truth = np.zeros((grid.nodes, 4, len(transition)))
    truth[:, [1, 3]] = sense.reshape(grid.nodes, 2, -1)
    load = np.zeros((len(transition), 1))
    return SampledArm(transition, force, load, truth.reshape(4 * grid.nodes, -1))


def closed_loop(arm: SampledArm, step: DenseStep, case: Case) -> Array:
    """One tick of (arm, estimates and commands of the nodes, measurements under way), square."""
    n, m = arm.force.shape[1], len(arm.transition)
    sensors, actuators = masks(case, n)
    own, measured = _split(step, n)
    sense = sensors.reshape(2 * n, 1) * arm.sense
    size = m + 5 * n + 2 * n * case.delay_ticks
    out = np.zeros((size, size))
    out[:m, :m] = arm.transition
    out[:m, m + 4 : m + 5 * n : 5] = arm.force * actuators
    out[m : m + 5 * n, m : m + 5 * n] = own
    queue = m + 5 * n
    if case.delay_ticks == 0:
        out[m:queue, :m] = measured @ sense
        return out
    out[queue : queue + 2 * n, :m] = sense
    for first in range(queue + 2 * n, size, 2 * n):
        out[first : first + 2 * n, first - 2 * n : first] = np.eye(2 * n)
    out[m:queue, size - 2 * n :] = measured
    return out


def _split(step: DenseStep, n: int) -> tuple[Array, Array]:
    """The step's matrix by its inputs: (xh, u) and y."""
    M = step.M.reshape(5 * n, n, 7)
    return M[:, :, :5].reshape(5 * n, 5 * n), M[:, :, 5:].reshape(5 * n, 2 * n)


def radius(matrix: Array) -> float:
    """Spectral radius."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def decay_per_s(spectral_radius: float, tick_s: float) -> float:
    """Rate of the slowest mode; negative if it grows."""
    return -math.log(spectral_radius) / tick_s


def design_weights(artefact: GainsArtefact) -> tuple[float, float]:
    """Of measurement noise and control effort; UsageError if the artefact does not say."""
    keys = ("measurement_noise", "control_effort")
    for key in keys:
        if key not in artefact.weights:
            raise UsageError(
                f"gains artefact: expected the design's weight {key!r}, got {', '.join(artefact.weights)}; "
                "make the gains with `octarm design`"
            )
    noise, effort = (artefact.weights[key] for key in keys)
    return noise, effort


def chosen_setpoints(artefact: GainsArtefact, names: Sequence[str]) -> list[str]:
    """The names, or all of the artefact's if there are none; UsageError for one that does not exist."""
    chosen = list(names) or [setpoint.name for setpoint in artefact.setpoints]
    for name in chosen:
        artefact.setpoint_index(name)
    return chosen


def loop_channel(
    arm: SampledArm,
    step: DenseStep,
    case: Case,
    deployment: Deployment,
    nominal: Arm,
    noise: float,
    effort: float,
) -> Channel:
    """From (uniform load, noise x measurement noise) to (mean v_y, mean k, effort x command).

    Nondimensional, as in the design's two problems (theory, section 3), but of the loop that runs: both gains
    together, sampled. The bilinear transform makes it a continuous system with the same norm.
    """
    n, m = arm.force.shape[1], len(arm.transition)
    grid = SegmentGrid(deployment.faces_m)
    length, time = nominal.length_m, time_unit_s(nominal)
    unit_load = nominal.bending_stiffness_n_m2 / length**3
    matrix = closed_loop(arm, step, case)
    size = len(matrix)
    y_unit = np.array([length / time, 1.0 / length])
    share = np.stack(
        [grid.dual_widths_m(Place.OUTER_FACE), grid.dual_widths_m(Place.INNER_FACE)], axis=1
    )
    share /= length
    sensors, _ = masks(case, n)
    per_noise = np.diag((noise * sensors * y_unit / np.sqrt(share)).ravel())
    B = np.zeros((size, 1 + 2 * n))
    B[:m, :1] = unit_load * arm.load
    if case.delay_ticks == 0:
        B[m : m + 5 * n, 1:] = _split(step, n)[1] @ per_noise
    else:
        B[m + 5 * n : m + 7 * n, 1:] = per_noise
    C = np.zeros((2 + n, size))
    truth = arm.truth.reshape(n, 4, m)
    C[0, :m] = share[:, 0] @ truth[:, 1] / y_unit[0]
    C[1, :m] = share[:, 1] @ truth[:, 3] / y_unit[1]
    loaded = share[:, 0].copy()
    loaded[0] += grid.centres_m[0] / length  # the arm carries the first command from the clamp on
    C[2:, m + 4 : m + 5 * n : 5] = np.diag(effort * np.sqrt(loaded) / unit_load)
    return bilinear(matrix, B, C, 2.0 * time / deployment.tick_s)


def bilinear(A: Array, B: Array, C: Array, rate: float) -> Channel:
    """x(k+1) = A x + B w, z = C x as a continuous system of the same norm: z = (rate + s) / (rate - s)."""
    identity = np.eye(len(A))
    half = np.linalg.solve(A + identity, np.hstack([A - identity, B]))
    rates, entry = half[:, : len(A)], half[:, len(A) :]
    exit_ = np.linalg.solve((A + identity).T, C.T).T
    return Channel(
        *(np.asarray(part) for part in (rate * rates, rate * entry, 2.0 * exit_, -C @ entry))
    )
