"""Expressions of problem files that are refused: every message names the term and what is wrong with it."""

from __future__ import annotations

import math

import pytest
from expression_names import W, names, read, terms
from hypothesis import given, settings
from hypothesis import strategies as st

from design.pde.expression import Role
from design.pde.model import Field
from wire.errors import UsageError


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        # not linear
        ("x_ss + x*w", ["'x*w' is not linear", "linearise"]),
        ("x*x_s", ["'x*x_s' is not linear"]),
        ("(x + y)*(1 + u)", ["'(x + y)*(1 + u)' is not linear"]),
        ("w*int(x)", ["'w*int(x)' is not linear"]),
        ("x + y**2", ["'y**2' is not linear", "power"]),
        ("x**0", ["'x**0' is not linear"]),
        ("s/x", ["'s/x' divides by something that is not a number"]),
        ("x/s", ["'x/s' divides by", "polynomials in s"]),
        ("x/(s - s + 1)", ["divides by"]),
        ("x/zero", ["'x/zero' divides by zero"]),
        ("x*0**-1", ["'0**-1' divides by zero"]),
        ("2**s*x", ["'2**s' has an exponent that is not a number"]),
        ("s**x", ["exponent"]),
        ("s**0.5*x", ["'s**0.5' is no polynomial", "exponents are 0, 1, 2"]),
        ("s**-1*x", ["'s**-1' is no polynomial"]),
        ("(s**2)**26*x", ["'(s**2)**26' is no polynomial in s of degree 50 or less"]),
        ("s**51*x", ["'s**51' is no polynomial in s of degree 50 or less"]),
        ("s**1000000000*x", ["is no polynomial in s of degree 50"]),
        ("s**30*s**30*x", ["has degree 60 in s, more than 50"]),
        ("(-1)**0.5*x", ["'(-1)**0.5' is not a real number"]),
        # constants
        ("x + 1", ["'1' is a constant term", "equilibrium"]),
        ("x + w - lam*s", ["'lam*s' is a constant term"]),
        ("lam", ["'lam' is a constant term"]),
        ("int(x + s)", ["'int(x + s)' is a constant term"]),
        # not finite
        ("huge*huge*x", ["'huge*huge' is not finite", "overflow"]),
        ("huge*(huge*x)", ["is not finite"]),
        ("huge**2*x", ["'huge**2' is not finite"]),
        ("1e400*x", ["'1e400' is not finite"]),
        ("9" * 400 + "*x", ["too large a number"]),
        ("huge*int(huge*x)", ["is not finite"]),
        # names
        ("z", ["'z' is not declared", "(declared: x, y, q, X, w, v, u, g, lam"]),
        ("x + lamb*y", ["'lamb' is not declared; did you mean lam?"]),
        ("x_sx", ["'x_sx' is not declared; did you mean x_s"]),
        ("x_s0", ["'x_s0' is not declared"]),
        ("x_t", ["'x_t' is a derivative in time", 'x = "v"']),
        ("x_tt + x", ["'x_tt' is a derivative in time"]),
        ("t*x", ["'t' is time"]),
        ("int", ["'int' needs what it integrates"]),
        ("int*x", ["'int' needs what it integrates"]),
        ("sin(pi*s)*x", ["'sin(pi*s)' is not available", "polynomials in s"]),
        ("foo(x)", ["'foo' is not declared"]),
        # derivatives and values at the ends
        ("x_ssss", ["'x_ssss' is not defined", "x has order 3", "up to x_sss"]),
        ("x_s99", ["'x_s99' is not defined"]),
        ("y_ss + x", ["'y_ss' is not defined", "y has order 1", "up to y_s"]),
        ("q_s", ["'q_s' is not defined", "derivatives exist up to q"]),
        ("int(y_ss)", ["'y_ss' is not defined"]),
        ("x_sss(0)", ["'x_sss(0)' is not defined", "values at the ends exist up to x_ss"]),
        ("y_s(1)", ["'y_s(1)' is not defined", "up to y"]),
        ("q(0)", ["'q(0)' is not defined", "values at the ends exist not at all"]),
        ("X_s", ["'X_s' is not defined: X is an ode state"]),
        ("X(0)", ["'X(0)' is not defined: X is an ode state"]),
        ("X(s)", ["'X(s)' is not defined: X is an ode state"]),
        ("x(0.5)", ["'x(0.5)' is taken at 0.5", "ends of the domain [0, 1] only"]),
        ("x(lam)", ["'x(lam)' is taken at 4"]),
        ("x(1.001)", ["is taken at 1.001"]),
        ("x(s/2)", ["'x(s/2)' must be taken at s or at an end of the domain [0, 1]"]),
        ("x(X)", ["'x(X)' must be taken at s or at an end"]),
        ("w(s)", ["'w(s)' is not defined: w is a number", 'declared as "w(s)"']),
        ("v(0)", ["'v(0)' is not defined: v has no values at points"]),
        ("v_s", ["'v_s' is not declared"]),
        # integrals
        ("int(int(x))", ["'int(x)' is an integral inside of an integral"]),
        ("int(s*(x(0) + int(y)))", ["'int(y)' is an integral inside"]),
        ("int(x, s)", ["'int(x, s)' must have one argument in the parentheses after int"]),
        ("int()", ["must have one argument"]),
        ("x()", ["'x()' must have one argument in the parentheses after x"]),
        ("int(*x)", ["must have one argument"]),
        # syntax
        ("", ["expected an expression, got an empty one"]),
        ("  ", ["empty"]),
        ("x +", ["cannot be read"]),
        ("(x", ["cannot be read"]),
        ("x)", ["cannot be read"]),
        ("2x", ["cannot be read", "products are written with *"]),
        ("x y", ["cannot be read"]),
        ("2(x)", ["'2(x)' lacks an operator"]),
        ("lam(x)", ["'lam(x)' lacks an operator"]),
        ("s(0)*x", ["'s(0)' lacks an operator"]),
        ("0x1*w", ["'0x1' is no decimal number", "0*x"]),
        ("2j*x", ["'2j' is no decimal number"]),
        ("...", ["'...' is no decimal number"]),
        ("x.real", ["'x.real' has no meaning"]),
        ("x, y", ["'x, y' has no meaning"]),
        ("x//2", ["'x//2' has an operator that is none of"]),
        ("s^2*x", ["'^' has no meaning", "**"]),
        ("x = 0", ["'=' has no meaning", "only a boundary condition"]),
        ("x[0]", ["'[' has no meaning"]),
        ("x # w", ["'#' has no meaning"]),
        ("x − y", ["'−' has no meaning"]),  # a minus sign that is none
        ("'x'", ["has no meaning"]),
        ("x if w else y", ["'if' is reserved"]),
        ("lambda*x", ["'lambda' is reserved and cannot be a name"]),
        ("None", ["'None' is reserved"]),
        ("(" * 1500 + "x" + ")" * 1500, ["too deeply"]),
        ("-" * 3000 + "x", ["deep"]),
        ("x(" * 61 + "0" + ")" * 61, ["nested more than 60 levels deep"]),
        ("x" + " + x" * 1500, ["characters, but at most 4000 are read"]),
    ],
)  # fmt: skip
def test_refusals(text: str, parts: list[str]) -> None:
    with pytest.raises(UsageError) as refusal:
        read(text)
    message = str(refusal.value)
    assert message.startswith("file: key: ")
    for part in parts:
        assert part in message
    assert len(message) < 600


@pytest.mark.parametrize(
    ("role", "text", "parts"),
    [
        (Role.ODE, "X + x", ["'x' depends on s, but the equation of an ode state", "int(...)"]),
        (Role.ODE, "-X + s*w", ["'s*w' depends on s"]),
        (Role.ODE, "v", ["'v' depends on s"]),
        (Role.CONDITION, "x(0) - 2*x_s", ["'2*x_s' depends on s, but a boundary condition"]),
        (Role.CONDITION, "x(0) = s*X", ["'s*X' depends on s"]),
        (Role.CONDITION, "x(0) = u", ["'u' contains an input", "ode state", "x(1) = X"]),
        (Role.CONDITION, "x(0) - int(s*v)", ["'int(s*v)' contains an input"]),
        (Role.CONDITION, "x(0) = 1", ["'1' is a constant term"]),
        (Role.CONDITION, "1 + x(0)", ["'1' is a constant term"]),
        (Role.CONDITION, "X", ["'X' holds no function of s"]),
        (Role.CONDITION, "x(0) = x(0)", ["'x(0) = x(0)' holds no function of s"]),
        (Role.CONDITION, "x(0) = ", ["empty"]),
        (Role.CONDITION, "x(0) == x(1)", ["'=' occurs twice"]),
        (Role.CONDITION, "x(0) = x(1) = 0", ["'=' occurs twice"]),
        (Role.NORM, "x + u", ["'u' contains an input, which a norm cannot"]),
    ],
)  # fmt: skip
def test_refusals_of_a_place(role: Role, text: str, parts: list[str]) -> None:
    with pytest.raises(UsageError) as refusal:
        read(text, role)
    for part in parts:
        assert part in str(refusal.value)


def test_numbers_are_welcome_where_functions_are_not() -> None:
    assert terms("-X + int(s*x) + y(1) + w", Role.ODE)[W] == (1.0,)
    assert terms("x(1) = X + int(y)", Role.CONDITION)[Field(3)] == (-1.0,)


@pytest.mark.parametrize(
    ("role", "text", "at", "length"),
    [
        (Role.OUTPUT, "x_ss + x*w", 7, 3),
        (Role.OUTPUT, "  x_ss + (z)", 10, 1),
        (Role.OUTPUT, "x + s^2", 5, 1),
        (Role.OUTPUT, " x + 3 y", 7, 1),
        (Role.CONDITION, " x(0) =  z", 9, 1),
        (Role.CONDITION, "x(0) = 1", 7, 1),
        (Role.CONDITION, "x(0) = x(1) $", 12, 1),
    ],
)
def test_a_mark_points_at_the_term(role: Role, text: str, at: int, length: int) -> None:
    with pytest.raises(UsageError) as refusal:
        read(text, role)
    _, shown, mark = str(refusal.value).split("\n")
    assert shown == "    " + text
    assert mark == "    " + " " * at + "^" * length


def test_a_long_text_is_not_repeated() -> None:
    with pytest.raises(
        UsageError, match=r"'z' is not declared.*\(character 1001 of 1001\)"
    ) as refusal:
        read("x + " * 250 + "z")
    assert len(str(refusal.value)) < 300


@pytest.mark.parametrize(
    ("domain", "text"),
    [((0.0, 1e-200), "x_ss"), ((0.0, 1e200), "int(s*x)"), ((0.0, 1e-200), "x_ss(0)")],
)
def test_a_domain_out_of_all_proportion_is_refused(domain: tuple[float, float], text: str) -> None:
    with pytest.raises(UsageError, match="not finite"):
        read(text, Role.EQUATION, names(domain))


@settings(max_examples=300, deadline=None)
@given(st.text(st.sampled_from("xyXwvu_s0123.e+-*/() int,"), max_size=30))
def test_any_text_is_read_or_refused(text: str) -> None:
    check_read_or_refused(text, Role.OUTPUT)


@settings(max_examples=100, deadline=None)
@given(st.text(max_size=20), st.sampled_from(Role))
def test_any_characters_are_read_or_refused(text: str, role: Role) -> None:
    check_read_or_refused(text, role)


def check_read_or_refused(text: str, role: Role) -> None:
    message = ""
    try:
        for _, coefficient in read(text, role).expression.terms:
            assert coefficient and all(math.isfinite(c) for c in coefficient)
    except UsageError as error:
        message = str(error)
    assert not message or message.startswith("file: key: ")
