"""Kelvin-Voigt damping of the discrete arm: an implicit step of the velocities, made once a substep.

The stress E (strain + tau strain_t) adds to the elastic force of `plant.elastic` the force -D v, the gradient
by the velocities of the Rayleigh potential of the same strains,

    R = tau / 2 (sum EA ds (stretch rate)^2 + sum EI / length_j (turn rate)^2),    D v = dR/dv,

with the rates at the present shape. Power 2 R is dissipated. D grows with the fourth power of the grid's
fineness, so an explicit step would be limited by it; the implicit midpoint rule is stable below the elastic
limit 2 / w for any tau and takes out exactly (step) 2 R of the mean velocity.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from plant.grid import Grid

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

_BAND = 5
"""Below the diagonal: a node's force depends on two neighbours on either side, x and y of each."""


class ViscousStep:
    """The implicit step for one grid; D is a banded matrix in (x_1, y_1, x_2, ...) of the free nodes."""

    def __init__(
        self,
        grid: Grid,
        axial_stiffness_n: float,
        bending_stiffness_n_m2: float,
        mass_per_length_kg_per_m: float,
        retardation_s: float,
    ) -> None:
        # per mass of an inner node
        scale = retardation_s / (mass_per_length_kg_per_m * grid.step_m)
        self._axial = scale * axial_stiffness_n / grid.step_m
        bending = scale * bending_stiffness_n_m2 / grid.curvature_lengths_m
        self._bending = bending
        self._bending_beside = bending + np.append(bending[1:], 0.0)
        self._mass = np.repeat(grid.weights_m / grid.step_m, 2)
        self._band = np.zeros((_BAND + 1, 2 * grid.cells))

    def apply(self, edges: Complex, before: Complex, explicit: Complex, reach_s: float) -> Complex:
        """y with y = explicit - reach_s M^-1 D (y + before) / 2; all (cells,), in any unit of velocity.

        edges: between neighbouring grid nodes, the shape at which D is taken. explicit: where the
        velocities would be without viscous stress. Numbers that are not finite stay so.
        """
        band = self._matrix(edges)
        band *= 0.5 * reach_s
        band[0] += self._mass
        right = self._mass * (explicit + before).view(np.float64)
        # the names of LAPACK: a positive definite band matrix, factorised and solved
        _, total, failed = lapack.dpbsv(band, right, lower=1, overwrite_ab=1, overwrite_b=1)
        if failed:
            return np.full_like(before, complex(np.nan, np.nan))
        return np.asarray(total.view(np.complex128) - before)

    def rate(self, edges: Complex, velocity: Complex) -> Complex:
        """M^-1 D v (cells,) per second, M the mass of an inner node."""
        band = self._matrix(edges)
        v = np.ascontiguousarray(velocity).view(np.float64)
        out = band[0] * v
        for k in range(1, _BAND + 1):
            out[k:] += band[k, :-k] * v[:-k]
            out[:-k] += band[k, :-k] * v[k:]
        return np.asarray(out.view(np.complex128))

    def _matrix(self, edges: Complex) -> Array:
        """The lower band of D over the mass of an inner node, (6, 2 cells)."""
        inverse = 1.0 / np.abs(edges)
        along = edges * inverse
        stretch = along.view(np.float64).reshape(-1, 2)  # stretch rate = stretch . (v_j - v_j-1)
        turn = (1j * along * inverse).view(np.float64).reshape(-1, 2)  # rate of the angle
        # the potential in differences of velocities: blocks at (j, j) and (j, j + 1)
        own = self._axial * stretch[:, :, None] * stretch[:, None, :]
        own += self._bending_beside[:, None, None] * turn[:, :, None] * turn[:, None, :]
        next_ = -self._bending[1:, None, None] * turn[:-1, :, None] * turn[1:, None, :]
        # ... and in velocities: v_j is in the differences j and j + 1
        diagonal = own.copy()
        diagonal[:-1] += own[1:] - next_ - next_.transpose(0, 2, 1)
        first = next_ - own[1:]
        first[:-1] += next_[1:]
        second = -next_[1:]
        band = self._band
        band[:] = 0.0
        band[0, 0::2], band[1, 0::2], band[0, 1::2] = (
            diagonal[:, 0, 0],
            diagonal[:, 1, 0],
            diagonal[:, 1, 1],
        )
        for blocks, below in ((first, 2), (second, 4)):
            stop = 2 * len(blocks)
            for column in range(2):
                for row in range(2):
                    # a block above the diagonal, seen from below
                    band[below + row - column, column:stop:2] = blocks[:, column, row]
        return band
