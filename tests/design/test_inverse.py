"""P^-1 Z against a collocation (Nystrom) solve whose integrals are split at the kernel's kink."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import legendre as plain
from pi_reference import at, function_part, kernel_at, polynomial, random_operator, values

from design.arm_pie import arm_pie
from design.gain_problem import controller_problem, observer_problem
from design.inverse import SampledKernels, separate, solve_gain
from design.moment_lpi import solve_hinf
from design.operators import PIOperator, Shape

Array = npt.NDArray[np.float64]
Function = Callable[[Array], Array]
ONE = Shape(0, 1)
NOTHING = np.zeros(0)


def coefficients(function: Function, degree: int) -> Array:
    """Orthonormal Legendre coefficients of a polynomial, from samples."""
    x, w = plain.leggauss(degree + 2)
    s = 0.5 * (x + 1.0)
    return np.asarray(values(s, degree + 1).T @ (0.5 * w * function(s)))


def scalar(r0: Function, r1: Array, r2: Array) -> PIOperator:
    """3-PI operator on one function from a multiplier (degree <= 3) and kernels' coefficients."""
    zero = PIOperator.zeros(ONE, ONE)
    return zero.replace(r0=coefficients(r0, 3)[None, None], r1=r1[None, None], r2=r2[None, None])


def linear_kernel(variable: int) -> Array:
    """3 (1 + s) for variable 0, 3 (1 + t) for variable 1."""
    line = coefficients(lambda x: 3.0 * (1.0 + x), 1)
    out = np.zeros((2, 2))
    out[(slice(None), 0) if variable == 0 else (0, slice(None))] = line
    return out


def collocation(P: PIOperator, right: Function, size: int) -> tuple[Array, Array, Array]:
    """Solve P x = right for values at `size` Gauss nodes; returns nodes, values (n, size), P's matrix.

    x is the interpolating polynomial; integrals over [0, s_i] and [s_i, 1] are taken apart, each by a
    Gauss rule that is exact for it, so that the kink at s = t costs nothing.
    """
    x, w = plain.leggauss(size)
    s = 0.5 * (x + 1.0)
    n = P.shape_out.functions
    to_coefficients = values(s, size).T * (0.5 * w)
    matrix = np.zeros((n, size, n, size))
    r0 = at(P.r0, s)
    for i in range(size):
        matrix[:, i, :, i] = r0[i]
    more, more_w = plain.leggauss(size)
    for kernel, low, high in ((P.r1, np.zeros(size), s), (P.r2, s, np.ones(size))):
        half = 0.5 * (high - low)[:, None]
        t, v = low[:, None] + half * (more + 1.0), half * more_w
        k = kernel_at(kernel, np.broadcast_to(s[:, None], t.shape), t)
        interpolate = values(t, size) @ to_coefficients
        matrix += np.einsum("iaqn,ia,iaj->qinj", k, v, interpolate, optimize=True)
    flat = matrix.reshape(n * size, n * size)
    solved: Array = np.asarray(np.linalg.solve(flat, right(s).reshape(-1)))
    return s, solved.reshape(n, size), flat


def apply_gain(gain: SampledKernels, function: Function) -> tuple[Array, Array]:
    """(nodes, values (q, N)) of the gain on a function, by integrals of its own factors' series."""
    count = gain.multiplier.shape[2]
    x, _ = plain.leggauss(count)
    s = 0.5 * (x + 1.0)
    given = function(s)
    out = np.einsum("qma,ma->qa", gain.multiplier, given)
    for outer, inner, forward in (
        (gain.outer1, gain.inner1, True),
        (gain.outer2, gain.inner2, False),
    ):
        product = np.einsum("rma,ma->ra", inner, given)
        series = plain.legfit(x, product.T, count - 1)
        primitive = plain.legint(series, lbnd=-1.0, scl=0.5)
        below = np.asarray(plain.legval(x, primitive))
        whole = np.asarray(plain.legval(np.ones(1), primitive))
        sums = below if forward else whole - below
        out = out + np.einsum("qra,ra->qa", outer, sums)
    return s, out


def relative_error(P: PIOperator, Z: PIOperator, size: int) -> float:
    """Largest difference to the collocation solve in L2, over some functions, relative."""
    gain = solve_gain(P, Z)
    assert gain.tail <= 1e-10
    worst = 0.0
    rng = np.random.default_rng(3)
    for degree in (0, 3, 6):
        function = polynomial(rng.normal(size=(Z.shape_in.functions, degree + 1)))
        nodes, solved, _ = collocation(P, function_part(Z, NOTHING, function), size)
        s, got = apply_gain(gain, function)
        series = plain.legfit(2.0 * nodes - 1.0, solved.T, size - 1)
        expected = plain.legval(2.0 * s - 1.0, series)
        worst = max(worst, float(np.linalg.norm(got - expected) / np.linalg.norm(expected)))
    return worst


IDENTITY = PIOperator.identity(ONE)


def test_multiplier_with_a_deep_minimum() -> None:
    """R0 = 0.05 + s^2 and R1 = R2*: the poles of 1 / R0 are near the interval."""
    random = np.random.default_rng(1).normal(size=(4, 4)) * 0.02
    P = scalar(lambda s: 0.05 + s**2, random, random.T)
    Z = random_operator(np.random.default_rng(2), ONE, ONE)
    assert relative_error(P, Z, 90) < 1e-9


@pytest.mark.parametrize("multiplier", [1.0, 0.2])
def test_different_kernels(multiplier: float) -> None:
    """R0 + 3 (1 + max(s, t)): rank one on each side, yet R1 != R2.

    K u = lambda u gives lambda u'' = 3 u, u'(0) = 0: but for one positive eigenvalue they are
    -3 / w^2 with tan w = -1 / (2 w), the lowest -0.339. So P is coercive for R0 = 1, and for R0 = 0.2
    indefinite but invertible, which is all the inverse needs.
    """
    P = scalar(lambda s: multiplier + 0.0 * s, linear_kernel(0), linear_kernel(1))
    _, _, matrix = collocation(P, lambda s: s[None], 40)
    smallest = np.linalg.eigvals(matrix).real.min()
    w = 2.975078
    assert np.tan(w) == pytest.approx(-0.5 / w, abs=1e-5)
    assert smallest == pytest.approx(multiplier - 3.0 / w**2, abs=1e-5)
    assert relative_error(P, IDENTITY, 40) < 1e-9


def test_kernel_that_is_no_adjoint() -> None:
    """Matrix valued, nothing symmetric, Z with kernels of its own."""
    rng = np.random.default_rng(7)
    square, wide = Shape(0, 3), Shape(0, 2)
    P = random_operator(rng, square, square) * 0.3
    P = P + PIOperator.identity(square) * 2.5
    Z = random_operator(rng, square, wide)
    _, _, matrix = collocation(P, function_part(Z, NOTHING, polynomial(np.ones((2, 1)))), 24)
    assert np.linalg.cond(matrix) < 100.0
    assert relative_error(P, Z, 60) < 1e-9


@pytest.mark.parametrize("role", ["observer", "controller"])
def test_gain_of_a_real_design(role: str) -> None:
    pie = arm_pie(np.ones(1), np.zeros(1), 80.0, 0.7)
    problem = observer_problem(pie, 0.1) if role == "observer" else controller_problem(pie, 0.1)
    result = solve_hinf(problem, counts=(1,))
    assert relative_error(result.P, result.Z, 30) < 1e-6


def test_volterra_closed_form() -> None:
    """x(s) - int_0^s x = y has the solution y(s) + int_0^s exp(s - t) y(t) dt."""
    zero = PIOperator.zeros(ONE, ONE)
    P = IDENTITY + zero.replace(r1=np.full((1, 1, 1, 1), -1.0))
    s, got = apply_gain(solve_gain(P, IDENTITY), lambda s: np.ones((1, s.size)))
    np.testing.assert_allclose(got[0], np.exp(s), rtol=1e-11)


def test_identity_and_multipliers() -> None:
    """No kernel at all: nothing to integrate, the gain is Z / R0."""
    gain = solve_gain(IDENTITY, IDENTITY)
    np.testing.assert_allclose(gain.multiplier, 1.0, rtol=1e-14)
    assert gain.outer1.shape[1] == gain.inner2.shape[0] == 0
    P = scalar(lambda s: 1.0 + s, np.zeros((1, 1)), np.zeros((1, 1)))
    s, got = apply_gain(solve_gain(P, IDENTITY), lambda s: s[None] ** 2)
    np.testing.assert_allclose(got[0], s**2 / (1.0 + s), rtol=1e-12)


def test_inverse_of_the_identity_is_z() -> None:
    Z = random_operator(np.random.default_rng(5), Shape(0, 2), Shape(0, 3))
    function = polynomial(np.random.default_rng(6).normal(size=(3, 4)))
    s, got = apply_gain(solve_gain(PIOperator.identity(Shape(0, 2)), Z), function)
    np.testing.assert_allclose(got, function_part(Z, NOTHING, function)(s), atol=1e-11)


@pytest.mark.parametrize(
    ("multiplier", "message"),
    [
        (lambda s: s - 0.3, "multiplier of P is singular"),
        (lambda s: 0.0 * s, "multiplier of P is singular"),
        (lambda s: s, "multiplier of P is singular"),
        (lambda s: (s - 0.3) ** 2, "multiplier of P is almost singular"),
    ],
    ids=["sign change", "zero", "zero at the root", "double zero between nodes"],
)
def test_singular_multiplier(multiplier: Function, message: str) -> None:
    P = scalar(multiplier, np.ones((1, 1)), np.ones((1, 1)))
    with pytest.raises(ArithmeticError, match=message):
        solve_gain(P, IDENTITY)


def test_singular_matrix_multiplier() -> None:
    """Each entry is far from zero, the determinant is not."""
    P = PIOperator.multiplier(np.array([[[1.0], [2.0]], [[2.0], [4.0]]]))
    with pytest.raises(ArithmeticError, match="multiplier"):
        solve_gain(P, PIOperator.identity(Shape(0, 2)))


def test_singular_operator() -> None:
    """P = I - <1, .> 1 sends the constant to zero, though its multiplier is one."""
    minus = np.full((1, 1), -1.0)
    P = scalar(lambda s: 1.0 + 0.0 * s, minus, minus)
    with pytest.raises(ArithmeticError, match="boundary matrix"):
        solve_gain(P, IDENTITY)
    for kernels in (0.9 * minus, 1.1 * minus):  # to either side there is an inverse
        assert (
            relative_error(scalar(lambda s: 1.0 + 0.0 * s, kernels, kernels), IDENTITY, 20) < 1e-9
        )


def test_wrong_dimensions() -> None:
    rng = np.random.default_rng(0)
    square, finite = Shape(0, 2), Shape(1, 2)
    good = PIOperator.identity(square)
    for P, Z in (
        (random_operator(rng, square, Shape(0, 3)), good),
        (good, random_operator(rng, Shape(0, 3), square)),
        (PIOperator.identity(finite), PIOperator.identity(finite)),
        (good, random_operator(rng, square, finite)),
    ):
        with pytest.raises(ValueError, match="square 3-PI operator"):
            solve_gain(P, Z)


def test_separated_kernel() -> None:
    rng = np.random.default_rng(4)
    kernel = np.einsum("qri,rnj->qnij", rng.normal(size=(3, 2, 5)), rng.normal(size=(2, 2, 4)))
    left, right = separate(kernel)
    assert left.shape == (3, 2, 5)
    assert right.shape == (2, 2, 4)
    np.testing.assert_allclose(np.einsum("qri,rnj->qnij", left, right), kernel, atol=1e-13)
    left, right = separate(np.zeros((3, 2, 5, 4)))
    assert (left.shape[1], right.shape[0]) == (0, 0)
