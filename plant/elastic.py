"""Energy and forces of the discrete arm: the right-hand side of the exact model, chapter (1).

Called once in every substep of the plant's integrator. Points of the plane are complex numbers x +
i y, which halves the number of array operations and makes rotations products.

Continuous model (chapter (1) with J = 0 and the density of theory, section 1): r(s, t) is the
centre line, r' = (1 + e) t its tangent with angle theta, n = i t its normal, and the internal force
is

    N = EA e t - EI theta'' / (1 + e) n,     rhoA r_tt = N' + f - rhoA d r_t,
    r(0) = 0, theta(0) = 0, N(L) = 0, theta'(L) = 0.

It follows from the energy int EA/2 e^2 + EI/2 theta'^2 ds. The discrete forces are the exact
negative gradient of the same energy summed over the staggered grid, so the discrete arm is a
Hamiltonian system too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from plant.grid import Grid

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class Strains:
    """Strains of a shape: `axial` at the cell centres, `curvature_per_m` at nodes 0..cells."""

    axial: Array
    curvature_per_m: Array


def strains(position: Complex, grid: Grid) -> Strains:
    """Axial strain (cells,) and curvature (cells + 1,) of grid node positions (cells + 1,) in m."""
    edges = np.diff(position)
    tangents = np.concatenate([[1.0 + 0.0j], edges])
    turns = np.angle(tangents[1:] * tangents[:-1].conj())
    curvature = np.zeros(grid.cells + 1)
    curvature[:-1] = turns / grid.curvature_lengths_m
    return Strains(np.abs(edges) / grid.step_m - 1.0, curvature)


def elastic_energy(
    position: Complex, grid: Grid, axial_stiffness_n: float, bending_stiffness_n_m2: float
) -> tuple[float, float]:
    """Axial and bending energy in J of grid node positions (cells + 1,)."""
    found = strains(position, grid)
    axial = 0.5 * axial_stiffness_n * grid.step_m * float(np.sum(found.axial**2))
    squares = found.curvature_per_m[:-1] ** 2
    bending = 0.5 * bending_stiffness_n_m2 * float(np.sum(squares * grid.curvature_lengths_m))
    return axial, bending


def rest_shape(curvature_per_m: Array, strain: Array, grid: Grid) -> Complex:
    """Positions (cells + 1,) in m whose discrete strains are exactly those given.

    `curvature_per_m` (cells,) at grid nodes 0..cells-1, `strain` (cells,) at the cell centres.
    """
    angles = np.cumsum(curvature_per_m * grid.curvature_lengths_m)
    edges = grid.step_m * (1.0 + strain) * np.exp(1j * angles)
    return np.concatenate([[0.0 + 0.0j], np.cumsum(edges)])


class ElasticForce:
    """The elastic forces, evaluated in place: about twenty array operations and no allocation.

    `evaluate(position)` fills `kick` (cells,) with `scale` times the acceleration-like quantity F /
    w, where F is the force on grid node 1..cells and w is 1, but 1/2 at the tip, whose mass is half
    of the others'. With scale = 1 the kick is thus the force in N, twice it at the tip.
    """

    def __init__(self, grid: Grid, axial_stiffness_n: float, bending_stiffness_n_m2: float) -> None:
        cells = grid.cells
        self._axial = axial_stiffness_n
        self._bending = bending_stiffness_n_m2 / grid.curvature_lengths_m
        self._step = grid.step_m
        self.kick: Complex = np.zeros(cells, dtype=np.complex128)
        # Edges between neighbours, with the direction of the clamp (1, 0) put in front.
        self._tangents = np.ones(cells + 1, dtype=np.complex128)
        self._edges = self._tangents[1:]
        self._before = self._tangents[:-1]
        self._product = np.zeros(cells, dtype=np.complex128)
        self._product_real, self._product_imag = self._product.real, self._product.imag
        self._inverse = np.zeros(cells)
        self._length = np.zeros(cells)
        self._moments = np.zeros(cells + 1)  # scaled bending moments; 0 at the tip
        self._moments_inner, self._moments_outer = self._moments[:-1], self._moments[1:]
        self._shear = np.zeros(cells)
        self._ratio = np.zeros(cells, dtype=np.complex128)  # N / edge
        self._ratio_real, self._ratio_imag = self._ratio.real, self._ratio.imag
        self._internal = np.zeros(
            cells + 1, dtype=np.complex128
        )  # N, with its reflection at the tip
        self._internal_in, self._internal_out = self._internal[:-1], self._internal[1:]
        self.set_scale(1.0)

    def set_scale(self, scale: float) -> None:
        """Scale all following kicks."""
        self._scaled_axial = np.array(scale * self._axial)
        self._scaled_axial_rate = np.array(scale * self._axial / self._step)
        self._scaled_bending = scale * self._bending

    @property
    def edges(self) -> Complex:
        """Edges (cells,) between neighbouring grid nodes at the last evaluation; do not change them."""
        return self._edges

    def normals(self, out: Complex) -> None:
        """Fill `out` (cells,) with unit normals at grid nodes 1..cells, last evaluation.

        The normal of a node stands across the mean direction of the edges beside it, at the tip across the
        last edge.
        """
        np.absolute(self._edges, self._length)
        np.divide(self._edges, self._length, self._product)
        np.add(self._product[:-1], self._product[1:], out[:-1])
        out[-1] = self._product[-1]
        np.absolute(out, self._length)
        np.divide(out, self._length, out)
        np.multiply(out, 1j, out)

    @property
    def clamp(self) -> tuple[complex, float]:
        """Internal force N and moment EI kappa at the clamp, last evaluation, times the scale."""
        return complex(self._internal[0]), float(self._moments[0])

    def evaluate(self, position: Complex) -> None:
        """Fill `kick` (cells,) for grid node positions (cells + 1,) in m; node 0 is the clamp."""
        product, inverse, shear = self._product, self._inverse, self._shear
        np.subtract(position[1:], position[:-1], self._edges)
        # Turn at each node, by atan2(cross, dot) of the edges beside it: exact, nothing to unwrap.
        np.conjugate(self._before, product)
        np.multiply(product, self._edges, product)
        np.arctan2(self._product_imag, self._product_real, self._moments_inner)
        np.multiply(self._moments_inner, self._scaled_bending, self._moments_inner)
        np.subtract(self._moments_inner, self._moments_outer, shear)
        # N = EA e t + (M_j - M_j+1) / |edge| n
        #   = (EA / ds - EA / |edge| + i (M_j - M_j+1) / |edge|^2) edge.
        np.absolute(self._edges, inverse)
        np.reciprocal(inverse, inverse)
        np.multiply(shear, inverse, shear)
        np.multiply(shear, inverse, self._ratio_imag)
        np.multiply(inverse, self._scaled_axial, inverse)
        np.subtract(self._scaled_axial_rate, inverse, self._ratio_real)
        np.multiply(self._ratio, self._edges, self._internal_in)
        self._internal[-1] = -self._internal[-2]
        np.subtract(self._internal_out, self._internal_in, self.kick)
