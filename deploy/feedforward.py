"""The load that holds a setpoint, as commands of the segments.

The arm carries the load that is linear between the segments' commands and constant from the root to the first
outer face. The commands are the L2 projection of the setpoint's load onto these profiles: then the difference
has no moment against any of them, and the held shape is closer to the setpoint's by an order or two than with
samples of the load.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from deploy.grid import SegmentGrid

Array = npt.NDArray[np.float64]
GAUSS = 8
"""Quadrature points a segment; exact for the products of a hat and a series of degree 14."""


def profiles(grid: SegmentGrid, s_m: Array) -> Array:
    """Load profiles (points, n) of unit commands at arclengths s_m: what the arm carries for u_i = 1."""
    faces = grid.faces_m[1:]
    return np.stack([np.interp(s_m, faces, row) for row in np.eye(grid.nodes)], axis=1)


def holding_commands(series_n_per_m: Sequence[float], grid: SegmentGrid) -> Array:
    """Commands (n,) in N/m whose load is nearest in L2 to the Legendre series f_e(s) (theory, section 5)."""
    x, w = legendre.leggauss(GAUSS)
    widths = grid.cell_widths_m
    points = (grid.faces_m[:-1, None] + 0.5 * widths[:, None] * (x + 1.0)).ravel()
    weights = (0.5 * widths[:, None] * w).ravel()
    hats = profiles(grid, points)
    load = legendre.legval(2.0 * points / grid.length_m - 1.0, np.asarray(series_n_per_m))
    return np.asarray(np.linalg.solve(hats.T * weights @ hats, hats.T @ (weights * load)))
