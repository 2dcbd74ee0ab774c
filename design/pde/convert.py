"""From a PDE with boundary conditions to a partial integral equation: no conditions, no derivatives remain.

A function state of order k is x^(j)(s) = sum_{l < k-j} s^l/l! c_{j+l} + int_0^s (s-t)^(k-j-1)/(k-j-1)! f dt
with c_l = x^(l)(0) and f = x^(k) in L2. So every term of the PDE is a PI operator of (ode states X, constants
c | f); the conditions give c, and what remains has polynomial kernels on (X | f): chapter, (9)-(11), for any
mix of orders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from math import factorial

import numpy as np
from numpy.polynomial import polynomial

from design import legendre
from design.legendre import Array
from design.operators import PIOperator, Shape, compose, vertical
from design.pde.model import (
    Atom,
    Expression,
    Field,
    Input,
    InputIntegral,
    Kind,
    Output,
    Pde,
    Point,
    Polynomial,
    Signal,
)
from wire.errors import UsageError

NOISE = 1e-13
"""Coefficients below this, relative to the largest of their row, are rounding."""
FREE = (1e-3, 1e-10)
"""Singular values of the scaled conditions below which constants count as free; the second if this fails."""
INDEPENDENT = (1e-3, 1e-8)
"""Norms that the functionals of f belonging to the free constants must have, for each entry of FREE."""


@dataclass(frozen=True, eq=False)
class Pie:
    """T f_t = A f + B1 w + B2 u, z = C1 f + D11 w + D12 u, y = C2 f + D21 w + D22 u; x = T f.

    f = (ode states | one function per function state), x likewise; signals and outputs are (scalars |
    distributed ones), each in the PDE's order. The functions of f are the highest derivatives where the
    conditions determine all constants; else (Neumann at both ends, periodic) they also carry the free
    constants. f <-> x is one to one.
    """

    pde: Pde
    T: PIOperator
    A: PIOperator
    B1: PIOperator
    B2: PIOperator
    C1: PIOperator
    C2: PIOperator
    D11: PIOperator
    D12: PIOperator
    D21: PIOperator
    D22: PIOperator
    numerator: PIOperator
    denominator: PIOperator
    derivatives: tuple[tuple[int, int, PIOperator], ...]
    """(i, j, f -> d^j x_i / ds^j) for every function state i of the PDE and every j below its order."""
    ends: tuple[tuple[int, int, int, PIOperator], ...]
    """(i, j, end, f -> d^j x_i / ds^j (end)) for the same i, j and both ends 0, 1."""


def convert(pde: Pde) -> Pie:
    """The PIE of a PDE (theory, section 2; chapter (9)-(11)), exact up to rounding.

    Raises UsageError if the number of conditions is not the sum of the orders, if they are dependent or contain
    signals, or if a term asks for a derivative that its state does not have.
    """
    extended = _Extended(pde)
    substitution = _substitution(extended)

    def operators(outputs: Sequence[Output]) -> list[PIOperator]:
        """(f ->, w ->, u ->), scalar outputs first."""
        ordered = sorted(outputs, key=lambda output: output.distributed)
        rows = [extended.row(output.expression, output.distributed) for output in ordered]
        of_state, of_w, of_u = (
            _stack([row[k] for row in rows], into) for k, into in enumerate(extended.domains)
        )
        return [_cleaned(a) for a in (compose(of_state, substitution), of_w, of_u)]

    def substituted(operator: PIOperator) -> PIOperator:
        return _cleaned(compose(operator, substitution))

    functions = [state.order is not None for state in pde.states]
    identity = [Expression(((Field(i), (1.0,)),)) for i in range(len(pde.states))]
    T, _, _ = operators([Output(*pair) for pair in zip(identity, functions, strict=True)])
    A, B1, B2 = operators([Output(*pair) for pair in zip(pde.equations, functions, strict=True)])
    C1, D11, D12 = operators(pde.regulated)
    C2, D21, D22 = operators(pde.measured)
    values = extended.constants
    return Pie(
        pde=pde,
        T=T, A=A, B1=B1, B2=B2, C1=C1, C2=C2, D11=D11, D12=D12, D21=D21, D22=D22,
        numerator=operators(pde.numerator)[0],
        denominator=operators(pde.denominator)[0],
        derivatives=tuple((i, j, substituted(extended.field(i, j))) for i, j in values),
        ends=tuple(
            (i, j, end, substituted(extended.point(i, j, end))) for i, j in values for end in (0, 1)
        ),
    )  # fmt: skip


class _Extended:
    """Every atom as an operator with one output on (X, c | f), on the disturbances or on the controls."""

    def __init__(self, pde: Pde) -> None:
        self.pde = pde
        ode = [i for i, state in enumerate(pde.states) if state.order is None]
        functions = [i for i, state in enumerate(pde.states) if state.order is not None]
        self.ode = {state: k for k, state in enumerate(ode)}
        self.function = {state: k for k, state in enumerate(functions)}
        self.orders = {i: pde.states[i].order or 0 for i in functions}
        self.constants = [(i, j) for i in functions for j in range(self.orders[i])]
        self._place = {key: len(ode) + k for k, key in enumerate(self.constants)}
        self.domains = (
            Shape(len(ode) + len(self.constants), len(functions)),
            _signal_shape(pde.disturbances),
            _signal_shape(pde.controls),
        )

    def row(self, expression: Expression, distributed: bool) -> tuple[PIOperator, ...]:
        """The operators on the three domains that an expression is the sum of."""
        out = [PIOperator.zeros(_range(distributed), into) for into in self.domains]
        for atom, weight in expression.terms:
            where, operator = self.atom(atom, expression)
            out[where] = out[where] + self._times(weight, operator, distributed, expression)
        return tuple(out)

    def atom(self, atom: Atom, expression: Expression) -> tuple[int, PIOperator]:
        """(0 state, 1 disturbances, 2 controls; the operator)."""
        if isinstance(atom, (Input, InputIntegral)):
            return (1 if atom.kind is Kind.DISTURBANCE else 2), self._signal(atom)
        limit = self.orders.get(atom.state, 0)
        if isinstance(atom, Point):
            limit -= 1
        if atom.derivative > limit:
            name = self.pde.states[atom.state].name
            raise UsageError(
                f"{_file(self.pde)}: '{expression.text}' uses derivative {atom.derivative} of {name}, "
                f"but {name} has {_highest(limit)} there. Declare a higher order for {name} in [states] "
                "or lower the derivative."
            )
        if isinstance(atom, Point):
            return 0, self.point(atom.state, atom.derivative, atom.end)
        inside = self.field(atom.state, atom.derivative)
        return 0, inside if isinstance(atom, Field) else _integral(atom.weight, inside)

    def field(self, state: int, derivative: int) -> PIOperator:
        """d^j x_i / ds^j; of an ode state, the number X_i."""
        if state in self.ode:
            return _unit(self.domains[0], finite=self.ode[state])
        order, column = self.orders[state], self.function[state]
        if derivative == order:
            return _unit(self.domains[0], function=column)
        remaining = order - derivative
        q2 = np.zeros((1, self.domains[0].finite, remaining))
        for power in range(remaining):
            taylor = coefficients((0.0,) * power + (1.0 / factorial(power),))
            q2[0, self._place[state, derivative + power], : power + 1] = taylor
        r1 = np.zeros((1, self.domains[0].functions, remaining, remaining))
        nodes, _ = legendre.gauss(remaining)
        kernel = (nodes[:, None] - nodes) ** (remaining - 1) / factorial(remaining - 1)
        r1[0, column] = legendre.fit(legendre.fit(kernel).T).T
        return PIOperator.zeros(Shape(0, 1), self.domains[0]).replace(q2=q2, r1=r1)

    def point(self, state: int, derivative: int, end: int) -> PIOperator:
        """d^j x_i / ds^j (end): at 1 it is the value at 0 plus the integral of the next derivative."""
        if state in self.ode:
            return self.field(state, 0)
        at_zero = _unit(self.domains[0], finite=self._place[state, derivative])
        if end == 0:
            return at_zero
        return at_zero + _integral((1.0,), self.field(state, derivative + 1))

    def _signal(self, atom: Input | InputIntegral) -> PIOperator:
        signals = self.pde.disturbances if atom.kind is Kind.DISTURBANCE else self.pde.controls
        into = _signal_shape(signals)
        distributed = signals[atom.index].distributed
        place = sum(s.distributed is distributed for s in signals[: atom.index])
        operator = _unit(into, function=place) if distributed else _unit(into, finite=place)
        return operator if isinstance(atom, Input) else _integral(atom.weight, operator)

    def _times(
        self, weight: Polynomial, operator: PIOperator, distributed: bool, expression: Expression
    ) -> PIOperator:
        if distributed:
            column = coefficients(weight)[None, None]
            if operator.shape_out.finite:
                zero = PIOperator.zeros(Shape(0, 1), Shape(1, 0))
                return compose(zero.replace(q2=column), operator)
            return compose(PIOperator.multiplier(column), operator)
        if operator.shape_out.functions or any(weight[1:]):
            raise UsageError(
                f"{_file(self.pde)}: '{expression.text}' must be a number, but a term of it depends on s. "
                "Integrate it, int(...), or take it at an end of the domain."
            )
        return operator * weight[0]


def _substitution(extended: _Extended) -> PIOperator:
    """(X | f) -> (X, c | highest derivatives), by which every condition holds.

    The scaled conditions read Bx X + Bc c + Bf f = 0. With Bc = U S V^T, constants a = V^T c whose singular
    value is not small follow from their row of U^T(...) = 0. Small ones (r rows) are free instead: with g the
    r rows of U^T Bf, set a = (g g*)^(-1/2) g f and change f along g* so that those rows hold: a bijection too.
    """
    pde, names = extended.pde, extended.constants
    bx, bc, bf = _conditions(extended)
    u, s, vt = np.linalg.svd(bc)
    for free, independent in zip(FREE, INDEPENDENT, strict=True):
        r = int(np.sum(s < free))
        k = len(s) - r
        g = np.tensordot(u[:, k:].T, bf, axes=1)
        p, norms, q = np.linalg.svd(g.reshape(r, g[0].size if r else 1), full_matrices=False)
        if np.all(norms >= independent) and len(norms) == r:
            break
    else:
        raise _dependent(pde, u[:, k:] @ np.linalg.eigh(np.einsum("anj,bnj->ab", g, g))[1][:, 0])
    # c = V (large a, small a); the free rows p diag(norms) q f = -(S a + U^T Bx X), a = p q f
    into = Shape(len(extended.ode), len(extended.function))
    functionals = np.tensordot(p, q.reshape(r, *bf.shape[1:]), axes=1)
    gain = p / norms @ p.T
    of_state = -gain @ u[:, k:].T @ bx
    of_free = -np.eye(r) - gain * s[k:]
    column = functionals.transpose(1, 0, 2)
    feedback = np.einsum("nri,rq,qmj->nmij", column, of_free, functionals)
    highest = PIOperator.identity(Shape(0, into.functions))
    corrected = PIOperator.zeros(Shape(0, into.functions), into).replace(
        q2=np.einsum("nri,rm->nmi", column, of_state), r0=highest.r0, r1=feedback, r2=feedback
    )
    zero = PIOperator.zeros(Shape(r, 0), into)
    free_part = zero.replace(q1=functionals)
    rows = PIOperator.zeros(Shape(k, 0), corrected.shape_out)
    rows = rows.replace(q1=np.tensordot(u[:, :k].T, bf, axes=1))
    of_x = PIOperator.zeros(Shape(k, 0), into).replace(p=u[:, :k].T @ bx)
    large = (compose(rows, corrected) + of_x) * -1.0
    constants = vertical(
        PIOperator(large.p / s[:k, None], large.q1 / s[:k, None, None], *_rest(large)), free_part
    )
    ode = PIOperator.zeros(Shape(into.finite, 0), into).replace(p=np.eye(into.finite))
    mixing = PIOperator.zeros(Shape(len(names), 0), Shape(len(names), 0)).replace(p=vt.T)
    return _cleaned(vertical(ode, compose(mixing, constants), corrected))


def _rest(operator: PIOperator) -> tuple[Array, Array, Array, Array]:
    return operator.q2, operator.r0, operator.r1, operator.r2


def _conditions(extended: _Extended) -> tuple[Array, Array, Array]:
    """Bx (Nc, m), Bc (Nc, Nc) and Bf (Nc, n, d), rows scaled to about 1."""
    pde, into = extended.pde, extended.domains[0]
    wanted = len(extended.constants)
    if len(pde.conditions) != wanted:
        orders = ", ".join(f"{pde.states[i].name}: {order}" for i, order in extended.orders.items())
        raise UsageError(
            f"{_file(pde)}: [boundary] conditions has {len(pde.conditions)} conditions; the orders of the "
            f"states ({orders or 'no functions of s'}) need {wanted} in total. "
            f"{'Add some' if len(pde.conditions) < wanted else 'Remove some'} or correct the orders."
        )
    rows = []
    for condition in pde.conditions:
        if any(isinstance(atom, (Input, InputIntegral)) for atom, _ in condition.terms):
            raise UsageError(
                f"{_file(pde)}: [boundary] conditions: '{condition.text}' contains a disturbance or control; "
                "a condition may hold states only. Move the signal into an equation, or add an ode state X "
                "that it drives and use X in the condition."
            )
        row = extended.row(condition, distributed=False)[0]
        size = max(
            (
                abs(weight[0]) * _norm(extended.atom(atom, condition)[1])
                for atom, weight in condition.terms
                if not (isinstance(atom, Field) and atom.state in extended.ode)
            ),
            default=0.0,
        )
        rows.append(row * (1.0 / size if size > 0.0 else 1.0))
    stacked = _cleaned(_stack(rows, into)) if rows else PIOperator.zeros(Shape(0, 0), into)
    m = len(extended.ode)
    return stacked.p[:, :m], stacked.p[:, m:], stacked.q1


def _dependent(pde: Pde, combination: Array) -> UsageError:
    largest = float(combination[np.argmax(np.abs(combination))])
    terms = [
        f"{weight / largest:+.3g} * ({condition.text})"
        for condition, weight in zip(pde.conditions, combination, strict=True)
        if abs(weight / largest) > 1e-6
    ]
    return UsageError(
        f"{_file(pde)}: [boundary] conditions do not determine the states: the combination "
        f"{' '.join(terms)} says nothing about any function of s, so one of these conditions repeats or "
        "contradicts the others. Replace it by an independent one."
    )


def coefficients(weight: Polynomial) -> Array:
    """A polynomial of the model, in the orthonormal Legendre basis."""
    nodes, _ = legendre.gauss(max(len(weight), 1))
    return legendre.fit(polynomial.polyval(nodes, np.asarray(weight or (0.0,), dtype=np.float64)))


def _file(pde: Pde) -> str:
    return pde.name or "the problem"


def _highest(derivative: int) -> str:
    return f"derivatives up to {derivative} only" if derivative >= 0 else "no values at the ends"


def _signal_shape(signals: tuple[Signal, ...]) -> Shape:
    distributed = sum(signal.distributed for signal in signals)
    return Shape(len(signals) - distributed, distributed)


def _range(distributed: bool) -> Shape:
    return Shape(0, 1) if distributed else Shape(1, 0)


def _unit(into: Shape, finite: int | None = None, function: int | None = None) -> PIOperator:
    """Picks one number or one function."""
    zero = PIOperator.zeros(_range(function is not None), into)
    p, r0 = zero.p.copy(), zero.r0.copy()
    if finite is not None:
        p[0, finite] = 1.0
    if function is not None:
        r0[0, function, 0] = 1.0
    return zero.replace(p=p, r0=r0)


def _integral(weight: Polynomial, inside: PIOperator) -> PIOperator:
    """int_0^1 weight (inside); a number under the integral is taken as a constant function."""
    if inside.shape_out.finite:
        return inside * float(sum(a / (i + 1.0) for i, a in enumerate(weight)))
    row = PIOperator.zeros(Shape(1, 0), Shape(0, 1)).replace(q1=coefficients(weight)[None, None])
    return compose(row, inside)


def _stack(rows: Sequence[PIOperator], into: Shape) -> PIOperator:
    return vertical(PIOperator.zeros(Shape(0, 0), into), *rows)


def _norm(operator: PIOperator) -> float:
    return float(np.sqrt(sum(np.sum(a * a) for a in (operator.p, operator.q1))))


def _cleaned(operator: PIOperator) -> PIOperator:
    """Without coefficients that are rounding, so that degrees stay minimal."""

    def cleaned(names: tuple[str, ...]) -> dict[str, Array]:
        arrays = {name: np.array(getattr(operator, name)) for name in names}
        sizes = [np.abs(a).max(axis=tuple(range(1, a.ndim)), initial=0.0) for a in arrays.values()]
        level = NOISE * reduce(np.maximum, sizes)
        for a in arrays.values():
            a[np.abs(a) <= level.reshape(-1, *[1] * (a.ndim - 1))] = 0.0
        return arrays

    everything = cleaned(("p", "q1")) | cleaned(("q2", "r0", "r1", "r2"))
    return operator.replace(**everything).trimmed(0.0)
