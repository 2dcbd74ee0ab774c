"""P^-1 Z with ode states and distributed outputs, against a dense solve by quadrature split at the kink."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from lpi_reference import Function, example_problem, inequality
from numpy.polynomial import legendre as plain
from pi_reference import (
    at,
    finite_part,
    function_part,
    kernel_at,
    polynomial,
    random_operator,
    values,
)

from design.lpi.gains import gain_operator
from design.lpi.scaling import scaled
from design.operators import PIOperator, Shape
from design.pde.convert import convert

Array = npt.NDArray[np.float64]
ONE = Shape(0, 1)
TOLERANCE = 1e-6
"""Relative, in R^m x L2^n (theory, section 4)."""


def coefficients(function: Function, degree: int) -> Array:
    """Orthonormal Legendre coefficients of a polynomial, from samples."""
    x, w = plain.leggauss(degree + 2)
    s = 0.5 * (x + 1.0)
    return np.asarray(values(s, degree + 1).T @ (0.5 * w * function(s)))


class Dense:
    """P by collocation at Gauss nodes: numbers, then values of the interpolating polynomials.

    Integrals over [0, s_i] and [s_i, 1] are taken apart, each by a rule that is exact for it.
    """

    def __init__(self, P: PIOperator, size: int) -> None:
        x, w = plain.leggauss(size)
        self.nodes, self.weights = 0.5 * (x + 1.0), 0.5 * w
        self.m, n = P.shape_in
        s = self.nodes
        to_coefficients = values(s, size).T * self.weights
        block = np.zeros((n, size, n, size))
        r0 = at(P.r0, s)
        for i in range(size):
            block[:, i, :, i] = r0[i]
        for kernel, low, high in ((P.r1, np.zeros(size), s), (P.r2, s, np.ones(size))):
            half = 0.5 * (high - low)[:, None]
            t, v = low[:, None] + half * (x + 1.0), half * w
            k = kernel_at(kernel, np.broadcast_to(s[:, None], t.shape), t)
            interpolate = values(t, size) @ to_coefficients
            block += np.einsum("iaqn,ia,iaj->qinj", k, v, interpolate, optimize=True)
        row = np.einsum("ipn,i->pni", at(P.q1, s), self.weights)
        column = np.moveaxis(at(P.q2, s), 0, 1)
        self.matrix = np.block(
            [
                [P.p, row.reshape(self.m, n * size)],
                [column.reshape(n * size, self.m), block.reshape(n * size, n * size)],
            ]
        )

    def solve(self, number: Array, function: Function) -> tuple[Array, Array]:
        """P^-1 of an element: numbers and values (n, size) at the nodes."""
        right = np.concatenate([number, function(self.nodes).ravel()])
        found = np.linalg.solve(self.matrix, right)
        return found[: self.m], found[self.m :].reshape(-1, self.nodes.size)

    def size(self, number: Array, samples: Array) -> float:
        return float(np.sqrt(number @ number + np.sum(samples**2 * self.weights)))


def error(P: PIOperator, Z: PIOperator, size: int = 40) -> float:
    """Largest relative difference over outputs of degree 0, 2 and 5, and over each number alone."""
    L, tail = gain_operator(P, Z)
    assert (L.shape_out, L.shape_in) == (P.shape_in, Z.shape_in)
    assert tail <= 1e-6
    dense = Dense(P, size)
    rng = np.random.default_rng(2)
    m, n = Z.shape_in
    inputs = [(np.eye(m)[k], polynomial(np.zeros((n, 1)))) for k in range(m)]
    if n:
        inputs += [(rng.normal(size=m), polynomial(rng.normal(size=(n, d)))) for d in (1, 3, 6)]
    worst = 0.0
    for y in inputs:
        number, samples = dense.solve(finite_part(Z, *y), function_part(Z, *y))
        got = finite_part(L, *y), function_part(L, *y)(dense.nodes)
        difference = dense.size(got[0] - number, got[1] - samples)
        worst = max(worst, difference / dense.size(number, samples))
    return worst


def positive(rng: np.random.Generator, space: Shape, small: float) -> PIOperator:
    """Self-adjoint, 1 + small random parts."""
    half = random_operator(rng, space, space)
    return PIOperator.identity(space) + (half + half.adjoint) * small


def kernel(variable: int) -> Array:
    """3 (1 + s) for variable 0, 3 (1 + t) for variable 1."""
    line = coefficients(lambda x: 3.0 * (1.0 + x), 1)
    out = np.zeros((1, 1, 2, 2))
    out[(0, 0, slice(None), 0) if variable == 0 else (0, 0, 0, slice(None))] = line
    return out


PAIRS = [
    (Shape(0, 1), Shape(2, 1)),
    (Shape(0, 2), Shape(0, 1)),
    (Shape(1, 1), Shape(1, 0)),
    (Shape(1, 1), Shape(0, 1)),
    (Shape(2, 2), Shape(1, 2)),
    (Shape(2, 0), Shape(1, 2)),
]


@pytest.mark.parametrize(
    ("space", "outputs"), PAIRS, ids=[f"R{m} L2^{n} from R{p} L2^{q}" for (m, n), (p, q) in PAIRS]
)
def test_random_operators(space: Shape, outputs: Shape) -> None:
    rng = np.random.default_rng(10 * space.finite + space.functions)
    P, Z = positive(rng, space, 0.1), random_operator(rng, space, outputs)
    assert np.linalg.eigvalsh(P.discretise(12))[0] > 0.05
    assert error(P, Z) < TOLERANCE


@pytest.mark.parametrize("outputs", [Shape(1, 0), Shape(0, 1)], ids=["number", "function"])
def test_multiplier_with_a_deep_minimum(outputs: Shape) -> None:
    """R0 = 0.05 + s^2: the poles of 1 / R0 are near the interval."""
    rng = np.random.default_rng(1)
    half = rng.normal(size=(1, 1, 4, 4)) * 0.02
    P = PIOperator.multiplier(coefficients(lambda s: 0.05 + s**2, 2)[None, None])
    P = P.replace(r1=half, r2=half.transpose(0, 1, 3, 2))
    assert error(P, random_operator(rng, ONE, outputs), 90) < TOLERANCE


@pytest.mark.parametrize("outputs", [Shape(1, 0), Shape(0, 1)], ids=["number", "function"])
@pytest.mark.parametrize("multiplier", [1.0, 0.2])
def test_different_kernels(multiplier: float, outputs: Shape) -> None:
    """R1 = 3 (1 + s), R2 = 3 (1 + t): coercive with R0 = 1; invertible but indefinite with R0 = 0.2."""
    P = PIOperator.multiplier(np.full((1, 1, 1), multiplier)).replace(r1=kernel(0), r2=kernel(1))
    Z = random_operator(np.random.default_rng(3), ONE, outputs)
    assert error(P, Z) < TOLERANCE


def test_different_kernels_with_an_ode() -> None:
    """The same kernels bordered: the Schur complement is taken on the inverse of the function part."""
    space = Shape(1, 1)
    column = coefficients(lambda s: 1.0 - s**2, 2)
    P = PIOperator(
        p=np.array([[2.0]]),
        q1=column[None, None],
        q2=column[None, None],
        r0=np.ones((1, 1, 1)),
        r1=kernel(0),
        r2=kernel(1),
    )
    Z = random_operator(np.random.default_rng(3), space, Shape(1, 1))
    assert error(P, Z) < TOLERANCE


def test_operators_of_an_observer() -> None:
    """N1: P as the solver leaves it, far from the identity."""
    pie = scaled(convert(example_problem("n1"))).pie
    lpi = inequality(pie, 3, measured=True)
    point = lpi.program.solve({"gamma": 1.0}, {"delta": 1e-3, "epsilon": 1e-5})
    assert point.found
    P, Z = lpi.operators(point)
    assert Z is not None
    values_of_P = np.linalg.eigvalsh(P.discretise(30))
    assert values_of_P[-1] > 100.0 * values_of_P[0] > 0.0
    assert error(P, Z) < TOLERANCE


def test_identity_changes_nothing() -> None:
    space = Shape(2, 2)
    Z = random_operator(np.random.default_rng(5), space, Shape(1, 2))
    L, tail = gain_operator(PIOperator.identity(space), Z)
    assert tail < 1e-12
    np.testing.assert_allclose(L.discretise(12), Z.discretise(12), atol=1e-12)


def test_closed_form() -> None:
    """x + <1, x> 1 = y with y = s: x = s - 1/4. Bordered by an ode state, too: X + int x = 1, x + X = 0."""
    ones = np.ones((1, 1, 1, 1))
    P = PIOperator.identity(ONE).replace(r1=ones, r2=ones)
    s = coefficients(lambda x: x, 1)
    Z = PIOperator.zeros(ONE, Shape(1, 0)).replace(q2=s[None, None])
    L, _ = gain_operator(P, Z)
    points = np.linspace(0.0, 1.0, 5)
    got = function_part(L, np.ones(1), polynomial(np.zeros((0, 1))))(points)
    np.testing.assert_allclose(got[0], points - 0.25, atol=1e-12)

    border = PIOperator.identity(Shape(1, 1)).replace(
        q1=np.ones((1, 1, 1)) / 2, q2=np.ones((1, 1, 1))
    )
    Z = PIOperator.zeros(Shape(1, 1), Shape(1, 0)).replace(p=np.ones((1, 1)))
    L, _ = gain_operator(border, Z)  # X + int x / 2 = 1, x = -X: X = 2
    np.testing.assert_allclose(L.p, [[2.0]], rtol=1e-12)
    got = function_part(L, np.ones(1), polynomial(np.zeros((0, 1))))(points)
    np.testing.assert_allclose(got[0], -2.0, rtol=1e-12)


MINUS = -np.ones((1, 1, 1, 1))
SINGULAR = {
    "multiplier zero inside": PIOperator.multiplier(coefficients(lambda s: s - 0.3, 1)[None, None]),
    "constants to zero": PIOperator.identity(ONE).replace(r1=MINUS, r2=MINUS),
    "ode block": PIOperator.identity(Shape(2, 1)).replace(p=np.ones((2, 2))),
    "ode block, no functions": PIOperator.identity(Shape(2, 0)).replace(p=np.ones((2, 2))),
    "Schur complement": PIOperator.identity(Shape(1, 1)).replace(
        q1=np.ones((1, 1, 1)), q2=np.ones((1, 1, 1))
    ),
    "Schur complement, to rounding": PIOperator.identity(Shape(1, 1)).replace(
        q1=np.full((1, 1, 1), 0.1), q2=np.full((1, 1, 1), 10.0 * (1.0 + 1e-15))
    ),
}


@pytest.mark.parametrize("P", SINGULAR.values(), ids=SINGULAR.keys())
def test_singular_operator(P: PIOperator) -> None:
    Z = random_operator(np.random.default_rng(1), P.shape_in, Shape(1, 0))
    with pytest.raises(ArithmeticError, match="singular"):
        gain_operator(P, Z)


def test_wrong_dimensions() -> None:
    rng = np.random.default_rng(0)
    space, other = Shape(1, 2), Shape(1, 1)
    good = PIOperator.identity(space)
    for P, Z in (
        (random_operator(rng, space, other), good),
        (good, random_operator(rng, other, space)),
        (good, random_operator(rng, Shape(0, 2), space)),
    ):
        with pytest.raises(ValueError, match="square P and Z into its range"):
            gain_operator(P, Z)
