"""Norms of operators as sums of squares: the constants of Poincare and Wirtinger, and wrong ones refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from lpi_reference import DD, DN, admissible, problem
from numpy.polynomial import Polynomial as Poly
from numpy.polynomial import legendre as plain
from pde_polynomials import evaluate
from pi_reference import function_part
from scipy import linalg

from design.lpi.norm import NormInequality
from design.lpi.sdp import Point
from design.operators import PIOperator
from design.pde.convert import convert
from design.pde.model import Pde

Array = npt.NDArray[np.float64]
X, W = plain.leggauss(30)
NODES, WEIGHTS = 0.5 * (X + 1.0), 0.5 * W


def constant(order: int, conditions: tuple[str, ...], of: str, by: str) -> Pde:
    return problem({"x": (order, "")}, conditions, norm=(of, by))


PROBLEMS: dict[str, tuple[Pde, int, float]] = {
    "Volterra": (constant(1, ("x(0)",), "x", "x_s"), 3, 2.0 / math.pi),
    "Poincare, second derivative": (constant(2, DD, "x", "x_ss"), 4, 1.0 / math.pi**2),
    "half held": (constant(2, DN, "x", "x_ss"), 3, 4.0 / math.pi**2),
    "slope by curvature": (constant(2, DD, "x_s", "x_ss"), 4, 1.0 / math.pi),
    "functional": (constant(1, ("x(0)",), "x(1)", "x_s"), 1, 1.0),
    "mean": (constant(2, DD, "int(x)", "x_ss"), 3, math.sqrt(1.0 / 120.0)),
}
"""PDE, degree, the least constant."""


def ratio(pde: Pde, size: int) -> tuple[float, Array, list[Array]]:
    """Largest |N x| / |D x| over polynomials that meet the conditions, and the quadratic forms' matrices."""
    states = admissible(pde, size)
    forms = []
    for outputs in (pde.numerator, pde.denominator):
        rows = [
            np.concatenate([evaluate(o.expression, x)(NODES) for o in outputs])
            * np.tile(np.sqrt(WEIGHTS), len(outputs))
            for x in states
        ]
        forms.append(np.array(rows) @ np.array(rows).T)
    values, vectors = linalg.eigh(forms[0], forms[1])
    return math.sqrt(values[-1]), vectors[:, -1], forms


@pytest.mark.parametrize("name", PROBLEMS)
def test_least_constant(name: str) -> None:
    """Bounded below by polynomials, above by the sum of squares; in between is the known constant."""
    pde, degree, exact = PROBLEMS[name]
    lpi = NormInequality(convert(pde), degree)
    point = lpi.program.solve({"c2": 1.0}, {})
    found = lpi.certificate(point)
    reached, _, _ = ratio(pde, 8)
    assert reached == pytest.approx(exact, rel=1e-6)
    assert reached * (1.0 - 1e-9) <= found.gamma <= exact * 1.01
    assert exact * (1.0 - 1e-6) <= found.gamma
    assert found.gamma**2 >= point.numbers["c2"]
    assert found.margin > -1e-9 * found.gamma**2
    assert found.change < 1e-4


def test_solver_below_the_truth() -> None:
    """What the solver says is 1e-6 too small here; what is certified is not."""
    pde, _, exact = PROBLEMS["Volterra"]
    lpi = NormInequality(convert(pde), 4)
    point = lpi.program.solve({"c2": 1.0}, {})
    assert point.numbers["c2"] < exact**2 * (1.0 + 1e-4)
    assert point.smallest_eigenvalue < 0.0
    assert exact < lpi.certificate(point).gamma < 1.001 * exact


@pytest.mark.parametrize("name", ["Volterra", "half held", "functional"])
def test_margin_is_that_of_the_form(name: str) -> None:
    """c^2 |D x|^2 - |N x|^2 on a section, by polynomials: also for a c that is too small."""
    pde, degree, exact = PROBLEMS[name]
    lpi = NormInequality(convert(pde), degree)
    point = lpi.program.solve({"c2": 1.0}, {})
    clean = replace(point, grams={key: 0.0 * g for key, g in point.grams.items()})
    _, _, (over, under) = ratio(pde, 6)
    for factor in (0.9, 1.1):
        c2 = (factor * exact) ** 2
        found = lpi.certificate(replace(clean, numbers={"c2": c2}), sections=(5, 6))
        expected = linalg.eigh(c2 * under - over, under, eigvals_only=True)[0]
        assert found.margin == pytest.approx(float(expected), rel=1e-6)
        assert (found.margin > 0.0) == (factor > 1.0)
        assert found.gamma == pytest.approx(factor * exact, rel=1e-12)


def test_negative_eigenvalues_are_paid_for() -> None:
    """With Gram matrices >= -eta, the form is at least -eta |rows x|^2, which gamma covers."""
    pde, degree, _ = PROBLEMS["Volterra"]
    lpi = NormInequality(convert(pde), degree)
    point = lpi.program.solve({"c2": 1.0}, {})
    honest = lpi.certificate(point).gamma
    eta = 1e-3
    worse = {key: g - 2.0 * eta * np.eye(len(g)) for key, g in point.grams.items()}
    smallest = min(float(np.linalg.eigvalsh(g)[0]) for g in worse.values())
    assert smallest < -eta
    found = lpi.certificate(replace(point, grams=worse))
    assert found.gamma**2 - honest**2 > eta  # some row is at least |D x|^2 for some x
    assert found.gamma**2 - honest**2 < 1.0


@pytest.mark.parametrize(
    "numbers", [{"c2": -0.1}, {"c2": float("nan")}], ids=["negative", "not a number"]
)
def test_no_constant(numbers: dict[str, float]) -> None:
    pde, degree, _ = PROBLEMS["Volterra"]
    lpi = NormInequality(convert(pde), degree)
    grams = {name: np.zeros((k, k)) for name, k in lpi.program.layout.grams}
    point = Point("optimal", numbers, np.zeros(0), grams, 0.0, 0.0, 1, 0.0, 0.0)
    assert math.isnan(lpi.certificate(point).gamma)


def test_identity_holds_on_polynomials() -> None:
    """c^2 |D x|^2 - |N x|^2 = <rows, G rows> + weighted ones, for x = s (1 - s)^2 + s^3: by quadrature."""
    pde = constant(1, ("x(0)",), "x", "x_s")
    x = Poly([0.0, 1.0]) * Poly([1.0, -1.0]) ** 2 + Poly([0.0, 0.0, 0.0, 1.0])
    lpi = NormInequality(convert(pde), 3)
    point = lpi.program.solve({"c2": 1.0}, {})
    f = x.deriv()

    def of(rows: PIOperator | None) -> Array:
        assert rows is not None
        return function_part(rows, np.zeros(0), lambda s: f(s)[None])(NODES)

    rows, multiples = of(lpi.rows), of(lpi.multiples)
    squares = np.einsum("ia,ij,ja,a->", rows, point.grams["inequality"], rows, WEIGHTS)
    for key, weight in (("inequality s", NODES), ("inequality 1-s", 1.0 - NODES)):
        gram = point.grams[key]
        squares += np.einsum("ia,ij,ja,a,a->", multiples, gram, multiples, weight, WEIGHTS)
    left = point.numbers["c2"] * float(f(NODES) ** 2 @ WEIGHTS) - float(x(NODES) ** 2 @ WEIGHTS)
    assert left > 0.0
    assert float(squares) == pytest.approx(left, rel=1e-8)
