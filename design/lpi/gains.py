"""Gains from P and Z: L = P^-1 Z for 4-PI operators, as an operator again.

The function part of P is inverted exactly (design.inverse: the ODE of separable kernels), ode states by the
Schur complement. The kernels of the result are smooth, no polynomials; they are fitted to the tolerance to
which their Legendre coefficients have fallen, which is reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from design import legendre
from design.inverse import SINGULAR, SampledKernels, solve_columns, solve_gain
from design.legendre import Array
from design.operators import PIOperator, Shape, horizontal, vertical


@dataclass(frozen=True)
class Gain:
    """A gain and where it acts.

    role 'observer': L, outputs -> rate of the state, xh_t = A xh + L (C2 xh - y). role 'controller': K, state
    -> controls, u = K x. tail: relative size of the last fitted coefficients. fundamental: for a K that acts on
    the fundamental state f instead, the map f -> x = T f.
    """

    role: str
    operator: PIOperator
    tail: float
    fundamental: PIOperator | None = None


def gain_operator(P: PIOperator, Z: PIOperator) -> tuple[PIOperator, float]:
    """P^-1 Z and the tail of the fit.

    Raises ValueError if the shapes do not fit and ArithmeticError if P is singular.
    """
    if P.shape_in != P.shape_out or Z.shape_out != P.shape_in:
        raise ValueError(
            f"P^-1 Z needs a square P and Z into its range; got P {P.shape_in} -> {P.shape_out}, "
            f"Z {Z.shape_in} -> {Z.shape_out}"
        )
    m, n = P.shape_in
    p, q1 = _finite_rows(P)
    z_rows = Z.rows(range(m), [])
    if not n:
        return _inverse(p.p, p.p) @ z_rows, 0.0
    R = PIOperator(
        p=np.zeros((0, 0)),
        q1=np.zeros((0, n, 1)),
        q2=np.zeros((n, 0, 1)),
        r0=P.r0,
        r1=P.r1,
        r2=P.r2,
    )
    of_z, tail_z = _inverse_times(R, Z.rows([], range(n)))
    if not m:
        return of_z, tail_z
    column = PIOperator.zeros(Shape(0, n), Shape(m, 0)).replace(q2=P.q2)
    of_column, tail_column = _inverse_times(R, column)
    schur = p - q1 @ of_column
    finite = _inverse(schur.p, p.p) @ (z_rows - q1 @ of_z)
    return vertical(_as_rows(finite), of_z - of_column @ finite), max(tail_z, tail_column)


def _inverse_times(R: PIOperator, Z: PIOperator) -> tuple[PIOperator, float]:
    """R^-1 Z for a 3-PI R: kernels and columns by the ODE."""
    n = R.shape_in.functions
    finite, functions = Z.shape_in
    parts = []
    tail, finer = 0.0, 1.0
    if finite:
        columns, tail = solve_columns(R, Z.q2)
        parts.append(PIOperator.zeros(Shape(0, n), Shape(finite, 0)).replace(q2=columns))
    if functions:
        kernels = solve_gain(
            R,
            PIOperator(
                p=np.zeros((0, 0)),
                q1=np.zeros((0, functions, 1)),
                q2=np.zeros((n, 0, 1)),
                r0=Z.r0,
                r1=Z.r1,
                r2=Z.r2,
            ),
        )
        parts.append(_fitted(kernels))
        tail, finer = max(tail, kernels.tail), kernels.finer
    if not parts:
        return Z, 0.0
    return horizontal(*parts).trimmed(1e-12 / finer), tail


def _fitted(kernels: SampledKernels) -> PIOperator:
    """The operator with polynomial kernels, interpolated at the samples."""
    operator = PIOperator.multiplier(legendre.interpolate(kernels.multiplier))
    outer1, inner1, outer2, inner2 = (
        legendre.interpolate(x)
        for x in (kernels.outer1, kernels.inner1, kernels.outer2, kernels.inner2)
    )
    return operator.replace(
        r1=np.einsum("qri,rmj->qmij", outer1, inner1),
        r2=np.einsum("qri,rmj->qmij", outer2, inner2),
    )


def _finite_rows(P: PIOperator) -> tuple[PIOperator, PIOperator]:
    """The two blocks of P's finite outputs: from the finite part and from the functions."""
    m, n = P.shape_in
    matrix = _matrix(P.p)
    row = PIOperator.zeros(Shape(m, 0), Shape(0, n)).replace(q1=P.q1)
    return matrix, row


def _inverse(schur: Array, block: Array) -> PIOperator:
    """Of P's Schur complement on the ode states; ArithmeticError if it is rounding against P's own block."""
    values = np.linalg.svd(schur, compute_uv=False)
    if not values[-1] > SINGULAR * max(values[0], float(np.linalg.norm(block, 2))):
        raise ArithmeticError("P is singular on the ode states: P is not coercive")
    return _matrix(np.linalg.inv(schur))


def _matrix(matrix: npt.ArrayLike) -> PIOperator:
    values = np.asarray(matrix, dtype=np.float64)
    zero = PIOperator.zeros(Shape(values.shape[0], 0), Shape(values.shape[1], 0))
    return zero.replace(p=values)


def _as_rows(operator: PIOperator) -> PIOperator:
    return operator.rows(range(operator.shape_out.finite), [])
