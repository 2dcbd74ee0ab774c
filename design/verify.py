"""Verification of finished gains by something that shares no code with the LPI (theory, section 3).

The gains as they will be written, in SI units and with their truncated ranks, are put on staggered
finite-difference grids (the room `deploy`) much finer than any run, and there the closed loop's eigenvalues
and H-infinity norm are computed, with refinement; and, for comparison, the norm without the gain and the best
value any gain could reach (Riccati).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import linalg
from scipy.optimize import minimize_scalar

from deploy.grid import COMMAND_PLACES, MEASUREMENT_PLACES, STATE_PLACES, make_grid
from deploy.step import make_loop
from design.arm_file import time_unit_s
from wire.artefact import Arm, Setpoint

Array = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

GRIDS = (40, 80)
"""Segments of the two grids; the norms at both give the extrapolated value (second order)."""
RICCATI_GRID = 16
_ON_THE_AXIS = 1e-12
"""Real parts below this share of the largest eigenvalue are rounding: such a mode does not decay."""
PEAKS = 5
"""Local maxima of the sweep that are refined, the highest ones."""
FREQUENCIES = np.concatenate([[0.0], np.geomspace(1e-2, 1e3, 120)])


@dataclass(frozen=True)
class Channel:
    """x_t = A x + B w, z = C x + D w, nondimensional and in coordinates where norms are Euclidean."""

    A: Array
    B: Array
    C: Array
    D: Array

    @cached_property
    def _schur(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Triangular T, and input and output matrix in its coordinates: a frequency costs one sweep."""
        T, Q = linalg.schur(self.A.astype(np.complex128), output="complex")
        return T, Q.conj().T @ self.B, self.C @ Q

    def norm_at(self, omega: float) -> float:
        """Largest singular value of the transfer function at i omega."""
        T, B, C = self._schur
        shifted = 1j * omega * np.eye(len(T)) - T
        response = C @ linalg.solve_triangular(shifted, B, check_finite=False) + self.D
        return float(np.linalg.norm(response, 2))

    def hinf_norm(self) -> float:
        """H-infinity norm by a sweep over frequencies and a refinement at the highest peaks.

        The sweep visits the frequency of every eigenvalue and the flanks of its resonance, so that no
        peak is too narrow for it. Infinite unless all modes of A decay: the sweep would otherwise return
        a finite number.
        """
        if self.decay() <= 0.0:
            return float("inf")
        poles = np.diag(self._schur[0])
        resonances = [np.abs(poles.imag) + k * np.abs(poles.real) for k in (-1.0, 0.0, 1.0)]
        sweep = np.unique(np.concatenate([FREQUENCIES, *resonances]).clip(0.0))
        sweep = sweep[np.append(True, np.diff(sweep) > 1e-8 * sweep[1:])]  # equal but for rounding
        values = np.array([self.norm_at(w) for w in sweep])
        padded = np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]))
        best = float(values.max())
        for k in peaks[np.argsort(values[peaks])[-PEAKS:]]:
            low, high = sweep[max(k - 1, 0)], sweep[min(k + 1, len(sweep) - 1)]
            found = minimize_scalar(
                lambda w: -self.norm_at(w),
                bounds=(low, high),
                method="bounded",
                options={"xatol": 1e-6 * high},
            )
            best = max(best, -float(found.fun))
        return best

    def decay(self) -> float:
        """Minus the largest real part of the eigenvalues of A; zero where it is no more than rounding."""
        values = np.diag(self._schur[0])
        slowest = -float(values.real.max())
        return slowest if abs(slowest) > _ON_THE_AXIS * np.abs(values).max() else 0.0


@dataclass(frozen=True)
class Achieved:
    """Figures of one gain on the finite-difference grids, nondimensional but for the decay."""

    gamma: float
    gamma_by_grid: tuple[float, ...]
    open_loop_gamma: float
    optimum_gamma: float
    decay_per_s: float


@dataclass(frozen=True)
class _Plant:
    """The arm on one grid in nondimensional Euclidean coordinates."""

    A: Array
    disturbance: Array
    force: Array
    outputs: Array
    measure: Array
    L: Array
    K: Array


def _plant(arm: Arm, setpoint: Setpoint, nodes: int) -> _Plant:
    grid = make_grid(arm.length_m, nodes, "equispaced")
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
    u_scale = np.sqrt(u_share) / load
    outputs = np.zeros((2, 4 * nodes))
    outputs[0, 1::4] = np.sqrt(share[1::4])
    outputs[1, 3::4] = np.sqrt(share[3::4])
    force = time * scale[:, None] * loop.model.B / u_scale
    return _Plant(
        A=time * scale[:, None] * loop.model.A / scale,
        disturbance=force @ np.sqrt(u_share)[:, None],
        force=force,
        outputs=outputs,
        measure=y_scale[:, None] * loop.model.C / scale,
        L=time * scale[:, None] * loop.L / y_scale,
        K=u_scale[:, None] * loop.K / scale,
    )


def _alpha2(arm: Arm) -> float:
    return arm.axial_stiffness_n * arm.length_m**2 / arm.bending_stiffness_n_m2


def observer_channel(plant: _Plant, noise: float, *, closed: bool = True) -> Channel:
    """Error e = xh - x: e_t = (A + L C) e - B w - rho L w_y, z = C1 e (chapter (17))."""
    if not closed:
        return Channel(plant.A, plant.disturbance, plant.outputs, np.zeros((2, 1)))
    B = np.hstack([-plant.disturbance, -noise * plant.L])
    return Channel(plant.A + plant.L @ plant.measure, B, plant.outputs, np.zeros((2, B.shape[1])))


def controller_channel(plant: _Plant, effort: float, *, closed: bool = True) -> Channel:
    """x_t = (A + B2 K) x + B w, z = (C1 x, effort K x) (chapter (20))."""
    if not closed:
        return Channel(plant.A, plant.disturbance, plant.outputs, np.zeros((2, 1)))
    C = np.vstack([plant.outputs, effort * plant.K])
    return Channel(plant.A + plant.force @ plant.K, plant.disturbance, C, np.zeros((len(C), 1)))


def verify_observer(arm: Arm, setpoint: Setpoint, noise: float) -> Achieved:
    """Figures of the observer gain of a setpoint; `noise` is the weight of the measurement noise."""

    def optimum(plant: _Plant) -> float:
        return riccati_optimum(
            plant.A.T, plant.outputs.T, plant.disturbance.T, plant.measure.T, noise
        )

    return _verify(
        arm, setpoint, lambda p, closed: observer_channel(p, noise, closed=closed), optimum
    )


def verify_controller(arm: Arm, setpoint: Setpoint, effort: float) -> Achieved:
    """Figures of the state-feedback gain of a setpoint; `effort` weighs the command in z."""

    def optimum(plant: _Plant) -> float:
        return riccati_optimum(plant.A, plant.disturbance, plant.outputs, plant.force, effort)

    return _verify(
        arm, setpoint, lambda p, closed: controller_channel(p, effort, closed=closed), optimum
    )


def _verify(
    arm: Arm,
    setpoint: Setpoint,
    channel: Callable[[_Plant, bool], Channel],
    optimum: Callable[[_Plant], float],
) -> Achieved:
    plants = [_plant(arm, setpoint, nodes) for nodes in GRIDS]
    closed = [channel(p, True) for p in plants]
    norms = [c.hinf_norm() for c in closed]
    extrapolated = norms[1] + (norms[1] - norms[0]) / 3.0
    return Achieved(
        gamma=max(norms[1], extrapolated),
        gamma_by_grid=tuple(norms),
        open_loop_gamma=channel(plants[0], False).hinf_norm(),
        optimum_gamma=optimum(_plant(arm, setpoint, RICCATI_GRID)),
        decay_per_s=min(c.decay() for c in closed) / time_unit_s(arm),
    )


def riccati_optimum(A: Array, B1: Array, C1: Array, B2: Array, effort: float) -> float:
    """Infimum of gamma for x_t = A x + B1 w + B2 u, z = (C1 x, effort u), by bisection to 1e-4 relative.

    A gamma is reachable by state feedback iff the game Riccati equation has a stabilising X >= 0.
    """
    low, high = 0.0, 1.0
    while not _reachable(A, B1, C1, B2, effort, high):
        low, high = high, 2.0 * high
        if high > 1e6:
            return float("inf")
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _reachable(A, B1, C1, B2, effort, middle) else (middle, high)
    return high


def _reachable(A: Array, B1: Array, C1: Array, B2: Array, effort: float, gamma: float) -> bool:
    n = len(A)
    drive, force, cost = B1 @ B1.T / gamma**2, B2 @ B2.T / effort**2, C1.T @ C1
    size = np.linalg.norm(drive) + np.linalg.norm(force)
    scale = np.sqrt(np.linalg.norm(cost) / size) if size > 0.0 and np.any(cost) else 1.0
    # the solution is scaled so that the blocks are of one size
    hamiltonian = np.block([[A, scale * (drive - force)], [-cost / scale, -A.T]])
    values = np.linalg.eigvals(hamiltonian)
    if np.min(np.abs(values.real)) < _ON_THE_AXIS * np.max(np.abs(values)):
        return False
    _, vectors, stable = linalg.schur(hamiltonian, output="real", sort="lhp")
    if stable != n:
        return False
    upper, lower = vectors[:n, :n], vectors[n:, :n]
    if np.linalg.cond(upper) > 1e14:
        return False
    solution = np.linalg.solve(upper.T, lower.T).T
    eigenvalues = np.linalg.eigvalsh(0.5 * (solution + solution.T))
    return bool(eigenvalues[0] >= -1e-8 * max(abs(eigenvalues[-1]), 1e-300))
