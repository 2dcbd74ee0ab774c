"""The LPI in moments: figures between the optimum and what a bent arm needs, and what gets no certificate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from beam_modes import beam, controller_optimum, observer_optimum

from design.arm_pie import arm_pie
from design.factors import factorise
from design.gain_problem import Role, controller_problem, observer_problem
from design.hinf import HinfProblem, HinfResult, Stages, lpi_eigenvalue
from design.inverse import solve_gain
from design.moment_lpi import EIGENVALUE_TOLERANCE, MomentProgram, _verdict, solve_hinf
from design.moments import make_moments
from design.setpoint import CHAPTER_SHAPES, from_shape

ALPHA, DRAG, WEIGHT = 80.0, 0.7, 0.1
LEAST = Stages(slack=0.0, small_delta=1e-3)


def straight(role: Role, drag: float = DRAG) -> HinfProblem:
    pie = arm_pie(np.ones(1), np.zeros(1), ALPHA, drag)
    return (observer_problem if role == "observer" else controller_problem)(pie, WEIGHT)


def bent(measured: list[str]) -> HinfProblem:
    """Observer of an arm bent like the chapter's setpoint 1, its frame of degree 6."""
    setpoint = from_shape("1", CHAPTER_SHAPES["1"])
    pie = arm_pie(*setpoint.frame(6), ALPHA, DRAG)
    return observer_problem(pie, WEIGHT, measured)


@pytest.fixture(scope="module")
def quick() -> HinfResult:
    """The straight arm's observer, one polynomial a state."""
    return solve_hinf(straight("observer"), counts=(1,))


@pytest.mark.parametrize(
    ("role", "count", "near"), [("observer", 2, 1.01), ("controller", 3, 1.05)]
)
def test_smallest_gamma_is_near_the_optimum_and_above(role: Role, count: int, near: float) -> None:
    """Without slack the first solve stands: no bound can be below the best norm there is."""
    found = solve_hinf(straight(role), counts=(count,), stages=LEAST)
    optimum = (observer_optimum if role == "observer" else controller_optimum)(
        beam(10, DRAG), WEIGHT
    )
    assert found.outcome == "certified"
    assert optimum * (1.0 - 1e-4) <= found.gamma <= near * optimum


def test_more_polynomials_until_gamma_is_near_enough(quick: HinfResult) -> None:
    told: list[str] = []
    stages = Stages(near=1.05 * quick.gamma, aim=1.2 * quick.gamma)
    found = solve_hinf(straight("observer"), counts=(1, 2), stages=stages, progress=told.append)
    assert len(told) == 3 and told[0].startswith("1 polynomials a state, matrices (18, 4, 2, 2)")
    assert found.gamma == pytest.approx(1.2 * quick.gamma)
    assert found.sizes == quick.sizes
    told.clear()
    nearer = Stages(near=0.9 * quick.gamma)
    found = solve_hinf(straight("observer"), counts=(1, 2), stages=nearer, progress=told.append)
    assert [line.split()[0] for line in told[:2]] == ["1", "2"]
    assert found.outcome == "certified"
    assert found.gamma < 0.9 * quick.gamma


@pytest.mark.variants("measured1-0.4")
@pytest.mark.parametrize(("measured", "gamma"), [(["v_y", "k"], 0.12), (["k"], 0.4)])
def test_a_bent_arm_is_certified(measured: list[str], gamma: float) -> None:
    problem = bent(measured)
    found = solve_hinf(problem, counts=(2,))
    assert found.outcome == "certified"
    assert found.gamma < gamma
    gain = solve_gain(found.P, found.Z)
    factors, _ = factorise(gain, 1e-10)
    L = factors.operator()
    assert lpi_eigenvalue(problem, found.P, L, found.gamma) <= 1e-6
    assert lpi_eigenvalue(problem, found.P, -L, found.gamma) > 1e-3


def test_the_stages_make_gains_moderate(quick: HinfResult) -> None:
    """With 3 % more than the least gamma, P is larger and the gain smaller."""
    plain = solve_hinf(straight("observer"), counts=(1,), stages=LEAST)
    assert plain.gamma < quick.gamma <= 1.035 * plain.gamma
    assert quick.delta > 2.0 * plain.delta

    def size(result: HinfResult) -> float:
        return factorise(solve_gain(result.P, result.Z), 1e-10)[0].norm()

    assert size(quick) < size(plain)


# What gets no certificate


@pytest.mark.parametrize("role", ["observer", "controller"])
def test_arm_that_gains_energy_has_no_certificate(role: Role) -> None:
    """Negative drag: the axial modes grow, and neither sensor nor force reaches them."""
    found = solve_hinf(straight(role, drag=-DRAG), counts=(1, 2))
    assert found.outcome in ("infeasible", "unreliable")  # it may stall instead of a proof
    assert found.solution.status != "optimal"
    assert np.isnan(found.gamma)


def test_time_limit_gives_no_certificate() -> None:
    told: list[str] = []
    found = solve_hinf(straight("observer"), counts=(1,), time_limit_s=1e-5, progress=told.append)
    assert found.outcome == "unreliable"
    assert np.isnan(found.gamma)
    assert len(told) == 1
    assert "matrices (18, 4, 2, 2): user_limit" in told[0]


def failing(after: int) -> Callable[..., object]:
    """A solver that fails after so many solves."""
    solve, done = cp.Problem.solve, []

    def stand_in(problem: cp.Problem, *arguments: object, **options: object) -> object:
        done.append(1)
        if len(done) > after:
            raise cp.error.SolverError("out of order")
        return solve(problem, *arguments, **options)

    return stand_in


@pytest.mark.parametrize("after", [0, 1, 2])
def test_a_solver_that_fails(
    quick: HinfResult, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the first solve there is nothing; later, what has been found stands with its own evidence."""
    monkeypatch.setattr(cp.Problem, "solve", failing(after))
    found = solve_hinf(straight("observer"), counts=(1,))
    if after == 0:
        assert (found.outcome, found.solution.status) == ("unreliable", "solver_error")
        assert found.solution.smallest_eigenvalue == -np.inf
    else:
        assert (found.outcome, found.solution.status) == ("certified", "optimal")
        assert found.gamma < 1.04 * quick.gamma


def test_more_polynomials_that_fail_leave_what_fewer_gave(
    quick: HinfResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cp.Problem, "solve", failing(1))
    found = solve_hinf(straight("observer"), counts=(1, 2), stages=Stages(near=0.0))
    assert found.outcome == "certified"
    assert found.sizes == quick.sizes


def test_unknown_solver() -> None:
    assert solve_hinf(straight("observer"), counts=(1,), solver="ABACUS").outcome == "unreliable"


def test_verdict_is_on_the_recomputed_evidence(quick: HinfResult) -> None:
    solution = quick.solution
    assert _verdict(solution) == "certified"
    assert _verdict(replace(solution, status="optimal_inaccurate")) == "certified"
    for broken in (
        replace(solution, smallest_eigenvalue=-10.0 * EIGENVALUE_TOLERANCE),
        replace(solution, smallest_eigenvalue=float("nan")),
        replace(solution, status="user_limit"),
        replace(solution, status="unbounded"),
    ):
        assert _verdict(broken) == "unreliable"
    assert _verdict(replace(solution, status="infeasible_inaccurate")) == "infeasible"


def test_smallest_eigenvalue_is_that_of_all_matrices() -> None:
    """A solver that says 'optimal' with numbers that violate the inequality is seen through."""
    problem = straight("observer")
    program = MomentProgram(problem, make_moments(problem, 1))
    solution = program.solve(program.gamma, {"delta": 0.05}, "CLARABEL", 60.0)
    values = [np.linalg.eigvalsh(m.value) for m in program.matrices]
    assert solution.smallest_eigenvalue == pytest.approx(
        min(v[0] / v[-1] for v in values), abs=1e-12
    )
    assert solution.iterations > 5
