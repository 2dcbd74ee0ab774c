"""Expressions of problem files: their values against numpy.polynomial, and their terms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from expression_names import G, U, V, W, names, read, terms
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from pde_reference import Sample, distance, integral, value

from design.pde.expression import Role
from design.pde.model import (
    Atom,
    Field,
    InputIntegral,
    Integral,
    Kind,
    Point,
)
from design.pde.model import Polynomial as Coefficients

DOMAINS = ((0.0, 1.0), (-1.0, 1.0), (2.0, 2.5), (-0.3, 4.2))
# Values: random texts, evaluated as they are read, and by Python functions that are made along with them


@dataclass(frozen=True)
class World:
    """What the names stand for, in the file's own coordinate."""

    sample: Sample
    parameter: float

    @property
    def ends(self) -> tuple[float, float]:
        return self.sample.domain


@dataclass(frozen=True)
class Sentence:
    """A text and its meaning, a polynomial in s; varies: it is a function of s."""

    text: Callable[[World], str]
    meaning: Callable[[World], Polynomial]
    varies: bool = False


numbers = st.floats(-3.0, 3.0, allow_subnormal=False).map(lambda x: round(x, 3))


def plain(number: float) -> Sentence:
    return Sentence(lambda _: f"({number!r})", lambda _: Polynomial([number]))


LEAVES = (
    Sentence(lambda _: "s", lambda _: Polynomial([0.0, 1.0]), True),
    Sentence(lambda _: "lam", lambda world: Polynomial([world.parameter])),
    Sentence(lambda _: "pi", lambda _: Polynomial([math.pi])),
)


def summed(a: Sentence, b: Sentence) -> Sentence:
    return Sentence(
        lambda w: f"({a.text(w)} + {b.text(w)})",
        lambda w: a.meaning(w) + b.meaning(w),
        a.varies or b.varies,
    )


def reduced(a: Sentence, b: Sentence) -> Sentence:
    return Sentence(
        lambda w: f"({a.text(w)}-{b.text(w)})",
        lambda w: a.meaning(w) - b.meaning(w),
        a.varies or b.varies,
    )


def times(a: Sentence, b: Sentence) -> Sentence:
    return Sentence(
        lambda w: f"{a.text(w)}*{b.text(w)}",
        lambda w: a.meaning(w) * b.meaning(w),
        a.varies or b.varies,
    )


def negated(a: Sentence) -> Sentence:
    return Sentence(lambda w: f"(-{a.text(w)})", lambda w: -a.meaning(w), a.varies)


def divided(a: Sentence, number: float) -> Sentence:
    return Sentence(lambda w: f"{a.text(w)}/{number!r}", lambda w: a.meaning(w) / number, a.varies)


def raised(a: Sentence, exponent: int) -> Sentence:
    return Sentence(
        lambda w: f"({a.text(w)})**{exponent}", lambda w: a.meaning(w) ** exponent, a.varies
    )


def integrated(a: Sentence) -> Sentence:
    return Sentence(
        lambda w: f"int({a.text(w)})", lambda w: Polynomial([integral(a.meaning(w), *w.ends)])
    )


leaves = st.one_of(st.sampled_from(LEAVES), numbers.map(plain))
coefficients = st.recursive(
    st.one_of(leaves, st.builds(raised, st.builds(summed, leaves, leaves), st.integers(0, 3))),
    lambda inner: st.one_of(
        st.builds(summed, inner, inner),
        st.builds(reduced, inner, inner),
        st.builds(times, inner, inner),
        inner.map(negated),
        st.builds(divided, inner, st.sampled_from([0.5, 3.0, -8.0])),
    ),
    max_leaves=4,
)
outer_coefficients = st.one_of(coefficients, coefficients.map(integrated))


def derivative(state: int, order: int, text: str) -> Sentence:
    def meaning(world: World) -> Polynomial:
        function = world.sample.states[state]
        assert isinstance(function, Polynomial)
        return function.deriv(order)

    return Sentence(lambda _: text, meaning, True)


def at_end(state: int, order: int, text: str, end: int) -> Sentence:
    def meaning(world: World) -> Polynomial:
        return Polynomial([derivative(state, order, "").meaning(world)(world.ends[end])])

    return Sentence(lambda w: f"{text}({w.ends[end]!r})", meaning)


def quantity(pick: Callable[[World], Polynomial | float], text: str, varies: bool) -> Sentence:
    def meaning(world: World) -> Polynomial:
        picked = pick(world)
        return picked if isinstance(picked, Polynomial) else Polynomial([picked])

    return Sentence(lambda _: text, meaning, varies)


FUNCTIONS = (
    derivative(0, 0, "x"), derivative(0, 0, "x(s)"), derivative(0, 1, "x_s"), derivative(0, 2, "x_ss"),
    derivative(0, 2, "x_s2"), derivative(0, 3, "x_sss"), derivative(0, 3, "x_s3(s)"), derivative(1, 0, "y"),
    derivative(1, 1, "y_s"), derivative(2, 0, "q"),
    quantity(lambda w: w.sample.disturbances[1], "v", True),
    quantity(lambda w: w.sample.controls[1], "g(s)", True),
)  # fmt: skip
NUMBERS = (
    at_end(0, 0, "x", 0), at_end(0, 1, "x_s", 1), at_end(0, 2, "x_ss", 0), at_end(1, 0, "y", 1),
    quantity(lambda w: w.sample.states[3], "X", False),
    quantity(lambda w: w.sample.disturbances[0], "w", False),
    quantity(lambda w: w.sample.controls[0], "u", False),
)  # fmt: skip


def linear(
    atoms: st.SearchStrategy[Sentence], factors: st.SearchStrategy[Sentence]
) -> st.SearchStrategy[Sentence]:
    return st.recursive(
        atoms,
        lambda inner: st.one_of(
            st.builds(summed, inner, inner),
            st.builds(reduced, inner, inner),
            st.builds(times, factors, inner),
            st.builds(times, inner, factors),
            inner.map(negated),
            st.builds(divided, inner, st.sampled_from([0.5, 3.0, -8.0])),
        ),
        max_leaves=5,
    )


inside = linear(st.sampled_from(FUNCTIONS + NUMBERS), coefficients)
sentences = linear(
    st.one_of(st.sampled_from(FUNCTIONS + NUMBERS), inside.map(integrated)), outer_coefficients
)
polynomials = st.lists(numbers, min_size=1, max_size=6).map(Polynomial)


@st.composite
def worlds(draw: st.DrawFn) -> World:
    states = (draw(polynomials), draw(polynomials), draw(polynomials), draw(numbers))
    sample = Sample(
        draw(st.sampled_from(DOMAINS)),
        states,
        disturbances=(draw(numbers), draw(polynomials)),
        controls=(draw(numbers), draw(polynomials)),
    )
    return World(sample, draw(numbers))


@settings(max_examples=300, deadline=None)
@given(sentences, worlds())
def test_value_is_that_of_the_text(sentence: Sentence, world: World) -> None:
    text, sample = sentence.text(world), world.sample
    reading = read(text, Role.OUTPUT, names(sample.domain, lam=world.parameter))
    assert reading.distributed == sentence.varies
    got, size = value(reading.expression, sample)
    expected = sample.on_unit(sentence.meaning(world))
    if sentence.varies:  # a distributed output keeps its L2 norm
        expected = expected * math.sqrt(sample.length)
    bound = float(np.abs(expected.coef).sum()) + size
    assert distance(got, expected) <= 1e-9 * (1.0 + bound), text
    atoms = [atom for atom, _ in reading.expression.terms]
    assert len(atoms) == len(set(atoms))


# Terms


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x_ss + lam*x + w", {Field(0, 2): (1.0,), Field(0): (4.0,), W: (1.0,)}),
        ("+x - -x", {Field(0): (2.0,)}),
        ("x_s3 + x_sss", {Field(0, 3): (2.0,)}),
        ("(1 - s)**2*x", {Field(0): (1.0, -2.0, 1.0)}),
        ("2**-1*x + x*4**0.5", {Field(0): (2.5,)}),
        ("x**1", {Field(0): (1.0,)}),
        ("-s**2*x", {Field(0): (0.0, 0.0, -1.0)}),
        ("1e-3*X", {Field(3): (1e-3,)}),
        ("x - x + y", {Field(1): (1.0,)}),
        ("0.1*x + 0.2*x - 0.3*x", {}),
        ("zero*x_s + 0", {}),
        ("x + 1 - 1", {Field(0): (1.0,)}),
        ("v + v(s)", {V: (2.0,)}),
        ("x_s(0) + 2*x(1)", {Point(0, 1, 0): (1.0,), Point(0, 0, 1): (2.0,)}),
        ("x(lam/4)", {Point(0, 0, 1): (1.0,)}),
        ("x(1 + 1e-12)", {Point(0, 0, 1): (1.0,)}),
        ("int(x)", {Integral(0, 0, (1.0,)): (1.0,)}),
        ("3*int(s*x) + int(x)", {Integral(0, 0, (1.0, 3.0)): (1.0,)}),
        ("int(x) - int(x)", {}),
        ("int(s*x + y_s)", {Integral(0, 0, (0.0, 1.0)): (1.0,), Integral(1, 1, (1.0,)): (1.0,)}),
        ("s*int(x) + s**2*int(x)", {Integral(0, 0, (1.0,)): (0.0, 1.0, 1.0)}),
        ("(1 + s)*int(x) + int(x)", {Integral(0, 0, (1.0,)): (2.0, 1.0)}),
        (
            "s*int(s*x) + int(x)",
            {Integral(0, 0, (0.0, 1.0)): (0.0, 1.0), Integral(0, 0, (1.0,)): (1.0,)},
        ),
        ("s*int(2*x) + 2*int(x)", {Integral(0, 0, (2.0,)): (1.0, 1.0)}),
        ("(1 + s)*int(x) - s*int(x)", {Integral(0, 0, (1.0,)): (1.0,)}),
        ("int(s*v) + 2*int(v)", {InputIntegral(Kind.DISTURBANCE, 1, (2.0, 1.0)): (1.0,)}),
        ("int(s*u + X + 6*s*x(0))", {U: (0.5,), Field(3): (1.0,), Point(0, 0, 0): (3.0,)}),
        ("int(s)*g + int(1)*u", {G: (0.5,), U: (1.0,)}),
        ("x +\n\t y", {Field(0): (1.0,), Field(1): (1.0,)}),
    ],
)
def test_terms(text: str, expected: dict[Atom, Coefficients]) -> None:
    got = terms(text)
    assert list(got) == list(expected) or set(got) == set(expected)
    for atom, coefficient in expected.items():
        assert got[atom] == pytest.approx(coefficient, rel=1e-15)


def test_text_is_kept_as_written() -> None:
    assert read(" x_ss  + w").expression.text == " x_ss  + w"


@pytest.mark.parametrize(
    ("text", "distributed"),
    [
        ("int(x)", False), ("x(1) + w", False), ("u", False), ("X", False), ("int(s*v) + int(s)*X", False),
        ("x", True), ("v", True), ("s*w", True), ("zero*s*w + u", True), ("zero*x + w", True),
        ("(1 + s - s)*X", True), ("s*int(x)", True), ("x(1) + 0*s", True),
    ],
)  # fmt: skip
def test_an_output_is_a_function_where_its_text_depends_on_s(text: str, distributed: bool) -> None:
    assert read(text).distributed is distributed


@pytest.mark.parametrize(
    "text", ["x(0) = x(1)", "x(0)-x(1)=0", "0 = x(1) - x(0)", " 2*x(0) = x(0) + x(1) "]
)
def test_a_condition_may_be_an_equation(text: str) -> None:
    got = terms(text, Role.CONDITION)
    assert got[Point(0, 0, 0)] == pytest.approx(tuple(-c for c in got[Point(0, 0, 1)]))


def test_long_sums_and_products_are_read() -> None:
    assert terms("+".join(["x"] * 900)) == {Field(0): (900.0,)}
    assert terms("*".join(["1"] * 900) + "*x") == {Field(0): (1.0,)}
    assert terms("(" * 59 + "x" + ")" * 59) == {Field(0): (1.0,)}


def test_integrals_of_one_state_stay_apart_where_coefficients_vary() -> None:
    got = terms("s*int(x) + s*int(s*x) + s*int(x_s)")
    assert got == {
        Integral(0, 0, (1.0,)): (0.0, 1.0),
        Integral(0, 0, (0.0, 1.0)): (0.0, 1.0),
        Integral(0, 1, (1.0,)): (0.0, 1.0),
    }
