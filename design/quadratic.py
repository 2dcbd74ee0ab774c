"""Quadratic forms of PI rows: what turns an operator inequality into linear equations for Gram matrices.

A row is a PI operator with one function output; the form of a pair of rows (a, b) is <a xi, b xi>. Its
operator a* b + b* a is unique, so matching coefficients in the orthonormal basis is exact: no sampling
(theory, section 3, point 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design import legendre
from design.legendre import Array
from design.operators import PIOperator, Shape, vertical

_NEGLIGIBLE = 1e-13
"""Coefficients below this, relative to the largest of all forms, are rounding of the compositions."""


@dataclass(frozen=True)
class FormTable:
    """Coefficients of self-adjoint 4-PI operators, one per entry of the leading axes (a, b).

    p: (a, b, m, m); q: (a, b, n, m, d); r0: (a, b, n, n, d); r1: (a, b, n, n, ds, dt). The missing
    parameters follow from self-adjointness.
    """

    p: Array
    q: Array
    r0: Array
    r1: Array

    def symmetric(self) -> FormTable:
        """Entry (a, b) plus entry (b, a)."""
        return FormTable(*(x + x.swapaxes(0, 1) for x in (self.p, self.q, self.r0, self.r1)))

    def trace(self) -> FormTable:
        """Sum over the diagonal a = b, kept as a table of shape (1, 1)."""
        return FormTable(
            *(np.einsum("aa...->...", x)[None, None] for x in (self.p, self.q, self.r0, self.r1))
        )

    def upper(self, diagonal_factor: float) -> FormTable:
        """The entries a <= b as a (count, 1) table, the diagonal ones scaled."""
        i, j = np.triu_indices(self.p.shape[0])
        factor = np.where(i == j, diagonal_factor, 1.0)
        return FormTable(
            *(
                (x[i, j] * factor.reshape(-1, *[1] * (x.ndim - 2)))[:, None]
                for x in (self.p, self.q, self.r0, self.r1)
            )
        )

    def __mul__(self, number: float) -> FormTable:
        return FormTable(self.p * number, self.q * number, self.r0 * number, self.r1 * number)

    def __add__(self, other: FormTable) -> FormTable:
        return FormTable(
            *(
                _pad_add(x, y)
                for x, y in zip(
                    (self.p, self.q, self.r0, self.r1),
                    (other.p, other.q, other.r0, other.r1),
                    strict=True,
                )
            )
        )


def forms(left: PIOperator, right: PIOperator) -> FormTable:
    """All forms of pairs (row of left, row of right); both map the same space to functions only.

    Raises ValueError if the domains differ or a row has a finite output.
    """
    if left.shape_in != right.shape_in or left.shape_out.finite or right.shape_out.finite:
        raise ValueError(
            f"forms need rows on one space: got {left.shape_in} -> {left.shape_out} and "
            f"{right.shape_in} -> {right.shape_out}"
        )
    m, n = left.shape_in
    count = left.shape_out.functions
    columns = _adjoint_columns(left)
    parts: list[FormTable] = []
    for j in range(right.shape_out.functions):
        c = columns @ right.rows([], [j])
        p = c.p.reshape(count, m, m)
        q1 = c.q1.reshape(count, m, n, c.q1.shape[2])
        q2 = c.q2.reshape(count, n, m, c.q2.shape[2])
        r0 = c.r0.reshape(count, n, n, c.r0.shape[2])
        r1 = c.r1.reshape(count, n, n, *c.r1.shape[2:])
        r2 = c.r2.reshape(count, n, n, *c.r2.shape[2:])
        parts.append(
            FormTable(
                p=p + p.transpose(0, 2, 1),
                q=_pad_add(q2, q1.transpose(0, 2, 1, 3)),
                r0=r0 + r0.transpose(0, 2, 1, 3),
                r1=_pad_add(r1, r2.transpose(0, 2, 1, 4, 3)),
            )
        )
    return FormTable(
        *(
            np.stack(_common([getattr(t, key) for t in parts], 3), axis=1)
            for key in ("p", "q", "r0", "r1")
        )
    )


def coefficient_matrix(tables: list[FormTable]) -> Array:
    """Columns: all entries of all tables in order; rows: the coefficients that an equality must match.

    Rows that are zero for every column are left out, as are coefficients at the level of rounding.
    """
    q = _common([t.q for t in tables], 4)
    r0 = _common([t.r0 for t in tables], 4)
    r1 = _common([t.r1 for t in tables], 4)
    m, n = tables[0].p.shape[2], tables[0].r0.shape[2]
    im, jm = np.triu_indices(m)
    i0, j0 = np.triu_indices(n)
    columns = []
    for t, qt, r0t, r1t in zip(tables, q, r0, r1, strict=True):
        count = t.p.shape[0] * t.p.shape[1]
        flat = [t.p[:, :, im, jm], qt, r0t[:, :, i0, j0], r1t]
        columns.append(
            np.concatenate([x.reshape(count, int(x.size / count)) for x in flat], axis=1)
        )
    matrix = np.concatenate(columns).T
    matrix[np.abs(matrix) < _NEGLIGIBLE * np.abs(matrix).max()] = 0.0
    return np.ascontiguousarray(matrix[np.any(matrix != 0.0, axis=1)])


def weighted(rows: PIOperator, weight: Array) -> PIOperator:
    """Every row times the scalar polynomial `weight` (orthonormal coefficients)."""

    def times(coefficients: Array) -> Array:
        matrix = legendre.multiplication(tuple(weight), coefficients.shape[2])
        return np.moveaxis(np.tensordot(coefficients, matrix, axes=(2, 1)), -1, 2)

    return rows.replace(
        q2=times(rows.q2), r0=times(rows.r0), r1=times(rows.r1), r2=times(rows.r2)
    ).trimmed()


def lifted(finite: PIOperator) -> PIOperator:
    """Finite outputs as constant functions on [0, 1]."""
    m = finite.shape_out.finite
    lift = PIOperator.zeros(Shape(0, m), Shape(m, 0)).replace(q2=np.eye(m)[:, :, None])
    return lift @ finite


def unit_rows(rows: PIOperator) -> PIOperator:
    """Rows scaled to about Hilbert-Schmidt norm one, to balance Gram matrices.

    Multipliers count by their L2 norm, kernels by half their squares over the whole of [0, 1]^2.
    """
    out = []
    for i in range(rows.shape_out.functions):
        row = rows.rows([], [i])
        squares = np.sum(row.q2**2) + np.sum(row.r0**2)
        squares += 0.5 * (np.sum(row.r1**2) + np.sum(row.r2**2))
        out.append(row * float(1.0 / np.sqrt(squares)))
    return vertical(*out)


def function_span(columns: list[Array], tolerance: float = 1e-7) -> Array:
    """Orthonormal basis, constant first, of the span of scalar polynomials; shape (count, degree + 1)."""
    size = max(c.size for c in columns)
    stacked = np.array([np.pad(c, (0, size - c.size)) for c in columns])
    norms = np.linalg.norm(stacked, axis=1)
    stacked = stacked[norms > tolerance] / norms[norms > tolerance][:, None]
    constant = np.eye(1, size)
    rest = stacked - stacked[:, :1] * constant
    _, values, vectors = np.linalg.svd(rest, full_matrices=False)
    return np.concatenate([constant, vectors[values > tolerance]])


def _adjoint_columns(rows: PIOperator) -> PIOperator:
    """L2 -> R^(q m) x L2^(q n): the adjoints of all q rows stacked, so that one composition serves all."""
    q = rows.shape_out.functions
    m, n = rows.shape_in
    a = rows.adjoint
    return PIOperator(
        p=np.zeros((q * m, 0)),
        q1=a.q1.transpose(1, 0, 2).reshape(q * m, 1, a.q1.shape[2]),
        q2=np.zeros((q * n, 0, 1)),
        r0=a.r0.transpose(1, 0, 2).reshape(q * n, 1, a.r0.shape[2]),
        r1=a.r1.transpose(1, 0, 2, 3).reshape(q * n, 1, *a.r1.shape[2:]),
        r2=a.r2.transpose(1, 0, 2, 3).reshape(q * n, 1, *a.r2.shape[2:]),
    )


def _common(arrays: list[Array], first: int) -> list[Array]:
    """Pad the degree axes, from `first` on, to a common size."""
    sizes = [max(a.shape[k] for a in arrays) for k in range(first, arrays[0].ndim)]
    return [
        np.pad(a, [(0, 0)] * first + [(0, s - a.shape[first + i]) for i, s in enumerate(sizes)])
        for a in arrays
    ]


def _pad_add(a: Array, b: Array) -> Array:
    shape = [max(x, y) for x, y in zip(a.shape, b.shape, strict=True)]
    left = np.pad(a, [(0, s - x) for s, x in zip(shape, a.shape, strict=True)])
    return left + np.pad(b, [(0, s - x) for s, x in zip(shape, b.shape, strict=True)])


__all__ = [
    "FormTable",
    "coefficient_matrix",
    "forms",
    "function_span",
    "lifted",
    "unit_rows",
    "weighted",
]
