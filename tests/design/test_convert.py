"""A PDE's PIE against the PDE itself: both are applied to random states, the PDE with numpy.polynomial."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import Polynomial as Poly
from pde_polynomials import (
    Value,
    at,
    d,
    distributed,
    evaluate,
    int_u,
    int_w,
    integral,
    random_signals,
    random_states,
    scalar,
    signals,
    states,
    sum_of,
    u,
    w,
)
from pi_reference import finite_part, function_part

from design.operators import PIOperator
from design.pde.convert import Pie, convert
from design.pde.model import Expression, Output, Pde
from wire.errors import UsageError

Array = npt.NDArray[np.float64]
S = np.linspace(0.0, 1.0, 7)
DEGREE = 7

DIRICHLET = (sum_of(at(0, 0, 0)), sum_of(at(0, 0, 1)))
NEUMANN = (sum_of(at(0, 1, 0)), sum_of(at(0, 1, 1)))
PERIODIC = tuple(sum_of(at(0, j, 0), at(0, j, 1, -1.0)) for j in (0, 1))
ROBIN = (sum_of(at(0, 1, 0), at(0, 0, 0, -2.0)), sum_of(at(0, 1, 1), at(0, 0, 1, 0.5)))
NEARLY_NEUMANN = (sum_of(at(0, 1, 0), at(0, 0, 0, -1e-6)), sum_of(at(0, 1, 1)))
WITH_INTEGRALS = (
    sum_of(at(0, 0, 0), integral(0, 0, [1.0, 2.0], -0.3)),
    sum_of(at(0, 0, 1), integral(0, 2, [0.0, 0.0, 1.0]), integral(0, 1, [0.2, 1.0])),
)


def heat(conditions: Sequence[Expression]) -> Pde:
    return Pde(
        states(2),
        (
            sum_of(
                d(0, 2, 2.0, 0.0, -1.0, 1.0),
                d(0, 1, 0.0, -2.0, 3.0),
                d(0, 0, 0.7, 1.0),
                w(0, 0.0, 1.0),
                u(0),
            ),
        ),
        tuple(conditions),
        disturbances=signals(False, True),
        controls=signals(True, False),
        regulated=(
            distributed(d(0), u(0)),
            scalar(integral(0, 0, [1.0]), int_w(1, [1.0, 1.0])),
            scalar(at(0, 1, 1)),
        ),
        measured=(scalar(at(0, 0, 1), w(0, 2.0)), distributed(d(0, 1), w(1, 0.0, 3.0), u(1))),
        numerator=(distributed(d(0, 0)),),
        denominator=(distributed(d(0, 1)), scalar(at(0, 0, 0))),
    )


def beam(*conditions: Expression) -> Pde:
    return Pde(
        states(4),
        (sum_of(d(0, 4, -1.0, 0.5), d(0, 3), d(0, 0)),),
        conditions,
        regulated=(scalar(at(0, 3, 0)),),
    )


def transport(condition: Expression) -> Pde:
    return Pde(
        states(1),
        (sum_of(d(0, 1, -1.0, -0.5), integral(0, 0, [1.0, 0.0, 1.0], 0.3, 1.0)),),
        (condition,),
    )


MIXED = Pde(
    # function states of orders 0, 1, 2, 3 between two ode states
    states(None, 2, 0, None, 1, 3),
    (
        sum_of(d(0, 0, -1.0), at(1, 0, 1), integral(2, 0, [0.0, 1.0]), w(1), int_u(0, [1.0, -1.0])),
        sum_of(
            d(1, 2),
            d(2, 0, 0.0, 1.0),
            d(0, 0, 1.0, -1.0),
            at(5, 2, 1, 0.5),
            u(0),
            int_w(0, [2.0], 0.0, 1.0),
        ),
        sum_of(d(2, 0, -1.0), d(1, 1), d(3, 0, 0.0, 0.0, 1.0), w(0)),
        sum_of(d(3, 0, -2.0), d(0, 0, 3.0), u(1, 0.5)),
        sum_of(d(4, 1), integral(5, 1, [1.0, 1.0], 0.0, 1.0), integral(0, 0, [1.0, 1.0])),
        sum_of(d(5, 3), d(5, 1, 0.0, 1.0), d(4, 1, 0.2), w(1, 1.0, 1.0)),
    ),
    (
        sum_of(at(1, 0, 0), d(0, 0, -1.0)),
        sum_of(at(1, 1, 1), at(4, 0, 1), d(3, 0, 2.0)),
        sum_of(at(4, 0, 0), at(5, 0, 0, 0.5), integral(2, 0, [1.0, 1.0])),
        sum_of(at(5, 0, 1)),
        sum_of(at(5, 1, 0), integral(1, 0, [0.0, 1.0])),
        sum_of(at(5, 2, 0), at(5, 1, 1, -1.0)),
    ),
    disturbances=signals(True, False),
    controls=signals(True, False),
    regulated=(scalar(at(5, 2, 1), d(3), u(1)), distributed(d(2), d(1, 2), d(0))),
)

CASES = {
    "dirichlet": heat(DIRICHLET),
    "neumann": heat(NEUMANN),
    "periodic": heat(PERIODIC),
    "robin": heat(ROBIN),
    "nearly neumann": heat(NEARLY_NEUMANN),
    "conditions with integrals": heat(WITH_INTEGRALS),
    "inflow": transport(sum_of(at(0, 0, 0))),
    "periodic transport": transport(sum_of(at(0, 0, 0), at(0, 0, 1, -1.0))),
    "clamped beam": beam(*(sum_of(at(0, j, e)) for j, e in ((0, 0), (1, 0), (0, 1), (1, 1)))),
    "clamped-free beam": beam(*(sum_of(at(0, j, e)) for j, e in ((0, 0), (1, 0), (2, 1), (3, 1)))),
    "free beam": beam(*(sum_of(at(0, j, e)) for j, e in ((2, 0), (3, 0), (2, 1), (3, 1)))),
    "multiplication": Pde(states(0), (sum_of(d(0, 0, -1.0, 1.0), integral(0, 0, [1.0]), w(0)),),
        disturbances=signals(True),
    ),
    "free with an ode state": Pde(
        # the free constant's condition x_s(1) = X, x_s(0) = 0 constrains x_ss by X
        states(2, None), (sum_of(d(0, 2), d(1)), sum_of(d(1, 0, -1.0), at(0, 0, 0))),
        (sum_of(at(0, 1, 1), d(1, 0, -1.0)), sum_of(at(0, 1, 0))),
    ),
    "ode only": Pde(states(None, None), (sum_of(d(1)), sum_of(d(0, 0, -1.0), w(0))),
        disturbances=signals(False),
    ),
    "mixed": MIXED,
}  # fmt: skip
FREE_CONSTANTS = {
    *("neumann", "nearly neumann", "periodic"),
    *("periodic transport", "free beam", "free with an ode state"),
}


def split(x: Sequence[Value]) -> tuple[Array, list[Poly]]:
    """(numbers | functions), as the operators take them."""
    return np.array([v for v in x if not isinstance(v, Poly)]), [
        v for v in x if isinstance(v, Poly)
    ]


def apply(operator: PIOperator, numbers: Array, functions: Sequence[Poly]) -> tuple[Array, Array]:
    """(finite part, function part at S)."""

    def inside(s: Array) -> Array:
        return np.array([f(s) for f in functions]).reshape(len(functions), len(s))

    return finite_part(operator, numbers, inside), function_part(operator, numbers, inside)(S)


def fundamental(pie: Pie, x: Sequence[Value]) -> tuple[Array, list[Poly]]:
    """The polynomial f with T f = x, by least squares on unit vectors; fails if there is none."""
    m, n = pie.T.shape_in
    units = []
    for column in range(n):
        for power in range(DEGREE + 1):
            one = [Poly([0.0])] * n
            one[column] = Poly([-1.0, 2.0]) ** power
            units.append((np.zeros(m), one))
    numbers, functions = split(x)
    full = [(numbers, [Poly([0.0])] * n), *units]
    images = [np.concatenate([part.ravel() for part in at_more_points(pie.T, *f)]) for f in full]
    wanted = np.concatenate([numbers, *(v(POINTS) for v in functions)]) - images[0]
    matrix = np.array(images[1:]).T.reshape(len(wanted), -1)
    weights = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    assert np.abs(matrix @ weights - wanted).max(initial=0.0) < 1e-11 * np.abs(weights).max(
        initial=1.0
    )
    out = [Poly([0.0])] * n
    for weight, (_, one) in zip(weights, units, strict=True):
        out = [a + weight * b for a, b in zip(out, one, strict=True)]
    return numbers, out


POINTS = 0.5 - 0.5 * np.cos(np.pi * np.arange(15) / 14)


def at_more_points(
    operator: PIOperator, numbers: Array, functions: Sequence[Poly]
) -> tuple[Array, Array]:
    def inside(s: Array) -> Array:
        return np.array([f(s) for f in functions]).reshape(len(functions), len(s))

    return finite_part(operator, numbers, inside), function_part(operator, numbers, inside)(POINTS)


def expected(
    rows: Sequence[tuple[Expression, bool]], *args: Sequence[Value]
) -> tuple[Array, Array]:
    """What operators must give: numbers first, then functions at S."""
    numbers = [float(evaluate(e, *args)(0.3)) for e, is_function in rows if not is_function]
    functions = [evaluate(e, *args)(S) for e, is_function in rows if is_function]
    return np.array(numbers), np.array(functions).reshape(-1, len(S))


def same(got: tuple[Array, Array], want: tuple[Array, Array]) -> None:
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9 * (1.0 + np.abs(b).max(initial=0.0)))


def outputs(group: Sequence[Output]) -> list[tuple[Expression, bool]]:
    return [(o.expression, o.distributed) for o in group]


@pytest.mark.parametrize("name", CASES)
def test_every_operator_does_to_f_what_the_pde_does_to_x(name: str) -> None:
    pde = CASES[name]
    pie = convert(pde)
    rng = np.random.default_rng(1)
    (x,) = random_states(pde, rng, DEGREE)
    f = fundamental(pie, x)
    disturbances, controls = (
        random_signals(pde.disturbances, rng),
        random_signals(pde.controls, rng),
    )
    functions = [state.order is not None for state in pde.states]
    groups = [
        (list(zip(pde.equations, functions, strict=True)), pie.A, pie.B1, pie.B2),
        (outputs(pde.regulated), pie.C1, pie.D11, pie.D12),
        (outputs(pde.measured), pie.C2, pie.D21, pie.D22),
    ]
    zero = [v * 0.0 for v in x]
    no_w, no_u = [v * 0.0 for v in disturbances], [v * 0.0 for v in controls]
    for rows, of_state, of_w, of_u in groups:
        same(apply(of_state, *f), expected(rows, x, no_w, no_u))
        same(apply(of_w, *split(disturbances)), expected(rows, zero, disturbances, no_u))
        same(apply(of_u, *split(controls)), expected(rows, zero, no_w, controls))
    same(apply(pie.numerator, *f), expected(outputs(pde.numerator), x))
    same(apply(pie.denominator, *f), expected(outputs(pde.denominator), x))
    for i, j, operator in pie.derivatives:
        same(apply(operator, *f), expected([(sum_of(d(i, j)), True)], x))
    for i, j, end, operator in pie.ends:
        same(apply(operator, *f), expected([(sum_of(at(i, j, end)), False)], x))
    orders = {i: s.order for i, s in enumerate(pde.states) if s.order is not None}
    assert [key[:2] for key in pie.derivatives] == [
        (i, j) for i, order in orders.items() for j in range(order)
    ]
    assert [key[:3] for key in pie.ends] == [
        (i, j, e) for i, j, _ in pie.derivatives for e in (0, 1)
    ]


@pytest.mark.parametrize("name", CASES)
def test_every_f_gives_a_state_that_meets_the_conditions(name: str) -> None:
    pde = CASES[name]
    pie = convert(pde)
    rng = np.random.default_rng(2)
    m, n = pie.T.shape_in
    f = (rng.normal(size=m), [Poly(rng.normal(size=5)) for _ in range(n)])
    numbers, samples = at_more_points(pie.T, *f)
    functions = iter(Poly.fit(POINTS, row, 13, domain=[0, 1]).convert() for row in samples)
    odes = iter(numbers)
    x: list[Value] = [float(next(odes)) if s.order is None else next(functions) for s in pde.states]
    for condition in pde.conditions:
        # monomial coefficients of a fit of degree 13, differentiated up to three times
        assert abs(evaluate(condition, x)(0.0)) < 1e-6
    if name not in FREE_CONSTANTS:
        for i, k in enumerate(i for i, s in enumerate(pde.states) if s.order is not None):
            order = pde.states[k].order
            state = x[k]
            assert order is not None and isinstance(state, Poly)
            np.testing.assert_allclose(state.deriv(order)(S), f[1][i](S), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("name", CASES)
def test_f_and_x_are_one_to_one(name: str) -> None:
    matrix = convert(CASES[name]).T.discretise(8, 20)
    assert np.linalg.svd(matrix, compute_uv=False)[-1] > 1e-8


@pytest.mark.parametrize(
    ("conditions", "spectrum"),
    [
        (DIRICHLET, -(np.pi**2) * np.array([1, 4, 9])),
        (NEUMANN, -(np.pi**2) * np.array([0, 1, 4])),
        (PERIODIC, -(np.pi**2) * np.array([0, 4, 4])),
    ],
)
def test_spectrum_of_the_heat_equation(conditions: Sequence[Expression], spectrum: Array) -> None:
    pie = convert(Pde(states(2), (sum_of(d(0, 2)),), tuple(conditions)))
    eigenvalues = np.linalg.eigvals(np.linalg.solve(pie.T.discretise(24), pie.A.discretise(24)))
    np.testing.assert_allclose(np.sort(eigenvalues.real)[::-1][:3], spectrum, atol=1e-8)
    np.testing.assert_allclose(eigenvalues.imag, 0.0, atol=1e-6)


def test_degrees_stay_minimal() -> None:
    pie = convert(Pde(states(2), (sum_of(d(0, 2), d(0)),), DIRICHLET))
    assert pie.T.r0.shape == (1, 1, 1) and not pie.T.r0.any()
    assert pie.T.r1.shape == pie.T.r2.shape == (1, 1, 2, 2)
    assert pie.A.r0.shape == (1, 1, 1) and pie.A.r1.shape == (1, 1, 2, 2)


@pytest.mark.parametrize(
    ("pde", "words"),
    [
        (heat(DIRICHLET[:1]), ["1 conditions", "x0: 2", "need 2", "Add some"]),
        (heat((*DIRICHLET, NEUMANN[0])), ["3 conditions", "need 2", "Remove some"]),
        (
            heat((DIRICHLET[0], sum_of(w(0), at(0, 0, 1)))),
            ["disturbance or control", "Input", "ode state"],
        ),
        (
            heat((DIRICHLET[0], DIRICHLET[0])),
            ["+1 * ((1.0,)*Point(state=0, derivative=0, end=0))", "independent"],
        ),
        (
            # x(1) - x(0) - int x_s says nothing, and only the first condition is to blame
            heat(
                (sum_of(at(0, 0, 1), at(0, 0, 0, -1.0), integral(0, 1, [1.0], -1.0)), DIRICHLET[0])
            ),
            ["+1 * (", "Integral"],
        ),
        (
            Pde(states(1, None), (sum_of(d(0, 1)), sum_of(d(1))), (sum_of(d(1)),)),
            ["+1 * ((1.0,)*Field(state=1, derivative=0))"],
        ),
        (
            Pde(states(1), (sum_of(d(0, 2)),), DIRICHLET[:1]),
            ["derivative 2 of x0", "up to 1 only", "[states]"],
        ),
        (
            Pde(states(1), (sum_of(d(0, 1)),), (sum_of(at(0, 1, 0)),)),
            ["derivative 1 of x0", "up to 0 only"],
        ),
        (Pde(states(0), (sum_of(at(0, 0, 1)),)), ["no values at the ends"]),
        (Pde(states(0), (sum_of(d(0)),), regulated=(scalar(d(0)),)), ["must be a number", "int("]),
        (
            Pde(states(1, None), (sum_of(d(0)), sum_of(d(1, 0, 0.0, 1.0))), DIRICHLET[:1]),
            ["depends on s"],
        ),
    ],
)
def test_refusals_say_what_is_wrong(pde: Pde, words: Sequence[str]) -> None:
    with pytest.raises(UsageError) as error:
        convert(pde)
    for word in words:
        assert word in str(error.value)


def test_independent_conditions_are_not_blamed() -> None:
    repeated = sum_of(at(0, 2, 1))
    pde = beam(sum_of(at(0, 0, 0)), repeated, sum_of(at(0, 1, 0)), repeated)
    with pytest.raises(UsageError) as error:
        convert(pde)
    assert "derivative=2, end=1" in str(error.value) and "end=0" not in str(error.value)
