"""Which waves grow in the linear models (5) and in the linearisation of (1): frozen coefficients and the
whole arm.

Frozen: a Fourier mode exp(i k x + g t) on an infinite arm whose coefficients are those of one point. Whole arm:
Rayleigh and Ritz on the second variation of the energy, which freezes nothing.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Literal

import numpy as np
import sympy as sp
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import Legendre, leggauss
from scipy.linalg import eig, eigh

from chapter import derivation
from chapter.constants import Constants
from chapter.pde import Form, Setpoint, matrices

Array = np.ndarray[Any, np.dtype[Any]]
Energy = Literal["cubic", "exact"]
"""cubic: the energy of (2), degree 3 in the displacements; exact: that of (1)."""
GAUSS = 400
"""Points of the integrals over the arm; the graph of setpoint 3 turns within a fiftieth of its length."""


def leading_growth(slope: float, k: float, constants: Constants) -> float:
    """Growth rate in 1/s that the fourth derivatives alone give: eigenvalue of (EI/rho) [[0, c], [c, -1]]."""
    eigenvalue = 0.5 * (math.sqrt(1.0 + 4.0 * slope**2) - 1.0)
    return k**2 * math.sqrt(constants.bending_n_m2 / constants.mass_kg_m * eigenvalue)


def growing_bands(slope: float, constants: Constants) -> tuple[float, float]:
    """(k1, k2) in 1/m: waves with k < k1 and with k > k2 grow, u_e = 0, A_2 and A_4 alone with w_e' frozen.

    [[-EA k^2, c (EI k^4 - EA k^2)], [the same, -EI k^4]] has a positive eigenvalue where its determinant is
    negative. With K = EI k^2 / EA that is K < c^2 (K - 1)^2, whose roots have the product 1.
    """
    if slope == 0.0:
        return 0.0, math.inf
    c2 = slope**2
    upper = (2.0 * c2 + 1.0 + math.sqrt(4.0 * c2 + 1.0)) / (2.0 * c2)
    unit = math.sqrt(constants.axial_n / constants.bending_n_m2)
    return unit / math.sqrt(upper), unit * math.sqrt(upper)


def frozen_growth(
    setpoint: Setpoint, constants: Constants, form: Form, x: float, k: Array
) -> Array:
    """Largest growth rate in 1/s at the wave numbers k: (5) with its coefficients at x."""
    symbol = np.zeros((k.size, 2, 2), dtype=complex)
    for order, matrix in enumerate(matrices(setpoint, constants, form)[1:], start=1):
        values = np.array([[matrix[i][j](x) for j in (0, 2)] for i in (1, 3)])
        symbol += values * ((1j * k) ** order)[:, None, None]
    return np.asarray(np.max(np.abs(np.sqrt(np.linalg.eigvals(symbol)).real), axis=1))


@cache
def _second_variation(energy: Energy) -> Any:
    """Hessian of the energy density by (u_x, w_x, u_xx, w_xx), a function of (EA, EI, u1, w1, u2, w2)."""
    density = derivation.exact_energy()
    if energy == "cubic":
        density = derivation.truncated(density, 3)
    jets = (derivation.U[1], derivation.W[1], derivation.U[2], derivation.W[2])
    hessian = sp.hessian(density, jets)
    return sp.lambdify((derivation.EA, derivation.EI, *jets), hessian, modules="numpy", cse=True)


def hessian(setpoint: Setpoint, constants: Constants, energy: Energy, x: float) -> Array:
    """Second derivatives of the energy density at the setpoint by (u_x, w_x, u_xx, w_xx), in N, N m, N m2."""
    u, w = setpoint.u, setpoint.w
    at = (u.deriv(1)(x), w.deriv(1)(x), u.deriv(2)(x), w.deriv(2)(x))
    found = _second_variation(energy)(constants.axial_n, constants.bending_n_m2, *map(float, at))
    return np.asarray(found, dtype=np.float64)


def energy_growth(
    setpoint: Setpoint, constants: Constants, energy: Energy, x: float, k: Array
) -> Array:
    """Largest growth rate in 1/s with the energy's coefficients frozen at x: the symbol is Hermitian then.

    Freezing the equation instead makes spurious growth where coefficients vary, as its symbol is not Hermitian.
    """
    h = hessian(setpoint, constants, energy, x)
    by_force, mixed, by_bend = h[:2, :2], h[:2, 2:], h[2:, 2:]
    kk = k[:, None, None]
    form = kk**2 * by_force + kk**4 * by_bend - 1j * kk**3 * (mixed.T - mixed)
    lowest = np.linalg.eigvalsh(form)[:, 0] / constants.mass_kg_m
    return np.asarray(np.sqrt(np.maximum(-lowest, 0.0)))


def ritz_growth(
    setpoint: Setpoint, constants: Constants, energy: Energy, size: int
) -> tuple[float, float]:
    """(growth rate, lowest frequency) in 1/s of the whole arm, clamped at 0 and free at 1, in `size`
    shapes each.

    Shapes: integrals of Legendre polynomials, u~(0) = w~(0) = w~_x(0) = 0. The lowest Ritz value bounds
    the lowest point of the spectrum from above: the growth rate is a lower bound, whatever is left out can
    only add to it. The frequency is that of the lowest Ritz value that is positive (0 if there is none).
    """
    points, weights = leggauss(GAUSS)
    x, weights = 0.5 * (points + 1.0), 0.5 * weights
    bends = [Legendre.basis(j, domain=[0.0, 1.0]) for j in range(size)]
    zero = np.zeros((size, x.size))
    tilt = np.array([b.integ(1, lbnd=0.0)(x) for b in bends])
    rows = np.array([b(x) for b in bends])
    rate = np.array([b.deriv(1)(x) if b.degree() else 0.0 * x for b in bends])
    lift = np.array([b.integ(2, lbnd=0.0)(x) for b in bends])
    # (u_x, w_x, u_xx, w_xx) and (u, w) of the shapes, first those of u, then those of w
    jets = [
        np.vstack([rows, zero]),
        np.vstack([zero, tilt]),
        np.vstack([rate, zero]),
        np.vstack([zero, rows]),
    ]
    moves = [np.vstack([tilt, zero]), np.vstack([zero, lift])]
    h = np.array([hessian(setpoint, constants, energy, float(v)) for v in x])
    stiffness = sum(
        (jets[i] * (weights * h[:, i, j])) @ jets[j].T for i in range(4) for j in range(4)
    )
    mass = constants.mass_kg_m * sum((m * weights) @ m.T for m in moves)
    values = eigh(np.asarray(stiffness), np.asarray(mass), eigvals_only=True)
    positive = values[values > 0.0]
    lowest = float(np.sqrt(positive[0])) if positive.size else 0.0
    return float(np.sqrt(max(-values[0], 0.0))), lowest


def galerkin_squares(setpoint: Setpoint, constants: Constants, form: Form, size: int) -> Array:
    """Squares of the rates in 1/s2 of (5) on the whole arm under the printed boundary conditions.

    `size` shapes each for u~ and w~: polynomials with v(0) = v'(0) = v''(1) = v'''(1) = 0, of second
    derivative (1 - x)^2 times a Legendre polynomial. (5), not its energy, is tested with the same functions,
    so this serves both forms.
    """
    points, weights = leggauss(GAUSS)
    x, weights = 0.5 * (points + 1.0), 0.5 * weights
    rim = Polynomial([1.0, -2.0, 1.0])
    second = [
        Legendre.basis(j, domain=[0.0, 1.0]).convert(kind=Polynomial) * rim for j in range(size)
    ]
    # values of the derivatives 0 to 4, of shape (size, points) each
    jets = [
        np.array([s.integ(2 - j, lbnd=0.0)(x) if j < 2 else s(x) for s in second]) for j in range(3)
    ]
    jets += [np.array([s.deriv(j)(x) for s in second]) for j in (1, 2)]
    stiffness = np.zeros((2, size, 2, size))
    for order, matrix in enumerate(matrices(setpoint, constants, form)[1:], start=1):
        for i, row in enumerate((1, 3)):
            for j, column in enumerate((0, 2)):
                entry = weights * matrix[row][column](x)
                stiffness[i, :, j, :] += (jets[0] * entry) @ jets[order].T
    mass = np.kron(np.eye(2), (jets[0] * weights) @ jets[0].T)
    values = eig(stiffness.reshape(2 * size, 2 * size), mass, right=False)
    return np.asarray(values, dtype=complex)


def galerkin_growth(setpoint: Setpoint, constants: Constants, form: Form, size: int) -> float:
    """Largest growth rate in 1/s of the same: a rate g and its negative belong to g^2."""
    return float(
        np.max(np.sqrt(galerkin_squares(setpoint, constants, form, size)).real, initial=0.0)
    )


def packet_growth(
    setpoint: Setpoint, constants: Constants, k: float, centre: float, width: float
) -> float:
    """Lower bound in 1/s of (5) corrected, from one wave packet: no matrix, no frozen coefficient.

    u~ = a p, w~ = p with p = (1 - y^2)^4 cos(k x), y = (x - centre) / width; a from the leading matrix at the
    centre. The force on the packet is taken from (5) by applying its polynomials to p's derivatives, and the
    Rayleigh quotient <v, A v> / <v, v> by the trapezoidal rule.
    """
    slope = float(setpoint.w.deriv()(centre))
    ratio = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * slope**2)) / slope
    count = max(2001, int(40 * k * width))
    y = np.linspace(-1.0, 1.0, count)
    x = centre + width * y
    bump = Polynomial([1.0, 0.0, -1.0]) ** 4
    derivatives = []
    for order in range(5):
        value = np.zeros_like(x)
        for j in range(order + 1):
            envelope = (bump.deriv(j) if j else bump)(y) / width**j
            turned = np.cos(k * x + 0.5 * math.pi * (order - j)) * k ** (order - j)
            value += math.comb(order, j) * envelope * turned
        derivatives.append(value)
    fields = (ratio, 1.0)
    work = np.zeros_like(x)
    for order, matrix in enumerate(matrices(setpoint, constants, "corrected")[1:], start=1):
        for i, row in enumerate((1, 3)):
            for j, column in enumerate((0, 2)):
                entry = np.asarray(matrix[row][column](x))
                work += fields[i] * derivatives[0] * entry * fields[j] * derivatives[order]
    norm = (ratio**2 + 1.0) * derivatives[0] ** 2
    return math.sqrt(max(float(np.sum(work) / np.sum(norm)), 0.0))


def steepest(setpoint: Setpoint, end: float) -> tuple[float, float]:
    """(x, w_e'(x)) where |w_e'| is largest in [0, end]."""
    slope = setpoint.w.deriv()
    roots = [complex(r) for r in slope.deriv().roots()]
    turning = [r.real for r in roots if abs(r.imag) < 1e-12 and 0.0 < r.real < end]
    best = max((end, *turning), key=lambda v: abs(float(slope(v))))
    return best, float(slope(best))
