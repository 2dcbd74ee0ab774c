"""The arm at rest by shooting, from first principles: shares nothing with `deploy`.

    r' = (1 + e) t,   N' = -f b,   M' = -(1 + e) N.n,   M = EI theta',   EA e = N.t

with b the direction of the load f: y, or the normal n. At the tip N = 0 and M = 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from wire.artefact import Arm

Array = npt.NDArray[np.float64]
SETPOINT_2 = [
    0.9469171743602257,
    -1.8582759056425275,
    1.5730344855388223,
    -0.9389824978978203,
    0.2773067436413,
]
SETPOINT_3 = [
    1.4415943567712162,
    -3.371496082033491,
    4.84687783993511,
    -4.5001559272389855,
    1.5831798125662044,
]
"""Curvatures in 1/m of the chapter's second and third shape on 1 m, Legendre series."""


def tip_to_root(arm: Arm, load: Callable[[float], float], tip_angle: float, breaks: Array) -> Array:
    """State (x, y, theta, M, N_x, N_y) at the breaks from tip to root; integration starts at the tip."""

    def rates(s: float, z: Array) -> list[float]:
        _, _, angle, moment, nx, ny = z
        tangent, normal = (np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))
        strain = (nx * tangent[0] + ny * tangent[1]) / arm.axial_stiffness_n
        along = normal if arm.actuator == "normal" else (0.0, 1.0)
        f = load(s)
        return [
            (1.0 + strain) * tangent[0],
            (1.0 + strain) * tangent[1],
            moment / arm.bending_stiffness_n_m2,
            -(1.0 + strain) * (nx * normal[0] + ny * normal[1]),
            -f * along[0],
            -f * along[1],
        ]

    state = np.array([0.0, 0.0, tip_angle, 0.0, 0.0, 0.0])
    out = [state]
    for end, begin in zip(breaks[:0:-1], breaks[-2::-1], strict=True):
        found = solve_ivp(rates, (end, begin), state, rtol=1e-10, atol=1e-12, method="DOP853")
        state = found.y[:, -1]
        out.append(state)
    return np.stack(out)


def rest(arm: Arm, load: Callable[[float], float], guess: float, breaks: Array) -> Array:
    """(theta, x, y, M) at the breaks, root to tip; they go from 0 to the length, with all kinks of the load."""

    def at_root(angle: float) -> float:
        return float(tip_to_root(arm, load, angle, breaks)[-1, 2])

    angle = brentq(at_root, guess - 0.05, guess + 0.05, xtol=1e-12)
    found = tip_to_root(arm, load, float(angle), breaks)[::-1]
    place = found[:, :2] - found[0, :2]
    return np.column_stack([found[:, 2], place, found[:, 3]])
