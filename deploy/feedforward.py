"""The load that holds a setpoint, as commands of the segments.

The arm carries the load that is linear between the segments' commands and constant from the root to the first
outer face. `holding_commands` is the L2 projection of the setpoint's load onto these profiles: then the
difference has no moment against any of them, and the held shape is closer to the setpoint's by an order or two
than with samples of the load. `holding` projects the bending moment instead, which is what bends the arm: it
holds strongly bent shapes closer by another order, and says how the held shape differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from deploy.grid import SegmentGrid
from deploy.model import tangent_angle
from wire.artefact import Arm

Array = npt.NDArray[np.float64]
GAUSS = 8
"""Quadrature points a segment; exact for the products of a hat and a series of degree 14."""


def profiles(grid: SegmentGrid, s_m: Array) -> Array:
    """Load profiles (points, n) of unit commands at arclengths s_m: what the arm carries for u_i = 1."""
    faces = grid.faces_m[1:]
    return np.stack([np.interp(s_m, faces, row) for row in np.eye(grid.nodes)], axis=1)


def projection(grid: SegmentGrid, modes: int) -> Array:
    """Matrix (n, modes): commands whose load is nearest in L2 to each Legendre function of 2 s / L - 1."""
    x, w = legendre.leggauss(GAUSS)
    widths = grid.cell_widths_m
    points = (grid.faces_m[:-1, None] + 0.5 * widths[:, None] * (x + 1.0)).ravel()
    weights = (0.5 * widths[:, None] * w).ravel()
    hats = profiles(grid, points)
    waves = legendre.legvander(2.0 * points / grid.length_m - 1.0, modes - 1)
    return np.asarray(np.linalg.solve(hats.T * weights @ hats, hats.T @ (weights[:, None] * waves)))


def holding_commands(series_n_per_m: Sequence[float] | Array, grid: SegmentGrid) -> Array:
    """Commands (n,) in N/m whose load is nearest in L2 to the Legendre series f_e(s) (theory, section 5)."""
    series = np.asarray(series_n_per_m, dtype=np.float64)
    return np.asarray(projection(grid, len(series)) @ series)


@dataclass(frozen=True, eq=False)
class Holding:
    """The commands that hold a shape, and the shape that they hold."""

    commands_n_per_m: Array
    """(n,)."""
    curvature_change_per_m: Array
    """(n,): curvature held at the inner faces minus the shape's, to first order. A reference with it agrees
    with the sensors at rest, so that observer and controller do not push the arm away again."""


def holding(
    arm: Arm,
    curvature_per_m: Sequence[float] | Array,
    strain: Sequence[float] | Array,
    load_n_per_m: Sequence[float] | Array,
    grid: SegmentGrid,
) -> Holding:
    """Commands whose bending moment is nearest in L2 to that of the shape's own load.

    Curvature, strain and load are Legendre series in 2 s / L - 1 of an exact equilibrium. In its
    configuration a load u along d (y, or the normal n of the shape: `Arm.actuator`) bends by
    EI k' = -(1 + e) n.int_s^L u d, k(L) = 0 (theory, section 5).
    """
    x, w = legendre.leggauss(GAUSS)
    degree, faces, half = np.arange(GAUSS), grid.faces_m, 0.5 * grid.cell_widths_m
    points = (faces[:-1, None] + half[:, None] * (x + 1.0)).ravel()
    weights = (half[:, None] * w).ravel()
    # int_s^L at the points: whole segments behind, and the rest of the own one
    higher = legendre.legvander(x, GAUSS)
    integrals = np.hstack(
        [(1.0 + x)[:, None], (higher[:, 2:] - higher[:, :-2]) / (2.0 * degree[1:] + 1.0)]
    )
    own = w - integrals @ ((degree + 0.5) * higher[:, :-1] * w[:, None]).T
    segment = np.repeat(np.arange(grid.nodes), GAUSS)
    to_tip = (segment > segment[:, None]) * weights + np.kron(np.diag(half), own)
    faces_to_tip = (segment >= np.arange(grid.nodes)[:, None]) * weights

    angle = tangent_angle(curvature_per_m, points, grid.length_m)
    # d.n(s) of a load at another point: n turns with s, d = y = n(0) or d = n there
    turned = angle[:, None] - (angle if arm.actuator == "normal" else 0.0)
    stretch = 1.0 + _series(strain, points, grid)
    slope = stretch[:, None] * np.cos(turned) * to_tip
    load, profile = _series(load_n_per_m, points, grid), profiles(grid, points)
    root = np.sqrt(weights)
    moment = root[:, None] * (to_tip @ slope)
    # columns of one size: short segments would else be lost in the rounding of long ones
    columns = moment @ profile
    size = np.linalg.norm(columns, axis=0)
    commands = np.linalg.lstsq(columns / size, moment @ load, rcond=None)[0] / size
    change = faces_to_tip @ (slope @ (profile @ commands - load)) / arm.bending_stiffness_n_m2
    return Holding(commands, change)


def _series(coefficients: Sequence[float] | Array, s_m: Array, grid: SegmentGrid) -> Array:
    scaled = 2.0 * s_m / grid.length_m - 1.0
    return np.asarray(legendre.legval(scaled, np.asarray(coefficients, dtype=np.float64)))
