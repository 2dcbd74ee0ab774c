"""Section 4.1 on the chapter's grid: (4) by differences, its outputs, and the error dynamics (15) over time.

Between `chapter.pde` with `plant.differences` and the experiment of `chapter.observer`. States are the
chapter's, (u, u_t, w, w_t) at s_1..s_n, one after the other, SI units; errors are estimate minus truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.linalg import block_diag, eigh, expm

from chapter.constants import LENGTH_M, Constants
from chapter.pde import Form, Setpoint, matrices
from plant.differences import AxialEnds, Bias, Differences, differences

Array = npt.NDArray[np.float64]

CELLS = 10
INITIAL = Polynomial([0.0, 0.0, 2.0, -8.0 / 3.0, 1.0])
"""x_3(s, 0) of section 4.1 in m; all other states and the estimate are zero."""
AMPLITUDE_N_PER_M = 0.1
"""w(t) = sin(t) / (10 t)."""


def disturbance(times_s: Array) -> Array:
    """w(t) in N/m."""
    return AMPLITUDE_N_PER_M * np.sinc(times_s / np.pi)


@dataclass(frozen=True, eq=False)
class GridError:
    """e_t = A e - B w of an observer without correction, and what is made of e; n cells."""

    differences: Differences
    A: Array
    """(4n, 4n)."""
    B: Array
    """(4n,), per N/m."""
    tip: Array
    """(4n,): error of w(L), the first output."""
    mean: Array
    """(4, 4n): sums of d_s^4 of the errors of (u, u_t, w, w_t) over the grid, the chapter's averages (L =
    1). Not consistent: the difference at s_1 with its even ghost is wrong by d_s^3 w / (3 step), so the sum
    of w's tends to 2/3 of -w'''(0), the integral that it is meant to be."""
    root: Array
    """(4n,): error of -w'''(0) = int d_s^4 w ds, of first order; the second output and z."""
    energy: Array
    """(4n, 4n): |energy e|^2 / 2 is the energy of the straight arm in the error, J."""

    @property
    def cells(self) -> int:
        """n."""
        return len(self.B) // 4

    @property
    def outputs(self) -> Array:
        """(2, 4n): y = (tip in m, integral of d_s^4 w in 1/m^2)."""
        return np.stack([self.tip, self.root])

    @property
    def points_m(self) -> Array:
        """s_1..s_n."""
        return self.differences.step_m * np.arange(1.0, self.cells + 1.0)

    def initial(self, w: Polynomial = INITIAL) -> Array:
        """Error (4n,) at t = 0 of an estimate zero when the arm is at rest with transverse displacement w."""
        start = np.zeros(4 * self.cells)
        start[2 * self.cells : 3 * self.cells] = -w(self.points_m)
        return start


def grid_error(
    setpoint: Setpoint,
    constants: Constants,
    form: Form = "corrected",
    *,
    cells: int = CELLS,
    drag_per_s: float = 0.0,
    bias: Bias = "root",
    axial_ends: AxialEnds = "two",
) -> GridError:
    """The linear model (5) at a setpoint by the chapter's differences."""
    grid = differences(cells, LENGTH_M, bias=bias, axial_ends=axial_ends)
    s = grid.step_m * np.arange(1, cells + 1)
    A = np.zeros((4, cells, 4, cells))
    for order, matrix in enumerate(matrices(setpoint, constants, form)):
        for row in range(4):
            for column in range(4):
                by = (grid.axial if column < 2 else grid.transverse)[order]
                A[row, :, column] += matrix[row][column](s)[:, None] * by
    for velocity in (1, 3):
        A[velocity, :, velocity] -= drag_per_s * np.eye(cells)
    B = np.zeros((4, cells))
    B[3] = 1.0 / constants.mass_kg_m
    weights = np.full(cells, grid.step_m)
    weights[-1] *= 0.5
    tip, root, mean = np.zeros((4, cells)), np.zeros((4, cells)), np.zeros((4, 4, cells))
    tip[2, -1] = 1.0
    # w = a s^2 + b s^3 through the first two points
    root[2, :2] = np.array([6.0, -1.5]) / grid.step_m**3
    for state in range(4):
        by = (grid.axial if state < 2 else grid.transverse)[4]
        mean[state, state] = weights @ by
    return GridError(
        differences=grid,
        A=A.reshape(4 * cells, 4 * cells),
        B=B.ravel(),
        tip=tip.ravel(),
        root=root.ravel(),
        mean=mean.reshape(4, 4 * cells),
        energy=_energy(grid, weights, constants),
    )


def _energy(grid: Differences, weights: Array, constants: Constants) -> Array:
    """The straight arm's matrices of d_s^2 u and d_s^4 w are symmetric with half the weight at the tip;
    those of "four" axial conditions are not, and the symmetric part is taken."""
    roots = np.diag(np.sqrt(weights))
    inverse = np.diag(1.0 / np.sqrt(weights))

    def root(stiffness: Array) -> Array:
        symmetric = roots @ stiffness @ inverse
        values, vectors = eigh(0.5 * (symmetric + symmetric.T))
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T @ roots)

    inertia = np.sqrt(constants.mass_kg_m) * roots
    return np.asarray(
        block_diag(
            root(-constants.axial_n * grid.axial[2]),
            inertia,
            root(constants.bending_n_m2 * grid.transverse[4]),
            inertia,
        )
    )


def propagate(A: Array, B: Array, start: Array, times_s: Array, loads: Array) -> Array:
    """x(t) of x_t = A x + B load at equal steps, (times, states); the load is linear in between, else exact.

    times_s, loads: (times,). Values that leave double precision stay infinite.
    """
    step, states = float(times_s[1] - times_s[0]), len(B)
    wide = np.zeros((states + 2, states + 2))
    wide[:states, :states], wide[:states, states] = A, B
    wide[states, states + 1] = 1.0 / step  # the slope of the load
    found = expm(step * wide)[:states]
    advance, held, rising = found[:, :states], found[:, states], found[:, states + 1]
    out = np.empty((len(times_s), states))
    out[0] = start
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(times_s) - 1):
            out[k + 1] = advance @ out[k] + held * loads[k] + rising * (loads[k + 1] - loads[k])
    return out
