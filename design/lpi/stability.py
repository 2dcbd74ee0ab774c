"""The task stability: a Lyapunov operator, or a conserved form where nothing decays."""

from __future__ import annotations

import math
import time

import numpy as np

from design.lpi.achieved import Verification
from design.lpi.inequality import Certificate, Inequality, dissipated_ends
from design.lpi.result import Achieved, Attempt, Options, Progress, Result, Status
from design.lpi.rows import structure
from design.lpi.sdp import Point
from design.lpi.search import RESIDUAL_TOLERANCE, Search, make_attempt, solve_ladder
from design.lpi.verdict import nothing, sound, unstable
from design.pde.convert import convert
from design.pde.model import Pde

LOSSLESS = 1e-9
"""Decay of every mode, relative to the largest eigenvalue, below which a system counts as lossless."""
NEUTRAL = (1e-9, 1e-13)
"""Decay of a mode, relative to its own and to the largest eigenvalue, that is rounding."""
ROUNDING = 1e-7
"""Margin relative to P that counts as zero where a mode is neutral: no form can decrease strictly."""


def stability(pde: Pde, options: Options, progress: Progress) -> Result:
    """Whether all modes decay (or, for marginal systems, none grows), with the form that shows it."""
    check = Verification(pde)
    if check.unstable():
        return unstable("stability", check)
    system = check.system(23)
    largest = float(np.abs(system.eigenvalues).max(initial=1.0))
    lossless = bool(np.all(np.abs(system.eigenvalues.real) <= LOSSLESS * largest))
    own, common = NEUTRAL
    rounding = own * np.abs(system.eigenvalues) + common * largest
    neutral = lossless or bool(np.any(system.eigenvalues.real > -rounding))
    search = Search("stability", options, progress, lower=1.0)
    _attempts(pde, search, lossless=lossless, neutral=neutral, rate=check.slowest_rate())
    best = search.best.attempt if search.best else None
    kind = "conserved" if lossless else "non-increasing" if neutral else "decreasing"
    return Result(
        task="stability",
        status=Status.CERTIFIED if best else Status.UNRELIABLE,
        message=(
            f"stable{', not asymptotically' if neutral else ''}: a {kind} quadratic form, "
            f"degree {best.degree}"
            if best
            else nothing(search)
        ),
        achieved=Achieved(
            value=check.abscissa(),
            by_size=tuple((n, check.system(n).abscissa()) for n in (15, 23)),
            converged=True,
        ),
        formulation="conserved form" if lossless else "Lyapunov LPI",
        best=best,
        attempts=tuple(search.attempts),
    )


def _attempts(pde: Pde, search: Search, *, lossless: bool, neutral: bool, rate: float) -> None:
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
            if neutral:
                size = float(np.linalg.norm(point.grams["P"], 2)) + point.numbers["delta"]
                good = point.residual <= RESIDUAL_TOLERANCE and found.coercivity > 0.0
                within = abs(found.margin) if lossless else -found.margin
                return good and within <= ROUNDING * size, found
            return sound(point, found), found

        fixed = {"delta": 1.0, "epsilon": 0.0} if lossless else {"delta": 1.0}
        cost = {} if lossless else {"epsilon": -1.0 / rate}
        solved = solve_ladder(
            program,
            cost,
            fixed,
            judge,
            options=search.options,
            positive=("epsilon",) if "epsilon" not in fixed else (),
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
