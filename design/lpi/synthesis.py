"""The tasks gain, observer and controller: H-infinity bounds, alone and with a gain to be found.

State feedback is the observer of the adjoint system, whose P is coercive on the state (theory, section 3);
where there is no adjoint PDE, the usual dual LPI (chapter (21)).
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

from design.lpi.achieved import Verification
from design.lpi.dual import dual_pie, dual_structure
from design.lpi.gains import Gain, gain_operator
from design.lpi.inequality import Certificate, Inequality, dissipated_ends
from design.lpi.result import Achieved, Attempt, Options, Progress, Result, Status
from design.lpi.rows import Structure, build_rows, structure, unbounded
from design.lpi.scaling import scaled
from design.lpi.sdp import Point
from design.lpi.search import Search, make_attempt, solve_ladder
from design.lpi.verdict import DELTA, bound, finite, impossible, margin, sound, unstable
from design.operators import PIOperator
from design.pde.adjoint import NotAdjointable, dual_system
from design.pde.convert import Pie, convert
from design.pde.model import Pde

GIVE = 5e-3
"""Share of gamma that is given away for a moderate gain."""


def gain(pde: Pde, options: Options, progress: Progress) -> Result:
    """The H-infinity norm from disturbances to regulated outputs, bounded by the bounded real lemma."""
    check = Verification(pde)
    if check.unstable():
        return unstable("gain", check)
    open_loop = check.open_loop()
    if not math.isfinite(open_loop.value):
        return Result(
            task="gain",
            status=Status.UNRELIABLE,
            message="a mode neither grows nor decays: no strict inequality holds, and the gain may be infinite",
            achieved=open_loop,
            formulation="spectrum of the discretisation",
        )
    pie = convert(pde)
    shape = structure(pie)
    ends = dissipated_ends(pie, shape, False)
    refused = _refused("gain", pie, shape, ends, "bounded real lemma")
    if refused is not None:
        return replace(refused, achieved=open_loop)
    search = Search("gain", options, progress, lower=finite(open_loop.value))
    _attempts(pie, shape, ends, search, measured=False, rate=check.slowest_rate())
    return bound("gain", search, open_loop, "bounded real lemma")


def observer(pde: Pde, options: Options, progress: Progress) -> Result:
    """An observer and the H-infinity norm of its error."""
    check = Verification(pde)
    hopeless = impossible("observer", check, "observer")
    if hopeless is not None:
        return hopeless
    pie = convert(pde)
    shape = structure(pie)
    ends = dissipated_ends(pie, shape, True)
    refused = _refused("observer", pie, shape, ends, "observer LPI")
    if refused is not None:
        return refused
    search = Search("observer", options, progress, lower=finite(check.optimum("observer")))
    _attempts(pie, shape, ends, search, measured=True, rate=check.slowest_rate())
    found, achieved = _gain_of(search, "observer", check)
    return bound("observer", search, achieved, "observer LPI", found)


def controller(pde: Pde, options: Options, progress: Progress) -> Result:
    """A state feedback and the H-infinity norm of the loop."""
    check = Verification(pde)
    hopeless = impossible("controller", check, "controller")
    if hopeless is not None:
        return hopeless
    search = Search("controller", options, progress, lower=finite(check.optimum("controller")))
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
    ends = dissipated_ends(pie, shape, True)
    places = _unbounded(pie, shape, ends)
    if places:
        scalars = [w.name for w in pde.disturbances if not w.distributed]
        names = ", ".join(repr(scalars[k]) for k in places)
        why = f"no adjoint system, as {reason}; " if reason else ""
        return Result(
            task="controller",
            status=Status.UNRELIABLE,
            message=f"no formulation: {why}the dual of disturbance {names} is an output that the dual dynamics "
            "do not bound; profiles that vanish at the ends could be",
            formulation=formulation,
        )
    _attempts(pie, shape, ends, search, measured=True, rate=check.slowest_rate())
    found, achieved = _gain_of(search, "controller", check, fundamental)
    return bound("controller", search, achieved, formulation, found)


def _refused(
    task: str, pie: Pie, shape: Structure, ends: PIOperator | None, formulation: str
) -> Result | None:
    """The verdict if a regulated output is not bounded by what the dynamics dissipate, else None."""
    places = _unbounded(pie, shape, ends)
    outputs = [o for o in pie.pde.regulated if not o.distributed]
    if not places:
        return None
    names = ", ".join(repr(outputs[k].expression.text) for k in places)
    return Result(
        task=task,
        status=Status.UNRELIABLE,
        message=f"no formulation: the regulated output {names} is not bounded by what the dynamics dissipate, "
        "so no <x, P x> with bounded P can dominate it",
        formulation=formulation,
    )


def _unbounded(pie: Pie, shape: Structure, ends: PIOperator | None) -> list[int]:
    degree = min(max(1, pie.C1.q1.shape[2]), 6)
    return unbounded(pie.C1, build_rows(pie, shape, degree, None, ends).inequality)


def _attempts(
    pie: Pie,
    shape: Structure,
    ends: PIOperator | None,
    search: Search,
    *,
    measured: bool,
    rate: float,
) -> None:
    """Gain-type attempts of growing degree on the scaled PIE; with a gain, the last makes it moderate.

    The least gamma is reached by an almost singular P and a huge gain P^-1 Z. So GIVE of gamma is given away
    for the largest delta, P >= delta I, as in the arm's design.
    """
    scale = scaled(pie)
    epsilon = margin(rate)
    made: dict[int, Inequality] = {}

    def solved(
        degree: int,
        cost: dict[str, float],
        fixed: dict[str, float],
        name: str,
        most: float,
        least: float,
    ) -> tuple[Attempt, Certificate | None]:
        """An attempt; accepted with gamma below `most` and P above `least`, in the program's units."""
        start = time.perf_counter()
        if degree not in made:
            made[degree] = Inequality(scale.pie, shape, degree, measured=measured, ends=ends)
        inequality = made[degree]
        program = inequality.program
        assembly = time.perf_counter() - start

        def judge(point: Point) -> tuple[bool, Certificate]:
            found = inequality.certificate(*inequality.operators(point))
            good = sound(point, found) and found.gamma < most and found.coercivity > least
            return good, found

        answer = solve_ladder(
            program,
            cost,
            {**fixed, "epsilon": epsilon},
            judge,
            options=search.options,
            remaining_s=search.remaining_s,
            dump_name=name,
        )
        done = make_attempt(
            inequality, assembly, answer, search.options.solver, lambda c: c.gamma * scale.gamma
        )
        return done, answer[1] if answer[2] else None

    search.run(
        lambda degree: solved(
            degree, {"gamma": 1.0}, {"delta": DELTA}, f"degree_{degree}", math.inf, 0.0
        )
    )
    best = search.best
    if measured and best is not None and best.attempt.solver_s < search.remaining_s():
        degree, gamma = best.attempt.degree, best.certificate.gamma
        search.replace(
            *solved(
                degree,
                {"delta": -1.0},
                {"gamma": gamma * (1.0 + GIVE)},
                f"degree_{degree}_moderate",
                gamma * (1.0 + 2.0 * GIVE),
                best.certificate.coercivity,
            )
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
