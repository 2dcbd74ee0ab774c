"""From a search to a verdict: what counts as certified, what is refused, and in which words."""

from __future__ import annotations

import math

from design.lpi.achieved import Verification
from design.lpi.gains import Gain
from design.lpi.inequality import Certificate
from design.lpi.result import Achieved, Result, Status
from design.lpi.sdp import Point
from design.lpi.search import RESIDUAL_TOLERANCE, SECTION_TOLERANCE, Search

GRAM_TOLERANCE = 1e-4
"""Negative eigenvalues of Gram matrices, relative, below which a point is no sum of squares at all: the
operators alone, on sections, are then too little of a proof."""
DELTA = 1e-3
"""P >= DELTA I, in the program's units."""
MARGIN = 1e-5
"""Dissipation beyond need, in the norm of the rows, that a strict inequality carries (program's units)."""
ACHIEVED_MARGIN = 1e-5
"""Relative allowance of the achieved norm over the certified one: accuracy of the frequency sweep."""


def margin(rate: float) -> float:
    """The dissipation to ask for: MARGIN, less for systems that decay at a slow `rate`."""
    return min(MARGIN, 2e-4 * rate)


def sound(point: Point, found: Certificate) -> bool:
    """Whether a certificate is more than rounding: P positive, the state's part strictly negative.

    A gamma must not change between the sections; where there is none, the sign of the margin is what counts.
    """
    return (
        point.residual <= RESIDUAL_TOLERANCE
        and point.smallest_eigenvalue >= -GRAM_TOLERANCE
        and found.coercivity > 0.0
        and found.margin > 0.0
        and (found.change <= SECTION_TOLERANCE or math.isnan(found.gamma))
    )


def bound(
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
        message = nothing(search)
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


def nothing(search: Search) -> str:
    """Why there is no certificate."""
    if not search.attempts:
        return "no attempt was made: the time limit is too short"
    last = search.attempts[-1]
    return (
        f"no certificate up to degree {last.degree} within {search.options.time_limit_s:g} s; the last program "
        f"ended as '{last.solver_status}'. Try a higher --degree or a longer --time-limit"
    )


def impossible(task: str, check: Verification, role: str) -> Result | None:
    """The verdict if no gain of any size reaches a finite norm on the discretisation, else None."""
    values = [check.optimum(role, size) for size in (15, 23)]
    if any(value is None or math.isfinite(value) for value in values):
        return None
    lacks = "detected from the outputs" if role == "observer" else "reached by the controls"
    return Result(
        task=task,
        status=Status.INFEASIBLE,
        message=f"no {role} reaches a finite gamma: a mode grows at {check.abscissa():.6g} per unit of time "
        f"that cannot be {lacks}",
        formulation="Riccati equation of the discretisation",
    )


def unstable(task: str, check: Verification) -> Result:
    """The verdict on a task that only a stable system has an answer to."""
    return Result(
        task=task,
        status=Status.INFEASIBLE,
        message=f"unstable: a mode grows at {check.abscissa():.6g} per unit of time",
        formulation="spectrum of the discretisation",
    )


def finite(value: float | None) -> float | None:
    """The value, None unless it is finite."""
    return value if value is not None and math.isfinite(value) else None
