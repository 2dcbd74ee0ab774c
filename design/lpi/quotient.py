"""The task norm: the smallest c with |numerator| <= c |denominator|."""

from __future__ import annotations

import math
import time

from design.lpi.achieved import Verification
from design.lpi.inequality import Certificate
from design.lpi.norm import NormInequality
from design.lpi.result import Attempt, Options, Progress, Result
from design.lpi.sdp import Point
from design.lpi.search import RESIDUAL_TOLERANCE, Search, make_attempt, solve_ladder
from design.lpi.verdict import bound, finite
from design.pde.convert import convert
from design.pde.model import Pde


def norm(pde: Pde, options: Options, progress: Progress) -> Result:
    """The smallest constant that sums of squares of rows prove."""
    check = Verification(pde)
    achieved = check.norm()
    search = Search("norm", options, progress, lower=finite(achieved.value))
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
    return bound("norm", search, achieved, "sum of squares of PI rows")
