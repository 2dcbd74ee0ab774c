"""The LPI engine: a PDE and a task in, a verdict with its evidence out.

Every task is one inequality (design.lpi.inequality, design.lpi.norm) of growing degree (design.lpi.search); the
answer is judged by the operators P and Z and confirmed on matrices that share no code with them
(design.lpi.achieved).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from design.lpi.achieved import Verification
from design.lpi.bisection import bisect_stability
from design.lpi.dual import dual_pie, dual_structure
from design.lpi.gains import Gain, gain_operator
from design.lpi.inequality import Certificate, Inequality, dissipated_ends
from design.lpi.norm import NormInequality
from design.lpi.result import Achieved, Attempt, Options, Progress, Result, Status, silent
from design.lpi.rows import Structure, structure
from design.lpi.scaling import scaled
from design.lpi.sdp import Point
from design.lpi.search import (
    RESIDUAL_TOLERANCE,
    SECTION_TOLERANCE,
    Search,
    make_attempt,
    solve_ladder,
)
from design.operators import PIOperator
from design.pde.adjoint import NotAdjointable, dual_system
from design.pde.convert import Pie, convert
from design.pde.model import Pde

DELTA = 1e-3
"""P >= DELTA I, in the program's units."""
MARGIN = 1e-5
"""Dissipation beyond need, in the norm of the rows, that a strict inequality carries (program's units)."""
ACHIEVED_MARGIN = 1e-5
"""Relative allowance of the achieved norm over the certified one: accuracy of the frequency sweep."""
LOSSLESS = 1e-9
"""Decay, relative to the largest eigenvalue, below which a system counts as marginal."""


def solve(
    pde: Pde, task: str, options: Options | None = None, progress: Progress = silent
) -> Result:
    """Answer one task: 'stability', 'gain', 'observer', 'controller' or 'norm'.

    Raises UsageError for ill-posed boundary conditions, ValueError for an unknown task or signals that the
    task needs and the PDE lacks.
    """
    options = options or Options()
    start = time.perf_counter()
    tasks = {
        "stability": _stability,
        "gain": _gain,
        "observer": _observer,
        "controller": _controller,
        "norm": _norm,
    }
    if task not in tasks:
        raise ValueError(f"task {task!r}: expected one of {', '.join(tasks)}")
    result = tasks[task](pde, options, progress)
    return replace(result, seconds=time.perf_counter() - start)


def _gain(pde: Pde, options: Options, progress: Progress) -> Result:
    check = Verification(pde)
    if check.unstable():
        return _unstable("gain", check)
    open_loop = check.open_loop()
    search = Search("gain", options, progress, lower=_finite(open_loop.value))
    pie = convert(pde)
    _attempts(pie, structure(pie), search, measured=False, rate=check.slowest_rate())
    return _bound("gain", search, open_loop, "bounded real lemma")


def _observer(pde: Pde, options: Options, progress: Progress) -> Result:
    check = Verification(pde)
    search = Search("observer", options, progress, lower=_finite(check.optimum("observer")))
    pie = convert(pde)
    _attempts(pie, structure(pie), search, measured=True, rate=check.slowest_rate())
    gain, achieved = _gain_of(search, "observer", check)
    return _bound("observer", search, achieved, "observer LPI", gain)


def _controller(pde: Pde, options: Options, progress: Progress) -> Result:
    check = Verification(pde)
    search = Search("controller", options, progress, lower=_finite(check.optimum("controller")))
    fundamental, reason = None, ""
    try:
        pie = convert(dual_system(pde))
        shape = structure(pie)
        formulation = "observer LPI of the adjoint system, u = K x"
    except NotAdjointable as error:
        reason = str(error)
        primal = convert(pde)
        pie, fundamental = dual_pie(primal), primal.T
        shape = dual_structure(pie)
        formulation = f"dual LPI, u = K f on the highest derivatives: {reason}"
        progress(f"no adjoint system ({reason}): the usual dual LPI")
    _attempts(pie, shape, search, measured=True, rate=check.slowest_rate())
    gain, achieved = _gain_of(search, "controller", check, fundamental)
    result = _bound("controller", search, achieved, formulation, gain)
    if result.best is None and reason:
        result = replace(result, message=f"{result.message}. No adjoint formulation: {reason}")
    return result


def _attempts(pie: Pie, shape: Structure, search: Search, *, measured: bool, rate: float) -> None:
    """Gain-type attempts of growing degree on the scaled PIE."""
    scale = scaled(pie)
    ends = dissipated_ends(scale.pie, shape, measured)
    epsilon = min(MARGIN, 2e-4 * rate)

    def attempt(degree: int) -> tuple[Attempt, Certificate | None]:
        start = time.perf_counter()
        inequality = Inequality(scale.pie, shape, degree, measured=measured, ends=ends)
        program = inequality.program
        assembly = time.perf_counter() - start

        def judge(point: Point) -> tuple[bool, Certificate]:
            found = inequality.certificate(*inequality.operators(point))
            return _sound(point, found) and math.isfinite(found.gamma), found

        solved = solve_ladder(
            program,
            {"gamma": 1.0},
            {"delta": DELTA, "epsilon": epsilon},
            judge,
            options=search.options,
            remaining_s=search.remaining_s,
            dump_name=f"degree_{degree}",
        )
        done = make_attempt(
            inequality, assembly, solved, search.options.solver, lambda c: c.gamma * scale.gamma
        )
        return done, solved[1] if solved[2] else None

    search.run(attempt)


def _sound(point: Point, found: Certificate) -> bool:
    """Whether a certificate is more than rounding: P positive, the state's part strictly negative."""
    return (
        point.residual <= RESIDUAL_TOLERANCE
        and found.coercivity > 0.0
        and found.margin > 0.0
        and found.change <= SECTION_TOLERANCE
    )


def _gain_of(
    search: Search, role: str, check: Verification, fundamental: PIOperator | None = None
) -> tuple[Gain | None, Achieved | None]:
    """The best attempt's gain and what it achieves."""
    if search.best is None:
        return None, None
    certificate = search.best.certificate
    if certificate.P is None or certificate.Z is None:
        return None, None
    try:
        operator, tail = gain_operator(certificate.P, certificate.Z)
    except ArithmeticError:
        return None, None
    if role == "controller":
        operator = operator.adjoint
    gain = Gain(role, operator, tail, fundamental)
    return gain, check.loop(gain)


def _bound(
    task: str,
    search: Search,
    achieved: Achieved | None,
    formulation: str,
    gain: Gain | None = None,
) -> Result:
    """The verdict on a search for a smallest gamma."""
    best = search.best.attempt if search.best else None
    status, message = Status.UNRELIABLE, ""
    if best is None:
        message = _nothing(search)
    elif achieved is None:
        message = "P and Z are certified, but P^-1 Z cannot be formed: P is almost singular"
    elif not math.isfinite(achieved.value):
        message = "the discretised loop is unstable although the inequality holds: refused"
    elif achieved.value > best.value * (1.0 + ACHIEVED_MARGIN):
        message = (
            f"the discretisation reaches {achieved.value:.6g}, more than the {best.value:.6g} "
            "that the inequality certifies: refused"
        )
    else:
        status = Status.CERTIFIED
        message = f"certified at degree {best.degree}"
        if not achieved.converged:
            message += "; the achieved value has not converged under refinement"
    return Result(
        task=task,
        status=status,
        message=message,
        gamma=best.value if best and status is Status.CERTIFIED else None,
        achieved=achieved,
        formulation=formulation,
        best=best,
        attempts=tuple(search.attempts),
        gain=gain if status is Status.CERTIFIED else None,
    )


def _nothing(search: Search) -> str:
    """Why there is no certificate."""
    if not search.attempts:
        return "no attempt was made: the time limit is too short"
    last = search.attempts[-1]
    return (
        f"no certificate up to degree {last.degree} within {search.options.time_limit_s:g} s; the last program "
        f"ended as '{last.solver_status}'. Try a higher --degree or a longer --time-limit"
    )


def _unstable(task: str, check: Verification) -> Result:
    return Result(
        task=task,
        status=Status.INFEASIBLE,
        message=f"unstable: a mode grows at {check.abscissa():.6g} per unit of time",
        formulation="spectrum of the discretisation",
    )


def _stability(pde: Pde, options: Options, progress: Progress) -> Result:
    check = Verification(pde)
    if check.unstable():
        return _unstable("stability", check)
    system = check.system(23)
    largest = float(np.abs(system.eigenvalues).max(initial=1.0))
    marginal = abs(check.abscissa()) <= LOSSLESS * largest
    search = Search("stability", options, progress, lower=1.0)
    _stability_attempts(pde, search, lossless=marginal, rate=check.slowest_rate())
    best = search.best.attempt if search.best else None
    kind = "conserved" if marginal else "decreasing"
    return Result(
        task="stability",
        status=Status.CERTIFIED if best else Status.UNRELIABLE,
        message=(
            f"stable{', not asymptotically' if marginal else ''}: a {kind} quadratic form, "
            f"degree {best.degree}"
            if best
            else _nothing(search)
        ),
        achieved=Achieved(
            value=check.abscissa(),
            by_size=tuple((n, check.system(n).abscissa()) for n in (15, 23)),
            converged=True,
        ),
        formulation="conserved form" if marginal else "Lyapunov LPI",
        best=best,
        attempts=tuple(search.attempts),
    )


def _stability_attempts(pde: Pde, search: Search, *, lossless: bool, rate: float) -> None:
    pie = convert(pde)
    shape = structure(pie)
    ends = dissipated_ends(pie, shape, False)

    def attempt(degree: int) -> tuple[Attempt, Certificate | None]:
        start = time.perf_counter()
        inequality = Inequality(pie, shape, degree, channels=False, lossless=lossless, ends=ends)
        program = inequality.program
        assembly = time.perf_counter() - start

        def judge(point: Point) -> tuple[bool, Certificate]:
            found = inequality.certificate(*inequality.operators(point))
            if lossless:
                size = float(np.linalg.norm(point.grams["P"], 2)) + point.numbers["delta"]
                good = point.residual <= RESIDUAL_TOLERANCE and found.coercivity > 0.0
                return good and abs(found.margin) <= 1e-7 * size, found
            return _sound(point, found), found

        fixed = {"delta": 1.0, "epsilon": 0.0} if lossless else {"delta": 1.0}
        cost = {} if lossless else {"epsilon": -1.0 / rate}
        solved = solve_ladder(
            program,
            cost,
            fixed,
            judge,
            options=search.options,
            remaining_s=search.remaining_s,
            dump_name=f"degree_{degree}",
        )
        accepted = solved[2]
        done = make_attempt(
            inequality,
            assembly,
            solved,
            search.options.solver,
            lambda _: 1.0 if accepted else math.nan,
        )
        return done, solved[1] if accepted else None

    search.run(attempt)


def _norm(pde: Pde, options: Options, progress: Progress) -> Result:
    check = Verification(pde)
    achieved = check.norm()
    search = Search("norm", options, progress, lower=_finite(achieved.value))
    pie = convert(pde)

    def attempt(degree: int) -> tuple[Attempt, Certificate | None]:
        start = time.perf_counter()
        inequality = NormInequality(pie, degree)
        program = inequality.program
        assembly = time.perf_counter() - start

        def judge(point: Point) -> tuple[bool, Certificate]:
            found = inequality.certificate(point)
            return point.residual <= RESIDUAL_TOLERANCE and math.isfinite(found.gamma), found

        solved = solve_ladder(
            program,
            {"c2": 1.0},
            {},
            judge,
            options=search.options,
            remaining_s=search.remaining_s,
            dump_name=f"degree_{degree}",
        )
        done = make_attempt(inequality, assembly, solved, search.options.solver, lambda c: c.gamma)
        return done, solved[1] if solved[2] else None

    search.run(attempt)
    return _bound("norm", search, achieved, "sum of squares of PI rows")


def stability_limit(
    problem: Callable[[float], Pde],
    low: float,
    high: float,
    options: Options | None = None,
    progress: Progress = silent,
) -> Result:
    """The largest certified stable parameter on the way from the stable end towards the other.

    Raises ValueError if the discretisation is stable, or unstable, at both ends.
    """
    return bisect_stability(_stability, problem, low, high, options or Options(), progress)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
