"""Verification of finished gains by something that shares no code with the LPI (theory, section 3).

The gains as they will be written, in SI units and with their truncated ranks, are put on staggered
finite-difference grids (the room `deploy`) much finer than any run, and there the closed loop's eigenvalues
and H-infinity norm are computed, with refinement; and, for comparison, the norm without the gain and the best
value any gain could reach (Riccati).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy.grid import COMMAND_PLACES, MEASUREMENT_PLACES, STATE_PLACES, make_grid
from deploy.step import make_loop
from design.arm_file import time_unit_s
from design.channel import Channel, riccati_optimum
from wire.artefact import SENSOR_SETS, Arm, Setpoint

Array = npt.NDArray[np.float64]

GRIDS = (40, 80)
"""Segments of the two grids; the norms at both give the extrapolated value (second order)."""
RESOLVED_RAD_PER_S = 20.0
"""Modes faster than this are the grid's, not the arm's: no tick turns them, and the decay of the fastest axial
ones depends on the grid alone and tends to half the drag."""
RICCATI_GRID = 32
"""The optimum changes by less than 1.3 % beyond (0.1 % but for the controller at the most bent setpoint)."""


@dataclass(frozen=True)
class Achieved:
    """Figures of one gain on the finite-difference grids, nondimensional but for the decay."""

    gamma: float
    gamma_by_grid: tuple[float, ...]
    open_loop_gamma: float
    optimum_gamma: float
    decay_per_s: float
    """Of the modes up to `RESOLVED_RAD_PER_S`; infinite gamma says that a mode grows."""


@dataclass(frozen=True)
class ArmMatrices:
    """The arm with its gains in nondimensional coordinates in which all norms are Euclidean."""

    A: Array
    disturbance: Array
    force: Array
    outputs: Array
    measure: Array
    L: Array
    K: Array


def arm_matrices(
    arm: Arm, setpoint: Setpoint, nodes: int, spacing: str | Sequence[float] = "equispaced"
) -> ArmMatrices:
    """Arm and gains of a setpoint on the segment grid of `deploy.make_grid`."""
    grid = make_grid(arm.length_m, nodes, spacing)
    loop = make_loop(arm, setpoint, grid)
    length, time = arm.length_m, time_unit_s(arm)
    load = arm.bending_stiffness_n_m2 / length**3
    # units of (v_x, v_y, e, k), and share of the arm that each grid value stands for
    unit = np.tile([length / time, length / time, 1.0 / np.sqrt(_alpha2(arm)), 1.0 / length], nodes)
    share = np.stack([grid.dual_widths_m(p) for p in STATE_PLACES], axis=1).ravel() / length
    scale = np.sqrt(share) / unit
    y_unit = np.tile([length / time, 1.0 / length], nodes)
    y_share = np.stack([grid.dual_widths_m(p) for p in MEASUREMENT_PLACES], axis=1).ravel() / length
    y_scale = np.sqrt(y_share) / y_unit
    u_share = grid.dual_widths_m(COMMAND_PLACES[0]) / length
    u_share[0] += grid.centres_m[0] / length  # the arm carries the first command from the clamp on
    u_scale = np.sqrt(u_share) / load
    outputs = np.zeros((2, 4 * nodes))
    outputs[0, 1::4] = np.sqrt(share[1::4])
    outputs[1, 3::4] = np.sqrt(share[3::4])
    force = time * scale[:, None] * loop.model.B / u_scale
    transverse = time * scale[:, None] * loop.model.transverse / u_scale
    sensors = measured_rows(arm, nodes)
    return ArmMatrices(
        A=time * scale[:, None] * loop.model.A / scale,
        disturbance=transverse @ np.sqrt(u_share)[:, None],
        force=force,
        outputs=outputs,
        measure=(y_scale[:, None] * loop.model.C / scale)[sensors],
        L=(time * scale[:, None] * loop.L / y_scale)[:, sensors],
        K=u_scale[:, None] * loop.K / scale,
    )


def measured_rows(arm: Arm, nodes: int) -> npt.NDArray[np.bool_]:
    """Which of the 2n rows (v_y, k) of C, and columns of L, the arm has sensors for, shape (2n,), bool."""
    return np.tile([name in arm.measured for name in SENSOR_SETS[0]], nodes)


def _alpha2(arm: Arm) -> float:
    return arm.axial_stiffness_n * arm.length_m**2 / arm.bending_stiffness_n_m2


def observer_channel(plant: ArmMatrices, noise: float, *, closed: bool = True) -> Channel:
    """Error e = xh - x: e_t = (A + L C) e - B w - rho L w_y, z = C1 e (chapter (17))."""
    if not closed:
        return Channel(plant.A, plant.disturbance, plant.outputs, np.zeros((2, 1)))
    B = np.hstack([-plant.disturbance, -noise * plant.L])
    return Channel(plant.A + plant.L @ plant.measure, B, plant.outputs, np.zeros((2, B.shape[1])))


def controller_channel(plant: ArmMatrices, effort: float, *, closed: bool = True) -> Channel:
    """x_t = (A + B2 K) x + B w, z = (C1 x, effort K x) (chapter (20))."""
    if not closed:
        return Channel(plant.A, plant.disturbance, plant.outputs, np.zeros((2, 1)))
    C = np.vstack([plant.outputs, effort * plant.K])
    return Channel(plant.A + plant.force @ plant.K, plant.disturbance, C, np.zeros((len(C), 1)))


def observer_optimum(arm: Arm, setpoint: Setpoint, noise: float) -> float:
    """Norm of the error that no observer of this arm can be below, on the grid of `RICCATI_GRID` segments."""
    plant = arm_matrices(arm, setpoint, RICCATI_GRID)
    return riccati_optimum(plant.A.T, plant.outputs.T, plant.disturbance.T, plant.measure.T, noise)


def controller_optimum(arm: Arm, setpoint: Setpoint, effort: float) -> float:
    """Norm that no state feedback can be below, on the grid of `RICCATI_GRID` segments."""
    plant = arm_matrices(arm, setpoint, RICCATI_GRID)
    return riccati_optimum(plant.A, plant.disturbance, plant.outputs, plant.force, effort)


def verify_observer(
    arm: Arm, setpoint: Setpoint, noise: float, optimum: float | None = None
) -> Achieved:
    """Figures of the observer gain of a setpoint; `noise` is the weight of the measurement noise.

    optimum: that of `observer_optimum` where it is known already, computed if not.
    """
    if optimum is None:
        optimum = observer_optimum(arm, setpoint, noise)
    return _verify(
        arm, setpoint, lambda p, closed: observer_channel(p, noise, closed=closed), optimum
    )


def verify_controller(
    arm: Arm, setpoint: Setpoint, effort: float, optimum: float | None = None
) -> Achieved:
    """Figures of the state-feedback gain of a setpoint; `effort` weighs the command in z.

    optimum: that of `controller_optimum` where it is known already, computed if not.
    """
    if optimum is None:
        optimum = controller_optimum(arm, setpoint, effort)
    return _verify(
        arm, setpoint, lambda p, closed: controller_channel(p, effort, closed=closed), optimum
    )


def _verify(
    arm: Arm,
    setpoint: Setpoint,
    channel: Callable[[ArmMatrices, bool], Channel],
    optimum: float,
) -> Achieved:
    plants = [arm_matrices(arm, setpoint, nodes) for nodes in GRIDS]
    closed = [channel(p, True) for p in plants]
    norms = [c.hinf_norm() for c in closed]
    extrapolated = norms[1] + (norms[1] - norms[0]) / 3.0
    time = time_unit_s(arm)
    return Achieved(
        gamma=max(norms[1], extrapolated),
        gamma_by_grid=tuple(norms),
        open_loop_gamma=channel(plants[0], False).hinf_norm(),
        optimum_gamma=optimum,
        decay_per_s=min(c.decay(RESOLVED_RAD_PER_S * time) for c in closed) / time,
    )
