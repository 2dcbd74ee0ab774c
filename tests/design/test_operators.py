"""Laws of the PI operator algebra, and every operation against evaluation from the definition (7)."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pi_reference import (
    FOUR_PI,
    PARAMETERS,
    POINTS,
    SPACES,
    THREE_PI,
    Chain,
    at,
    chains,
    distance,
    finite_part,
    function_part,
    inner,
    kernel_at,
    polynomial,
    random_operator,
    rule,
    size_of,
    values,
)

from design.operators import PIOperator, Shape, compose, horizontal, vertical

Array = npt.NDArray[np.float64]
TOLERANCE = 1e-12
"""Rounding of the coefficients, relative to the product of the operators' largest ones."""
deterministic = settings(derandomize=True, deadline=None, database=None, max_examples=40)


# Laws


@deterministic
@given(chains(3))
def test_composition_is_associative(chain: Chain) -> None:
    a, b, c = chain.operators
    assert distance((a @ b) @ c, a @ (b @ c)) <= TOLERANCE * size_of(a, b, c)


@deterministic
@given(chains(2))
def test_composition_distributes_over_sums(chain: Chain) -> None:
    (a, b), (c, d) = chain.operators, chain.twins
    scale = size_of(a, b) + size_of(c, d)
    assert distance((a + c) @ b, a @ b + c @ b) <= TOLERANCE * scale * size_of(b)
    assert distance(a @ (b - d), a @ b - a @ d) <= TOLERANCE * scale * size_of(a)


@deterministic
@given(chains(2), st.floats(-3.0, 3.0))
def test_numbers_pass_through_composition_and_adjoint(chain: Chain, factor: float) -> None:
    a, b = chain.operators
    assert distance((factor * a) @ b, a @ (b * factor)) <= 10 * TOLERANCE * size_of(a, b)
    assert distance((a * factor).adjoint, factor * a.adjoint) == 0.0
    assert distance(-a, -1.0 * a) == 0.0


@deterministic
@given(chains(1))
def test_sums_are_commutative_with_zero_and_negatives(chain: Chain) -> None:
    (a,), (b,) = chain.operators, chain.twins
    assert distance(a + b, b + a) == 0.0
    assert distance(a + PIOperator.zeros(a.shape_out, a.shape_in), a) == 0.0
    assert distance(a - a, PIOperator.zeros(a.shape_out, a.shape_in)) == 0.0


@deterministic
@given(chains(1))
def test_identity_and_zero_are_neutral_and_absorbing(chain: Chain) -> None:
    (a,) = chain.operators
    out, into = a.shape_out, a.shape_in
    assert distance(PIOperator.identity(out) @ a, a) <= TOLERANCE * size_of(a)
    assert distance(a @ PIOperator.identity(into), a) <= TOLERANCE * size_of(a)
    nothing = PIOperator.zeros(into, Shape(1, 1))
    assert distance(a @ nothing, PIOperator.zeros(out, Shape(1, 1))) == 0.0


@deterministic
@given(chains(2))
def test_adjoint_is_an_involution_that_reverses_products(chain: Chain) -> None:
    a, b = chain.operators
    assert distance(a.adjoint.adjoint, a) == 0.0
    assert distance((a @ b).adjoint, b.adjoint @ a.adjoint) <= TOLERANCE * size_of(a, b)
    assert distance((a + chain.twins[0]).adjoint, a.adjoint + chain.twins[0].adjoint) == 0.0


@deterministic
@given(chains(1))
def test_adjoint_by_inner_products(chain: Chain) -> None:
    (a,) = chain.operators
    (u, v), (x, y) = chain.vectors
    left = inner(finite_part(a, x, y), function_part(a, x, y), u, v)
    adjoint = a.adjoint
    right = inner(x, y, finite_part(adjoint, u, v), function_part(adjoint, u, v))
    assert left == pytest.approx(right, abs=1e-10 * size_of(a))


@deterministic
@given(chains(1), st.floats(-3.0, 3.0))
def test_operators_act_linearly(chain: Chain, factor: float) -> None:
    (a,), (b,) = chain.operators, chain.twins
    (x, y), (u, v) = chain.vectors[1], chain.others[1]
    ax, ay = a.apply(x, y, POINTS)
    au, av = a.apply(u, v, POINTS)
    cx, cy = a.apply(x + factor * u, lambda s: y(s) + factor * v(s), POINTS)
    np.testing.assert_allclose(cx, ax + factor * au, atol=1e-10 * size_of(a))
    np.testing.assert_allclose(cy, ay + factor * av, atol=1e-10 * size_of(a))
    bx, by = b.apply(x, y, POINTS)
    sx, sy = (a + factor * b).apply(x, y, POINTS)
    np.testing.assert_allclose(sx, ax + factor * bx, atol=1e-10 * size_of(a))
    np.testing.assert_allclose(sy, ay + factor * by, atol=1e-10 * size_of(a))


# Against the definition


@deterministic
@given(chains(1))
def test_apply_evaluates_the_definition(chain: Chain) -> None:
    (a,) = chain.operators
    x, y = chain.vectors[1]
    finite, function = a.apply(x, y, POINTS)
    assert finite.shape == (a.shape_out.finite,)
    assert function.shape == (a.shape_out.functions, POINTS.size)
    np.testing.assert_allclose(finite, finite_part(a, x, y), atol=1e-10)
    np.testing.assert_allclose(function, function_part(a, x, y)(POINTS), atol=1e-10)


def test_apply_takes_functions_that_are_not_polynomials() -> None:
    _, got = volterra().apply(np.zeros(0), lambda t: np.exp(-t[None]) * np.sin(t[None]), POINTS)
    exact = 0.5 * (1.0 - np.exp(-POINTS) * (np.sin(POINTS) + np.cos(POINTS)))
    np.testing.assert_allclose(got[0], exact, atol=1e-14)


@deterministic
@given(chains(2))
def test_composition_acts_as_one_operator_after_the_other(chain: Chain) -> None:
    a, b = chain.operators
    x, y = chain.vectors[2]
    middle, field = finite_part(b, x, y), function_part(b, x, y)
    finite = finite_part(a, middle, field)
    function = function_part(a, middle, field)(POINTS)
    product = compose(a, b)
    assert (product.shape_out, product.shape_in) == (a.shape_out, b.shape_in)
    np.testing.assert_allclose(finite_part(product, x, y), finite, atol=1e-10 * size_of(a, b))
    np.testing.assert_allclose(
        function_part(product, x, y)(POINTS), function, atol=1e-10 * size_of(a, b)
    )


@deterministic
@given(chains(1), st.integers(1, 5), st.integers(1, 5))
def test_discretise_gives_the_galerkin_entries(chain: Chain, columns: int, rows: int) -> None:
    (a,) = chain.operators
    (pf, q), (mf, n) = a.shape_out, a.shape_in
    expected = np.zeros((pf + q * rows, mf + n * columns))
    (t,), (w,) = rule(np.zeros(1), np.ones(1))
    test_functions = values(t, rows) * w[:, None]
    for column in range(expected.shape[1]):
        x, coefficients = np.zeros(mf), np.zeros((n, columns))
        if column < mf:
            x[column] = 1.0
        else:
            coefficients[divmod(column - mf, columns)] = 1.0
        y = polynomial(coefficients)
        expected[:pf, column] = finite_part(a, x, y)
        expected[pf:, column] = (function_part(a, x, y)(t) @ test_functions).ravel()
    np.testing.assert_allclose(a.discretise(columns, rows), expected, atol=1e-11 * size_of(a))
    if rows == columns:
        np.testing.assert_array_equal(a.discretise(columns), a.discretise(columns, rows))


@deterministic
@given(chains(1), st.integers(1, 5), st.integers(1, 5))
def test_discretise_turns_adjoints_into_transposes(chain: Chain, columns: int, rows: int) -> None:
    (a,) = chain.operators
    np.testing.assert_allclose(
        a.adjoint.discretise(rows, columns),
        a.discretise(columns, rows).T,
        atol=TOLERANCE * size_of(a),
    )


@deterministic
@given(chains(1), SPACES)
def test_concatenation_keeps_each_block(chain: Chain, extra: Shape) -> None:
    (a,) = chain.operators
    rng = np.random.default_rng(chain.spaces[0].functions)
    below = random_operator(rng, extra, a.shape_in)
    beside = random_operator(rng, a.shape_out, extra)
    x, y = chain.vectors[1]
    stacked = vertical(a, below)
    assert stacked.shape_out == tuple(np.add(a.shape_out, extra))
    finite = np.concatenate([finite_part(a, x, y), finite_part(below, x, y)])
    function = [function_part(k, x, y)(POINTS) for k in (a, below)]
    np.testing.assert_allclose(finite_part(stacked, x, y), finite, atol=1e-12)
    np.testing.assert_allclose(
        function_part(stacked, x, y)(POINTS), np.concatenate(function), atol=1e-12
    )

    u, v = rng.normal(size=extra.finite), polynomial(rng.normal(size=(extra.functions, 3)))
    wide = horizontal(a, beside)
    assert wide.shape_in == tuple(np.add(a.shape_in, extra))
    xu = np.concatenate([x, u])

    def yv(s: Array) -> Array:
        return np.concatenate([y(s), v(s)])

    np.testing.assert_allclose(
        finite_part(wide, xu, yv), finite_part(a, x, y) + finite_part(beside, u, v), atol=1e-12
    )
    np.testing.assert_allclose(
        function_part(wide, xu, yv)(POINTS),
        function_part(a, x, y)(POINTS) + function_part(beside, u, v)(POINTS),
        atol=1e-12,
    )


@deterministic
@given(chains(1), st.randoms(use_true_random=False))
def test_rows_picks_outputs_in_the_given_order(chain: Chain, random: object) -> None:
    (a,) = chain.operators
    x, y = chain.vectors[1]
    finite = list(range(a.shape_out.finite))[::-1]
    functions = list(range(a.shape_out.functions))[::-1][:2]
    picked = a.rows(finite, functions)
    np.testing.assert_array_equal(finite_part(picked, x, y), finite_part(a, x, y)[finite])
    np.testing.assert_allclose(
        function_part(picked, x, y)(POINTS),
        function_part(a, x, y)(POINTS)[functions],
        atol=1e-14,
    )


# Closed forms


def volterra() -> PIOperator:
    """(V y)(s) = int_0^s y."""
    one = Shape(0, 1)
    return PIOperator.zeros(one, one).replace(r1=np.ones((1, 1, 1, 1)))


def times_s() -> PIOperator:
    """Multiplication by s = phi_0 / 2 + phi_1 / (2 sqrt(3))."""
    return PIOperator.multiplier(np.array([[[0.5, 0.5 / np.sqrt(3.0)]]]))


def is_kernel_operator(
    a: PIOperator, below: Array, above: Array, multiplier: Array | None = None
) -> None:
    """Compare r1 (t < s), r2 (t > s) and r0 with values on a grid."""
    s, t = np.meshgrid(POINTS, POINTS, indexing="ij")
    np.testing.assert_allclose(kernel_at(a.r1, s, t)[..., 0, 0], below, atol=1e-14)
    np.testing.assert_allclose(kernel_at(a.r2, s, t)[..., 0, 0], above, atol=1e-14)
    expected = np.zeros_like(POINTS) if multiplier is None else multiplier
    np.testing.assert_allclose(at(a.r0, POINTS)[:, 0, 0], expected, atol=1e-14)


S, T = np.meshgrid(POINTS, POINTS, indexing="ij")
NONE = np.zeros_like(S)


def test_volterra_squared_has_kernel_s_minus_t() -> None:
    is_kernel_operator(volterra() @ volterra(), S - T, NONE)


def test_volterra_cubed_has_kernel_of_repeated_integration() -> None:
    is_kernel_operator(volterra() @ volterra() @ volterra(), 0.5 * (S - T) ** 2, NONE)


def test_adjoint_of_volterra_integrates_from_s_to_1() -> None:
    is_kernel_operator(volterra().adjoint, NONE, np.ones_like(S))


def test_volterra_times_its_adjoint_is_the_kernel_min() -> None:
    is_kernel_operator(volterra() @ volterra().adjoint, T, S)
    is_kernel_operator(volterra().adjoint @ volterra(), 1.0 - S, 1.0 - T)


def test_multiplication_by_s_before_and_after_volterra() -> None:
    is_kernel_operator(times_s() @ volterra(), S, NONE)
    is_kernel_operator(volterra() @ times_s(), T, NONE)
    is_kernel_operator(times_s() @ volterra().adjoint, NONE, S)
    is_kernel_operator(times_s() @ times_s(), NONE, NONE, POINTS**2)


def test_commutator_of_s_and_volterra_is_volterra_squared() -> None:
    commutator = times_s() @ volterra() - volterra() @ times_s()
    assert distance(commutator, volterra() @ volterra()) < 1e-15


def test_products_with_finite_parts_in_closed_form() -> None:
    mean = PIOperator.zeros(Shape(1, 0), Shape(0, 1)).replace(q1=np.ones((1, 1, 1)))  # int_0^1 y
    constant = mean.adjoint  # number -> constant function
    ramp = times_s() @ constant  # number -> s x
    np.testing.assert_allclose(
        at((mean @ volterra()).q1, POINTS)[:, 0, 0], 1.0 - POINTS, atol=1e-15
    )
    np.testing.assert_allclose(at((volterra() @ constant).q2, POINTS)[:, 0, 0], POINTS, atol=1e-15)
    np.testing.assert_allclose(
        at((volterra() @ ramp).q2, POINTS)[:, 0, 0], 0.5 * POINTS**2, atol=1e-15
    )
    assert (mean @ ramp).p[0, 0] == pytest.approx(0.5, abs=1e-15)
    assert (ramp.adjoint @ ramp).p[0, 0] == pytest.approx(1.0 / 3.0, abs=1e-15)
    is_kernel_operator(ramp @ ramp.adjoint, S * T, S * T)
    is_kernel_operator(constant @ mean @ volterra(), 1.0 - T, 1.0 - T)


def test_norm_of_volterra_tends_to_two_over_pi() -> None:
    norms = [np.linalg.norm(volterra().discretise(size), 2) for size in (1, 2, 4, 16)]
    assert norms[0] == pytest.approx(0.5, abs=1e-15)
    assert all(a < b - 1e-6 for a, b in pairwise(norms[:3]))
    assert norms[2] < 2.0 / np.pi
    assert norms[3] == pytest.approx(2.0 / np.pi, abs=1e-14)
    singular = np.linalg.svd(volterra().discretise(24), compute_uv=False)[:5]
    np.testing.assert_allclose(singular, 2.0 / (np.pi * (2.0 * np.arange(5) + 1.0)), rtol=1e-10)


# Trimming


@deterministic
@given(chains(1))
def test_trimmed_changes_nothing_above_rounding(chain: Chain) -> None:
    (a,) = chain.operators
    largest = max(float(np.max(np.abs(getattr(a, k)), initial=0.0)) for k in PARAMETERS[1:])
    padded = a.replace(
        r0=np.pad(a.r0, [(0, 0), (0, 0), (0, 3)]),
        r1=np.pad(a.r1, [(0, 0), (0, 0), (0, 2), (0, 1)], constant_values=1e-15 * largest),
        q1=np.pad(a.q1, [(0, 0), (0, 0), (0, 4)], constant_values=-1e-14 * largest),
    )
    trimmed = padded.trimmed()
    assert distance(trimmed, padded) <= 1e-13 * largest
    for key in PARAMETERS:
        assert all(np.array(getattr(trimmed, key).shape) <= getattr(a, key).shape), key


def test_trimmed_keeps_small_coefficients_above_rounding() -> None:
    kernel = np.zeros((1, 1, 3, 4))
    kernel[0, 0, 2, 3], kernel[0, 0, 0, 0] = 1e-12, 1.0
    a = volterra().replace(r1=kernel)
    assert a.trimmed().r1.shape == (1, 1, 3, 4)
    assert a.trimmed(1e-11).r1.shape == (1, 1, 1, 1)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_trimmed_hides_no_coefficient_that_is_not_finite(bad: float) -> None:
    kernel = np.zeros((1, 1, 2, 3))
    kernel[0, 0, 1, 2], kernel[0, 0, 0, 0] = bad, 1.0
    trimmed = volterra().replace(r1=kernel, r0=np.array([[[1.0, 2.0]]])).trimmed()
    assert not np.all(np.isfinite(trimmed.r1))
    assert trimmed.r0.shape == (1, 1, 2)


@pytest.mark.parametrize("power", [2, 3, 5])
def test_products_carry_no_more_degrees_than_they_have(power: int) -> None:
    product = volterra()
    for _ in range(power - 1):
        product = product @ volterra()
    assert product.r1.shape == (1, 1, power, power)  # (s - t)^(power - 1) / (power - 1)!
    assert product.r0.shape == (1, 1, 1)
    assert product.r2.shape == (1, 1, 1, 1)


# Errors


def between(out: Shape, into: Shape) -> PIOperator:
    return PIOperator.zeros(out, into)


@deterministic
@given(st.tuples(*(st.one_of(THREE_PI, FOUR_PI),) * 4).filter(lambda k: k[1] != k[2]))
def test_composition_names_both_inner_dimensions(spaces: tuple[Shape, ...]) -> None:
    out, left, right, into = spaces
    with pytest.raises(ValueError, match="cannot compose") as caught:
        between(out, left) @ between(right, into)
    assert str(left) in str(caught.value)
    assert str(right) in str(caught.value)


def test_sums_name_all_dimensions() -> None:
    a, b = between(Shape(1, 2), Shape(0, 3)), between(Shape(1, 2), Shape(4, 3))
    with pytest.raises(ValueError, match="cannot add") as caught:
        _ = a - b
    for shape in (Shape(1, 2), Shape(0, 3), Shape(4, 3)):
        assert str(shape) in str(caught.value)


def test_concatenation_names_the_dimensions_that_differ() -> None:
    a, b = between(Shape(1, 2), Shape(0, 3)), between(Shape(5, 2), Shape(4, 3))
    with pytest.raises(ValueError, match="domains differ") as caught:
        vertical(a, b)
    assert str([Shape(0, 3), Shape(4, 3)]) in str(caught.value)
    with pytest.raises(ValueError, match="ranges differ") as caught:
        horizontal(a, b)
    assert str([Shape(1, 2), Shape(5, 2)]) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("q1", np.zeros((1, 3, 1))),
        ("q2", np.zeros((2, 2, 1))),
        ("r1", np.zeros((3, 2, 1, 1))),
        ("r2", np.zeros((2, 3, 1, 1))),
    ],
)
def test_parameters_that_do_not_fit_are_refused_by_name(name: str, array: Array) -> None:
    good = between(Shape(1, 2), Shape(1, 2))
    with pytest.raises(ValueError, match=rf"{name}: expected a .* got") as caught:
        good.replace(**{name: array})
    assert str(array.shape[:2]) in str(caught.value)
    assert str(getattr(good, name).shape[:2]) in str(caught.value)
