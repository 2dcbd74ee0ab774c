"""Whether the setpoints of Fig. 2 are setpoints: what (2) and the free end would need to hold them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from chapter.constants import Constants
from chapter.pde import Setpoint
from design import legendre
from design.arm_file import read_arm_file
from supervise.shipped import DEFAULT_ARM


@dataclass(frozen=True)
class Need:
    """Loads that hold (u_e, w_e) at rest under (2), corrected form, over x in [0, end]."""

    axial_n_m: float
    """Largest axial load per length; the chapter has none."""
    transverse_n_m: float
    """Largest f."""
    tip_axial_n: float
    """Axial force to be applied at the free tip."""
    tip_transverse_n: float
    tip_moment_n_m: float
    """EI theta_x of the truncated model: the couple on w_x."""
    stretch: float
    """Largest stretch e that u_e, w_e mean, by its definition in section 2.1."""


def need(setpoint: Setpoint, constants: Constants, end: float) -> Need:
    """Evaluate (2) and its natural end conditions at rest."""
    EA, EI = constants.axial_n, constants.bending_n_m2
    u = [setpoint.u, *(setpoint.u.deriv(j) for j in range(1, 5))]
    w = [setpoint.w, *(setpoint.w.deriv(j) for j in range(1, 5))]
    axial = EA * (u[1] + 0.5 * w[1] ** 2) + EI * w[1] * w[3]
    transverse = (
        EA * u[1] * w[1] - EI * w[3] + EI * (2.0 * u[1] * w[3] + 2.0 * u[2] * w[2] + u[3] * w[1])
    )
    moment = EI * (w[2] - 2.0 * u[1] * w[2] - u[2] * w[1])
    x = np.linspace(0.0, end, 1001)
    stretch = np.hypot(1.0 + u[1](x), w[1](x)) - 1.0
    return Need(
        float(np.max(np.abs(axial.deriv()(x)))),
        float(np.max(np.abs(transverse.deriv()(x)))),
        float(axial(end)),
        float(transverse(end)),
        float(moment(end)),
        float(stretch[np.argmax(np.abs(stretch))]),
    )


def unstretched(setpoint: Setpoint) -> Setpoint:
    """The same w_e with u_e' = -w_e'^2 / 2: no stretch to degree 2."""
    slope = setpoint.w.deriv()
    return Setpoint(f"{setpoint.name}, unstretched", setpoint.w, -0.5 * (slope**2).integ())


def octarm(position: int, degree: int = 24) -> Setpoint:
    """octarm's setpoint at that place of the arm file as u_e(x), w_e(x), x the arclength, without its strain.

    Polynomials of that degree through u_e' = cos theta - 1, w_e' = sin theta at Chebyshev points.
    """
    own = read_arm_file(DEFAULT_ARM).design_setpoints()[position]
    x = 0.5 + 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    theta = legendre.basis(x, own.angle.size) @ own.angle
    rates = [
        Chebyshev.fit(x, f, degree, domain=[0.0, 1.0]).convert(kind=Polynomial)
        for f in (np.sin(theta), np.cos(theta) - 1.0)
    ]
    return Setpoint(f"{own.name}, octarm", rates[0].integ(), rates[1].integ())
