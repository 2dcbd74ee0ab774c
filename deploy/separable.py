"""Model and gains of one setpoint on n segments without a matrix of n columns: bands, and kernels as factors.

Between gains artefact and `deploy.structured`. The same numbers as `deploy.model` and `deploy.operators`, block
by block: what is farther than a neighbour apart is the product of a factor at the output and one at the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse.linalg import LinearOperator, svds

from deploy.grid import Place, SegmentGrid
from deploy.model import tangent_angle
from wire.artefact import Arm, OperatorFactors, PolynomialMatrix

Array = npt.NDArray[np.float64]

REACH = 2
"""Nodes on either side that a node's rate depends on: a curvature bends with the velocities of two segments."""


def shifted(values: Array, by: int) -> Array:
    """Values (n, ...) of node i + by at place i, zeros beyond the ends."""
    out = np.zeros_like(values)
    n = len(values)
    if abs(by) < n:
        out[max(0, -by) : n - max(0, by)] = values[max(0, by) : n + min(0, by)]
    return out


@dataclass(frozen=True, eq=False)
class SeparableGain:
    """y_i = sum of band[1 + o]_i x_(i+o), o = -1, 0, 1, and lower_a_i sum_(j < i - 1) lower_b_j x_j, and upper
    likewise, j > i + 1."""

    band: Array
    """(3, n, outputs, inputs)."""
    lower_a: Array
    """(n, outputs, rank)."""
    lower_b: Array
    """(n, rank, inputs)."""
    upper_a: Array
    upper_b: Array

    def __call__(self, x: Array) -> Array:
        """Apply to x (n, inputs): (n, outputs), in O(n)."""
        out = sum(np.einsum("nab,nb->na", self.band[1 + o], shifted(x, o)) for o in (-1, 0, 1))
        low = np.cumsum(np.einsum("nrb,nb->nr", self.lower_b, x), axis=0)
        high = np.cumsum(np.einsum("nrb,nb->nr", self.upper_b, x)[::-1], axis=0)[::-1]
        out = out + np.einsum("nar,nr->na", self.lower_a, shifted(low, -2))
        return np.asarray(out + np.einsum("nar,nr->na", self.upper_a, shifted(high, 2)))

    @property
    def transposed(self) -> SeparableGain:
        """The transposed matrix."""
        turn = (0, 2, 1)
        band = [shifted(self.band[1 - o], o).transpose(turn) for o in (-1, 0, 1)]
        return SeparableGain(
            np.stack(band),
            self.upper_b.transpose(turn),
            self.upper_a.transpose(turn),
            self.lower_b.transpose(turn),
            self.lower_a.transpose(turn),
        )

    def scaled(self, outputs: Array, inputs: Array) -> SeparableGain:
        """The same for scaled quantities: outputs (n, outputs) times, inputs (n, inputs) divided by."""
        out = outputs[:, :, None]
        band = [
            out
            * self.band[1 + o]
            / np.where(shifted(inputs, o) == 0.0, 1.0, shifted(inputs, o))[:, None, :]
            for o in (-1, 0, 1)
        ]
        by = inputs[:, None, :]
        return SeparableGain(
            np.stack(band),
            out * self.lower_a,
            self.lower_b / by,
            out * self.upper_a,
            self.upper_b / by,
        )

    def composed(self, before: Array | None = None, after: Array | None = None) -> SeparableGain:
        """after_i (n, p, outputs) times this times before_j (n, inputs, q)."""
        band, la, lb, ua, ub = self.band, self.lower_a, self.lower_b, self.upper_a, self.upper_b
        if after is not None:
            band, la, ua = after @ band, after @ la, after @ ua
        if before is not None:
            band = np.stack([band[1 + o] @ shifted(before, o) for o in (-1, 0, 1)])
            lb, ub = lb @ before, ub @ before
        return SeparableGain(band, la, lb, ua, ub)

    def norm(self) -> float:
        """The 2-norm, by Lanczos iteration from a fixed vector."""
        _, n, outputs, inputs = self.band.shape
        turned = self.transposed
        operator = LinearOperator(
            (n * outputs, n * inputs),
            matvec=lambda x: self(np.reshape(x, (n, inputs))).ravel(),
            rmatvec=lambda y: turned(np.reshape(y, (n, outputs))).ravel(),
            dtype=np.float64,
        )
        start = np.ones(n * min(outputs, inputs))
        if not np.any(operator.matvec(np.ones(n * inputs))):
            return 0.0
        found = svds(operator, k=1, v0=start, return_singular_vectors=False, tol=1e-10)
        return float(found[0])


def separable_gain(
    factors: OperatorFactors, grid: SegmentGrid, outputs: Sequence[Place], inputs: Sequence[Place]
) -> SeparableGain:
    """`deploy.operators.operator_matrix` as bands and factors."""
    length, n = grid.length_m, grid.nodes
    band = np.zeros((3, n, len(outputs), len(inputs)))
    lower_a, upper_a = (
        np.stack([one(grid.locations_m(to), length)[:, a] for a, to in enumerate(outputs)], axis=1)
        for one in (factors.n1a, factors.n2a)
    )
    lower, upper = (
        np.stack([_right(one, grid, place, b) for b, place in enumerate(inputs)], axis=2)
        for one in (factors.n1b, factors.n2b)
    )  # (n, rank, inputs), not yet times the cells
    for a, to in enumerate(outputs):
        here = grid.locations_m(to)
        n0 = factors.n0(here, length)[:, a]
        for b, source in enumerate(inputs):
            start, end = grid.dual_cells_m(source)
            bands = interpolation_band(grid, to, source)
            for o in (-1, 0, 1):
                at, inside = np.arange(n) + o, slice(max(0, -o), n - max(0, o))
                at = np.clip(at, 0, n - 1)
                before = np.clip(np.minimum(end[at], here) - start[at], 0.0, None)
                after = np.clip(end[at] - np.maximum(start[at], here), 0.0, None)
                entry = n0[:, b] * bands[1 + o]
                entry = entry + before * np.einsum("nr,nr->n", lower_a[:, a], lower[at, :, b])
                entry = entry + after * np.einsum("nr,nr->n", upper_a[:, a], upper[at, :, b])
                band[1 + o, inside, a, b] = entry[inside]
    cells = np.stack([grid.dual_widths_m(place) for place in inputs], axis=1)[:, None, :]
    return SeparableGain(band, lower_a, lower * cells, upper_a, upper * cells)


def _right(matrix: PolynomialMatrix, grid: SegmentGrid, place: Place, column: int) -> Array:
    """Right factor (n, rank) of one input at its places; no terms: (n, 0)."""
    if not matrix.coefficients:
        return np.zeros((grid.nodes, 0))
    return matrix(grid.locations_m(place), grid.length_m)[:, :, column]


def interpolation_band(grid: SegmentGrid, to: Place, source: Place) -> Array:
    """`deploy.operators.interpolation` as its three diagonals (3, n): from node i - 1, i and i + 1."""
    n = grid.nodes
    out = np.zeros((3, n))
    if to is source:
        out[1] = 1.0
        return out
    points, ahead = grid.locations_m(source), 0
    if source is Place.OUTER_FACE:  # v(0) = 0
        points, ahead = np.append(0.0, points), 1
    else:  # e(L) = 0, k(L) = 0
        points = np.append(points, grid.length_m)
    targets = grid.locations_m(to)
    left = np.clip(np.searchsorted(points, targets, side="right") - 1, 0, len(points) - 2)
    share = (targets - points[left]) / (points[left + 1] - points[left])
    for index, weight in ((left, 1.0 - share), (left + 1, share)):
        node = index - ahead
        real = (node >= 0) & (node < n) & (weight != 0.0)
        rows = np.flatnonzero(real)
        out[1 + node[rows] - rows, rows] += weight[rows]
    return out


@dataclass(frozen=True, eq=False)
class BandedModel:
    """x_t of node i = sum of A[REACH + o]_i x_(i+o) + B_i u_i, SI units (`deploy.model.GridModel`)."""

    A: Array
    """(2 REACH + 1, n, 4, 4)."""
    B: Array
    """(n, 4, 1)."""
    energy_weights: Array
    """(n, 4)."""


def banded_model(arm: Arm, curvature_per_m: Sequence[float], grid: SegmentGrid) -> BandedModel:
    """`deploy.model.make_model` as bands."""
    n = grid.nodes
    weights = grid.energy_weights(arm)
    angle = tangent_angle(curvature_per_m, grid.centres_m, grid.length_m)
    slope = (1.0 / grid.cell_widths_m)[:, None]
    tangent = slope * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = slope * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    bend = (1.0 / grid.dual_widths_m(Place.INNER_FACE))[:, None]
    A = np.zeros((2 * REACH + 1, n, 4, 4))
    own, left, second = REACH, REACH - 1, REACH - 2
    A[own, :, 2, :2], A[left, 1:, 2, :2] = tangent, -tangent[1:]
    A[own, :, 3, :2] = bend * normal
    A[left, 1:, 3, :2] = -bend[1:] * (normal[1:] + normal[:-1])
    A[second, 2:, 3, :2] = bend[2:] * normal[1:-1]
    for o in range(REACH + 1):
        rate = A[REACH - o, o:, 2:, :2]  # of the strains of node i by the velocities of node i - o
        ratio = weights[o:, None, 2:] / weights[: n - o, :2, None]
        A[REACH + o, : n - o, :2, 2:] = -rate.transpose(0, 2, 1) * ratio
    if arm.kelvin_voigt_s > 0.0:
        A[:, :, :2, :2] += arm.kelvin_voigt_s * _square(A)[:, :, :2, :2]
    A[REACH, :, [0, 1], [0, 1]] -= arm.drag_per_s
    B = np.zeros((n, 4, 1))
    turn = tangent_angle(curvature_per_m, grid.faces_m[1:], grid.length_m)
    normal_load = arm.actuator == "normal"
    B[:, 0, 0] = -np.sin(turn) if normal_load else 0.0
    B[:, 1, 0] = np.cos(turn) if normal_load else 1.0
    return BandedModel(A, B / arm.mass_per_length_kg_per_m, weights)


def _square(A: Array) -> Array:
    """The product with itself, as far as it lies within the band."""
    out = np.zeros_like(A)
    for o in range(-REACH, REACH + 1):
        for p in range(-REACH, REACH + 1):
            if abs(o + p) <= REACH:
                out[REACH + o + p] += A[REACH + o] @ shifted(A[REACH + p], o)
    return out
