"""Polynomials that meet the conditions of a PDE, and expressions as matrices on them; used by `galerkin`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legder
from numpy.polynomial.polynomial import polyval
from scipy import linalg

from design import legendre
from design.legendre import Array
from design.pde.model import (
    Atom,
    Expression,
    Field,
    Input,
    InputIntegral,
    Integral,
    Kind,
    Output,
    Pde,
    Point,
    Polynomial,
    Signal,
)

_RANK = 1e-11
"""Singular values of the conditions below this share of the largest are zero: one repeats the others."""
_ROUNDING = 1e-14
"""Entries of the conditions below this, in rows of length one, are rounding."""


class Matrices(NamedTuple):
    """What an expression does to coordinates q, disturbances w and controls u: one number of rows."""

    q: Array
    w: Array
    u: Array


@dataclass(frozen=True, eq=False)
class TrialSpace:
    """Polynomials of degree below sizes[i] + order for each state that together meet all conditions.

    derivatives[i][j]: (sizes[i] + order - j, len(q)), from q to the orthonormal Legendre coefficients of
    d^j x_i / ds^j, (1, len(q)) for an ode state; |q| is the norm of the state in R^m x L2. Signals: scalar
    ones in the PDE's order, then `size` Legendre coefficients of every distributed one.
    """

    pde: Pde
    size: int
    sizes: tuple[int, ...]
    derivatives: tuple[tuple[Array, ...], ...]

    @property
    def top(self) -> int:
        """Number of Legendre coefficients that holds every expression exactly."""
        return self.rows + _degree(self.pde)

    @property
    def rows(self) -> int:
        """Number of Legendre coefficients that holds every state."""
        return max(self.sizes) + max(s.order or 0 for s in self.pde.states)

    @property
    def dimension(self) -> int:
        """len(q)."""
        return int(self.derivatives[0][0].shape[1])

    def outputs(self, outputs: Sequence[Output], size: int) -> Matrices:
        """Rows of the scalar outputs, then `size` Legendre coefficients of every distributed one."""
        parts = [
            self.matrices(o.expression, size if o.distributed else None)
            for o in sorted(outputs, key=lambda o: o.distributed)
        ]
        return Matrices(*(np.vstack(blocks) for blocks in zip(self._zeros(0), *parts, strict=True)))

    def matrices(self, expression: Expression, size: int | None) -> Matrices:
        """Of an expression that is a number (size None, one row) or a function (`size` coefficients).

        Raises ValueError if a term does not fit to its state, or depends on s where a number is needed.
        """
        nodes, weights = legendre.gauss(self.top + 1)
        points = np.zeros(1) if size is None else nodes
        out = self._zeros(len(points))
        for atom, coefficient in expression.terms:
            self._check(expression, atom, coefficient, number=size is None)
            block, values = self._values(out, atom, points)
            block += _polynomial(coefficient, points)[:, None] * values
        if size is None:
            return out
        transform = legendre.basis(nodes, size).T * weights
        return Matrices(*(transform @ block for block in out))

    def tests(self, state: int) -> Array:
        """(sizes[state] or 1, top): Legendre coefficients of a derivative of the equation.

        Of the highest that all its terms have: of u_t = v, v in H^1, the first. So u may share a condition
        with v.
        """
        pde, order = self.pde, self.pde.states[state].order
        if order is None:
            return np.eye(1)
        spare = order
        for atom, _ in pde.equations[state].terms:
            match atom:
                case Field(i, j):
                    have = pde.states[i].order
                    spare = spare if have is None else min(spare, have - j)
                case Input(kind, k) if _signals(pde, kind)[k].distributed:
                    spare = 0
        scale = np.sqrt(2.0 * np.arange(self.top) + 1.0)
        derivative = legder(np.diag(scale), max(spare, 0), scl=2.0)
        size = self.sizes[state]
        return np.asarray(derivative[:size] / scale[:size, None])

    def _zeros(self, rows: int) -> Matrices:
        signals = (self.pde.disturbances, self.pde.controls)
        w, u = (sum(_width(s, self.size) for s in group) for group in signals)
        return Matrices(*(np.zeros((rows, width)) for width in (self.dimension, w, u)))

    def _values(self, out: Matrices, atom: Atom, points: Array) -> tuple[Array, Array]:
        """The block of `out` that the atom belongs to, and its values at the points (or one row)."""
        match atom:
            case Field(i, j):
                d = self.derivatives[i][j]
                return out.q, d if self.pde.states[i].order is None else _at(points, d)
            case Point(i, j, end):
                return out.q, _at(np.array([float(end)]), self.derivatives[i][j])
            case Integral(i, j, weight):
                return out.q, self._integral(weight, self.derivatives[i][j])
            case Input(kind, k):
                block, signal = self._signal(out, kind, k)
                distributed = _signals(self.pde, kind)[k].distributed
                return block, _at(points, signal) if distributed else signal
            case InputIntegral(kind, k, weight):
                block, signal = self._signal(out, kind, k)
                return block, self._integral(weight, signal)

    def _integral(self, weight: Polynomial, coefficients: Array) -> Array:
        """(1, columns): int_0^1 weight times the functions with these Legendre coefficients."""
        nodes, weights = legendre.gauss(self.top + 1)
        return np.asarray((_polynomial(weight, nodes) * weights)[None] @ _at(nodes, coefficients))

    def _signal(self, out: Matrices, kind: Kind, index: int) -> tuple[Array, Array]:
        """The block of a signal, and what picks its number or coefficients from all the signals'."""
        signals = _signals(self.pde, kind)
        order = sorted(range(len(signals)), key=lambda k: signals[k].distributed)
        widths = [_width(signals[k], self.size) for k in order]
        pick = np.split(np.eye(sum(widths)), np.cumsum(widths)[:-1])[order.index(index)]
        return (out.w if kind is Kind.DISTURBANCE else out.u), pick

    def _check(
        self, expression: Expression, atom: Atom, coefficient: Polynomial, *, number: bool
    ) -> None:
        where = f"{self.pde.name or 'PDE'}: {atom} in {expression.text or 'an expression'!r}"
        if isinstance(atom, Field | Point | Integral):
            order = self.pde.states[atom.state].order
            most = order or 0
            if isinstance(atom, Point):
                most -= 1
            elif isinstance(atom, Integral) and order is None:
                most = -1
            if atom.derivative > most:
                raise ValueError(f"{where}: its state, of order {order}, has no such derivative")
        if number and (
            any(coefficient[1:])
            or (isinstance(atom, Field) and self.pde.states[atom.state].order is not None)
            or (isinstance(atom, Input) and _signals(self.pde, atom.kind)[atom.index].distributed)
        ):
            raise ValueError(f"{where}: depends on s, but the expression is to be a number")


def trial_space(pde: Pde, size: int, sizes: tuple[int, ...] = ()) -> TrialSpace:
    """All such polynomials; without `sizes`, `size` for every state.

    First in the coordinates (x(0), .., d^{order-1} x(0), coefficients of d^order x) of each state, in which
    derivatives and conditions are bounded whatever the size; then along principal axes in L2, the shortest
    first: that order keeps the small eigenvalues of a stiff matrix accurate.
    """
    sizes = sizes or (size,) * len(pde.states)
    blocks = [_integrated(s.order, n) for s, n in zip(pde.states, sizes, strict=True)]
    widths = [b[0].shape[1] for b in blocks]
    columns = np.split(np.eye(sum(widths)), np.cumsum(widths)[:-1])
    raw = TrialSpace(
        pde,
        size,
        sizes,
        tuple(tuple(d @ c for d in b) for b, c in zip(blocks, columns, strict=True)),
    )
    free = _null_space(
        np.vstack([raw._zeros(0).q, *(raw.matrices(c, None).q for c in pde.conditions)])
    )
    values = np.vstack([d[0] for d in raw.derivatives])
    _, lengths, axes = np.linalg.svd(values @ free, full_matrices=False)
    q = (free @ (axes.T / lengths))[:, ::-1]
    q = q @ np.linalg.inv(np.linalg.qr(values @ q, mode="r"))  # orthonormal to rounding
    return TrialSpace(pde, size, sizes, tuple(tuple(d @ q for d in b) for b in raw.derivatives))


def _integrated(order: int | None, size: int) -> tuple[Array, ...]:
    """d^j x, j <= order, from (x(0), .., d^{order-1} x(0), coefficients of d^order x)."""
    if order is None:
        return (np.eye(1),)
    out = [np.hstack([np.zeros((size, order)), np.eye(size)])]
    for j in reversed(range(order)):
        count = len(out[0])
        lower = legendre.integration(count, count + 1).T @ out[0]
        lower[0, j] += 1.0
        out.insert(0, lower)
    return tuple(out)


def _null_space(conditions: Array) -> Array:
    """Orthonormal basis; coordinates that no condition touches stay as they are, free of rounding."""
    lengths = np.linalg.norm(conditions, axis=1, keepdims=True)
    scaled = conditions / np.where(lengths > 0.0, lengths, 1.0)
    scaled[np.abs(scaled) < _ROUNDING] = 0.0
    touched = np.any(scaled != 0.0, axis=0)
    if not touched.any():
        return np.eye(len(touched))
    small = linalg.null_space(scaled[:, touched], rcond=_RANK)
    out = np.zeros((len(touched), small.shape[1] + int(np.sum(~touched))))
    out[touched, : small.shape[1]] = small
    out[~touched, small.shape[1] :] = np.eye(int(np.sum(~touched)))
    return out


def _degree(pde: Pde) -> int:
    """A bound on the degree of coefficient times weight, over all expressions."""
    groups = (pde.regulated, pde.measured, pde.numerator, pde.denominator)
    outputs = [o.expression for group in groups for o in group]
    lengths = [
        len(coefficient) + (len(atom.weight) if isinstance(atom, Integral | InputIntegral) else 0)
        for expression in (*pde.equations, *pde.conditions, *outputs)
        for atom, coefficient in expression.terms
    ]
    return max(lengths, default=0)


def _signals(pde: Pde, kind: Kind) -> tuple[Signal, ...]:
    return pde.disturbances if kind is Kind.DISTURBANCE else pde.controls


def _width(signal: Signal, size: int) -> int:
    return size if signal.distributed else 1


def _at(points: Array, coefficients: Array) -> Array:
    """Values at the points, one row each, of functions with Legendre coefficients in the columns."""
    return legendre.basis(points, len(coefficients)) @ coefficients


def _polynomial(coefficients: Polynomial, points: Array) -> Array:
    return np.asarray(polyval(points, np.asarray(coefficients or (0.0,))))
