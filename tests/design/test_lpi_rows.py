"""Rows of the Gram forms: what they do to polynomials, and what follows from a PDE's structure by hand."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from lpi_reference import (
    DD,
    admissible,
    combined,
    example_problem,
    functions_of,
    fundamental,
    heat,
    in_space,
    legendre_polynomial,
    problem,
)
from numpy.polynomial import Polynomial as Poly
from pde_polynomials import evaluate
from pi_reference import function_part, inner, polynomial, random_operator

from design.lpi.inequality import dissipated_ends
from design.lpi.rows import (
    Rows,
    build_rows,
    dissipation_order,
    family,
    flattened,
    functions,
    independent,
    kernels,
    stack,
    structure,
    times,
)
from design.operators import PIOperator, Shape, vertical
from design.pde.convert import Pie, convert
from design.pde.model import Pde

Array = npt.NDArray[np.float64]
POINTS = np.linspace(0.02, 0.97, 14)
NOTHING = np.zeros(0)
CLAMPED_FREE = ("v(0)", "v_s(0)", "k(1)", "k_s(1)")
BEAM = problem({"v": (2, "-k_ss"), "k": (2, "v_ss")}, CLAMPED_FREE)
HEAT_DD = heat("x_ss + (1 + s)*x", DD)
LUMPED = example_problem("heat_lumped")


class Sampled:
    """Random states x that meet the conditions, with f and x_t by polynomials; rows at POINTS."""

    def __init__(self, pde: Pde, size: int = 8, count: int = 32) -> None:
        rng = np.random.default_rng(5)
        basis = admissible(pde, size)
        quiet = [0.0] * len(pde.disturbances)
        self.states = [combined(basis, rng.normal(size=len(basis))) for _ in range(count)]
        self.f = [fundamental(pde, x) for x in self.states]
        self.x = [in_space(x, functions_of(pde)) for x in self.states]
        self.x_t = [
            in_space([evaluate(e, x, quiet) for e in pde.equations], functions_of(pde))
            for x in self.states
        ]

    def of(self, rows: PIOperator, what: str) -> Array:
        """Each row's values at all points for all samples of f, x or x_t: (rows, samples * points)."""
        sampled = [function_part(rows, *one)(POINTS) for one in getattr(self, what)]
        return np.concatenate(sampled, axis=1)


def outside(rows: Array, span: Array) -> Array:
    """The part of the sampled rows, each scaled to one, that is no combination of the span."""
    unit = rows / np.linalg.norm(rows, axis=1)[:, None]
    _, sizes, axes = np.linalg.svd(
        span / np.linalg.norm(span, axis=1)[:, None], full_matrices=False
    )
    axes = axes[sizes > 1e-10 * sizes[0]]
    return np.asarray(unit - unit @ axes.T @ axes)


def kernel_rows(rows: Rows, pie: Pie, degree: int) -> PIOperator:
    """P's rows with integrals: those after the multiples of every state."""
    first = sum(pie.T.shape_in) * (degree + 1)
    return rows.lyapunov.rows([], range(first, rows.lyapunov.shape_out.functions))


@pytest.mark.parametrize(
    ("pde", "degree", "measured"),
    [
        (HEAT_DD, 3, False),
        (heat("(s**2 + 1)*x_ss + w"), 2, False),
        (BEAM, 2, False),
        (example_problem("n2"), 1, True),
        (LUMPED, 2, False),
        (example_problem("g20"), 1, False),
    ],
    ids=["heat DD", "heat DN, variable", "beam", "heat measured", "heat with ode", "transport"],
)
def test_kernel_rows_are_admissible(pde: Pde, degree: int, measured: bool) -> None:
    """The rate R x_t of every kernel row R is a combination of the rows of the inequality and of y."""
    pie = convert(pde)
    rows = build_rows(pie, structure(pie), degree, pie.C2 if measured else None)
    chosen = kernel_rows(rows, pie, degree)
    assert chosen.shape_out.functions > 0
    sampled = Sampled(pde)
    span = sampled.of(rows.inequality, "f")
    if measured:
        sensed = times(functions(pie.C2), degree + 1)
        assert sensed is not None
        span = np.vstack([span, sampled.of(sensed, "f")])
    assert span.shape[1] > 4 * span.shape[0]
    rates = sampled.of(chosen, "x_t")
    assert np.abs(outside(rates, span)).max() < 1e-7


@pytest.mark.parametrize(
    ("pde", "degree", "found"),
    [(heat("x_ss + w", DD), 1, 2), (heat(), 2, 9), (HEAT_DD, 3, 2)],
    ids=["DD", "DN", "DD, variable"],
)
def test_every_admissible_kernel_row_is_found(pde: Pde, degree: int, found: int) -> None:
    """As many as the null space has dimensions that polynomials alone give."""
    pie = convert(pde)
    rows = build_rows(pie, structure(pie), degree)
    candidates = kernels(PIOperator.identity(Shape(0, 1)), degree)
    assert candidates is not None
    sampled = Sampled(pde)
    rest = outside(sampled.of(candidates, "x_t"), sampled.of(rows.inequality, "f"))
    sizes = np.linalg.svd(rest, compute_uv=False)
    assert np.count_nonzero(sizes < 1e-9) == found < len(sizes)
    assert sizes[-found - 1] > 1e-6  # no doubt about the others
    assert kernel_rows(rows, pie, degree).shape_out.functions == found


def test_inverse_of_the_heat_operator_is_admissible() -> None:
    """A^-1 x = -int min(s, t) x dt for x_ss with x(0) = x_s(1) = 0: its rate is x itself, a row of degree 1."""
    pie = convert(heat())
    rows = build_rows(pie, structure(pie), 1)
    function = Poly([0.4, -1.0, 0.3, 0.8])

    def inverse(s: Array) -> Array:
        below, above = (Poly([0.0, 1.0]) * function).integ(), function.integ()
        return np.asarray(below(s) + s * (above(1.0) - above(s)))

    # the row itself, as an operator: coefficients of s and t from samples of min(s, t)
    line = np.array([0.5, 0.5 / np.sqrt(3.0)])
    zero = PIOperator.zeros(Shape(0, 1), Shape(0, 1))
    green = zero.replace(
        r1=np.pad(line[None], [(0, 1), (0, 0)])[None, None],
        r2=np.pad(line[:, None], [(0, 0), (0, 1)])[None, None],
    )
    given = function_part(green, NOTHING, lambda s: function(s)[None])(POINTS)[0]
    np.testing.assert_allclose(given, inverse(POINTS), atol=1e-13)
    chosen = flattened(vertical(kernel_rows(rows, pie, 1), green))
    assert np.abs(outside(chosen[-1:], chosen[:-1])).max() < 1e-9


@pytest.mark.parametrize(
    ("equations", "orders"),
    [
        ({"x": (2, "x_ss + 3*x_s")}, [1]),
        ({"v": (2, "-k_ss - v"), "k": (2, "v_ss")}, [0, 0]),
        ({"x": (4, "-x_ssss + x_ss")}, [2]),
        ({"x": (1, "-x_s")}, [0]),
        ({"x": (3, "-x_sss")}, [1]),
        ({"x": (0, "-x + int(x)")}, [0]),
        ({"X": ("ode", "-X + y(1)"), "x": (2, "x_ss + X"), "y": (1, "-y_s + x_s")}, [0, 1, 0]),
    ],
    ids=["heat", "beam", "fourth order", "transport", "KdV", "no derivative", "mixed"],
)
def test_dissipation_order(equations: dict[str, tuple[int | str, str]], orders: list[int]) -> None:
    zeros = [
        f"{x}{'_' * (j > 0)}{'s' * j}(0)"
        for x, (order, _) in equations.items()
        for j in range(order if isinstance(order, int) else 0)
    ]
    pde = problem(equations, zeros)
    assert [dissipation_order(pde, i) for i in range(len(pde.states))] == orders


def test_dissipation_rows_of_the_fourth_order() -> None:
    """x_t = -x_ssss dissipates x_ss; the norm also holds x_s and x, the highest alone gives the margin."""
    pde = problem({"x": (4, "-x_ssss")}, ("x(0)", "x_s(0)", "x(1)", "x_s(1)"))
    pie = convert(pde)
    rows = build_rows(pie, structure(pie), 2)
    assert rows.norm.shape_out == Shape(0, 3)
    assert rows.top.shape_out == Shape(0, 1)
    for x in admissible(pde, 4):
        f = fundamental(pde, x)
        assert isinstance(x[0], Poly)
        expected = np.array([x[0].deriv(2)(POINTS), x[0].deriv(1)(POINTS), x[0](POINTS)])
        np.testing.assert_allclose(function_part(rows.norm, *f)(POINTS), expected, atol=1e-10)
        np.testing.assert_allclose(function_part(rows.top, *f)(POINTS), expected[:1], atol=1e-10)


def kept_ends(pde: Pde) -> PIOperator | None:
    pie = convert(pde)
    return dissipated_ends(pie, structure(pie), False)


def not_kept(pde: Pde) -> Array:
    """Per regulated output, a functional of f: the part that lies outside the end values that are kept."""
    ends = kept_ends(pde)
    assert ends is not None
    wanted = functions(convert(pde).C1)
    flat = flattened(vertical(ends, wanted))
    kept = ends.shape_out.functions
    return np.asarray(np.linalg.norm(outside(flat[kept:], flat[:kept]), axis=1))


@pytest.mark.parametrize(
    "right", ["-x_s", "-x_s - (3 + 2*s)*x/10", "-(1 + s**2)*x_s + x", "-(1 + s**4)*x_s - s**3*x"]
)
def test_transport_loses_energy_where_it_leaves(right: str) -> None:
    """Also with coefficients that vary: those of odd degree force no square."""
    pde = problem({"x": (1, right)}, ("x(0)",), regulated=["x(1)"])
    ends = kept_ends(pde)
    assert ends is not None
    assert ends.shape_out == Shape(0, 1)
    assert not_kept(pde).max() < 1e-9


def test_damper_takes_the_tip_velocity() -> None:
    """v(1), and so e(1) = -v(1)/2; no integral."""
    pde = problem(
        {"v": (1, "e_s"), "e": (1, "v_s")},
        ("v(0)", "e(1) + 0.5*v(1)"),
        regulated=["v(1)", "e(1)", "int(v)"],
    )
    tip, force, integral = not_kept(pde)
    assert max(tip, force) < 1e-9
    assert integral > 0.1


@pytest.mark.parametrize(
    "pde",
    [BEAM, heat(), HEAT_DD, problem({"x": (0, "-x")})],
    ids=["clamped-free beam", "heat DN", "heat DD", "no derivative"],
)
def test_no_end_value_to_dissipate(pde: Pde) -> None:
    assert kept_ends(pde) is None


def test_independent_drops_what_depends_on_earlier_rows() -> None:
    rng = np.random.default_rng(9)
    rows = random_operator(rng, Shape(0, 4), Shape(1, 2))
    mix = PIOperator.multiplier(rng.normal(size=(2, 4))[:, :, None])
    nothing = rows.rows([], [0]) * 0.0
    together = vertical(nothing, rows.rows([], [0, 1]), rows.rows([], [1]) * -3.0, rows, mix @ rows)
    kept = independent(together)
    np.testing.assert_allclose(
        flattened(kept), flattened(vertical(together.rows([], [1, 2, 6, 7]))), atol=1e-14
    )


def test_independent_keeps_what_differs_a_little() -> None:
    one = PIOperator.identity(Shape(0, 1))
    zero = PIOperator.zeros(Shape(0, 1), Shape(0, 1))
    integral = zero.replace(r1=np.ones((1, 1, 1, 1)))
    for part, count in ((1e-3, 2), (1e-7, 1)):
        assert independent(vertical(one, one + integral * part)).shape_out.functions == count
    with pytest.raises(ValueError, match="at least one state"):
        independent(None)


def test_family_is_multiples_and_integrals() -> None:
    """phi_a x for a <= 2, phi_a int_0^s phi_b x and phi_a int_s^1 phi_b x for a + b <= 2, of every row."""
    rng = np.random.default_rng(2)
    rows = random_operator(rng, Shape(0, 2), Shape(1, 1))
    got = family(rows, 2)
    assert got is not None
    assert got.shape_out.functions == 2 * 3 + 2 * 12
    number, function = rng.normal(size=1), Poly(rng.normal(size=4))
    base = function_part(rows, number, lambda s: function(s)[None])
    sampled = function_part(got, number, lambda s: function(s)[None])(POINTS)
    phi = [legendre_polynomial(k) for k in range(3)]
    # each row of the operator on this function is a polynomial of degree < 12
    series = [Poly.fit(POINTS, y, 11).convert() for y in base(POINTS)]
    expected = [phi[a] * r for a in range(3) for r in series]
    for b in range(3):
        inside = [(phi[b] * r).integ(lbnd=0.0) for r in series]
        outside = [i(1.0) - i for i in inside]
        for integral in (inside, outside):
            expected += [phi[a] * i for a in range(3 - b) for i in integral]
    np.testing.assert_allclose(sampled, [p(POINTS) for p in expected], atol=1e-8)


def test_nothing_to_make_rows_of() -> None:
    rows = random_operator(np.random.default_rng(0), Shape(0, 1), Shape(0, 1))
    assert family(rows, -1) is None
    assert kernels(rows, -1) is None
    assert times(None, 3) is None
    assert stack(None, None) is None
    empty = PIOperator.zeros(Shape(0, 0), Shape(0, 1))
    assert stack(empty) is None


def test_functions_turns_numbers_into_constants() -> None:
    """The norm of R^m x L2^n stays: a constant on [0, 1] has the norm of its value."""
    operator = random_operator(np.random.default_rng(4), Shape(2, 1), Shape(1, 1))
    number, f = np.array([0.7]), polynomial(np.array([[0.2, 1.0, -0.4]]))
    all_functions = function_part(functions(operator), number, f)
    plain = function_part(operator, number, f)
    np.testing.assert_allclose(all_functions(POINTS)[:1], plain(POINTS), atol=1e-13)
    constants = all_functions(POINTS)[1:]
    assert np.ptp(constants, axis=1).max() < 1e-13
    assert inner(NOTHING, all_functions, NOTHING, all_functions) == pytest.approx(
        inner(constants[:, 0], plain, constants[:, 0], plain), rel=1e-12
    )
