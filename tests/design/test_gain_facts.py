"""The gain that is handed to the user is the model's, in the units of the file: checked by plain quadrature."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.polynomial import legendre as numpy_legendre
from scipy.integrate import quad

from design import legendre
from design.lpi.gain_facts import gain_facts
from design.lpi.gains import Gain
from design.operators import PIOperator, Shape
from design.pde.problem_file import parse_problem

TEXT = """
domain = [-1, 3]
[states]
X = "ode"
x = 2
[inputs]
disturbances = ["w"]
controls = ["u", "v(s)"]
[equations]
X = "-X + u"
x = "x_ss + w + v(s)"
[boundary]
conditions = ["x(-1)", "x_s(3)"]
[outputs]
regulated = ["int(x)"]
measured = ["X + w", "x + 0*s"]
"""
LENGTH = 4.0


def random_operator(seed: int, out: Shape, into: Shape) -> PIOperator:
    rng = np.random.default_rng(seed)
    (p, q), (m, n) = out, into
    return PIOperator(
        p=rng.normal(size=(p, m)),
        q1=rng.normal(size=(p, n, 3)),
        q2=rng.normal(size=(q, m, 4)),
        r0=rng.normal(size=(q, n, 2)),
        r1=rng.normal(size=(q, n, 3, 2)),
        r2=rng.normal(size=(q, n, 2, 3)),
    )


def value(coefficients: list[float], s: float) -> float:
    return float(numpy_legendre.legval((s + 1.0) / 2.0 - 1.0, coefficients))


def kernel_value(coefficients: list[list[float]], s: float, t: float) -> float:
    return float(
        numpy_legendre.legval2d((s + 1.0) / 2.0 - 1.0, (t + 1.0) / 2.0 - 1.0, coefficients)
    )


def y(s: float) -> float:
    return float(np.cos(s) + s)


def as_shown(facts: dict[str, Any], number: float, s: float) -> tuple[float, float]:
    """The map of the module's docstring, evaluated on [-1, 3] by scipy."""
    finite = facts["finite"][0][0] * number
    finite += quad(lambda t: value(facts["integrals"][0][0], t) * y(t), -1.0, 3.0)[0]
    function = value(facts["profiles"][0][0], s) * number + value(facts["multiplier"][0][0], s) * y(
        s
    )
    for key, low, high in (("below", -1.0, s), ("above", s, 3.0)):
        kernel = facts[key][0][0]
        function += quad(lambda t, k=kernel: kernel_value(k, s, t) * y(t), low, high)[0]
    return finite, function


@pytest.mark.parametrize("role", ["observer", "controller"])
def test_the_shown_gain_is_the_models_in_the_units_of_the_file(role: str) -> None:
    pde = parse_problem(TEXT, "test").pde
    operator = random_operator(3, Shape(1, 1), Shape(1, 1))
    facts = gain_facts(Gain(role, operator, 0.0), pde)
    # the model's distributed y is sqrt(length) times the file's, its u sqrt(length) times, states are the same
    into = np.sqrt(LENGTH) if role == "observer" else 1.0
    out = 1.0 if role == "observer" else 1.0 / np.sqrt(LENGTH)
    s = 0.7
    finite, function = operator.apply(
        np.array([1.3]),
        lambda sigma: np.array([[into * y(LENGTH * a - 1.0) for a in np.atleast_1d(sigma)]]),
        np.array([(s + 1.0) / LENGTH]),
    )
    got = as_shown(facts, 1.3, s)
    assert got == pytest.approx((float(finite[0]), out * float(function[0, 0])), rel=1e-9)


def test_names_say_what_goes_in_and_comes_out() -> None:
    pde = parse_problem(TEXT, "test").pde
    operator = random_operator(4, Shape(1, 1), Shape(1, 1))
    observer = gain_facts(Gain("observer", operator, 0.0), pde)
    assert observer["from"] == {"numbers": ["X + w"], "functions": ["x + 0*s"]}
    assert observer["to"] == {"numbers": ["X"], "functions": ["x"]}
    controller = gain_facts(Gain("controller", operator, 0.0), pde)
    assert controller["to"] == {"numbers": ["u"], "functions": ["v"]}
    assert legendre.trim(operator.q2, (2,)).shape[2] == len(controller["profiles"][0][0])
