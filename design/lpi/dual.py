"""The dual PIE, T* v_t = A* v: state feedback by the usual dual LPI, chapter (21), without an adjoint PDE.

With P >= delta I and Z found for the dual, u = Z* P^-1 f acts on the fundamental state, so it needs spatial
derivatives of the state: the formulation of last resort, for regulated outputs that are not bounded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from design import legendre
from design.legendre import Array
from design.lpi.rows import Structure, dissipation_order
from design.operators import PIOperator
from design.pde.convert import Pie


def dual_pie(pie: Pie) -> Pie:
    """The PIE with T*, A*, inputs and outputs exchanged; its measured output is what u would drive.

    Signs follow T f_t = A f - B1 w: the dual's w is the negative of the regulated output's dual.
    """
    return replace(
        pie,
        T=pie.T.adjoint,
        A=pie.A.adjoint,
        B1=-pie.C1.adjoint,
        C1=pie.B1.adjoint,
        D11=-pie.D11.adjoint,
        C2=pie.B2.adjoint,
        D21=-pie.D12.adjoint,
        B2=pie.C2.adjoint,
        D12=pie.D21.adjoint,
        D22=pie.D22.adjoint,
        derivatives=(),
        ends=(),
    )


def dual_structure(dual: Pie) -> Structure:
    """Levels of T* v by differentiation; the dissipation orders are those of the PDE."""
    levels: list[tuple[PIOperator, int]] = []
    place = 0
    for i, variable in enumerate(dual.pde.states):
        if variable.order is None:
            continue
        row = dual.T.rows([], [place])
        highest = min(dissipation_order(dual.pde, i), max(variable.order - 1, 0))
        ladder = [row]
        for _ in range(highest):
            ladder.append(derivative(ladder[-1]))
        levels += [(ladder[j], highest - j) for j in range(highest, -1, -1)]
        place += 1
    return Structure(levels=tuple(levels), ends=None)


def derivative(rows: PIOperator) -> PIOperator:
    """d/ds of the function outputs of an operator without multiplier.

    Raises ValueError if there is a multiplier: the derivative is then no PI operator.
    """
    if np.abs(rows.r0).max(initial=0.0) > 1e-12:
        raise ValueError("the derivative of an operator with a multiplier is no PI operator")
    size = max(sum(rows.r1.shape[2:]), sum(rows.r2.shape[2:]))
    return rows.replace(
        q2=_differentiated(rows.q2, 2),
        r0=_diagonal(rows.r1, size) - _diagonal(rows.r2, size),
        r1=_differentiated(rows.r1, 2),
        r2=_differentiated(rows.r2, 2),
    ).trimmed()


def _differentiated(coefficients: Array, axis: int) -> Array:
    size = coefficients.shape[axis]
    matrix = np.zeros((size, max(size - 1, 1)))
    # phi_j' = sum over k < j, j - k odd, of 2 sqrt((2j+1)(2k+1)) phi_k, on [0, 1]
    for j in range(1, size):
        for k in range(j - 1, -1, -2):
            matrix[j, k] = 2.0 * np.sqrt((2 * j + 1) * (2 * k + 1))
    return np.moveaxis(np.tensordot(coefficients, matrix, axes=(axis, 0)), -1, axis)


def _diagonal(kernel: Array, size: int) -> Array:
    """The kernel at t = s as a polynomial in s with `size` coefficients."""
    nodes, _ = legendre.gauss(size)
    left = legendre.basis(nodes, kernel.shape[2])
    right = legendre.basis(nodes, kernel.shape[3])
    return legendre.fit(np.einsum("qnij,ai,aj->qna", kernel, left, right))
