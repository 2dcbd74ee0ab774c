"""The adjoint of a PDE by its definition: both sides of the inner product, on random states of both domains."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from pde_polynomials import (
    Term,
    Value,
    at,
    d,
    distributed,
    evaluate,
    inner,
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

from design.pde.adjoint import NotAdjointable, adjoint, dual_system
from design.pde.convert import convert
from design.pde.model import Expression, Output, Pde


def ends(*values: tuple[int, int, int]) -> tuple[Expression, ...]:
    return tuple(sum_of(at(*value)) for value in values)


def heat(*conditions: Expression) -> Pde:
    return Pde(
        states(2),
        (
            sum_of(
                *(d(0, 2, 2.0, 0.0, -1.0, 1.0), d(0, 1, 0.0, -2.0, 4.0), d(0, 0, 0.7, 1.0)),
                *(w(0, 0.0, 1.0), int_w(1, [1.0, 1.0], 0.0, 2.0), u(0), u(1, 1.0, -1.0)),
            ),
        ),
        conditions,
        disturbances=signals(False, True),
        controls=signals(True, False),
        regulated=(
            distributed(d(0, 0, 1.0, 1.0), u(0, 0.0, 1.0), integral(0, 0, [1.0, 2.0], 0.0, 1.0)),
            scalar(integral(0, 0, [1.0]), int_w(1, [1.0, 1.0]), u(1)),
            scalar(int_u(0, [0.0, 1.0]), w(0, 0.5)),
        ),
    )


def first_order(*conditions: Expression) -> Pde:
    return Pde(
        states(1, 1),
        (
            sum_of(d(0, 1, -1.0, -0.5), d(1, 0, 1.0, 1.0), w(0)),
            sum_of(
                d(1, 1, 2.0),
                d(0, 1, 0.3),
                integral(0, 0, [1.0, 0.0, 1.0], 0.3, 1.0),
                u(0, 1.0, 1.0),
            ),
        ),
        conditions,
        disturbances=signals(False),
        controls=signals(False),
        regulated=(
            scalar(integral(0, 0, [1.0])),
            scalar(integral(1, 0, [1.0, -1.0])),
            scalar(u(0)),
        ),
    )


HEAT = {
    "dirichlet": heat(*ends((0, 0, 0), (0, 0, 1))),
    "dirichlet-neumann": heat(*ends((0, 0, 0), (0, 1, 1))),
    "neumann": heat(*ends((0, 1, 0), (0, 1, 1))),
    "both values at one end": heat(*ends((0, 0, 0), (0, 1, 0))),
    "periodic": heat(*(sum_of(at(0, j, 0), at(0, j, 1, -1.0)) for j in (0, 1))),
    "robin": heat(sum_of(at(0, 1, 0), at(0, 0, 0, -2.0)), sum_of(at(0, 1, 1), at(0, 0, 1, 0.5))),
    "integrals in the conditions": heat(
        sum_of(at(0, 0, 0), integral(0, 0, [1.0, 2.0], -0.3)),
        sum_of(at(0, 0, 1), integral(0, 2, [0.0, 0.0, 1.0]), integral(0, 1, [0.2, 1.0])),
    ),
}
CASES = HEAT | {
    "transport": first_order(sum_of(at(0, 0, 0), at(1, 0, 0, -0.4)), sum_of(at(1, 0, 1), at(0, 0, 1, -2.0))),
    "beam of fourth order": Pde(
        states(4),
        (sum_of(d(0, 4, -1.0, 0.5), d(0, 3, 0.2), d(0, 2, 1.0, 1.0), d(0, 0), w(0)),),
        (
            *ends((0, 0, 0), (0, 1, 0)),
            *(sum_of(at(0, 2, 1), at(0, 1, 1, 0.3)), sum_of(at(0, 3, 1), at(0, 0, 1, -1.0))),
        ),
        disturbances=signals(True),
        regulated=(distributed(d(0)),),
    ),
    "beam in velocity and curvature": Pde(
        states(2, 2),
        (sum_of(d(1, 2, -0.1), d(0, 0, -0.1), w(0), u(0, 0.0, 1.0)), sum_of(d(0, 2))),
        ends((0, 0, 0), (0, 1, 0), (1, 0, 1), (1, 1, 1)),
        disturbances=signals(False),
        controls=signals(False),
        regulated=(scalar(integral(0, 0, [1.0])), scalar(u(0))),
    ),
    "wave in position and velocity": Pde(
        states(2, 0),
        (sum_of(d(1)), sum_of(d(0, 2, 1.0, 1.0), d(0, 1), d(1, 0, -0.5), w(0))),
        ends((0, 0, 0), (0, 1, 1)),
        disturbances=signals(False),
        # int x_s = x(1) - x(0) would not be bounded, int (1 - s) x_s = -x(0) + int x is
        regulated=(scalar(integral(0, 1, [1.0, -1.0]), integral(1, 0, [1.0])),),
    ),
    "heat driven by an ode that it drives": Pde(
        states(None, 2),
        (sum_of(at(1, 0, 1), d(0, 0, -1.0), w(0)), sum_of(d(1, 2), d(0, 0, 0.0, 1.0), u(0))),
        (sum_of(at(1, 0, 0), d(0, 0, -1.0)), sum_of(at(1, 1, 1), at(1, 0, 1, 0.5))),
        disturbances=signals(False),
        controls=signals(True),
        # the end value is the ode state, so this output is bounded
        regulated=(scalar(at(1, 0, 0), d(0, 0, 2.0)), distributed(d(1), u(0), d(0, 0, 0.0, 1.0))),
    ),
    "mixed": Pde(
        states(None, 2, 0, None, 1, 3),
        (
            sum_of(
                *(d(0, 0, -1.0), at(1, 0, 1), integral(2, 0, [0.0, 1.0])),
                *(integral(5, 2, [1.0, 1.0]), int_w(1, [1.0])),
            ),
            sum_of(d(1, 2), d(2, 0, 0.0, 1.0), d(0, 0, 1.0, -1.0), at(5, 2, 1, 0.5, 1.0), u(0)),
            sum_of(d(2, 0, -1.0), d(1, 0), d(3, 0, 0.0, 0.0, 1.0), w(0)),
            sum_of(d(3, 0, -2.0), d(0, 0, 3.0), u(1, 0.5), integral(0, 0, [1.0, 2.0])),
            sum_of(d(4, 1, 1.0, 0.5), integral(5, 1, [1.0, 1.0], 0.0, 1.0), integral(0, 0, [1.0, 1.0])),
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
        disturbances=signals(False, True),
        controls=signals(True, False),
        regulated=(scalar(d(3), integral(4, 0, [1.0, 1.0])), distributed(d(2), d(0, 0, 1.0, 1.0))),
    ),
    "ode only": Pde(
        states(None, None),
        (sum_of(d(1)), sum_of(d(0, 0, -1.0), u(0))),
        controls=signals(False),
        regulated=(scalar(d(1)),),
    ),
}  # fmt: skip


def images(
    rows: Sequence[Expression], scalars: Sequence[bool], *args: Sequence[Value]
) -> list[Value]:
    parts = [evaluate(row, *args) for row in rows]
    return [float(p(0.3)) if number else p for p, number in zip(parts, scalars, strict=True)]


def block(pde: Pde, outputs: Sequence[str], *args: Sequence[Value]) -> list[Value]:
    """(equations, outputs) of states and signals, by the definition of the PDE."""
    rows = [(e, s.order is None) for e, s in zip(pde.equations, pde.states, strict=True)]
    rows += [(o.expression, not o.distributed) for group in outputs for o in getattr(pde, group)]
    return images([r for r, _ in rows], [number for _, number in rows], *args)


def silent(pde: Pde) -> tuple[list[Value], list[Value]]:
    rng = np.random.default_rng(0)
    return [0.0 * v for v in random_signals(pde.disturbances, rng)], [
        0.0 * v for v in random_signals(pde.controls, rng)
    ]


def close(left: float, right: float) -> bool:
    return abs(left - right) <= 1e-10 * max(1.0, abs(left), abs(right))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", [1, 2])
def test_adjoint_by_its_definition(name: str, seed: int) -> None:
    pde, rng = CASES[name], np.random.default_rng(seed)
    other = adjoint(pde)
    (x,), (y,) = random_states(pde, rng, degree=6), random_states(other, rng, degree=6)
    left = inner(block(pde, (), x, *silent(pde)), y)
    right = inner(x, block(other, (), y))
    assert abs(left) > 1e-3
    assert close(left, right)
    assert len(other.conditions) == len(pde.conditions)
    assert not (other.disturbances or other.controls or other.regulated or other.measured)


@pytest.mark.parametrize("name", CASES)
def test_dual_system_by_its_definition(name: str) -> None:
    pde, rng = CASES[name], np.random.default_rng(3)
    dual = dual_system(pde)
    assert [s.distributed for s in dual.disturbances] == [o.distributed for o in pde.regulated]
    assert [o.distributed for o in dual.regulated] == [s.distributed for s in pde.disturbances]
    assert [o.distributed for o in dual.measured] == [s.distributed for s in pde.controls]
    (x,), (y,) = random_states(pde, rng, degree=6), random_states(dual, rng, degree=6)
    disturbances, controls = (
        random_signals(pde.disturbances, rng),
        random_signals(pde.controls, rng),
    )
    inputs = random_signals(dual.disturbances, rng)
    left = inner(block(pde, ["regulated"], x, disturbances, controls), [*y, *inputs])
    right = inner([*x, *disturbances, *controls], block(dual, ["regulated", "measured"], y, inputs))
    assert close(left, right)


def transfer(pde: Pde, frequency: complex) -> npt.NDArray[np.complex128]:
    """(w, u) -> (z, y) by Galerkin's method on the PIE; functions of s enter by three Legendre coefficients."""
    pie, size, few = convert(pde), 28, 3
    T, A = pie.T.discretise(size), pie.A.discretise(size)
    inputs = np.hstack([B.discretise(few, size) for B in (pie.B1, pie.B2)])
    outputs = np.vstack([C.discretise(size, few) for C in (pie.C1, pie.C2)])
    through = np.block(
        [[D.discretise(few) for D in row] for row in ((pie.D11, pie.D12), (pie.D21, pie.D22))]
    )
    return np.asarray(
        outputs @ np.linalg.solve(frequency * T - A, inputs.astype(complex)) + through
    )


@pytest.mark.parametrize("name", CASES)
def test_dual_transfer_function_is_the_transpose(name: str) -> None:
    """Only the right domain gives it: with too many conditions on y its definition would hold as well."""
    pde = CASES[name]
    for frequency in (1.3j, 4.0 + 2.0j):
        forward, backward = transfer(pde, frequency), transfer(dual_system(pde), frequency)
        np.testing.assert_allclose(backward, forward.T, atol=1e-8 * np.abs(forward).max())


@pytest.mark.parametrize("name", CASES)
def test_adjoint_of_the_adjoint_is_the_pde(name: str) -> None:
    pde, rng = CASES[name], np.random.default_rng(4)
    twice = adjoint(adjoint(pde))
    assert [s.order for s in twice.states] == [s.order for s in pde.states]
    for x in random_states(pde, rng, degree=6, count=2):
        for condition in twice.conditions:
            assert abs(evaluate(condition, x)(0.0)) < 1e-9
        scalars = [s.order is None for s in pde.states]
        once = images(pde.equations, scalars, x, *silent(pde))
        for a, b in zip(once, images(twice.equations, scalars, x), strict=True):
            difference = a - b
            assert inner([difference], [difference]) < 1e-18 * (1.0 + inner([a], [a]))


@pytest.mark.parametrize(
    ("equation", "conditions", "adjoint_equation", "adjoint_conditions"),
    [
        # -d/ds with an inflow condition: d/ds with an outflow condition
        ((d(0, 1, -1.0),), ends((0, 0, 0)), {d(0, 1)}, [{at(0, 0, 1)}]),
        # self-adjoint
        ((d(0, 2), d(0)), ends((0, 0, 0), (0, 1, 1)), {d(0, 2), d(0)}, [{at(0, 0, 0)}, {at(0, 1, 1)}]),
        # (s x)_s = s x_s + x -> -s y_s, by parts
        (
            (d(0, 2), d(0, 1, 0.0, 1.0), d(0)), ends((0, 0, 0), (0, 0, 1)),
            {d(0, 2), d(0, 1, 0.0, -1.0)}, [{at(0, 0, 0)}, {at(0, 0, 1)}],
        ),
        # both values at 0: both at 1
        ((d(0, 2),), ends((0, 0, 0), (0, 1, 0)), {d(0, 2)}, [{at(0, 0, 1)}, {at(0, 1, 1)}]),
        # a profile times an integral: the two change places
        (
            (d(0, 1), integral(0, 0, [0.0, 2.0], 3.0)), ends((0, 0, 1)),
            {d(0, 1, -1.0), integral(0, 0, [3.0], 0.0, 2.0)}, [{at(0, 0, 0)}],
        ),
    ],
)  # fmt: skip
def test_known_adjoints(
    equation: tuple[Term, ...],
    conditions: tuple[Expression, ...],
    adjoint_equation: set[Term],
    adjoint_conditions: list[set[Term]],
) -> None:
    other = adjoint(Pde(states(1 if len(conditions) == 1 else 2), (sum_of(*equation),), conditions))
    assert set(other.equations[0].terms) == adjoint_equation
    assert sorted((set(c.terms) for c in other.conditions), key=repr) == sorted(
        adjoint_conditions, key=repr
    )


def test_expressions_read_like_a_problem_file() -> None:
    dual = dual_system(HEAT["dirichlet-neumann"])
    assert dual.conditions[0].text == "1*x0*(0)"
    assert (
        "(2 + -1*s^2 + 1*s^3)*x0*_ss" in dual.equations[0].text
        and "1*z2*" in dual.equations[0].text
    )
    assert dual.regulated[0].expression.text == "0.5*z3* + 1*int((1*s)*x0*)"


def plain_heat(*outputs: Output) -> Pde:
    return Pde(states(2), (sum_of(d(0, 2)),), ends((0, 1, 0), (0, 1, 1)), regulated=outputs)


def first(*terms: Term, conditions: Sequence[Expression] = ends((0, 0, 0))) -> Pde:
    return Pde(states(1), (sum_of(*terms),), tuple(conditions), disturbances=signals(False))


@pytest.mark.parametrize(
    ("pde", "reason"),
    [
        (
            plain_heat(scalar(at(0, 0, 1))),
            "'(1.0,)*Point(state=0, derivative=0, end=1)' depends on values",
        ),
        (plain_heat(scalar(integral(0, 1, [1.0]))), "Integral(state=0, derivative=1"),
        (plain_heat(distributed(d(0, 1))), "contains a derivative"),
        (
            Pde(states(2), (sum_of(d(0, 1)),), ends((0, 0, 0), (0, 0, 1))),
            "add up to 2, those of the adjoint to 1",
        ),
        (
            Pde(
                states(2, 2),
                (sum_of(d(0, 2), d(1, 2)), sum_of(d(0, 2), d(1, 2))),
                ends((0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 0, 1)),
            ),
            "singular near s",
        ),
        (first(d(0, 1, -0.123, 1.0)), "singular near s = 0.123"),
        (first(d(0, 1), conditions=[sum_of(integral(0, 0, [1.0]))]), "inside the domain"),
        (first(d(0, 1), conditions=[sum_of(at(0, 0, 0), w(0))]), "a signal"),
        (first(d(0, 1), conditions=[]), "number of conditions"),
        (
            Pde(states(1, None), (sum_of(d(0, 1)), sum_of(d(0))), ends((0, 0, 0))),
            "should be a number",
        ),
    ],
)
def test_refusals_give_the_reason(pde: Pde, reason: str) -> None:
    with pytest.raises(NotAdjointable) as error:
        dual_system(pde)
    assert reason in str(error.value)
