"""The orthonormal Legendre basis against numpy.polynomial and scipy's adaptive quadrature."""

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial import legendre as plain
from scipy.integrate import quad

from design import legendre

Array = npt.NDArray[np.float64]
S = np.linspace(0.0, 1.0, 23)


def series(coefficients: Array) -> Legendre:
    """The function with these orthonormal coefficients, as numpy knows it."""
    scale = np.sqrt(2.0 * np.arange(coefficients.size) + 1.0)
    return Legendre(coefficients * scale, domain=[0.0, 1.0])


def draw(*shape: int) -> Array:
    return np.random.default_rng(sum(shape) + len(shape)).normal(size=shape)


def test_basis_is_orthonormal_by_adaptive_quadrature() -> None:
    size = 6
    gram = [
        [
            quad(lambda s, i=i, j=j: legendre.basis(s, size)[0, i] * legendre.basis(s, size)[0, j], 0, 1)[0]
            for j in range(size)
        ]
        for i in range(size)
    ]  # fmt: skip
    np.testing.assert_allclose(gram, np.eye(size), atol=1e-12)


def test_basis_values_are_scaled_legendre_polynomials() -> None:
    for i in range(9):
        expected = np.sqrt(2 * i + 1) * Legendre.basis(i, domain=[0.0, 1.0])(S)
        np.testing.assert_allclose(legendre.basis(S, 9)[:, i], expected, atol=1e-13)
    np.testing.assert_allclose(legendre.basis(S, 3)[:, 1], np.sqrt(3) * (2 * S - 1), atol=1e-15)
    assert legendre.basis(0.25, 4).shape == (1, 4)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_gauss_is_exact_up_to_degree_2n_minus_1(count: int) -> None:
    nodes, weights = legendre.gauss(count)
    assert np.all((nodes > 0.0) & (nodes < 1.0))
    for degree in range(2 * count):
        assert weights @ nodes**degree == pytest.approx(1.0 / (degree + 1), abs=1e-13)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_gauss_misses_degree_2n_by_the_known_remainder(count: int) -> None:
    nodes, weights = legendre.gauss(count)
    monic = Legendre.basis(count, domain=[0.0, 1.0]).convert(kind=Polynomial)
    square = ((monic / monic.coef[-1]) ** 2).integ()
    missed = 1.0 / (2 * count + 1) - weights @ nodes ** (2 * count)
    assert missed == pytest.approx(square(1.0) - square(0.0), rel=1e-6)


def test_cached_arrays_cannot_be_changed_by_callers() -> None:
    cached = [
        *legendre.gauss(4),
        *legendre.projection(4),
        legendre.integration(3, 4),
        legendre.antiderivative_of_products(2, 3, 5),
        legendre.products(2, 3),
        legendre.products_with_antiderivatives(1, 2, 3),
    ]
    for array in cached:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


@pytest.mark.parametrize("size", [1, 2, 7, 20])
def test_transform_is_the_inverse_of_evaluation(size: int) -> None:
    coefficients = draw(size)
    nodes, values, transform = legendre.projection(size)
    np.testing.assert_allclose(transform @ series(coefficients)(nodes), coefficients, atol=1e-12)
    np.testing.assert_allclose(values @ coefficients, series(coefficients)(nodes), atol=1e-12)
    np.testing.assert_allclose(transform @ values, np.eye(size), atol=1e-12)


def test_fit_recovers_polynomials_along_the_last_axis() -> None:
    coefficients = draw(2, 3, 6)
    nodes = 0.5 * (plain.leggauss(6)[0] + 1.0)
    samples = np.array([[series(c)(nodes) for c in row] for row in coefficients])
    np.testing.assert_allclose(legendre.fit(samples), coefficients, atol=1e-12)


def test_fit_converges_to_the_l2_projection_of_smooth_functions() -> None:
    nodes, _ = legendre.gauss(24)
    fitted = legendre.fit(np.exp(nodes))
    for i in range(6):
        exact = quad(lambda s, i=i: np.exp(s) * series(np.eye(6)[i])(s), 0.0, 1.0, epsabs=1e-14)[0]
        assert fitted[i] == pytest.approx(exact, abs=1e-13)


@pytest.mark.parametrize(("size_in", "size_out"), [(1, 2), (4, 5), (4, 9), (12, 13)])
def test_integration_from_zero(size_in: int, size_out: int) -> None:
    coefficients = draw(size_in)
    integral = coefficients @ legendre.integration(size_in, size_out)
    assert integral.shape == (size_out,)
    expected = series(coefficients).integ(lbnd=0.0)
    np.testing.assert_allclose(series(integral)(S), expected(S), atol=1e-13)


def test_integration_is_tridiagonal_and_truncates_to_the_leading_coefficients() -> None:
    full = legendre.integration(7, 8)
    band = np.abs(np.subtract.outer(np.arange(7), np.arange(8)))
    assert np.all(full[(band != 1) & (np.arange(7)[:, None] + np.arange(8) > 0)] == 0.0)
    np.testing.assert_array_equal(legendre.integration(7, 3), full[:, :3])


@pytest.mark.parametrize(("left", "right"), [(1, 1), (1, 4), (4, 2), (5, 5)])
def test_antiderivatives_of_products(left: int, right: int) -> None:
    table = legendre.antiderivative_of_products(left, right, left + right)
    unit = np.eye(max(left, right))
    for j in range(left):
        for k in range(right):
            product = series(unit[j]) * series(unit[k])
            np.testing.assert_allclose(
                series(table[j, k])(S), product.integ(lbnd=0.0)(S), atol=1e-13
            )
            assert series(table[j, k])(1.0) == pytest.approx(float(j == k), abs=1e-13)
    padded = legendre.antiderivative_of_products(left, right, left + right + 3)
    np.testing.assert_allclose(padded[..., : left + right], table, atol=1e-15)
    assert not np.any(padded[..., left + right :])


@pytest.mark.parametrize("sizes", [(1, 1, 1), (3, 1, 4), (2, 5, 3)])
def test_products_and_products_with_antiderivatives(sizes: tuple[int, int, int]) -> None:
    outer, left, right = sizes
    unit = np.eye(max(sizes))
    plain_table = legendre.products(left, right)
    table = legendre.products_with_antiderivatives(outer, left, right)
    assert plain_table.shape == (left, right, left + right - 1)
    assert table.shape == (outer, left, right, sum(sizes) - 1)
    for j in range(left):
        for k in range(right):
            product = series(unit[j]) * series(unit[k])
            np.testing.assert_allclose(series(plain_table[j, k])(S), product(S), atol=1e-12)
            for i in range(outer):
                expected = series(unit[i])(S) * product.integ(lbnd=0.0)(S)
                np.testing.assert_allclose(series(table[i, j, k])(S), expected, atol=1e-12)


def test_products_of_matrix_polynomials() -> None:
    a, b = draw(2, 3, 4), draw(3, 1, 5)
    product = legendre.multiply(a, b)
    assert product.shape == (2, 1, 8)
    for m in range(2):
        expected = sum(series(a[m, k])(S) * series(b[k, 0])(S) for k in range(3))
        np.testing.assert_allclose(series(product[m, 0])(S), expected, atol=1e-12)


def test_products_with_an_empty_inner_dimension_are_zero() -> None:
    product = legendre.multiply(np.zeros((2, 0, 3)), np.zeros((0, 4, 2)))
    assert product.shape == (2, 4, 4)
    assert not np.any(product)


def test_plain_coefficients_are_those_of_numpy() -> None:
    coefficients = draw(3, 7)
    converted = legendre.to_plain(coefficients)
    for row, given in zip(converted, coefficients, strict=True):
        np.testing.assert_allclose(plain.legval(2 * S - 1, row), series(given)(S), atol=1e-13)
    np.testing.assert_allclose(legendre.from_plain(converted), coefficients, rtol=1e-15)


def test_norm_is_the_l2_norm_only_in_the_orthonormal_basis() -> None:
    # int_0^1 (1 + 2 s)^2 ds = 13/3, with 1 + 2 s = 2 P_0 + P_1(2 s - 1)
    assert np.sum(legendre.from_plain([2.0, 1.0]) ** 2) == pytest.approx(13.0 / 3.0, rel=1e-15)


def test_trim_drops_trailing_coefficients_up_to_the_tolerance() -> None:
    c = np.zeros((2, 5, 4))
    c[0, 2, 1], c[1, 0, 0], c[1, 3, 2] = 1.0, 2.0, 1e-9
    assert legendre.trim(c, (1, 2)).shape == (2, 4, 3)
    np.testing.assert_array_equal(legendre.trim(c, (1, 2), 1e-9), c[:, :3, :2])
    assert legendre.trim(c, (2,), 1e-9).shape == (2, 5, 2)
    assert legendre.trim(np.zeros((3, 4)), (1,)).shape == (3, 1)
    assert legendre.trim(np.zeros((0, 4)), (1,)).shape == (0, 1)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_trim_keeps_what_is_not_finite(bad: float) -> None:
    kept = legendre.trim(np.array([[1.0, 0.0, bad, 0.0]]), (1,), np.inf)
    assert kept.shape == (1, 3)
    assert not np.isfinite(kept[0, 2])


@pytest.mark.parametrize("count", [24, 48, 96])
def test_interpolation_is_right_at_the_ends_too(count: int) -> None:
    """`fit` is right to 1e-12 there: weights near the ends have a relative error of 1e-13 and more."""
    nodes, _ = legendre.gauss(count)
    ends = legendre.basis([0.0, 1.0], count) @ legendre.interpolate(np.exp(nodes))
    np.testing.assert_allclose(ends, np.exp([0.0, 1.0]), rtol=2e-14)
    samples = np.random.default_rng(0).normal(size=(2, 3, count))
    again = legendre.interpolate(samples) @ legendre.basis(nodes, count).T
    np.testing.assert_allclose(again, samples, atol=1e-13)
