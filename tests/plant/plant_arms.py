"""Arms, setpoint and loads of the plant's tests; shares no code with the plant's mathematics."""

import math

import numpy as np
import numpy.typing as npt

from wire.artefact import Arm

Array = npt.NDArray[np.float64]

# The chapter's arm: EA = 9.82 N, EI = 1.534e-3 N m^2, rhoA = 2.16 kg/m.
CHAPTER_ARM = Arm("chapter", 1.0, 0.025, 5e3, 1.1e3, 0.0187)
# Thick and soft, of another length, so that its stretch is visible and no 1.0 hides a factor.
THICK_ARM = Arm("thick", 0.7, 0.06, 2e4, 900.0, 0.3)

# Degree-4 Legendre series in 2 s / L - 1 of the chapter's first setpoint (Fig. 2), 1/m.
SETPOINT_CURVATURE = [
    0.3238292539866432,
    -0.5448064286091925,
    0.23741958252342482,
    0.000757059988081444,
    -0.017199467888957067,
]


def undamped(arm: Arm) -> Arm:
    return damped(arm, 0.0)


def damped(arm: Arm, drag_per_s: float) -> Arm:
    return Arm(
        arm.name,
        arm.length_m,
        arm.radius_m,
        arm.youngs_modulus_pa,
        arm.density_kg_per_m3,
        drag_per_s,
    )


def stiffnesses(arm: Arm) -> tuple[float, float, float]:
    """EA, EI, rhoA from the cross-section."""
    area = math.pi * arm.radius_m**2
    return (
        arm.youngs_modulus_pa * area,
        arm.youngs_modulus_pa * area * arm.radius_m**2 / 4.0,
        arm.density_kg_per_m3 * area,
    )


def setpoint_feedforward(arm: Arm, s_m: Array) -> Array:
    """f_e = -N_y', N_y (1 + e) cos theta = -EI theta'', e = N_y sin theta / EA (theory, 5)."""
    EA, EI, _ = stiffnesses(arm)
    curvature = np.polynomial.Legendre(SETPOINT_CURVATURE, domain=[0.0, arm.length_m])
    angle, slope = curvature.integ(lbnd=0.0), curvature.deriv()

    def force(s: Array) -> Array:
        a, c = np.sin(angle(s)) * np.cos(angle(s)) / EA, np.cos(angle(s))
        right = -EI * slope(s)
        root = np.sqrt(c**2 + 4.0 * a * right)
        return np.asarray(2.0 * right / (c + root))

    series = np.polynomial.Chebyshev.interpolate(force, 40, domain=[0.0, arm.length_m])
    return -np.asarray(series.deriv()(s_m))
