"""A setpoint's entry in the gains artefact, before it has gains: equilibrium shape, strain, load, tip.

Between the arm file and the artefact; `design.gain` verifies a gain with it, `design.command` collects all.
"""

from __future__ import annotations

import numpy as np

from design import legendre
from design.arm_file import axial_ratio
from design.export import load_unit
from design.setpoint import Setpoint, equilibrium_load, tip_position
from wire.artefact import GAIN_SHAPES, Arm, Certificate, OperatorFactors, PolynomialMatrix
from wire.artefact import Setpoint as SetpointGains
from wire.errors import UsageError


def setpoint_entry(arm: Arm, setpoint: Setpoint) -> SetpointGains:
    """The artefact's entry of a setpoint without its gains: they are zero and uncertified.

    Raises UsageError if no load can hold the shape (theory, section 5).
    """
    try:
        load, strain = equilibrium_load(setpoint, axial_ratio(arm) ** 2, arm.actuator)
    except ValueError as error:
        raise UsageError(f"arm file: {error}") from None
    curvature = legendre.to_plain(setpoint.curvature) / arm.length_m
    plain_load = legendre.to_plain(legendre.trim(load, (0,), 1e-13)) * load_unit(arm)
    blank = Certificate("undesigned", *(0.0,) * 9, [], 0, 0, "", "", 0.0)
    return SetpointGains(
        name=setpoint.name,
        curvature_per_m=curvature.tolist(),
        strain=legendre.to_plain(legendre.trim(strain, (0,), 1e-16)).tolist(),
        feedforward_n_per_m=plain_load.tolist(),
        tip_m=(tip_position(setpoint, strain) * arm.length_m).tolist(),
        observer=_zero(*GAIN_SHAPES["observer"]),
        controller=_zero(*GAIN_SHAPES["controller"]),
        observer_certificate=blank,
        controller_certificate=blank,
    )


def _zero(outputs: int, inputs: int) -> OperatorFactors:
    none = PolynomialMatrix([])
    return OperatorFactors(
        n0=PolynomialMatrix.from_array(np.zeros((outputs, inputs, 1))),
        n1a=PolynomialMatrix.from_array(np.zeros((outputs, 0, 1))),
        n1b=none,
        n2a=PolynomialMatrix.from_array(np.zeros((outputs, 0, 1))),
        n2b=none,
    )
