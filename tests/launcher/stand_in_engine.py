"""Stand-ins for the LPI engine, quick and badly behaved; `stand_in_cli.py` puts them behind `octarm`."""

from __future__ import annotations

import math
import os
import signal
import time

from design.lpi.reporter import Reporter
from design.lpi.result import Achieved, Attempt, Result, Status
from design.solve_command import Request
from wire.errors import UsageError

NEVER_S = 600.0


def attempt(degree: int, value: float = 0.5) -> Attempt:
    return Attempt(
        degree=degree,
        gram_sizes=(8 + degree, 20),
        equalities=100,
        iterations=17,
        solver="CLARABEL",
        solver_status="optimal",
        residual=1e-9,
        smallest_gram_eigenvalue=-1e-10,
        margin=1e-7,
        value=value,
        section_change=1e-5,
        assembly_s=0.5,
        modelling_s=0.25,
        solver_s=1.0,
        verification_s=0.25,
    )


def certified(gamma: float | None, limit: float | None = None, task: str = "gain") -> Result:
    attempts = (attempt(1, math.nan), attempt(2))
    return Result(
        task=task,
        status=Status.CERTIFIED,
        message="the bound stopped improving",
        gamma=gamma,
        limit=limit,
        achieved=Achieved(0.4999, ((15, 0.499), (23, 0.4999)), True, math.inf, 0.49),
        formulation="bounded real lemma",
        best=attempts[-1],
        attempts=attempts,
        seconds=5.0,
    )


def well(request: Request, reporter: Reporter) -> Result:
    reporter("degree 1")
    reporter.best(certified(0.6))
    reporter("degree 2")
    print("a solver prints")
    return certified(0.5)


def unreliable(request: Request, reporter: Reporter) -> Result:
    return Result(request.task, Status.UNRELIABLE, "the margin is negative", attempts=(attempt(1),))


def hangs(request: Request, reporter: Reporter) -> Result:
    """As native code does: deaf, with a certified answer in hand."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    reporter.best(certified(0.6))
    reporter("degree 2")
    time.sleep(NEVER_S)
    return certified(0.5)


def hangs_at_once(request: Request, reporter: Reporter) -> Result:
    reporter("degree 1")
    time.sleep(NEVER_S)
    return certified(0.5)


def dies(request: Request, reporter: Reporter) -> Result:
    reporter.best(certified(0.6))
    return dies_at_once(request, reporter)


def dies_at_once(request: Request, reporter: Reporter) -> Result:
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(NEVER_S)
    return certified(0.5)


def refuses(request: Request, reporter: Reporter) -> Result:
    raise UsageError("boundary.conditions[1]: ill-posed")


def breaks(request: Request, reporter: Reporter) -> Result:
    return certified(1 / 0)


class PanicError(BaseException):
    """What native code raises: no Exception."""


def panics(request: Request, reporter: Reporter) -> Result:
    raise PanicError("in native code")


STAND_INS = {f.__name__: f for f in (well, unreliable, hangs, hangs_at_once, dies_at_once, breaks)}
