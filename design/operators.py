"""4-PI operators: the algebra in which PDEs, Lyapunov functions and gains are written without discretisation.

A 4-PI operator (chapter (7)) maps R^m x L2^n[0,1] to R^p x L2^q[0,1]:

    finite part    P x + int_0^1 Q1(s) y(s) ds
    function part  Q2(s) x + R0(s) y(s) + int_0^s R1(s,t) y(t) dt + int_s^1 R2(s,t) y(t) dt.

All parameters are matrix polynomials, stored as coefficients in the orthonormal Legendre basis; sums,
compositions and adjoints are exact up to rounding. A 3-PI operator (6) is the case m = p = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from design import legendre
from design.legendre import Array


class Shape(NamedTuple):
    """Dimensions: R^finite x L2^functions."""

    finite: int
    functions: int


@dataclass(frozen=True, eq=False)
class PIOperator:
    """A 4-PI operator with polynomial parameters on [0, 1].

    p: (p, m); q1: (p, n, d); q2: (q, m, d); r0: (q, n, d); r1, r2: (q, n, ds, dt).
    Raises ValueError if the shapes do not fit together.
    """

    p: Array
    q1: Array
    q2: Array
    r0: Array
    r1: Array
    r2: Array

    def __post_init__(self) -> None:
        (pf, mf), (q, n) = self.p.shape, self.r0.shape[:2]
        expected = {
            "q1": (self.q1.shape[:2], (pf, n)),
            "q2": (self.q2.shape[:2], (q, mf)),
            "r1": (self.r1.shape[:2], (q, n)),
            "r2": (self.r2.shape[:2], (q, n)),
        }
        for name, (got, want) in expected.items():
            if got != want:
                raise ValueError(f"PIOperator.{name}: expected a {want} matrix, got {got}")

    @property
    def shape_out(self) -> Shape:
        """Dimensions of the range."""
        return Shape(self.p.shape[0], self.r0.shape[0])

    @property
    def shape_in(self) -> Shape:
        """Dimensions of the domain."""
        return Shape(self.p.shape[1], self.r0.shape[1])

    @classmethod
    def zeros(cls, out: Shape, into: Shape) -> PIOperator:
        """The zero operator from `into` to `out`."""
        return cls(
            p=np.zeros((out.finite, into.finite)),
            q1=np.zeros((out.finite, into.functions, 1)),
            q2=np.zeros((out.functions, into.finite, 1)),
            r0=np.zeros((out.functions, into.functions, 1)),
            r1=np.zeros((out.functions, into.functions, 1, 1)),
            r2=np.zeros((out.functions, into.functions, 1, 1)),
        )

    @classmethod
    def multiplier(cls, coefficients: Array) -> PIOperator:
        """Multiplication by a matrix polynomial of shape (q, n, d)."""
        zero = cls.zeros(Shape(0, coefficients.shape[0]), Shape(0, coefficients.shape[1]))
        return zero.replace(r0=coefficients)

    @classmethod
    def identity(cls, shape: Shape) -> PIOperator:
        """The identity of R^finite x L2^functions."""
        zero = cls.zeros(shape, shape)
        return zero.replace(p=np.eye(shape.finite), r0=np.eye(shape.functions)[:, :, None])

    def replace(self, **parameters: Array) -> PIOperator:
        """The same operator with some parameters exchanged."""
        fields = {key: getattr(self, key) for key in ("p", "q1", "q2", "r0", "r1", "r2")}
        return PIOperator(**(fields | parameters))

    def trimmed(self, tolerance: float = 1e-13) -> PIOperator:
        """Without the trailing coefficients below rounding (relative to the largest parameter)."""
        arrays = {k: getattr(self, k) for k in ("q1", "q2", "r0", "r1", "r2")}
        level = tolerance * max(float(np.abs(a).max(initial=0.0)) for a in arrays.values())
        level = level if np.isfinite(level) else 0.0
        return PIOperator(
            p=self.p,
            **{k: legendre.trim(a, tuple(range(2, a.ndim)), level) for k, a in arrays.items()},
        )

    def __add__(self, other: PIOperator) -> PIOperator:
        """Sum; ValueError if the dimensions differ."""
        if (self.shape_out, self.shape_in) != (other.shape_out, other.shape_in):
            raise ValueError(
                f"cannot add PI operators {self.shape_in} -> {self.shape_out} and "
                f"{other.shape_in} -> {other.shape_out}"
            )
        return PIOperator(
            p=self.p + other.p,
            q1=_padded_sum(self.q1, other.q1),
            q2=_padded_sum(self.q2, other.q2),
            r0=_padded_sum(self.r0, other.r0),
            r1=_padded_sum(self.r1, other.r1),
            r2=_padded_sum(self.r2, other.r2),
        )

    def __mul__(self, factor: float) -> PIOperator:
        """Scaling by a number."""
        return PIOperator(*(factor * getattr(self, k) for k in ("p", "q1", "q2", "r0", "r1", "r2")))

    __rmul__ = __mul__

    def __neg__(self) -> PIOperator:
        return self * -1.0

    def __sub__(self, other: PIOperator) -> PIOperator:
        return self + (-other)

    def __matmul__(self, other: PIOperator) -> PIOperator:
        """Composition (self o other); ValueError if the inner dimensions differ."""
        return compose(self, other)

    @property
    def adjoint(self) -> PIOperator:
        """The adjoint in R^m x L2^n (chapter, section 3.6): kernels change sides and are transposed."""
        return PIOperator(
            p=self.p.T,
            q1=self.q2.transpose(1, 0, 2),
            q2=self.q1.transpose(1, 0, 2),
            r0=self.r0.transpose(1, 0, 2),
            r1=self.r2.transpose(1, 0, 3, 2),
            r2=self.r1.transpose(1, 0, 3, 2),
        )

    def rows(self, finite: Sequence[int], functions: Sequence[int]) -> PIOperator:
        """The operator restricted to some of its outputs."""
        i, j = list(finite), list(functions)
        return PIOperator(self.p[i], self.q1[i], self.q2[j], self.r0[j], self.r1[j], self.r2[j])

    def apply(
        self, vector: Array, function: Callable[[Array], Array], s: Array, nodes: int = 80
    ) -> tuple[Array, Array]:
        """Apply to (vector (m,), function) where function maps points (k,) to values (n, k).

        Integrals are taken by Gauss quadrature with `nodes` points on [0, s] and [s, 1], exact for
        polynomials of degree below 2 nodes. Returns (finite part (p,), function part (q, len(s))).
        """
        x, w = legendre.gauss(nodes)
        finite = self.p @ vector + np.einsum(
            "pna,na,a->p", self.q1 @ legendre.basis(x, self.q1.shape[2]).T, function(x), w
        )
        points = np.atleast_1d(s)
        out = np.einsum("qma,m->qa", self.q2 @ legendre.basis(points, self.q2.shape[2]).T, vector)
        out = out + np.einsum(
            "qna,na->qa", self.r0 @ legendre.basis(points, self.r0.shape[2]).T, function(points)
        )
        for a, point in enumerate(points):
            for kernel, low, length in ((self.r1, 0.0, point), (self.r2, point, 1.0 - point)):
                t = low + length * x
                values = np.einsum(
                    "qnij,i,kj->qnk",
                    kernel,
                    legendre.basis(point, kernel.shape[2])[0],
                    legendre.basis(t, kernel.shape[3]),
                    optimize=True,
                )
                out[:, a] += np.einsum("qnk,nk,k->q", values, function(t), length * w)
        return finite, out

    def discretise(self, size_in: int, size_out: int | None = None) -> Array:
        """Galerkin matrix in orthonormal Legendre functions of degree below `size_in` / `size_out`.

        Shape (p + q size_out, m + n size_in); functions are ordered function by function. Exact: the
        entry is <phi_i, (operator) phi_j>.
        """
        rows = size_in if size_out is None else size_out
        (pf, q), (mf, n) = self.shape_out, self.shape_in
        out = np.zeros((pf + q * rows, mf + n * size_in))
        out[:pf, :mf] = self.p
        out[:pf, mf:] = _resize(self.q1, size_in).reshape(pf, n * size_in)
        out[pf:, :mf] = _resize(self.q2, rows).transpose(0, 2, 1).reshape(q * rows, mf)
        degree = max(self.r0.shape[2], *self.r1.shape[2:], *self.r2.shape[2:])
        nodes, weights = legendre.gauss(rows + size_in + degree + 1)
        values = legendre.basis(nodes, max(rows, size_in))
        r0 = self.r0 @ legendre.basis(nodes, self.r0.shape[2]).T
        block = np.einsum(
            "qna,ai,aj,a->qinj", r0, values[:, :rows], values[:, :size_in], weights, optimize=True
        )
        # int_0^s phi_k phi_j dt in the basis, sampled at the nodes
        for kernel, upper in ((self.r1, False), (self.r2, True)):
            kt = kernel.shape[3]
            primitive = legendre.antiderivative_of_products(kt, size_in, kt + size_in)
            inner = primitive @ legendre.basis(nodes, kt + size_in).T
            if upper:
                inner = np.eye(kt, size_in)[:, :, None] - inner
            left = np.einsum("qnik,ai->qnka", kernel, legendre.basis(nodes, kernel.shape[2]))
            block += np.einsum(
                "qnka,kja,ai,a->qinj", left, inner, values[:, :rows], weights, optimize=True
            )
        out[pf:, mf:] = block.reshape(q * rows, n * size_in)
        return out


def vertical(*operators: PIOperator) -> PIOperator:
    """Stack outputs: col(A, B, ...); all must have the same domain."""
    into = operators[0].shape_in
    if any(a.shape_in != into for a in operators):
        raise ValueError(
            f"cannot stack PI operators: their domains differ, {[a.shape_in for a in operators]}"
        )
    return PIOperator(
        p=np.concatenate([a.p for a in operators]),
        **{
            key: np.concatenate(_common([getattr(a, key) for a in operators]))
            for key in ("q1", "q2", "r0", "r1", "r2")
        },
    )


def horizontal(*operators: PIOperator) -> PIOperator:
    """Put side by side: [A, B, ...]; all must have the same range."""
    out = operators[0].shape_out
    if any(a.shape_out != out for a in operators):
        raise ValueError(
            "cannot put PI operators side by side: their ranges differ, "
            f"{[a.shape_out for a in operators]}"
        )
    return vertical(*(a.adjoint for a in operators)).adjoint


def compose(a: PIOperator, b: PIOperator) -> PIOperator:
    """The composition a o b (PI operators are closed under it, chapter, section 3.6)."""
    if a.shape_in != b.shape_out:
        raise ValueError(f"cannot compose: inner dimensions {a.shape_in} and {b.shape_out} differ")
    mul = legendre.multiply
    # With F_jk(s) = int_0^s phi_j phi_k, every triple integral is a contraction over j or k with
    #   X_j(t) = sum_k F_jk(t) (B2 - B1)_k(t)    and    Y_k(s) = sum_j (A1 - A2)_j(s) F_jk(s).
    difference_b = _padded_sum(b.r2, -b.r1)
    difference_a = _padded_sum(a.r1, -a.r2)
    ja = max(a.r1.shape[3], a.r2.shape[3])
    kb = max(b.r1.shape[2], b.r2.shape[2])
    x = _contract_with_primitive(difference_b, ja, b_side=True)
    y = _contract_with_primitive(difference_a, kb, b_side=False)
    shared = _kernel_product(a.r2, b.r1)
    outer = np.tensordot(a.q2, b.q1, axes=(1, 0)).transpose(0, 2, 1, 3)
    r1 = _sum_all(
        _left_multiply(a.r0, b.r1), _right_multiply(a.r1, b.r0),
        _kernel_product(a.r1, x), _kernel_product(y, b.r1), shared, outer,
    )  # fmt: skip
    r2 = _sum_all(
        _left_multiply(a.r0, b.r2), _right_multiply(a.r2, b.r0),
        _kernel_product(a.r2, x), _kernel_product(y, b.r2), shared, outer,
    )  # fmt: skip
    return PIOperator(
        p=a.p @ b.p + _inner(a.q1, b.q2),
        q1=_sum_all(
            np.tensordot(a.p, b.q1, axes=1), mul(a.q1, b.r0), _row_through_kernels(a.q1, b)
        ),
        q2=_sum_all(
            np.einsum("qmd,mn->qnd", a.q2, b.p), mul(a.r0, b.q2), _kernels_on_column(a, b.q2)
        ),
        r0=mul(a.r0, b.r0),
        r1=r1,
        r2=r2,
    ).trimmed()


def _kernels_on_column(a: PIOperator, column: Array) -> Array:
    """int_0^s A1(s,t) g(t) dt + int_s^1 A2(s,t) g(t) dt for g of shape (n, m, d)."""
    y = _contract_with_primitive(_padded_sum(a.r1, -a.r2), column.shape[2], b_side=False)
    return _padded_sum(_contract_degree(y, column), _contract_degree(a.r2, column))


def _row_through_kernels(row: Array, b: PIOperator) -> Array:
    """int_0^1 q(s) (kernel part of b)(s, t) ds as a polynomial in t, by the adjoint of the above."""
    return _kernels_on_column(b.adjoint, row.transpose(1, 0, 2)).transpose(1, 0, 2)


def _contract_degree(kernel: Array, column: Array) -> Array:
    size = min(kernel.shape[3], column.shape[2])
    pairs = np.tensordot(kernel[..., :size], column[..., :size], axes=((1, 3), (0, 2)))
    return np.asarray(pairs.transpose(0, 2, 1))


def _kernel_product(left: Array, right: Array) -> Array:
    """int_0^1 left(s, r) right(r, t) dr: contraction over the basis of r."""
    if not (left.any() and right.any()):
        return np.zeros((left.shape[0], right.shape[1], 1, 1))
    size = min(left.shape[3], right.shape[2])
    pairs = np.tensordot(left[..., :size], right[:, :, :size], axes=((1, 3), (0, 2)))
    return np.asarray(pairs.transpose(0, 2, 1, 3))


def _contract_with_primitive(kernel: Array, other: int, *, b_side: bool) -> Array:
    """X_j(t) (b_side) or Y_k(s): the kernel's inner basis index paired with int_0^. phi_j phi_k."""
    if not kernel.any():
        return np.zeros((*kernel.shape[:2], 1, 1))
    if b_side:
        table = legendre.products_with_antiderivatives(kernel.shape[3], other, kernel.shape[2])
        return np.asarray(np.tensordot(kernel, table, axes=((2, 3), (2, 0))))
    table = legendre.products_with_antiderivatives(kernel.shape[2], kernel.shape[3], other)
    return np.asarray(np.tensordot(kernel, table, axes=((2, 3), (0, 1))).swapaxes(2, 3))


def _left_multiply(multiplier: Array, kernel: Array) -> Array:
    if not (multiplier.any() and kernel.any()):
        return np.zeros((multiplier.shape[0], kernel.shape[1], 1, 1))
    table = legendre.products(multiplier.shape[2], kernel.shape[2])
    spread = np.tensordot(multiplier, table, axes=(2, 0))  # (q, k, i, p)
    pairs = np.tensordot(spread, kernel, axes=((1, 2), (0, 2)))  # (q, p, n, j)
    return np.asarray(pairs.transpose(0, 2, 1, 3))


def _right_multiply(kernel: Array, multiplier: Array) -> Array:
    return _left_multiply(multiplier.transpose(1, 0, 2), kernel.transpose(1, 0, 3, 2)).transpose(
        1, 0, 3, 2
    )


def _inner(row: Array, column: Array) -> Array:
    size = min(row.shape[2], column.shape[2])
    return np.asarray(np.tensordot(row[..., :size], column[..., :size], axes=((1, 2), (0, 2))))


def _resize(coefficients: Array, size: int) -> Array:
    out = np.zeros((*coefficients.shape[:2], size))
    keep = min(size, coefficients.shape[2])
    out[..., :keep] = coefficients[..., :keep]
    return out


def _common(arrays: Sequence[Array]) -> list[Array]:
    """Pad the degree axes (all from the third on) to a common size."""
    target = _largest_degrees(arrays)
    return [_sum_to(target, (a,)) if a.shape[2:] != target else a for a in arrays]


def _padded_sum(a: Array, b: Array) -> Array:
    return a + b if a.shape == b.shape else _sum_to(_largest_degrees((a, b)), (a, b))


def _sum_all(*arrays: Array) -> Array:
    return _sum_to(_largest_degrees(arrays), arrays)


def _largest_degrees(arrays: Sequence[Array]) -> tuple[int, ...]:
    return (
        tuple(map(max, *(a.shape[2:] for a in arrays))) if len(arrays) > 1 else arrays[0].shape[2:]
    )


def _sum_to(degrees: tuple[int, ...], arrays: Sequence[Array]) -> Array:
    out = np.zeros((*arrays[0].shape[:2], *degrees))
    for a in arrays:
        part: tuple[slice, ...] = (slice(None), slice(None), *map(slice, a.shape[2:]))
        out[part] += a
    return out
