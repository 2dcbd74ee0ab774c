"""The adjoint of a PDE, again as a PDE: state feedback is an observer of the adjoint (theory, section 3).

Everything that a PDE does to (states, signals) is one block operator Acal from columns (states, disturbances,
controls) to rows (equations, outputs). Integration by parts moves it onto y:
<Acal x, y> = <x, Acal* y> + sum over boundary values b of x of b q_b(y), and the conditions of x make the last
sum a sum over free boundary values (their q must vanish: the adjoint conditions) and bounded terms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import comb

import numpy as np
import scipy.linalg
from numpy.polynomial import polynomial
from scipy.optimize import minimize_scalar

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
    StateVariable,
)

NOISE = 1e-13
"""Coefficients below this, relative to the largest of their expression, are rounding."""
SINGULAR = 1e-8
"""Relative size below which a leading coefficient, or a combination of boundary values, counts as zero."""

Terms = dict[Atom, Array]
"""Coefficients in powers of s by atom, while an expression is being built."""


class NotAdjointable(Exception):  # noqa: N818 - a finding about the problem, not a failure
    """The adjoint exists, if at all, not in the form of a PDE file; the argument says why."""


def adjoint(pde: Pde) -> Pde:
    """The adjoint in R^m x L2^n of the homogeneous part, without signals and outputs.

    For x that meets the conditions of `pde` and y those of the result, <Acal x, y> = <x, Acal* y>, and there is
    no larger set of such y. Raises NotAdjointable.
    """
    return _transposed(replace(pde, disturbances=(), controls=(), regulated=()), drop_signals=True)


def dual_system(pde: Pde) -> Pde:
    """The system whose observer problem is the state-feedback problem of `pde`.

    Of x_t = Acal x + B1 w + B2 u, z = C1 x + D11 w + D12 u it is y_t = Acal* y + C1* wd, regulated
    B1* y + D11* wd, measured B2* y + D12* wd: one disturbance per regulated output of `pde`, one regulated
    output per disturbance, one measured output per control, in their order. Raises NotAdjointable.
    """
    return _transposed(pde, drop_signals=False)


def _transposed(pde: Pde, *, drop_signals: bool) -> Pde:
    block = _Block(pde)
    for row, (expression, distributed) in enumerate(block.rows):
        for atom, weight in expression.terms:
            if drop_signals and isinstance(atom, (Input, InputIntegral)):
                continue
            for plain, factor in block.plain(atom, _array(weight)):
                block.move(row, distributed, plain, factor)
    orders = block.orders()
    conditions = block.conditions()
    count = len(pde.states)
    states = tuple(
        StateVariable(f"{state.name}*", None if state.order is None else order)
        for state, order in zip(pde.states, orders, strict=True)
    )
    inputs = tuple(
        Signal(f"z{k}*", output.distributed) for k, output in enumerate(pde.regulated, start=1)
    )
    write = _Writer(states, inputs)
    expressions = [
        write(terms, distributed)
        for terms, distributed in zip(block.moved, block.distributed, strict=True)
    ]
    outputs = [
        Output(expression, distributed)
        for expression, distributed in zip(expressions, block.distributed, strict=True)
    ][count:]
    return Pde(
        states=states,
        equations=tuple(expressions[:count]),
        conditions=tuple(write(terms, False) for terms in conditions),
        disturbances=inputs,
        regulated=tuple(outputs[: len(pde.disturbances)]),
        measured=tuple(outputs[len(pde.disturbances) :]),
        name=f"adjoint of {pde.name}" if pde.name else "adjoint",
        domain=pde.domain,
        parameters=dict(pde.parameters),
    )


class _Block:
    """The block operator of a PDE; signals are numbered on from the states, outputs on from the equations."""

    def __init__(self, pde: Pde) -> None:
        self.pde = pde
        signals = (*pde.disturbances, *pde.controls)
        functions = [state.order is not None for state in pde.states]
        self.distributed = [*functions, *(signal.distributed for signal in signals)]
        """Of the columns."""
        self.rows = [
            *zip(pde.equations, functions, strict=True),
            *((output.expression, output.distributed) for output in pde.regulated),
        ]
        self.points = [
            Point(i, j, end)
            for i, state in enumerate(pde.states)
            for j in range(state.order or 0)
            for end in (0, 1)
        ]
        self.moved: list[Terms] = [{} for _ in self.distributed]
        """Acal* y by column of Acal, where the rows of Acal are the states (and disturbances) of y."""
        self.at_ends: dict[Atom, Terms] = {point: {} for point in self.points}
        """q: the functional of y that multiplies each boundary value of x."""

    def plain(self, atom: Atom, weight: Array) -> Iterator[tuple[Atom, Array]]:
        """The same term without derivatives under integrals; signals as columns behind the states."""
        if isinstance(atom, (Input, InputIntegral)):
            before = len(self.pde.disturbances) if atom.kind is Kind.CONTROL else 0
            column = len(self.pde.states) + before + atom.index
            inside = atom.weight if isinstance(atom, InputIntegral) else None
            atom = Field(column) if inside is None else Integral(column, 0, inside)
        if not self.distributed[atom.state]:
            mean = _mean(_array(atom.weight)) if isinstance(atom, Integral) else 1.0
            yield Field(atom.state), weight * mean
        elif isinstance(atom, Integral):
            rest = _array(atom.weight)
            for left in reversed(range(atom.derivative)):
                for end in (0, 1):
                    value = float(polynomial.polyval(end, rest)) * (1.0 if end else -1.0)
                    yield Point(atom.state, left, end), weight * value
                rest = -_derivative(rest, 1)
            yield Integral(atom.state, 0, tuple(rest.tolist())), weight
        else:
            yield atom, weight

    def move(self, row: int, distributed: bool, atom: Atom, weight: Array) -> None:
        """Add weight * atom of the row `row` of Acal, multiplied by y_row, to what it is of x."""
        if not distributed and (
            weight[1:].any() or (isinstance(atom, Field) and self.distributed[atom.state])
        ):
            raise NotAdjointable(f"'{self.rows[row][0].text}' should be a number but depends on s")
        if distributed and isinstance(atom, Field) and self.distributed[atom.state]:
            self._move_field(row, atom.state, atom.derivative, weight)
            return
        factor: Terms = (
            {Integral(row, 0, tuple(weight.tolist())): np.ones(1)}
            if distributed
            else {Field(row): weight}
        )
        if isinstance(atom, Point):
            _add(self.at_ends[atom], factor)
        elif isinstance(atom, Integral):
            _add(self.moved[atom.state], factor, _array(atom.weight))
        elif isinstance(atom, Field):
            _add(self.moved[atom.state], factor)

    def _move_field(self, row: int, column: int, order: int, weight: Array) -> None:
        """int y a x^(j) = (-1)^j int (a y)^(j) x + sum_l (-1)^l [(a y)^(l) x^(j-1-l)]_0^1, by Leibniz."""
        sign = (-1.0) ** order
        for low in range(order + 1):
            factor = sign * comb(order, low) * _derivative(weight, order - low)
            _add(self.moved[column], {Field(row, low): factor})
        for power in range(order):
            for low in range(power + 1):
                factor = (-1.0) ** power * comb(power, low) * _derivative(weight, power - low)
                for end in (0, 1):
                    value = polynomial.polyval(float(end), factor) * (1.0 if end else -1.0)
                    target = self.at_ends[Point(column, order - 1 - power, end)]
                    _add(target, {Point(row, low, end): np.array([value])})

    def orders(self) -> list[int]:
        """The orders of y; refuses where Acal* y in L2 does not make every y_i that smooth."""
        count, total = len(self.pde.states), len(self.points) // 2
        orders = [0] * len(self.rows)
        for terms in self.moved:
            for atom, weight in _significant(terms).items():
                if isinstance(atom, Field) and weight.any():
                    orders[atom.state] = max(orders[atom.state], atom.derivative)
        for row in range(count, len(self.rows)):
            if orders[row]:
                raise NotAdjointable(
                    f"the output '{self.rows[row][0].text}' contains a derivative of a state: "
                    "it is not a bounded function of the states"
                )
        del orders[count:]
        if sum(orders) != total:
            raise NotAdjointable(
                f"the orders of the states add up to {total}, those of the adjoint to {sum(orders)}: highest "
                "derivatives enter the equations in combinations, or not at all"
            )
        smooth = [i for i, order in enumerate(orders) if order]
        columns = [i for i in range(count) if self.distributed[i]]

        def smallest(s: float) -> float:
            leading = [
                [self.moved[i].get(Field(p, orders[p]), np.zeros(1)) for p in smooth]
                for i in columns
            ]
            matrix = np.array([[polynomial.polyval(s, a) for a in row] for row in leading])
            norms = np.array(
                [max(np.abs(row[k]).max() for row in leading) for k in range(len(smooth))]
            )
            return float(np.linalg.svd(matrix / norms, compute_uv=False)[-1])

        if smooth:
            grid = np.linspace(0.0, 1.0, 41)
            sizes = [smallest(s) for s in grid]
            near = grid[int(np.argmin(sizes))]
            bounds = (max(near - 0.025, 0.0), min(near + 0.025, 1.0))
            refined = minimize_scalar(
                smallest, bounds=bounds, method="bounded", options={"xatol": 1e-10}
            )
            if min(*sizes, float(refined.fun)) < SINGULAR:
                raise NotAdjointable(
                    f"the coefficients of the highest derivatives are singular near s = {float(refined.x):.3g} "
                    "(of the domain scaled to [0, 1])"
                )
        return orders

    def conditions(self) -> list[Terms]:
        """The conditions on y: those of x are solved for some boundary values, and q of the others must vanish.

        Integrals and ode states in the conditions of x become boundary values in the equations of y.
        """
        if 2 * len(self.pde.conditions) != len(self.points):
            raise NotAdjointable("the number of conditions is not the sum of the orders")
        parts = [self._split(condition) for condition in self.pde.conditions]
        matrix = np.array([row for row, _ in parts]).reshape(len(parts), len(self.points))
        solved, solver = _solve(matrix)
        if solver is None:
            raise NotAdjointable(
                "the conditions restrict the states inside the domain, not at its ends"
            )
        for place, factors in zip(solved, solver, strict=True):
            for factor, (_, inside) in zip(factors, parts, strict=True):
                for column, profile in inside:
                    _add(self.moved[column], self.at_ends[self.points[place]], -factor * profile)
        out = []
        for place, coefficients in enumerate((solver @ matrix).T):
            if place not in solved:
                terms: Terms = {}
                _add(terms, self.at_ends[self.points[place]])
                for other, coefficient in zip(solved, coefficients, strict=True):
                    _add(terms, self.at_ends[self.points[other]], np.array([-coefficient]))
                out.append(_significant(terms))
        for atom in (atom for terms in out for atom in terms):
            row = getattr(atom, "state", 0)
            if row >= len(self.pde.states):
                raise NotAdjointable(
                    f"the output '{self.rows[row][0].text}' depends on values at the ends of the domain that "
                    "the conditions leave free: it is not a bounded function of the states"
                )
        return _independent(out)

    def _split(self, condition: Expression) -> tuple[Array, list[tuple[int, Array]]]:
        """Coefficients of the boundary values, and (state, weight) of what is not at the ends."""
        row, inside = np.zeros(len(self.points)), []
        for term, weight in condition.terms:
            if isinstance(term, (Input, InputIntegral)):
                raise NotAdjointable(f"the condition '{condition.text}' contains a signal")
            for atom, factor in self.plain(term, _array(weight)):
                if isinstance(atom, Point):
                    row[self.points.index(atom)] += factor[0]
                elif isinstance(atom, Integral):
                    inside.append((atom.state, factor[0] * _array(atom.weight)))
                elif isinstance(atom, Field):
                    inside.append((atom.state, factor[:1]))
        size = float(np.abs(row).max(initial=0.0)) or 1.0
        return row / size, [(state, profile / size) for state, profile in inside]


def _solve(matrix: Array) -> tuple[list[int], Array | None]:
    """Columns and a matrix E such that E @ matrix is the identity in those columns; None if there are none."""
    count = len(matrix)
    if count == 0:
        return [], np.zeros((0, 0))
    if count > matrix.shape[1]:
        return [], None
    _, r, order = scipy.linalg.qr(matrix, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(r))
    if sizes[count - 1] <= SINGULAR * sizes[0]:
        return [], None
    columns = sorted(int(k) for k in order[:count])
    return columns, np.asarray(np.linalg.inv(matrix[:, columns]))


def _independent(conditions: list[Terms]) -> list[Terms]:
    """The same conditions, each solved for another boundary value."""
    points = sorted({a for terms in conditions for a in terms if isinstance(a, Point)}, key=repr)
    matrix = np.array(
        [[float(terms.get(a, np.zeros(1))[0]) for a in points] for terms in conditions]
    )
    _, solver = _solve(matrix.reshape(len(conditions), len(points)))
    if solver is None:
        raise NotAdjointable("the conditions of the adjoint are dependent")
    out = []
    for factors in solver:
        combined: Terms = {}
        for factor, terms in zip(factors, conditions, strict=True):
            _add(combined, terms, np.array([factor]))
        out.append(combined)
    return out


@dataclass(frozen=True)
class _Writer:
    """Terms of y, with the signals numbered behind the states, as an expression of the adjoint PDE."""

    states: tuple[StateVariable, ...]
    inputs: tuple[Signal, ...]

    def __call__(self, terms: Terms, distributed: bool) -> Expression:
        merged: Terms = {}
        inside: dict[int, Array] = {}
        for atom, weight in terms.items():
            if isinstance(atom, Integral) and not distributed:
                part = weight[0] * _array(atom.weight)
                inside[atom.state] = polynomial.polyadd(inside.get(atom.state, np.zeros(1)), part)
            else:
                merged[atom] = weight
        merged |= {Integral(i, 0, tuple(a.tolist())): np.ones(1) for i, a in inside.items()}
        written = [(self._atom(a), tuple(w.tolist())) for a, w in _significant(merged).items()]
        text = " + ".join(f"{_number(weight)}*{self._text(atom)}" for atom, weight in written)
        return Expression(tuple(written), text or "0")

    def _atom(self, atom: Atom) -> Atom:
        if isinstance(atom, (Field, Integral)) and atom.state >= len(self.states):
            signal = atom.state - len(self.states)
            if isinstance(atom, Integral):
                return InputIntegral(Kind.DISTURBANCE, signal, atom.weight)
            return Input(Kind.DISTURBANCE, signal)
        return atom

    def _text(self, atom: Atom) -> str:
        if isinstance(atom, (Input, InputIntegral)):
            name = self.inputs[atom.index].name
        else:
            name = self.states[atom.state].name + (
                "_" + "s" * atom.derivative if atom.derivative else ""
            )
        if isinstance(atom, Point):
            return f"{name}({atom.end})"
        if isinstance(atom, (Integral, InputIntegral)):
            return f"int({_number(atom.weight)}*{name})"
        return name


def _number(weight: Polynomial) -> str:
    powers = ["", "*s", *(f"*s^{k}" for k in range(2, len(weight)))]
    text = " + ".join(f"{c:g}{power}" for c, power in zip(weight, powers, strict=False) if c)
    return text if len(weight) == 1 else f"({text})"


def _add(target: Terms, terms: Terms, factor: Array | None = None) -> None:
    """target += factor * terms."""
    for atom, weight in terms.items():
        product = weight if factor is None else polynomial.polymul(factor, weight)
        target[atom] = np.asarray(polynomial.polyadd(target.get(atom, np.zeros(1)), product))


def _significant(terms: Terms) -> Terms:
    """Without terms and coefficients that are zero or rounding."""
    inside = {a: np.abs(a.weight).max() if isinstance(a, Integral) else 1.0 for a in terms}
    level = NOISE * max((np.abs(w).max() * inside[a] for a, w in terms.items()), default=0.0)
    out: Terms = {}
    for atom, weight in terms.items():
        kept: Array = np.where(np.abs(weight) * inside[atom] > level, weight, 0.0)
        if kept.any():
            out[atom] = kept[: int(np.flatnonzero(kept)[-1]) + 1]
    return out


def _array(weight: Polynomial) -> Array:
    return np.array(weight or (0.0,), dtype=np.float64)


def _mean(weight: Array) -> float:
    return float(np.sum(weight / (np.arange(len(weight)) + 1.0)))


def _derivative(weight: Array, order: int) -> Array:
    return np.asarray(polynomial.polyder(weight, order))
