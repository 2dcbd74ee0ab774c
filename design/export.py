"""From nondimensional gains to the SI quantities of the gains artefact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from design import legendre
from design.arm_file import axial_ratio, time_unit_s
from design.factors import GainFactors
from design.legendre import Array
from wire.artefact import SENSOR_SETS, Arm, OperatorFactors, PolynomialMatrix


def state_units(arm: Arm) -> Array:
    """SI value of one unit of (v_x, v_y, e, k): m/s, m/s, 1, 1/m (theory, section 2)."""
    velocity = arm.length_m / time_unit_s(arm)
    return np.array([velocity, velocity, 1.0 / axial_ratio(arm), 1.0 / arm.length_m])


def load_unit(arm: Arm) -> float:
    """SI value of one unit of force per length, N/m."""
    return arm.bending_stiffness_n_m2 / arm.length_m**3


def observer_factors(gain: GainFactors, arm: Arm) -> OperatorFactors:
    """L of x_t = ... + L (v_y, k): state rates per unit of time from innovations in SI units.

    The gain acts on what the arm measures; a state that is not measured gets a column of zeros.
    Raises ValueError if the gain has another number of inputs.
    """
    units = state_units(arm)
    whole = _all_sensors(gain, arm)
    return _scaled(whole, units / time_unit_s(arm), 1.0 / units[[1, 3]], arm.length_m)


def _all_sensors(gain: GainFactors, arm: Arm) -> GainFactors:
    columns = [SENSOR_SETS[0].index(name) for name in arm.measured]
    if gain.n0.shape[1] != len(columns):
        raise ValueError(
            f"observer gain with {gain.n0.shape[1]} inputs; the arm measures {arm.measured}"
        )

    def spread(part: Array) -> Array:
        out = np.zeros((part.shape[0], len(SENSOR_SETS[0]), part.shape[2]))
        out[:, columns] = part
        return out

    return replace(gain, n0=spread(gain.n0), n1b=spread(gain.n1b), n2b=spread(gain.n2b))


def controller_factors(gain: GainFactors, arm: Arm) -> OperatorFactors:
    """K of u = K x: force per length in N/m, along the arm's actuators, from states in SI units."""
    return _scaled(gain, np.array([load_unit(arm)]), 1.0 / state_units(arm), arm.length_m)


def _scaled(gain: GainFactors, rows: Array, columns: Array, length_m: float) -> OperatorFactors:
    left, right = rows[:, None, None], columns[None, :, None]
    return OperatorFactors(
        n0=_matrix(left * gain.n0 * right),
        n1a=_matrix(left * gain.n1a),
        n1b=_matrix(gain.n1b * right / length_m),
        n2a=_matrix(left * gain.n2a),
        n2b=_matrix(gain.n2b * right / length_m),
    )


def _matrix(coefficients: Array) -> PolynomialMatrix:
    return PolynomialMatrix.from_array(legendre.to_plain(coefficients))
