"""The main job of the room: arm file in, gains artefact out.

Per setpoint an observer and a controller are synthesised, factorised, verified on finite differences and
refused unless certified; the artefact is written only when every gain is.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from design import legendre
from design.arm_file import ArmFile, axial_ratio, read_arm_file, time_unit_s
from design.arm_pie import ArmPIE, arm_pie, functional, selection
from design.export import controller_factors, load_unit, observer_factors
from design.factors import GainFactors, factorise
from design.hinf import (
    LPI_TOLERANCE,
    HinfProblem,
    HinfResult,
    Stages,
    lpi_eigenvalue,
    solve_hinf,
)
from design.inverse import solve_gain
from design.semidefinite import solvers
from design.setpoint import Setpoint, equilibrium_load, tip_position
from design.verify import Achieved, verify_controller, verify_observer
from wire.artefact import (
    ACTUATORS,
    SENSOR_SETS,
    Arm,
    Certificate,
    GainsArtefact,
    OperatorFactors,
    write_artefact,
)
from wire.artefact import Setpoint as SetpointGains
from wire.errors import GainsRefusedError, UsageError

Role = Literal["observer", "controller"]
LEVEL = 2
"""Krylov level of the rows: 1 certifies too, 2 finds controllers with smaller gains."""
RANK_TOLERANCES = (5e-2, 2e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-6, 1e-10)
"""Kernel directions below this share of the gain are dropped: each costs a number in every message. The
first entry is taken with which the gain that is left still satisfies the LPI at the same gamma."""
ACHIEVED_MARGIN = 1e-3
"""Allowance of the finite-difference norm over the certified one (theory, section 3)."""
STAGES: dict[Role, Stages] = {"observer": Stages(keep=1.0), "controller": Stages()}


@dataclass(frozen=True)
class Options:
    """What the command line can change."""

    solver: str = "CLARABEL"
    time_limit_s: float = 300.0
    """For one semidefinite program."""


@dataclass(frozen=True)
class _Gain:
    factors: GainFactors
    result: HinfResult
    eigenvalue: float


def run_design(
    arm_path: Path,
    out_path: Path,
    options: Options | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[GainsArtefact, str]:
    """Design all setpoints of an arm file and write the artefact; returns it and its SHA-256 digest.

    Raises UsageError for a bad arm file, solver or output path, before the work starts, and
    GainsRefusedError, before anything is written, if a gain is not certified; the message names setpoint,
    role and what failed.
    """
    file = read_arm_file(arm_path)
    _check_output(out_path)
    options = options or Options()
    if options.solver not in solvers():
        raise UsageError(
            f"--solver {options.solver}: expected a semidefinite solver that is installed: "
            f"{', '.join(solvers())}"
        )
    artefact = design_artefact(file, options, progress)
    try:
        return artefact, write_artefact(artefact, out_path)
    except OSError as error:
        raise UsageError(f"--out {out_path}: {error.strerror or error}") from None


def _check_output(path: Path) -> None:
    """UsageError, now and not after minutes of work, if nothing can be written there."""
    existing = path.parent
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if path.is_dir():
        raise UsageError(f"--out {path}: is a directory; give the name of a file")
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise UsageError(f"--out {path}: {existing} is no directory that can be written to")


def design_artefact(
    file: ArmFile, options: Options, progress: Callable[[str], None] = lambda _: None
) -> GainsArtefact:
    """Design all setpoints of an arm file. Raises GainsRefusedError if a gain is not certified."""
    arm = file.arm()
    entries = [
        _design_setpoint(file, arm, setpoint, options, progress)
        for setpoint in file.design_setpoints()
    ]
    names = ("octarm", "numpy", "scipy", "cvxpy", "clarabel")
    return GainsArtefact(
        arm=arm,
        weights={
            "measurement_noise": file.weights.measurement_noise,
            "control_effort": file.weights.control_effort,
        },
        setpoints=entries,
        versions={name: importlib.metadata.version(name) for name in names}
        | {"python": platform.python_version()},
    )


def observer_problem(
    pie: ArmPIE, noise: float, measured: Sequence[str] = SENSOR_SETS[0]
) -> HinfProblem:
    """Estimate z = int (v_y, k) from the measured states + noise under a uniform transverse load."""
    return HinfProblem(
        T=pie.T,
        A=pie.A,
        krylov=pie.inverse(),
        B=functional("v_y").adjoint,
        C1=functional("v_y", "k"),
        C2=selection(*measured),
        rho=noise,
    )


def controller_problem(pie: ArmPIE, effort: float, actuator: str = ACTUATORS[0]) -> HinfProblem:
    """State feedback for z = (int (v_y, k), effort u) under a uniform transverse load.

    It is the observer of the adjoint system from what the command works on: v_y, or the normal velocity.
    """
    return HinfProblem(
        T=pie.T_adjoint,
        A=pie.A_adjoint,
        krylov=pie.inverse(adjoint=True),
        B=functional("v_y", "k").adjoint,
        C1=functional("v_y"),
        C2=pie.command(actuator),
        rho=effort,
    )


def pie_at(arm: Arm, setpoint: Setpoint) -> ArmPIE:
    """The arm's partial integral equation at a setpoint."""
    cosine, sine = setpoint.frame(setpoint.frame_degree())
    unit = time_unit_s(arm)
    return arm_pie(cosine, sine, axial_ratio(arm), arm.drag_per_s * unit, arm.kelvin_voigt_s / unit)


def _design_setpoint(
    file: ArmFile, arm: Arm, setpoint: Setpoint, options: Options, progress: Callable[[str], None]
) -> SetpointGains:
    pie = pie_at(arm, setpoint)
    try:
        load, strain = equilibrium_load(setpoint, axial_ratio(arm) ** 2)
    except ValueError as error:
        raise UsageError(f"arm file: {error}") from None
    problems: dict[Role, HinfProblem] = {
        "observer": observer_problem(pie, file.weights.measurement_noise, arm.measured),
        "controller": controller_problem(pie, file.weights.control_effort, arm.actuator),
    }
    gains = {
        role: _synthesise(problem, role, setpoint.name, options, progress)
        for role, problem in problems.items()
    }
    observer = observer_factors(gains["observer"].factors, arm)
    controller = controller_factors(gains["controller"].factors.adjoint, arm)
    unverified = _entry(arm, setpoint, load, strain, observer, controller)
    achieved: dict[Role, Achieved] = {
        "observer": verify_observer(arm, unverified, file.weights.measurement_noise),
        "controller": verify_controller(arm, unverified, file.weights.control_effort),
    }
    certificates = {
        role: _certificate(gains[role], achieved[role], role, setpoint.name, options, progress)
        for role in problems
    }
    return msgspec.structs.replace(
        unverified,
        observer_certificate=certificates["observer"],
        controller_certificate=certificates["controller"],
    )


def _synthesise(
    problem: HinfProblem, role: Role, name: str, options: Options, progress: Callable[[str], None]
) -> _Gain:
    def tell(text: str) -> None:
        progress(f"setpoint {name}, {role}: {text}")

    result = solve_hinf(
        problem,
        level=LEVEL,
        stages=STAGES[role],
        solver=options.solver,
        time_limit_s=options.time_limit_s,
        progress=tell,
    )
    if result.outcome != "certified":
        s = result.solution
        raise GainsRefusedError(
            f"setpoint {name}, {role}: the LPI is {result.outcome} (solver {options.solver} says {s.status}; "
            f"equality residual {s.residual:.1e}, smallest Gram eigenvalue {s.smallest_gram_eigenvalue:.1e}); "
            "nothing was written. "
            "Try other weights, more damping or a less curved setpoint"
        )
    try:
        exact = solve_gain(result.P, result.Z)
    except ArithmeticError as error:
        raise GainsRefusedError(
            f"setpoint {name}, {role}: {error}; nothing was written. Try other weights or damping"
        ) from None
    for tolerance in RANK_TOLERANCES:
        factors, dropped = factorise(exact, tolerance)
        eigenvalue = lpi_eigenvalue(problem, result.P, factors.operator(), result.gamma)
        if eigenvalue <= LPI_TOLERANCE:
            break
    else:
        raise GainsRefusedError(
            f"setpoint {name}, {role}: with the gain put in, the LPI has the eigenvalue {eigenvalue:.1e}, "
            f"expected at most {LPI_TOLERANCE:g}; the gain is refused and nothing was written"
        )
    tell(f"kernel ranks {factors.ranks}, {dropped:.1e} of the gain dropped")
    return _Gain(factors, result, eigenvalue)


def _entry(
    arm: Arm,
    setpoint: Setpoint,
    load: legendre.Array,
    strain: legendre.Array,
    observer: OperatorFactors,
    controller: OperatorFactors,
) -> SetpointGains:
    blank = Certificate("unverified", *(0.0,) * 9, [], 0, 0, "", "", 0.0)
    curvature = legendre.to_plain(setpoint.curvature) / arm.length_m
    tip = tip_position(setpoint, strain) * arm.length_m
    return SetpointGains(
        name=setpoint.name,
        curvature_per_m=curvature.tolist(),
        strain=legendre.to_plain(legendre.trim(strain, (0,), 1e-16)).tolist(),
        feedforward_n_per_m=(
            legendre.to_plain(legendre.trim(load, (0,), 1e-13)) * load_unit(arm)
        ).tolist(),
        tip_m=tip.tolist(),
        observer=observer,
        controller=controller,
        observer_certificate=blank,
        controller_certificate=blank,
    )


def _certificate(
    gain: _Gain,
    achieved: Achieved,
    role: Role,
    name: str,
    options: Options,
    progress: Callable[[str], None],
) -> Certificate:
    result = gain.result
    if not achieved.gamma <= result.gamma * (1.0 + ACHIEVED_MARGIN) or achieved.decay_per_s <= 0.0:
        raise GainsRefusedError(
            f"setpoint {name}, {role}: on finite differences the closed loop has norm {achieved.gamma:.4f} and "
            f"decay {achieved.decay_per_s:.3g}/s, the LPI certified {result.gamma:.4f}; the gain is refused "
            "and nothing was written"
        )
    progress(
        f"setpoint {name}, {role}: certified {result.gamma:.4f}, achieved {achieved.gamma:.4f}, "
        f"open loop {achieved.open_loop_gamma:.3f}, decay {achieved.decay_per_s:.4f}/s"
    )
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
        equality_residual=result.solution.residual,
        gram_sizes=list(result.gram_sizes),
        equalities=result.solution.equalities,
        iterations=result.solution.iterations,
        solver=options.solver,
        solver_status=result.solution.status,
        seconds=round(result.seconds, 2),
    )
