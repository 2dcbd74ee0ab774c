"""PDEs as data evaluated with numpy.polynomial: shares no code with the conversions under test.

States are (X, functions): a number for an ode state and a numpy Polynomial for a function of s, in the order of
the PDE's states. Short names build expressions: d(i, j) is d^j x_i / ds^j.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial as Poly
from numpy.polynomial import legendre

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
    Signal,
    StateVariable,
)

Array = npt.NDArray[np.float64]
Value = float | Poly
Term = tuple[Atom, tuple[float, ...]]


def d(state: int, derivative: int = 0, *weight: float) -> Term:
    return Field(state, derivative), weight or (1.0,)


def at(state: int, derivative: int, end: int, *weight: float) -> Term:
    return Point(state, derivative, end), weight or (1.0,)


def integral(state: int, derivative: int, inside: Sequence[float], *weight: float) -> Term:
    return Integral(state, derivative, tuple(inside)), weight or (1.0,)


def w(index: int, *weight: float) -> Term:
    return Input(Kind.DISTURBANCE, index), weight or (1.0,)


def u(index: int, *weight: float) -> Term:
    return Input(Kind.CONTROL, index), weight or (1.0,)


def int_w(index: int, inside: Sequence[float], *weight: float) -> Term:
    return InputIntegral(Kind.DISTURBANCE, index, tuple(inside)), weight or (1.0,)


def int_u(index: int, inside: Sequence[float], *weight: float) -> Term:
    return InputIntegral(Kind.CONTROL, index, tuple(inside)), weight or (1.0,)


def sum_of(*terms: Term) -> Expression:
    return Expression(terms, " + ".join(f"{weight}*{atom}" for atom, weight in terms))


def scalar(*terms: Term) -> Output:
    return Output(sum_of(*terms), distributed=False)


def distributed(*terms: Term) -> Output:
    return Output(sum_of(*terms), distributed=True)


def states(*orders: int | None) -> tuple[StateVariable, ...]:
    return tuple(StateVariable(f"x{i}", order) for i, order in enumerate(orders))


def signals(*distributed: bool) -> tuple[Signal, ...]:
    return tuple(Signal(f"v{i}", flag) for i, flag in enumerate(distributed))


def definite(function: Poly) -> float:
    return float(function.integ()(1.0))


def value(
    atom: Atom, x: Sequence[Value], disturbances: Sequence[Value], controls: Sequence[Value]
) -> Value:
    match atom:
        case Field(state, derivative):
            inside = x[state]
            return inside.deriv(derivative) if isinstance(inside, Poly) else inside
        case Point(state, derivative, end):
            inside = x[state]
            return float(
                (inside if isinstance(inside, Poly) else Poly([inside])).deriv(derivative)(end)
            )
        case Integral(state, derivative, weight):
            inside = x[state]
            return definite(
                Poly(weight) * (inside.deriv(derivative) if isinstance(inside, Poly) else inside)
            )
        case Input(kind, index):
            return (disturbances if kind is Kind.DISTURBANCE else controls)[index]
        case InputIntegral(kind, index, weight):
            return definite(
                Poly(weight) * (disturbances if kind is Kind.DISTURBANCE else controls)[index]
            )


def evaluate(
    expression: Expression,
    x: Sequence[Value],
    disturbances: Sequence[Value] = (),
    controls: Sequence[Value] = (),
) -> Poly:
    """The expression as a function of s (a constant one if it is a number)."""
    total = Poly([0.0])
    for atom, weight in expression.terms:
        total = total + Poly(weight) * value(atom, x, disturbances, controls)
    return total


def random_signals(group: Sequence[Signal], rng: np.random.Generator) -> list[Value]:
    return [Poly(rng.normal(size=4)) if s.distributed else float(rng.normal()) for s in group]


def random_states(
    pde: Pde, rng: np.random.Generator, degree: int = 9, count: int = 1
) -> list[list[Value]]:
    """States that meet the conditions: random elements of the null space of the conditions on polynomials."""
    units: list[list[Value]] = []
    for i, state in enumerate(pde.states):
        for power in range(1 if state.order is None else degree + 1):
            one: list[Value] = [0.0 if s.order is None else Poly([0.0]) for s in pde.states]
            one[i] = 1.0 if state.order is None else Poly([-1.0, 2.0]) ** power
            units.append(one)
    rows = np.array([[evaluate(c, x)(0.0) for x in units] for c in pde.conditions]).reshape(
        -1, len(units)
    )
    _, sizes, vt = np.linalg.svd(rows)
    basis = vt[int(np.sum(sizes > 1e-10 * max(sizes, default=1.0))) :]
    out = []
    for _ in range(count):
        mixed = rng.normal(size=len(basis)) @ basis
        out.append(
            [
                sum((c * x[i] for c, x in zip(mixed, units, strict=True)), start=0.0 * units[0][i])
                for i in range(len(pde.states))
            ]
        )
    return out


def inner(x: Sequence[Value], y: Sequence[Value]) -> float:
    """In R^m x L2^n."""
    nodes, weights = legendre.leggauss(20)
    samples = [
        [v(0.5 + 0.5 * nodes) if isinstance(v, Poly) else v for v in pair]
        for pair in zip(x, y, strict=True)
    ]
    return float(sum(np.sum(0.5 * weights * a * b) for a, b in samples))
