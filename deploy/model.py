"""The arm's linear model at a setpoint on the segment grid: what the observer predicts with.

Theory, section 2, in SI units and on the staggered grid of `deploy.grid`:
    v_t = N'/(rho A) - drag v + f/(rho A),   N = EA e t - EI k' n,   e_t = t.v',   k_t = (n.v')'.
The discrete strain-rate operator G gives e_t and k_t; the velocities' rate is minus its adjoint in
the energy inner product, so the conservative part A0 is skew by construction and conserves energy
exactly. Kelvin-Voigt damping (e + tau e_t, k + tau k_t in N) adds -tau G* G to the velocities' rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from deploy.grid import COMMAND_PLACES, MEASURED_STATES, Place, SegmentGrid
from wire.artefact import Arm

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GridModel:
    """x_t = A x + B u, y = C x for the deviation x, flattened node by node as (v_x, v_y, e, k)."""

    A0: Array
    """Conservative part, (4n, 4n): skew in the inner product sum(energy_weights * x * z)."""
    A: Array
    """A0 minus the damping of the velocities: drag and tau G* G, (4n, 4n), 1/s."""
    B: Array
    """Command to rate, (4n, n): direction of the actuator at the outer faces, over rho A."""
    transverse: Array
    """Load per length along y to rate, (4n, n): 1/(rho A) in the rows of v_y. B of a transverse actuator."""
    C: Array
    """Selects (v_y, k) of every node, (2n, 4n)."""
    energy_weights: Array
    """(n, 4), J per unit squared, see `SegmentGrid.energy_weights`."""


def tangent_angle(curvature_per_m: Sequence[float] | Array, s_m: Array, length_m: float) -> Array:
    """theta_e(s) in rad, the integral of the curvature from the root, exact for the series."""
    series = np.asarray(curvature_per_m, dtype=np.float64)
    integral = legendre.legint(series, lbnd=-1.0, scl=1.0) * (0.5 * length_m)
    return np.asarray(legendre.legval(2.0 * s_m / length_m - 1.0, integral), dtype=np.float64)


def strain_rates(grid: SegmentGrid, angle_rad: Array) -> tuple[Array, Array]:
    """The discrete strain-rate operator G: (axial (n, n, 2), curvature (n, n, 2)).

    axial[i, j] . v_j summed over j is e_t of node i, and curvature likewise k_t, for velocities v_j
    (n, 2) at the outer faces and setpoint angles (n,) at the centres. v and the rotation rate
    vanish at the clamped root; the root's curvature is the rotation rate of the first centre over
    half a cell.
    """
    n = grid.nodes
    slope = (np.eye(n) - np.eye(n, k=-1)) / grid.cell_widths_m[:, None]
    tangent = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    normal = np.stack([-np.sin(angle_rad), np.cos(angle_rad)], axis=1)
    bend = (np.eye(n) - np.eye(n, k=-1)) / grid.dual_widths_m(Place.INNER_FACE)[:, None]
    axial = slope[:, :, None] * tangent[:, None, :]
    rotation = slope[:, :, None] * normal[:, None, :]
    return axial, np.einsum("ij,jkc->ikc", bend, rotation)


def make_model(arm: Arm, curvature_per_m: Sequence[float], grid: SegmentGrid) -> GridModel:
    """Discretise the arm, linearised at the setpoint with this curvature series, on the grid."""
    n = grid.nodes
    weights = grid.energy_weights(arm)
    angle = tangent_angle(curvature_per_m, grid.centres_m, grid.length_m)
    axial, curvature = strain_rates(grid, angle)
    blocks = np.zeros((n, 4, n, 4))
    blocks[:, 2, :, :2] = axial
    blocks[:, 3, :, :2] = curvature
    for strain in (2, 3):
        rate = blocks[:, strain, :, :2]  # [node of the strain, node of the velocity, x or y]
        adjoint = rate.transpose(1, 2, 0) * weights[:, strain] / weights[:, :2, None]
        blocks[:, :2, :, strain] = -adjoint
    A0 = blocks.reshape(4 * n, 4 * n)
    A = A0 - np.diag(np.tile([arm.drag_per_s, arm.drag_per_s, 0.0, 0.0], n))
    if arm.kelvin_voigt_s > 0.0:
        velocity = np.flatnonzero(np.tile([True, True, False, False], n))
        A[np.ix_(velocity, velocity)] += arm.kelvin_voigt_s * (A0 @ A0)[np.ix_(velocity, velocity)]
    transverse = np.zeros((4 * n, n))
    transverse[1::4] = np.eye(n) / arm.mass_per_length_kg_per_m
    B = transverse
    if arm.actuator == "normal":
        turn = tangent_angle(curvature_per_m, grid.locations_m(COMMAND_PLACES[0]), grid.length_m)
        B = np.zeros((4 * n, n))
        B[0::4] = np.diag(-np.sin(turn)) / arm.mass_per_length_kg_per_m
        B[1::4] = np.diag(np.cos(turn)) / arm.mass_per_length_kg_per_m
    C = np.zeros((2 * n, 4 * n))
    for row, component in enumerate(MEASURED_STATES):
        C[row::2, component::4] = np.eye(n)
    return GridModel(A0=A0, A=A, B=B, transverse=transverse, C=C, energy_weights=weights)
