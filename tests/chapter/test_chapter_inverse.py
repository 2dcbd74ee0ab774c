"""P^-1: the exact formula, octarm's, and polynomials for R_0^-1, against quadrature and closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from chapter.inverse import DEGREES, SETPOINTS
from chapter.inverse_arm import arm, arm_row, parameters_of
from chapter.inverse_cases import (
    best_kernel_errors,
    formula_error,
    membrane,
    membrane_kernel,
    octarm_error,
    one_kernel,
    operator_of,
    polynomials,
    powers_of,
    rational,
)
from chapter.inverse_equal import COUNT, NOISE, NotStrict
from chapter.inverse_formula import Separable, in_letters
from chapter.inverse_rational import approximated, ellipse, errors, valley
from chapter.inverse_reference import Nystrom
from chapter.lpi_gains import chapter_pie
from design.gain_problem import observer_problem
from design.moment_lpi import MARGIN, MomentProgram
from design.moments import make_moments

DOCS = Path(__file__).resolve().parents[2] / "docs" / "chapter"


def one_plus(gamma: float) -> Separable:
    """x + gamma int_0^1 x."""
    none = np.zeros((0, 1))
    return Separable(
        np.zeros((0, 0)),
        none,
        none,
        np.array([[gamma]]),
        powers_of(1, 1),
        lambda s: np.ones((len(s), 1, 1)),
    )


def test_the_formula_by_hand() -> None:
    """(1 + gamma <1, .> 1)^-1 = 1 - gamma / (1 + gamma) <1, .> 1, coercive or not; none at gamma = -1."""
    s = np.array([0.2, 0.9])
    for gamma in (2.0, -3.0):
        kernel = one_plus(gamma).inverse().kernel(s, s[::-1])
        assert kernel.ravel() == pytest.approx([-gamma / (1.0 + gamma)] * 2, abs=1e-13)
    with pytest.raises(ArithmeticError, match="singular"):
        one_plus(-1.0).inverse()


@pytest.mark.parametrize(
    ("operator", "least"),
    [(rational(), 0.287), (rational(self_adjoint=False), -1.52), (rational(sign=-1.0), -1.57)],
    ids=["coercive", "not self-adjoint", "indefinite"],
)
def test_the_formula_against_quadrature(operator: Separable, least: float) -> None:
    values = Nystrom(operator.parameters, 30).eigenvalues()
    assert values[0] == pytest.approx(least, abs=5e-3)
    assert formula_error(operator) < 1e-11


def test_octarm_and_the_letters() -> None:
    operator = rational()
    error, tail = octarm_error(operator.parameters, 4, 24)
    assert error < 1e-9 and tail < 1e-10
    found = operator.inverse()
    for letter, here in zip(in_letters(operator), (found.P, found.H1, found.Gamma), strict=True):
        assert letter == pytest.approx(here, abs=1e-12)
    assert pytest.approx(found.H2, abs=1e-12) == found.H1


def test_the_membrane_is_what_its_closed_form_says() -> None:
    """Eigenvalues 1 + 4 c / (pi (2 k + 1))^2; and k + c min o k = -c min for the kernel k of the inverse."""
    values = Nystrom(membrane(30.0), 40).eigenvalues()
    k = np.arange(6)
    assert values[::-1][:6] == pytest.approx(1.0 + 120.0 / (np.pi * (2 * k + 1)) ** 2, abs=1e-9)
    x, w = np.polynomial.legendre.leggauss(30)
    s, t = 0.7, 0.3
    total = 0.0
    for low, high in ((0.0, t), (t, s), (s, 1.0)):
        r = low + 0.5 * (high - low) * (x + 1.0)
        kernel = membrane_kernel(30.0, r, np.full_like(r, t))
        total += 0.5 * (high - low) * float(w @ (np.minimum(s, r) * kernel))
    here = float(membrane_kernel(30.0, np.array([s]), np.array([t]))[0])
    assert here + 30.0 * total == pytest.approx(-30.0 * t, abs=1e-11)


def test_one_kernel_for_two_is_wrong() -> None:
    found = one_kernel(30.0)
    assert found.quadrature < 1e-12 and found.octarm < 1e-9 and found.series < 1e-9
    ways = list(found.one.values())
    assert ways[0] == pytest.approx(0.693, abs=2e-3)
    assert ways[1] == pytest.approx(5.76, abs=2e-2)
    assert 1e-8 < ways[2] < 1e-6
    coarse, fine = best_kernel_errors(operator_of(membrane(30.0), 1), (16, 32), 100)
    assert np.log2(coarse / fine) == pytest.approx(1.9, abs=0.15)


def test_the_arm() -> None:
    row = arm_row("1", 24)
    assert row.least == pytest.approx(0.675, abs=1e-3)
    assert row.octarm < 1e-9 and row.octarm_gain < 1e-10
    wrong = list(row.one.values())
    assert wrong[:2] == pytest.approx([0.117, 0.172], abs=1e-3)
    assert row.rank == row.ranks[0] == 15 and row.ranks[1:] == (8, 6)
    P, _, _ = arm("1")
    at = parameters_of(P)
    s, t = np.array([0.7]), np.array([0.3])
    assert np.abs(at.R1(s, t) - at.R2(t, s).transpose(0, 2, 1)).max() < 1e-12  # self-adjoint
    assert np.abs(at.R1(s, t) - at.R2(s, t)).max() > 0.1  # and R_1 is not R_2
    assert np.abs(at.R1(s, s) - at.R2(s, s)).max() > 1e-3  # not even at the diagonal


@pytest.mark.parametrize("a", [0.5, 0.2])
def test_the_nearest_root_sets_the_rate(a: float) -> None:
    """The ellipse with foci +-1 through +-2 i a has half axes 2 a and sqrt(1 + 4 a^2)."""
    rho = ellipse(valley(a).R0, 2)
    assert rho == pytest.approx(2.0 * a + np.sqrt(1.0 + 4.0 * a * a), rel=1e-9)
    low, high = errors(valley(a), (8, 24), "projection")
    assert (low / high) ** (1.0 / 16.0) == pytest.approx(rho, rel=2e-3)


def test_degree_six() -> None:
    """Small errors where the roots are far, an indefinite R_0^-1 where they are near."""
    found = [errors(valley(a), (6,), "101 points")[0] for a in (0.5, 0.2, 0.1)]
    assert found == pytest.approx([1.3e-3, 7.3e-2, 0.38], rel=0.03)
    s = np.linspace(0.0, 1.0, 101)
    assert approximated(valley(0.1).R0, 6, "101 points")(s).min() < -5.0
    low, high = errors(rational(), (8, 32), "projection")
    rho = ellipse(rational().R0, 3)
    assert (low / high) ** (1.0 / 24.0) == pytest.approx(rho, rel=1e-2)


def test_factors_at_minimal_rank() -> None:
    coarse, fine = polynomials(30.0, 1e-4), polynomials(30.0, 1e-8)
    assert coarse.rank == fine.rank == 1
    assert coarse.degree < fine.degree
    assert fine.error < 1e-6 and 1e-3 < coarse.error < 0.1


def test_only_kappa_holds_strains_below_zero() -> None:
    """kappa = 0 leaves 0 where the strict inequality wants -MARGIN; NotStrict gives MARGIN back, no more."""
    problem = observer_problem(chapter_pie("1"), NOISE)
    moments = make_moments(problem, 1)
    strict, loose = MomentProgram(problem, moments), NotStrict(problem, moments)
    for program in (strict, loose):
        random = np.random.default_rng(1)
        for variable in {v.id: v for m in program.matrices for v in m.variables()}.values():
            value = np.abs(random.standard_normal(variable.shape))
            symmetric = variable.ndim == 2 and variable.attributes["symmetric"]
            variable.value = value + value.T if symmetric else value
    first, *others = (np.asarray(m.value) for m in strict.matrices)
    second, *same = (np.asarray(m.value) for m in loose.matrices)
    difference = np.diag(second - first)
    assert np.abs(second - first - np.diag(difference)).max() < 1e-12
    assert difference.sum() == pytest.approx(MARGIN * len(moments.state), rel=1e-6)
    assert all(np.array_equal(a, b) for a, b in zip(others, same, strict=True))
    strict.positive.value = strict.negative.value = 0.0
    assert float(strict._rest(strict._q(), -1.0).value) == 0.0 > -MARGIN
    assert COUNT == 2


def test_the_page_has_these_numbers() -> None:
    facts = json.loads((DOCS / "facts.json").read_text())["inverse"]["numbers"]
    rows = {one["name"]: one for one in facts["rational"]}
    assert len(rows) == 4
    found = errors(valley(0.2), DEGREES[:5], "projection")
    stored = [rows["R_0 = 0.2^2 + (s - 1/2)^2"]["errors"][str(d)] for d in DEGREES[:5]]
    assert stored == pytest.approx(found, rel=0.06)
    assert [one["setpoint"] for one in facts["arm"]] == list(SETPOINTS)
    assert all(one["octarm"] <= 1e-6 and one["octarm_gain"] <= 1e-6 for one in facts["arm"])
    assert [one["octarm"] is None for one in facts["membrane"]] == [False] * 6 + [True]
    for with_s, without in facts["equal"].values():
        assert with_s < without < NOISE
