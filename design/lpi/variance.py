"""The tasks h2 and h2-observer: the variance of the regulated outputs under white noise."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from design.lpi.achieved import Verification
from design.lpi.gains import Gain, gain_operator
from design.lpi.h2 import H2Inequality
from design.lpi.inequality import Certificate, dissipated_ends
from design.lpi.result import Attempt, Options, Progress, Result, Status
from design.lpi.rows import structure
from design.lpi.scaling import scaled, size
from design.lpi.sdp import Point
from design.lpi.search import Search, make_attempt, solve_ladder
from design.lpi.verdict import DELTA, bound, finite, margin, sound, unstable
from design.pde.convert import convert
from design.pde.model import Pde


def h2(pde: Pde, options: Options, progress: Progress) -> Result:
    """The H2 norm from disturbances to regulated outputs."""
    check = Verification(pde)
    if check.unstable():
        return unstable("h2", check)
    return _h2_task("h2", check, options, progress)


def h2_observer(pde: Pde, options: Options, progress: Progress) -> Result:
    """An observer and the H2 norm of its error."""
    return _h2_task("h2-observer", Verification(pde), options, progress)


def _h2_task(task: str, check: Verification, options: Options, progress: Progress) -> Result:
    pie = convert(check.pde)
    measured = task == "h2-observer"
    if pie.B1.shape_in.functions or size(pie.D11) > 0.0:
        return Result(
            task=task,
            status=Status.INFEASIBLE,
            message="the H2 norm is infinite: white noise is distributed, or in a regulated output "
            "directly",
            formulation="none",
        )
    open_loop = None if measured else check.h2()
    lower = check.kalman() if open_loop is None else open_loop.value
    search = Search(task, options, progress, lower=finite(lower))
    scale, shape = scaled(pie), structure(pie)
    ends = dissipated_ends(scale.pie, shape, measured)
    epsilon = margin(check.slowest_rate())

    def attempt(degree: int) -> tuple[Attempt, Certificate | None]:
        start = time.perf_counter()
        inequality = H2Inequality(scale.pie, shape, degree, measured=measured, ends=ends)
        program = inequality.program
        assembly = time.perf_counter() - start

        def judge(point: Point) -> tuple[bool, Certificate]:
            P, Z = inequality.operators(point)
            found = inequality.certificate(P, Z)
            if not sound(point, found):
                return False, found
            try:
                value = inequality.bound(P, Z)
            except ArithmeticError:
                return False, found
            return math.isfinite(value), replace(found, gamma=value)

        solved = solve_ladder(
            program,
            {"mu": 1.0},
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
    if open_loop is not None:
        return bound(task, search, open_loop, "H2 LPI")
    certificate = search.best.certificate if search.best else None
    gain = achieved = None
    if certificate is not None and certificate.P is not None and certificate.Z is not None:
        gain = Gain("observer", *gain_operator(certificate.P, certificate.Z))
        achieved = check.h2(gain)
    return bound(task, search, achieved, "H2 observer LPI", gain)
