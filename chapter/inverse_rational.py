"""R_0^-1 by a polynomial, as section 4 does it: what of P^-1 is left, by degree, and what the degree must be.

1 / R_0 is analytic inside the ellipse with foci 0 and 1 through the nearest root of det R_0; with rho the sum
of its half axes (of the interval [-1, 1]) polynomials of degree d are off by rho^-d, whatever the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial, legendre

from chapter.inverse_cases import powers_of
from chapter.inverse_formula import Function, Separable, gauss
from chapter.inverse_reference import relative, right_sides

Array = npt.NDArray[np.float64]
Fit = Literal["projection", "101 points"]

TOOLBOX_DEGREE = 6
RESOLUTION = 600


def valley(a: float) -> Separable:
    """One function, R_0 = a^2 + (s - 1/2)^2 with the roots 1/2 +- i a, kernel of rank three."""
    none = np.zeros((0, 3))

    def R0(s: Array) -> Array:
        return np.asarray((a**2 + (s - 0.5) ** 2)[:, None, None])

    return Separable(np.zeros((0, 0)), none, none, np.diag([1.0, 0.5, 0.25]), powers_of(1, 3), R0)


def approximated(R0: Function, degree: int, fit: Fit) -> Function:
    """R_0^-1 by a polynomial of this degree: its projection, or least squares at 101 equidistant points."""
    if fit == "projection":
        s, weights = gauss(RESOLUTION)
        x = np.asarray(2.0 * s - 1.0)
    else:
        x = np.linspace(-1.0, 1.0, 101)
        weights = np.ones_like(x)
    root = np.sqrt(weights)[:, None]
    values = np.linalg.inv(R0(0.5 * (x + 1.0)))
    basis = legendre.legvander(x, degree)
    found = np.linalg.lstsq(root * basis, root * values.reshape(len(x), -1), rcond=None)[0]
    shaped = found.reshape(degree + 1, *values.shape[1:])
    return lambda s: np.einsum("kd,dnm->knm", legendre.legvander(2.0 * s - 1.0, degree), shaped)


def ellipse(R0: Function, degree: int) -> float:
    """rho of the nearest root of det R_0, a polynomial of this degree."""
    s = np.linspace(0.0, 1.0, 2 * degree + 1)
    z = (
        2.0
        * np.asarray(Polynomial.fit(s, np.linalg.det(R0(s)), degree).roots(), dtype=np.complex128)
        - 1.0
    )
    root = np.sqrt(z * z - 1.0 + 0j)
    return float(np.maximum(np.abs(z + root), np.abs(z - root)).min())


def errors(operator: Separable, degrees: Sequence[int], fit: Fit) -> list[float]:
    """Of P^-1 with R_0^-1 by polynomials, relative, on polynomials of degree < 6."""
    s, w = gauss(RESOLUTION)
    finite, y = right_sides(len(operator.P), operator.R0(s[:1]).shape[1])
    exact = operator.inverse(nodes=RESOLUTION).apply(finite, y, s)
    return [
        relative(
            operator.inverse(
                approximated(operator.R0, degree, fit),
                exact_K=fit == "101 points",
                nodes=RESOLUTION,
            ).apply(finite, y, s),
            exact,
            w,
        )
        for degree in degrees
    ]


@dataclass(frozen=True)
class RationalRow:
    """One R_0."""

    name: str
    rho: float
    measured: float
    """(error at 8 / error at 32)^(1/24)."""
    errors: list[float]
    toolbox: float
    """Degree 6 by least squares at 101 equidistant points."""
    least: float
    """Smallest eigenvalue of that R_0^-1 on [0, 1], relative to its largest: negative is no inverse of anything
    coercive."""
    degree_1e6: int
    """Least even degree with an error below 1e-6."""


def row(name: str, operator: Separable, det_degree: int, degrees: Sequence[int]) -> RationalRow:
    """Everything about one operator."""
    found = errors(operator, degrees, "projection")
    low, high = errors(operator, (8, 32), "projection")
    polynomial = approximated(operator.R0, TOOLBOX_DEGREE, "101 points")
    values = np.linalg.eigvalsh(polynomial(np.linspace(0.0, 1.0, 201)))
    rho = ellipse(operator.R0, det_degree)
    degree, now = 2 * int(5.0 / np.log(rho)), 1.0
    while now > 1e-6:
        degree += 2
        now = errors(operator, (degree,), "projection")[0]
    return RationalRow(
        name,
        rho,
        float((low / high) ** (1.0 / 24.0)),
        found,
        errors(operator, (TOOLBOX_DEGREE,), "101 points")[0],
        float(values.min() / values.max()),
        degree,
    )
