"""The arm's own P, of the observers for the chapter's outputs, and every way to its inverse.

Between the stored programs (`chapter.lpi_gains`), `design.inverse`, the formula and quadrature.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre as plain

from chapter.constants import CORRECTED
from chapter.inverse_cases import applied, of_one_kernel, one_kernels
from chapter.inverse_formula import Function, Kernel, Parameters
from chapter.inverse_reference import Nystrom, relative, right_sides
from chapter.lpi_gains import COUNT, chapter_pie, gain_of, observer_gains
from chapter.lpi_solve import coordinates, observer_problem
from design.factors import factorise
from design.inverse import separate, solve_gain
from design.lpi.gains import gain_operator
from design.operators import PIOperator

Array = npt.NDArray[np.float64]

RANK_TOLERANCES = (1e-10, 1e-3, 1e-2)


def arm(name: str) -> tuple[PIOperator, PIOperator, PIOperator]:
    """P, Z = P L and L of the observer for the chapter's outputs (`chapter.lpi_gains`) at a setpoint."""
    gains = observer_gains(name, CORRECTED, 1e-3)
    posed = observer_problem(chapter_pie(name))
    P = gains.storage.operator(coordinates(posed, COUNT))
    L = gain_of(gains.energy)
    return P, P @ L, L


def parameters_of(P: PIOperator) -> Parameters:
    """(7) from the coefficients, without octarm's algebra."""

    def scaled(coefficients: Array, axis: int) -> Array:
        shape = [1] * coefficients.ndim
        shape[axis] = -1
        factors = np.sqrt(2.0 * np.arange(coefficients.shape[axis]) + 1.0)
        return np.asarray(coefficients * factors.reshape(shape))

    def function(coefficients: Array) -> Function:
        a = scaled(coefficients, 2)
        return lambda s: np.asarray(np.moveaxis(a @ _powers(s, a.shape[2]).T, 2, 0))

    def kernel(coefficients: Array) -> Kernel:
        a = scaled(scaled(coefficients, 2), 3)
        return lambda s, t: np.einsum(
            "qnij,ki,kj->kqn", a, _powers(s, a.shape[2]), _powers(t, a.shape[3]), optimize=True
        )

    return Parameters(
        P.p, function(P.q1), function(P.q2), function(P.r0), kernel(P.r1), kernel(P.r2)
    )


def _powers(s: Array, size: int) -> Array:
    return np.asarray(plain.legvander(2.0 * s - 1.0, size - 1), dtype=np.float64)


@dataclass(frozen=True)
class ArmRow:
    """The arm's P at a setpoint and the ways to P^-1, P^-1 Z."""

    setpoint: str
    least: float
    greatest: float
    """Eigenvalues of P."""
    octarm: float
    """P^-1 on polynomials of degree < 6 against quadrature."""
    octarm_gain: float
    """P^-1 (P L) against the polynomial L."""
    one: dict[str, float]
    """P^-1 (P L) by the formula with one kernel, against L."""
    rank: int
    """Of P's kernels."""
    ranks: tuple[int, ...]
    """Of those of P^-1 at RANK_TOLERANCES."""


def arm_row(name: str, size: int = 40) -> ArmRow:
    """At one setpoint ("1", "2", "3")."""
    P, Z, L = arm(name)
    rule = Nystrom(parameters_of(P), size)
    finite, y = right_sides(0, 4)
    identity = PIOperator.identity(P.shape_in)
    inverse, _ = gain_operator(P, identity)
    found = applied(inverse, finite, y, rule.nodes)
    gain, _ = gain_operator(P, Z)
    at = parameters_of(L).Q2(rule.nodes)
    none = np.zeros((0, at.shape[2]))
    kernels = solve_gain(P, identity)
    ranks = [factorise(kernels, tolerance)[0].ranks[0] for tolerance in RANK_TOLERANCES]
    values = rule.eigenvalues()
    return ArmRow(
        name,
        float(values[0]),
        float(values[-1]),
        relative(found, rule.solve(finite, y), rule.weights),
        relative((none, parameters_of(gain).Q2(rule.nodes)), (none, at), rule.weights),
        {
            way: relative(
                of_one_kernel(P, kernel).inverse().apply(none, parameters_of(Z).Q2, rule.nodes),
                (none, at),
                rule.weights,
            )
            for way, kernel in one_kernels(P).items()
        },
        separate(P.r1)[0].shape[1],
        tuple(ranks),
    )
