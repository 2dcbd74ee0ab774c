"""Quadratic forms of PI rows: what turns an operator inequality into linear equations for Gram matrices.

A row is a PI operator with one function output; the form of a pair of rows (a, b) is <a xi, b xi>. Its
operator a* b + b* a is unique, so matching coefficients in the orthonormal basis is exact: no sampling
(theory, section 3, point 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from design import legendre
from design.legendre import Array
from design.operators import PIOperator, Shape, compose

_NEGLIGIBLE = 1e-13
"""Coefficients below this, relative to the largest of all forms, are rounding of the compositions."""
_BATCH = 2**20
"""Kernel coefficients composed at once: bounds the memory, not the result."""

Index = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Coefficients:
    """Where the coefficients of a self-adjoint 4-PI operator on R^m x L2^n stand in a vector.

    p (m, m), q (n, m, degrees[0]), r0 (n, n, degrees[1]) and r1 (n, n, degrees[2], degrees[3]), in this order.
    The missing parameters follow from self-adjointness.
    """

    space: Shape
    degrees: tuple[int, int, int, int]

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Of p, q, r0 and r1."""
        (m, n), (q, r0, s, t) = self.space, self.degrees
        return (m, m), (n, m, q), (n, n, r0), (n, n, s, t)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def places(self) -> list[Index]:
        """The places of p, q, r0 and r1, in arrays of their shapes."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])
        parts = np.split(np.arange(self.size), ends[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True)]

    def within(self, larger: Coefficients) -> Index:
        """The place in `larger` of every coefficient."""
        return np.concatenate(
            [
                places[tuple(map(slice, shape))].ravel()
                for places, shape in zip(larger.places(), self.shapes, strict=True)
            ]
        )


class FormTable:
    """Coefficients of self-adjoint 4-PI operators, one for every entry (a, b) of a table.

    Kept sparse, for most rows act on one state only: `matrix` has a row per entry (b runs fastest) and a column
    per coefficient. Made from p (a, b, m, m), q (a, b, n, m, d), r0 (a, b, n, n, d), r1 (a, b, n, n, ds, dt).
    """

    entries: tuple[int, int]
    coefficients: Coefficients
    matrix: sparse.csr_array

    def __init__(self, p: Array, q: Array, r0: Array, r1: Array) -> None:
        self.entries = (p.shape[0], p.shape[1])
        degrees = (q.shape[4], r0.shape[4], r1.shape[4], r1.shape[5])
        self.coefficients = Coefficients(Shape(p.shape[2], r0.shape[2]), degrees)
        flat = [x.reshape(self.count, int(np.prod(x.shape[2:]))) for x in (p, q, r0, r1)]
        self.matrix = sparse.csr_array(np.concatenate(flat, axis=1))

    @classmethod
    def of(
        cls, entries: tuple[int, int], coefficients: Coefficients, matrix: sparse.csr_array
    ) -> FormTable:
        """From the matrix itself."""
        out = cls.__new__(cls)
        out.entries, out.coefficients, out.matrix = entries, coefficients, matrix
        return out

    @property
    def count(self) -> int:
        """Number of entries."""
        return self.entries[0] * self.entries[1]

    @property
    def p(self) -> Array:
        """(a, b, m, m)."""
        return self._part(0)

    @property
    def q(self) -> Array:
        """(a, b, n, m, d)."""
        return self._part(1)

    @property
    def r0(self) -> Array:
        """(a, b, n, n, d)."""
        return self._part(2)

    @property
    def r1(self) -> Array:
        """(a, b, n, n, ds, dt)."""
        return self._part(3)

    def _part(self, number: int) -> Array:
        places = self.coefficients.places()[number]
        part = self.matrix[:, places.ravel()].toarray()
        return np.asarray(part.reshape(*self.entries, *places.shape))

    def _with(self, matrix: sparse.csr_array) -> FormTable:
        return FormTable.of(self.entries, self.coefficients, matrix)

    def resized(self, coefficients: Coefficients) -> FormTable:
        """The same forms with room for higher degrees."""
        old = self.matrix
        places = self.coefficients.within(coefficients)[old.indices]
        shape = (old.shape[0], coefficients.size)
        matrix = sparse.csr_array((old.data, places, old.indptr), shape=shape)
        return FormTable.of(self.entries, coefficients, matrix)

    def symmetric(self) -> FormTable:
        """Entry (a, b) plus entry (b, a)."""
        swapped = np.arange(self.count).reshape(self.entries).T.ravel()
        return self._with(self.matrix + self.matrix[swapped])

    def trace(self) -> FormTable:
        """Sum over the diagonal a = b, kept as a table of shape (1, 1)."""
        diagonal = self.matrix[np.diag(np.arange(self.count).reshape(self.entries))]
        total = sparse.csr_array(np.ones((1, diagonal.shape[0]))) @ diagonal
        return FormTable.of((1, 1), self.coefficients, sparse.csr_array(total))

    def upper(self, diagonal_factor: float) -> FormTable:
        """The entries a <= b as a (count, 1) table, the diagonal ones scaled."""
        i, j = np.triu_indices(self.entries[0])
        factor = sparse.diags_array(np.where(i == j, diagonal_factor, 1.0))
        matrix = factor @ self.matrix[i * self.entries[1] + j]
        return FormTable.of((i.size, 1), self.coefficients, sparse.csr_array(matrix))

    def masked(self, keep: npt.NDArray[np.bool_]) -> FormTable:
        """The entries where keep (a, b) holds, the others zero."""
        matrix = sparse.diags_array(keep.ravel().astype(np.float64)) @ self.matrix
        return self._with(sparse.csr_array(matrix))

    def repeated(self, count: int) -> FormTable:
        """A (1, b) table as a (count, b) table of equal rows."""
        matrix = sparse.vstack([self.matrix] * count, format="csr")
        return FormTable.of((count, self.entries[1]), self.coefficients, matrix)

    def __mul__(self, number: float) -> FormTable:
        return self._with(self.matrix * number)

    def __add__(self, other: FormTable) -> FormTable:
        one, two = _common([self, other])
        return one._with(one.matrix + two.matrix)


def forms(left: PIOperator, right: PIOperator) -> FormTable:
    """All forms of pairs (row of left, row of right); both map the same space to functions only.

    Raises ValueError if the domains differ or a row has a finite output.
    """
    if left.shape_in != right.shape_in or left.shape_out.finite or right.shape_out.finite:
        raise ValueError(
            f"forms need rows on one space: got {left.shape_in} -> {left.shape_out} and "
            f"{right.shape_in} -> {right.shape_out}"
        )
    columns, rows = _Entries(left), _Entries(right)
    count, width = left.shape_out.functions, right.shape_out.functions
    degrees = [a + b for a, b in zip(columns.degrees, rows.degrees, strict=True)]
    per_row = max(len(columns.row) * len(rows.row) * degrees[0] * degrees[1] // max(count, 1), 1)
    step = max(_BATCH // per_row, 1)
    batches = _common(
        [
            _pairs(columns.between(first, min(first + step, count)), rows, left.shape_in)
            for first in range(0, max(count, 1), step)
        ]
    )
    matrix = sparse.vstack([b.matrix for b in batches], format="csr")
    return FormTable.of((count, width), batches[0].coefficients, matrix)


def coefficient_matrix(tables: list[FormTable]) -> Array:
    """Columns: all entries of all tables in order; rows: the coefficients that an equality must match.

    Rows that are zero for every column are left out, as are coefficients at the level of rounding.
    """
    tables = _common(tables)
    p, q, r0, r1 = tables[0].coefficients.places()
    wanted = [p[np.triu_indices(len(p))], q, r0[np.triu_indices(len(r0))], r1]
    matrix = sparse.vstack([t.matrix for t in tables], format="csc")
    matrix = matrix[:, np.concatenate([w.ravel() for w in wanted])]
    matrix.data[np.abs(matrix.data) < _NEGLIGIBLE * np.abs(matrix.data).max(initial=0.0)] = 0.0
    matrix.eliminate_zeros()
    present = np.flatnonzero(np.diff(matrix.indptr))
    return np.ascontiguousarray(matrix[:, present].T.toarray())


def weighted(rows: PIOperator, weight: Array) -> PIOperator:
    """Every row times the scalar polynomial `weight` (orthonormal coefficients)."""

    def times(coefficients: Array, axis: int) -> Array:
        table = np.tensordot(weight, legendre.products(weight.size, coefficients.shape[axis]), 1)
        return np.moveaxis(np.tensordot(coefficients, table, axes=(axis, 0)), -1, axis)

    if rows.shape_out.finite:
        raise ValueError(f"only functions can be weighted, not outputs {rows.shape_out}")
    return rows.replace(
        q2=times(rows.q2, 2), r0=times(rows.r0, 2), r1=times(rows.r1, 2), r2=times(rows.r2, 2)
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
    squares = np.sum(rows.q2**2, axis=(1, 2)) + np.sum(rows.r0**2, axis=(1, 2))
    squares += 0.5 * (np.sum(rows.r1**2, axis=(1, 2, 3)) + np.sum(rows.r2**2, axis=(1, 2, 3)))
    factor = 1.0 / np.sqrt(squares)[:, None, None]
    return rows.replace(
        q2=rows.q2 * factor,
        r0=rows.r0 * factor,
        r1=rows.r1 * factor[..., None],
        r2=rows.r2 * factor[..., None],
    )


class _Entries:
    """The entries of rows that are not zero, as one PI operator between functions of one component.

    Entry e is the coefficient of component `place[e]` of the domain's functions in row `row[e]`; likewise
    `finite_row` and `finite_place` for its numbers.
    """

    def __init__(self, rows: PIOperator) -> None:
        present = np.any(rows.r0 != 0.0, axis=2)
        present |= np.any(rows.r1 != 0.0, axis=(2, 3)) | np.any(rows.r2 != 0.0, axis=(2, 3))
        self.row, self.place = np.nonzero(present)
        self.finite_row, self.finite_place = np.nonzero(np.any(rows.q2 != 0.0, axis=2))
        self.degrees = tuple(map(max, rows.r1.shape[2:], rows.r2.shape[2:]))
        self._rows = rows

    def between(self, first: int, last: int) -> _Entries:
        """Those of the rows first .. last - 1, counted from zero."""
        return _Entries(self._rows.rows([], range(first, last)))

    @property
    def count(self) -> int:
        """Number of rows."""
        return self._rows.shape_out.functions

    @property
    def operator(self) -> PIOperator:
        """From one number or function per entry to the one function of a row."""
        rows, e = self._rows, (self.row, self.place)
        zero = PIOperator.zeros(Shape(0, 1), Shape(self.finite_row.size, self.row.size))
        return zero.replace(
            q2=rows.q2[self.finite_row, self.finite_place][None],
            r0=rows.r0[e][None],
            r1=rows.r1[e][None],
            r2=rows.r2[e][None],
        )


def _pairs(left: _Entries, right: _Entries, space: Shape) -> FormTable:
    """The forms of all pairs of rows, from one composition of all entries with all entries."""
    c = compose(left.operator.adjoint, right.operator)
    ends = c.r2.swapaxes(2, 3)
    inner = (max(c.r1.shape[2], ends.shape[2]), max(c.r1.shape[3], ends.shape[3]))
    degrees = (max(c.q1.shape[2], c.q2.shape[2]), c.r0.shape[2], *inner)
    coefficients = Coefficients(space, degrees)
    p, q, r0, r1 = coefficients.places()
    finite, function = (left.finite_row, left.finite_place), (left.row, left.place)
    finite_right, function_right = (right.finite_row, right.finite_place), (right.row, right.place)
    data, entry, place = [], [], []
    # every product and its adjoint; q alone stands for both mixed parts
    for values, (row, one), (other_row, other), places in (
        (c.p, finite, finite_right, p),
        (c.p, finite, finite_right, p.swapaxes(0, 1)),
        (c.q2, function, finite_right, q),
        (c.q1, finite, function_right, q.swapaxes(0, 1)),
        (c.r0, function, function_right, r0),
        (c.r0, function, function_right, r0.swapaxes(0, 1)),
        (c.r1, function, function_right, r1),
        (ends, function, function_right, r1.swapaxes(0, 1)),
    ):
        present = np.nonzero(values)
        e, f, *degree = present
        data.append(values[present])
        entry.append(row[e] * right.count + other_row[f])
        place.append(places[one[e], other[f], *degree])
    matrix = sparse.coo_array(
        (np.concatenate(data), (np.concatenate(entry), np.concatenate(place))),
        shape=(left.count * right.count, coefficients.size),
    )
    return FormTable.of((left.count, right.count), coefficients, matrix.tocsr())


def _common(tables: list[FormTable]) -> list[FormTable]:
    """The same tables with one place for every coefficient."""
    q, r0, s, t = map(max, zip(*(t.coefficients.degrees for t in tables), strict=True))
    common = Coefficients(tables[0].coefficients.space, (q, r0, s, t))
    return [t if t.coefficients == common else t.resized(common) for t in tables]


__all__ = [
    "FormTable",
    "coefficient_matrix",
    "forms",
    "lifted",
    "unit_rows",
    "weighted",
]
