"""P^-1 Z where P's kernels are large against its multiplier: closed forms, collocation, what is refused.

x + c int min(s, t) x = y is u'' = c u - y for u = int min x, u(0) = u'(1) = 0, x = y - c u, condition
1 + 4 c / pi^2. The inverse is harmless: 1 and a kernel of at most w / 2, w = sqrt(c), that falls like
e^(-w |s - t|). Its factors are not: cosh(w (1 - s)) and sinh(w t) / cosh(w), e^w between their ends.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from pi_reference import function_part, polynomial
from pi_reference import values as basis
from test_inverse import NOTHING, ONE, apply_gain, coefficients, collocation, scalar

from design import inverse, legendre
from design.factors import factorise
from design.inverse import SampledKernels, solve_columns, solve_gain
from design.lpi.gains import gain_operator
from design.operators import PIOperator, Shape

Array = npt.NDArray[np.float64]
IDENTITY = PIOperator.identity(ONE)
CONSTANT = np.ones((1, 1, 1))
ROUNDING = 2.2e-16


def membrane(c: float) -> PIOperator:
    line = coefficients(lambda x: c * x, 1)
    r1, r2 = np.zeros((2, 2)), np.zeros((2, 2))
    r1[0], r2[:, 0] = line, line
    return scalar(lambda s: 1.0 + 0.0 * s, r1, r2)


def closed_kernel(c: float, s: Array, t: Array) -> Array:
    """-w sinh(w low) cosh(w (1 - high)) / cosh(w), by exponentials that do not overflow."""
    w = np.sqrt(c)
    low, high = np.minimum(s, t), np.maximum(s, t)
    ends = (1.0 - np.exp(-2.0 * w * low)) * (1.0 + np.exp(-2.0 * w * (1.0 - high)))
    return np.asarray(-0.5 * w * np.exp(w * (low - high)) * ends / (1.0 + np.exp(-2.0 * w)))


def closed_of_one(c: float, s: Array) -> Array:
    """P^-1 on the constant one: cosh(w (1 - s)) / cosh(w)."""
    w = np.sqrt(c)
    return np.asarray((np.exp(-w * s) + np.exp(-w * (2.0 - s))) / (1.0 + np.exp(-2.0 * w)))


def kernel_error(c: float, s: Array, first: Array, second: Array) -> float:
    """Of N1 below the diagonal and N2 above it, given at all pairs of points, relative to the largest."""
    exact = closed_kernel(c, s[:, None], s[None])
    off = ~np.eye(len(s), dtype=bool)
    got = np.where(s[:, None] > s[None], first, second)
    return float(np.abs(got - exact)[off].max() / np.abs(exact).max())


def sampled_error(c: float, gain: SampledKernels) -> float:
    s, _ = legendre.gauss(gain.multiplier.shape[2])
    pairs = ((gain.outer1, gain.inner1), (gain.outer2, gain.inner2))
    return kernel_error(c, s, *(np.einsum("ra,rb->ab", o[0], i[:, 0]) for o, i in pairs))


def polynomial_error(c: float, *factors: Array) -> float:
    """Of coefficients outer1 (1, 1, d), inner1, outer2, inner2, on an even grid with both ends."""
    s = np.linspace(0.0, 1.0, 121)
    a, b, c1, d = (f[0, 0] @ basis(s, f.shape[2]).T for f in factors)
    return kernel_error(c, s, np.outer(a, b), np.outer(c1, d))


@pytest.mark.parametrize("c", [1.0, 10.0, 100.0, 300.0, 500.0])
def test_polynomial_factors_are_as_good_as_the_tail_says(c: float) -> None:
    """Shooting from end to end has 6e-5 at c = 100 and 1e5 at 300: e^(2 w) roundings, for e^w here."""
    gain = solve_gain(membrane(c), IDENTITY)
    w = np.sqrt(c)
    growth = w * np.sinh(w) / max(1.0, w * np.tanh(w))
    assert gain.outer1.shape[1] == gain.inner2.shape[0] == 1
    # of the largest product, at (0, 1), and the largest value, at (1, 1); nodes are not quite there
    assert gain.growth == pytest.approx(growth, rel=0.1)
    assert gain.tail <= max(1e-10, 20.0 * ROUNDING * growth)
    # the tail names the last coefficients, the error has them all, each sqrt(2 d + 1) at the ends
    error = polynomial_error(
        c, *map(legendre.interpolate, (gain.outer1, gain.inner1, gain.outer2, gain.inner2))
    )
    assert error <= max(1e-12, 10.0 * gain.tail)
    # samples need no polynomial: 1e-12 of the ODE a step
    assert sampled_error(c, gain) < 2e-11


@pytest.mark.variants("10000.0")
@pytest.mark.parametrize("c", [1e3, 1e4, 1e5])
def test_only_polynomial_factors_limit(c: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ODE keeps its digits at any c; what is refused is e^w roundings, e^316 at the last."""
    with pytest.raises(
        ArithmeticError, match=r"grow too much along the arm.*off by .* by rounding"
    ):
        solve_gain(membrane(c), IDENTITY)
    monkeypatch.setattr(inverse, "UNRESOLVED", np.inf)
    gain = solve_gain(membrane(c), IDENTITY)
    assert (
        sampled_error(c, gain) < 1e-10
    )  # 1e4 the most that a step's condition may be, times rounding


def test_the_loss_is_named() -> None:
    """sinh(w) = 2.7e13 times rounding of two factors: 1e-3 at least, 1 at most."""
    with pytest.raises(ArithmeticError) as raised:
        solve_gain(membrane(1000.0), IDENTITY)
    named = float(str(raised.value).split("off by ")[1].split()[0])
    assert 1e-3 < named < 1.0


@pytest.mark.variants("10000.0")
@pytest.mark.parametrize("c", [1.0, 10.0, 100.0, 300.0, 1e3, 1e4, 1e5])
def test_columns_have_no_limit_but_their_own_resolution(c: float) -> None:
    columns, tail = solve_columns(membrane(c), CONSTANT)
    s = np.linspace(0.0, 1.0, 301)
    got = columns[0, 0] @ basis(s, columns.shape[2]).T
    # the inverse takes errors of the multiplier's size: rounding times a step's condition, 1e4
    np.testing.assert_allclose(got, closed_of_one(c, s), atol=1e-11)
    assert tail < 1e-10


def test_columns_that_polynomials_do_not_resolve() -> None:
    with pytest.raises(ArithmeticError, match="P's kernels are large against its multiplier"):
        solve_columns(membrane(1e7), CONSTANT)


@pytest.mark.parametrize("limit", ["MOST_PIECES", "MOST_ENTRIES"])
def test_steps_that_would_have_to_be_too_many(limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At c = 1e4 a step from one of 24 nodes to the next has the condition 1e9."""
    monkeypatch.setattr(inverse, limit, 1)
    with pytest.raises(ArithmeticError, match="grow too much along the arm"):
        solve_columns(membrane(1e4), CONSTANT)


def test_a_coarse_tail_is_refused() -> None:
    """1 / R_0 has poles 0.003 from the middle, error 1.013^-d: not for 96 polynomials."""
    P = scalar(lambda s: 1e-5 + (s - 0.5) ** 2, np.zeros((1, 1)), np.zeros((1, 1)))
    with pytest.raises(ArithmeticError, match=r"varies too fast along the arm for 96 polynomials"):
        solve_columns(P, CONSTANT)


@pytest.mark.parametrize("c", [30.0, 100.0, 300.0])
def test_the_gain_as_an_operator(c: float) -> None:
    """gain_operator trims less where kernels grow, so that c = 300 keeps what the samples have."""
    P = membrane(c)
    inverse_of_p, tail = gain_operator(P, IDENTITY)
    _, got = inverse_of_p.apply(NOTHING, lambda t: np.ones((1, len(t))), np.linspace(0.0, 1.0, 41))
    exact = closed_of_one(c, np.linspace(0.0, 1.0, 41))
    np.testing.assert_allclose(got[0], exact, atol=max(1e-10, 10.0 * tail))
    assert tail <= max(1e-10, 20.0 * ROUNDING * np.sinh(np.sqrt(c)))


@pytest.mark.parametrize("c", [30.0, 100.0, 300.0])
def test_factors_keep_what_the_gain_needs(c: float) -> None:
    """fit_tolerance 1e-9 is one of the largest product, 2e7 gains at c = 300; the gain is the measure.

    ORDINARY (100) times 1e-9, times some ten coefficients that were dropped.
    """
    gain = solve_gain(membrane(c), IDENTITY)
    factors, dropped = factorise(gain, 1e-9)
    assert factors.ranks == (1, 1)
    assert dropped < 1e-12
    error = polynomial_error(c, factors.n1a, factors.n1b, factors.n2a, factors.n2b)
    assert error < 1e-6


def unsymmetric(c: float, skew: float) -> PIOperator:
    """I + c (V* V + skew (W - W*)) of two functions: P + P* >= 2 I, kernels of rank 4 that are no adjoints."""
    rng = np.random.default_rng(11)
    square = Shape(0, 2)
    zero = PIOperator.zeros(square, square)
    V, W = (zero.replace(r1=rng.normal(size=(2, 2, 2, 2))) for _ in range(2))
    return PIOperator.identity(square) + (V.adjoint @ V + (W - W.adjoint) * skew) * c


@pytest.mark.parametrize(
    ("c", "skew", "kernels"),
    [(3.0, 0.25, 1e-11), (10.0, 0.25, 1e-7), (100.0, 0.0, 1e-5), (30.0, 0.25, None)],
)
def test_matrix_against_collocation(c: float, skew: float, kernels: float | None) -> None:
    """Rates from 0 to 17 and more in one kernel; collocation of 70 and 90 nodes agrees to 1e-12.

    Tails: growth 74, 2e7 and 9e8 times rounding times some ten last coefficients.
    """
    P = unsymmetric(c, skew)
    given = np.random.default_rng(3).normal(size=(2, 4))
    function = polynomial(given)
    nodes, solved, _ = collocation(P, function, 80)
    series = (basis(nodes, 80).T * legendre.gauss(80)[1]) @ solved.T
    columns, _ = solve_columns(P, given[:, None])
    s = np.linspace(0.0, 1.0, 101)
    expected = basis(s, 80) @ series
    got = basis(s, columns.shape[2]) @ columns[:, 0].T
    assert np.abs(got - expected).max() < 1e-10 * np.abs(expected).max()
    if kernels is None:
        with pytest.raises(ArithmeticError, match="grow too much along the arm"):
            solve_gain(P, PIOperator.identity(Shape(0, 2)))
        return
    gain = solve_gain(P, PIOperator.identity(Shape(0, 2)))
    assert gain.outer1.shape[1] == 4
    assert gain.tail <= kernels
    s, got = apply_gain(gain, function)
    expected = (basis(s, 80) @ series).T
    assert np.linalg.norm(got - expected) <= max(gain.tail, 1e-11) * np.linalg.norm(expected)


def test_columns_of_many_functions_with_states() -> None:
    """Columns that are no constants: P of what comes out is what went in, by pointwise quadrature."""
    P = unsymmetric(30.0, 0.25)
    given = np.random.default_rng(5).normal(size=(2, 3, 4))
    columns, _ = solve_columns(P, given)
    s = np.linspace(0.01, 0.99, 7)
    for j in range(3):
        back = function_part(P, NOTHING, polynomial(columns[:, j]))(s)
        # of P's norm, 230: quadrature with 24 points an interval, layers of e^(-50 s)
        np.testing.assert_allclose(back, polynomial(given[:, j])(s), atol=1e-7)
