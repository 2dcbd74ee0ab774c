"""Equations (4) and (5): the linear PDE at a setpoint, its matrices as printed and as derived from (1).

States x = (u, u_t, w, w_t), each with up to four derivatives; entries are polynomials in x of [0, 1] m. The
corrected entries follow from (1) by expansion; `chapter.model` derives them symbolically.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from numpy.polynomial import Polynomial

from chapter.constants import Constants

Form = Literal["printed", "corrected"]
Matrix = tuple[tuple[Polynomial, ...], ...]
ZERO = Polynomial([0.0])
ONE = Polynomial([1.0])


@dataclass(frozen=True)
class Setpoint:
    """One of the shapes of Fig. 2, graphs u_e(x), w_e(x) over x in [0, 1] m."""

    name: str
    w: Polynomial
    u: Polynomial = field(default_factory=lambda: Polynomial([0.0]))


SETPOINTS = (
    Setpoint("1", Polynomial([0.0, 0.0, 0.55, -0.38, 0.09])),
    Setpoint("2", Polynomial([0.0, 0.0, 2.8, -2.6, 0.94])),
    Setpoint("3", Polynomial([0.0, 0.0, 28.8, -74.2, 71.7])),
)
STRAIGHT = Setpoint("straight", ZERO)


def matrices(setpoint: Setpoint, constants: Constants, form: Form) -> tuple[Matrix, ...]:
    """A_0 to A_4 of (4), each 4 x 4, so that x_t = sum_j A_j(s) d_s^j x + B_1 f with B_1 = (0, 0, 0, 1) / rho.

    "printed" is (5) letter by letter; "corrected" is what (1) gives (theory, section 1).
    """
    EA, EI, rho = constants.axial_n, constants.bending_n_m2, constants.mass_kg_m
    u = [setpoint.u.deriv(j) if j else setpoint.u for j in range(5)]
    w = [setpoint.w.deriv(j) if j else setpoint.w for j in range(5)]
    if form == "printed":
        by_u_in_w = (EA * w[2] + EI * w[3] + EI * w[4], EA * w[1] + EI * w[2] + 3 * EI * w[3])
        by_w_in_w = (
            EA * u[2] + EI * u[4],
            EA * u[1] + EI * u[2] + 3 * EI * u[3],
            EI * u[1] + 3 * EI * u[2],
            -EI * ONE + EI * u[1],
        )
        by_w_in_u = ZERO
    else:
        by_u_in_w = (EA * w[2] + 2 * EI * w[4], EA * w[1] + 4 * EI * w[3])
        by_w_in_w = (
            EA * u[2] + EI * u[4],
            EA * u[1] + 3 * EI * u[3],
            4 * EI * u[2],
            -EI * ONE + 2 * EI * u[1],
        )
        by_w_in_u = EA * w[2] + EI * w[4]
    nothing = (ZERO, ZERO, ZERO, ZERO)
    found: list[Matrix] = [
        (
            (ZERO, ONE, ZERO, ZERO),
            nothing,
            (ZERO, ZERO, ZERO, ONE),
            nothing,
        )
    ]
    in_u = (
        (ZERO, by_w_in_u),
        (EA * ONE, EA * w[1] + EI * w[3]),
        (ZERO, EI * w[2]),
        (ZERO, EI * w[1]),
    )
    in_w = (
        *zip(by_u_in_w, by_w_in_w[:2], strict=True),
        (3 * EI * w[2], by_w_in_w[2]),
        (EI * w[1], by_w_in_w[3]),
    )
    for (uu, uw), (wu, ww) in zip(in_u, in_w, strict=True):
        found.append(
            (
                nothing,
                (uu / rho, ZERO, uw / rho, ZERO),
                nothing,
                (wu / rho, ZERO, ww / rho, ZERO),
            )
        )
    return tuple(found)
