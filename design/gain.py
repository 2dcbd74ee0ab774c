"""One gain as one job: synthesised, factorised, certified and verified, or refused.

Between `design.gain_problem`, which states the problem, and `design.command`, which makes the artefact of all
gains. A job knows nothing of the other gains and touches no file, so that jobs run in processes of their own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np

from deploy.grid import make_grid
from deploy.model import make_model
from design.arm_file import ArmFile
from design.export import controller_factors, observer_factors
from design.factors import GainFactors, factorise
from design.gain_problem import Role, gain_problem, weight_of
from design.hinf import (
    LPI_TOLERANCE,
    HinfProblem,
    HinfResult,
    Stages,
    lpi_eigenvalue,
)
from design.inverse import solve_gain
from design.moment_lpi import COUNTS, solve_hinf
from design.setpoint_entry import setpoint_entry
from design.verify import (
    GRIDS,
    RESOLVED_RAD_PER_S,
    Achieved,
    controller_optimum,
    observer_optimum,
    verify_controller,
    verify_observer,
)
from wire.artefact import Arm, Certificate, OperatorFactors, check_gain
from wire.errors import GainsRefusedError

RANK_TOLERANCES = (5e-2, 2e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-6, 1e-10)
"""Kernel directions below this share of the gain are dropped: each costs a number in every message. The
first entry is taken with which the gain that is left still satisfies the LPI at the same gamma."""
ACHIEVED_MARGIN = 1e-3
"""Allowance of the finite-difference norm over the certified one (theory, section 3)."""
AIM = 1.13
"""Gamma, as a multiple of the optimum, that is designed for where the inequality reaches it: what lies between
makes gains moderate."""
NEAR = 1.16
"""Multiple of the optimum within which the inequality is near enough; beyond, more moments are taken."""
COUNTS_OF_FEW_SENSORS = (3, 4, 5)
"""With one sensor a segment: the inequality is tight later, and smaller."""
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Options:
    """How gains are computed; everything about what is asked of them is in the arm file."""

    solver: str = "CLARABEL"
    time_limit_s: float = 300.0
    """For one semidefinite program."""
    counts: tuple[int, ...] | None = None
    """Polynomials a state to try, see `design.moment_lpi`; None: COUNTS, or COUNTS_OF_FEW_SENSORS."""


class GainDesign(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A finished gain: what the artefact gets of it."""

    factors: OperatorFactors
    certificate: Certificate


@dataclass(frozen=True)
class _Gain:
    factors: GainFactors
    result: HinfResult
    eigenvalue: float


def design_gain(
    file: ArmFile,
    index: int,
    role: Role,
    options: Options,
    progress: Tell = lambda _: None,
) -> GainDesign:
    """Design the observer or the controller of the setpoint with this index in the arm file.

    Raises GainsRefusedError if the gain is not certified or does not keep what the certificate says, and
    UsageError if no load can hold the setpoint; the message names setpoint, role and what failed.
    """
    start = time.perf_counter()
    arm = file.arm()
    setpoint = file.setpoints[index].nondimensional(arm.length_m)
    name = f"setpoint {setpoint.name}, {role}"

    def tell(text: str) -> None:
        progress(f"{name}: {text}")

    entry = setpoint_entry(arm, setpoint)
    weight = weight_of(file, role)
    optimum = (observer_optimum if role == "observer" else controller_optimum)(arm, entry, weight)
    stages = Stages(aim=AIM * optimum, near=NEAR * optimum)
    gain = _synthesise(gain_problem(file, setpoint, role), stages, name, options, tell)
    if role == "observer":
        factors = observer_factors(gain.factors, arm)
        entry = msgspec.structs.replace(entry, observer=factors)
        achieved = verify_observer(arm, entry, weight, optimum)
    else:
        factors = controller_factors(gain.factors.adjoint, arm)
        entry = msgspec.structs.replace(entry, controller=factors)
        achieved = verify_controller(arm, entry, weight, optimum)
    _check_achieved(gain.result, achieved, name)
    open_loop_decay = _open_loop_decay(arm, entry.curvature_per_m)
    seconds = time.perf_counter() - start
    certificate = _certificate(gain, achieved, open_loop_decay, options, seconds)
    check_gain(factors, certificate, role, f"setpoint {setpoint.name}")
    tell(
        f"certified {certificate.certified_gamma:.4f}, achieved {achieved.gamma:.4f}, "
        f"optimum {achieved.optimum_gamma:.4f}, open loop {achieved.open_loop_gamma:.3f}, "
        f"decay {achieved.decay_per_s:.4f}/s (open loop {open_loop_decay:.4f}/s), {seconds:.0f} s"
    )
    return GainDesign(factors, certificate)


def _synthesise(
    problem: HinfProblem, stages: Stages, name: str, options: Options, tell: Tell
) -> _Gain:
    result = solve_hinf(
        problem,
        counts=options.counts or _counts(problem),
        stages=stages,
        solver=options.solver,
        time_limit_s=options.time_limit_s,
        progress=tell,
    )
    if result.outcome != "certified":
        s = result.solution
        raise GainsRefusedError(
            f"{name}: the LPI is {result.outcome} (solver {options.solver} says {s.status}; "
            f"smallest relative eigenvalue of its matrices {s.smallest_eigenvalue:.1e}). "
            "Try other weights, more damping or a less curved setpoint"
        )
    try:
        exact = solve_gain(result.P, result.Z)
    except ArithmeticError as error:
        raise GainsRefusedError(f"{name}: {error}. Try other weights or damping") from None
    for tolerance in RANK_TOLERANCES:
        factors, dropped = factorise(exact, tolerance)
        eigenvalue = lpi_eigenvalue(problem, result.P, factors.operator(), result.gamma)
        if eigenvalue <= LPI_TOLERANCE:
            break
    else:
        raise GainsRefusedError(
            f"{name}: with the gain put in, the LPI has the eigenvalue {eigenvalue:.1e}, "
            f"expected at most {LPI_TOLERANCE:g}; the gain is refused"
        )
    tell(f"kernel ranks {factors.ranks}, {dropped:.1e} of the gain dropped")
    return _Gain(factors, result, eigenvalue)


def _counts(problem: HinfProblem) -> tuple[int, ...]:
    few = problem.C2.shape_out.functions == 1 and problem.C1.shape_out.finite > 1
    return COUNTS_OF_FEW_SENSORS if few else COUNTS


def _check_achieved(result: HinfResult, achieved: Achieved, name: str) -> None:
    if not achieved.gamma <= result.gamma * (1.0 + ACHIEVED_MARGIN) or achieved.decay_per_s <= 0.0:
        raise GainsRefusedError(
            f"{name}: on finite differences the closed loop has norm {achieved.gamma:.4f} and "
            f"decay {achieved.decay_per_s:.3g}/s, the LPI certified {result.gamma:.4f}; the gain is refused"
        )
    if not np.isfinite([achieved.open_loop_gamma, achieved.optimum_gamma]).all():
        raise GainsRefusedError(
            f"{name}: on finite differences the open loop has norm {achieved.open_loop_gamma:.4g} and the best "
            f"of all gains {achieved.optimum_gamma:.4g}, so there is nothing to compare the gain with; it is "
            "refused. Try more moderate weights or more damping"
        )


def _open_loop_decay(arm: Arm, curvature_per_m: list[float]) -> float:
    """What the arm has by itself, in 1/s, among the modes and on the grids of the verification."""
    grids = [make_grid(arm.length_m, nodes, "equispaced") for nodes in GRIDS]
    models = [make_model(arm, curvature_per_m, grid) for grid in grids]
    values = np.concatenate([np.linalg.eigvals(model.A) for model in models])
    return -float(values[np.abs(values) <= RESOLVED_RAD_PER_S].real.max())


def _certificate(
    gain: _Gain, achieved: Achieved, open_loop_decay: float, options: Options, seconds: float
) -> Certificate:
    result = gain.result
    eigenvalues = np.linalg.eigvalsh(result.P.discretise(40))
    return Certificate(
        outcome=result.outcome,
        certified_gamma=result.gamma,
        achieved_gamma=achieved.gamma,
        open_loop_gamma=achieved.open_loop_gamma,
        optimum_gamma=achieved.optimum_gamma,
        decay_per_s=achieved.decay_per_s,
        gain_norm=gain.factors.norm(),
        smallest_eigenvalue_p=float(eigenvalues[0]),
        largest_eigenvalue_lpi=gain.eigenvalue,
        equality_residual=max(0.0, -result.solution.smallest_eigenvalue),
        gram_sizes=list(result.sizes),
        equalities=0,
        iterations=result.solution.iterations,
        solver=options.solver,
        solver_status=result.solution.status,
        seconds=round(seconds, 2),
        open_loop_decay_per_s=open_loop_decay,
    )
