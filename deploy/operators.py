"""Gain operators to matrices on the segment grid: quadrature of 3-PI operators with separable
kernels (6).

The rule, second order in the segment length. Every value of the input stands for its dual cell (see
`SegmentGrid.dual_cells_m`). The part of the dual cell on the root's side of the output's location
is weighted with the kernel N1, the part on the tip's side with N2, both taken at the two locations;
so a tie (both at one inner face) gives about the average of N1 and N2, and at root and tip the
one-sided value.

The multiplier N0 is taken at the output's location and applied to the input brought there: the
neighbour's value if it has one at that place, the mean or linear interpolation of the two beside it
otherwise. At the ends of the arm the boundary values v(0) = 0, e(L) = 0, k(L) = 0 (clamped root,
free tip) are used; e(0) is extrapolated from the two first segments.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from deploy.grid import Place, SegmentGrid
from wire.artefact import OperatorFactors, PolynomialMatrix

Array = npt.NDArray[np.float64]


def interpolation(grid: SegmentGrid, to: Place, source: Place) -> Array:
    """Matrix (n, n) that brings node values at places `source` to places `to`, second order."""
    n = grid.nodes
    if to is source:
        return np.eye(n)
    points = grid.locations_m(source)
    values = np.eye(n)
    if source is Place.OUTER_FACE:  # v(0) = 0
        points = np.append(0.0, points)
        values = np.vstack([np.zeros(n), values])
    else:  # e(L) = 0, k(L) = 0
        points = np.append(points, grid.length_m)
        values = np.vstack([values, np.zeros(n)])
    targets = grid.locations_m(to)
    left = np.clip(np.searchsorted(points, targets, side="right") - 1, 0, len(points) - 2)
    share = ((targets - points[left]) / (points[left + 1] - points[left]))[:, None]
    return np.asarray((1.0 - share) * values[left] + share * values[left + 1], dtype=np.float64)


def side_weights(grid: SegmentGrid, to: Place, source: Place) -> tuple[Array, Array]:
    """Lengths (n, n), m, of dual cells of inputs [column] before and after the outputs [row]."""
    start, end = grid.dual_cells_m(source)
    here = grid.locations_m(to)[:, None]
    before = np.clip(np.minimum(end, here) - start, 0.0, None)
    after = np.clip(end - np.maximum(start, here), 0.0, None)
    return before, after


def operator_matrix(
    factors: OperatorFactors,
    grid: SegmentGrid,
    outputs: Sequence[Place],
    inputs: Sequence[Place],
) -> Array:
    """The operator on the grid, shape (n * outputs, n * inputs), both flattened node by node.

    `outputs` and `inputs` give the place of each component of a node's output and input.
    """
    n = grid.nodes
    matrix = np.zeros((n, len(outputs), n, len(inputs)))
    for a, to in enumerate(outputs):
        n0 = factors.n0(grid.locations_m(to), grid.length_m)
        for b, source in enumerate(inputs):
            before, after = side_weights(grid, to, source)
            places = (grid.locations_m(to), a, grid.locations_m(source), b, grid.length_m)
            matrix[:, a, :, b] = (
                n0[:, a, b, None] * interpolation(grid, to, source)
                + before * _kernel(factors.n1a, factors.n1b, *places)
                + after * _kernel(factors.n2a, factors.n2b, *places)
            )
    return matrix.reshape(n * len(outputs), n * len(inputs))


def _kernel(
    left: PolynomialMatrix,
    right: PolynomialMatrix,
    to_m: Array,
    row: int,
    from_m: Array,
    column: int,
    length_m: float,
) -> Array:
    """left(s) right(t) at all pairs of places, (n, n), for one row of left and column of right."""
    if not right.coefficients:  # no terms
        return np.zeros((len(to_m), len(from_m)))
    return left(to_m, length_m)[:, row] @ right(from_m, length_m)[:, :, column].T
