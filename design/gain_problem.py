"""What is asked of a gain: the arm at a setpoint as H-infinity problems for an observer and for a controller.

Between the arm file and the synthesis: `design.gain` solves what is stated here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

from design.arm_file import ArmFile, axial_ratio, time_unit_s
from design.arm_pie import ArmPIE, arm_pie, functional, selection
from design.hinf import HinfProblem
from design.setpoint import Setpoint
from wire.artefact import ACTUATORS, SENSOR_SETS, Arm

Role = Literal["observer", "controller"]
ROLES: tuple[Role, ...] = get_args(Role)


def pie_at(arm: Arm, setpoint: Setpoint) -> ArmPIE:
    """The arm's partial integral equation at a setpoint."""
    cosine, sine = setpoint.frame(setpoint.frame_degree())
    unit = time_unit_s(arm)
    return arm_pie(cosine, sine, axial_ratio(arm), arm.drag_per_s * unit, arm.kelvin_voigt_s / unit)


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
        drag=pie.drag,
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
        drag=pie.drag,
    )


def weight_of(file: ArmFile, role: Role) -> float:
    """The one weight of the arm file that a gain depends on."""
    weights = file.weights
    return weights.measurement_noise if role == "observer" else weights.control_effort


def gain_problem(file: ArmFile, setpoint: Setpoint, role: Role) -> HinfProblem:
    """The problem of one gain; the controller's is that of the adjoint system (theory, section 3)."""
    arm = file.arm()
    pie, weight = pie_at(arm, setpoint), weight_of(file, role)
    if role == "observer":
        return observer_problem(pie, weight, arm.measured)
    return controller_problem(pie, weight, arm.actuator)
