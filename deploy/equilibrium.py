"""Strain and load that go with a curvature at rest: the exact equilibrium of the arm (theory, section 5).

Between the shapes that a run passes through (`deploy.path`) and the loads that the segments command
(`deploy.feedforward`). A setpoint of the gains artefact has the same in it, from design time; here it is
computed for any shape on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from deploy.model import tangent_angle
from wire.artefact import Arm
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

SIZE = 96
"""Legendre functions that strain and load are expanded in: smooth, but no polynomials."""
STEEPEST_RAD = np.radians(89.0)
"""A transverse load cannot hold an arm that points along it."""


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A shape at rest on [0, L]; Legendre series in 2 s / L - 1."""

    strain: Array
    load_n_per_m: Array
    """Along the arm's actuator."""
    position_m: Array
    """(2, modes): x and y of the centre line."""


def equilibrium(arm: Arm, curvature_per_m: Sequence[float] | Array, what: str) -> Equilibrium:
    """The equilibrium with this curvature, a Legendre series; `what` names the shape in messages.

    Raises UsageError if no load of the arm's actuator holds the shape.
    """
    series = np.asarray(curvature_per_m, dtype=np.float64)
    balance = _normal if arm.actuator == "normal" else _transverse
    strain, load = balance(arm, series, what)
    nodes, _ = _gauss()
    angle = tangent_angle(series, 0.5 * arm.length_m * (nodes + 1.0), arm.length_m)
    stretch = 1.0 + legendre.legval(nodes, strain)
    half = 0.5 * arm.length_m
    position = [
        legendre.legint(_fit(stretch * turn(angle)), lbnd=-1.0) * half for turn in (np.cos, np.sin)
    ]
    return Equilibrium(strain, load, np.stack(position))


def inertia_load(arm: Arm, curvature_per_m: Array, acceleration_m_per_s2: Array) -> Array:
    """Load that must be added so that the arm keeps its shape while every point accelerates; Legendre series.

    acceleration_m_per_s2: (2, modes), Legendre series, drag included (a = r_tt + drag r_t). The force beyond s
    is the load's less rho A a's; what bends is its part along n, which is to stay as at rest. A transverse
    load f must then make up for the inertia in x as well: with X = int_s^L rho A a_x,

        N.n = X sin theta + N_y cos theta   gives   f = f_rest + rho A a_y + (X tan theta)'.
    """
    nodes, _ = _gauss()
    mass, half = arm.mass_per_length_kg_per_m, 0.5 * arm.length_m
    along, across = acceleration_m_per_s2
    angle = tangent_angle(curvature_per_m, half * (nodes + 1.0), arm.length_m)
    if arm.actuator == "normal":  # to first order: the part along n of the acceleration
        wanted = -np.sin(angle) * legendre.legval(nodes, along)
        return _fit(mass * (wanted + np.cos(angle) * legendre.legval(nodes, across)))
    beyond = -mass * half * legendre.legint(along, lbnd=1.0)
    lifted = _fit(legendre.legval(nodes, beyond) * np.tan(angle))
    out = np.zeros(max(SIZE, len(across)))
    out[: len(lifted) - 1] += legendre.legder(lifted) / half
    out[: len(across)] += mass * across
    return out


def _transverse(arm: Arm, curvature: Array, what: str) -> tuple[Array, Array]:
    """Strain and load of a transverse load f: N = (0, N_y), EA e = N_y sin theta, f = -N_y'.

    N_y = -EI theta'' / ((1 + e) cos theta), so e (1 + e) = -(EI / EA) theta'' tan theta, on the branch that
    starts at e = 0.
    """
    nodes, _ = _gauss()
    angle = tangent_angle(curvature, 0.5 * arm.length_m * (nodes + 1.0), arm.length_m)
    steepest = float(np.max(np.abs(angle)))
    if steepest >= STEEPEST_RAD:
        raise UsageError(
            f"{what}: the arm turns by {np.degrees(steepest):.1f} degrees; a transverse load can hold "
            "less than 90"
        )
    rate = _curvature_rate(arm, curvature)
    ratio = arm.bending_stiffness_n_m2 / arm.axial_stiffness_n
    discriminant = 1.0 - 4.0 * ratio * rate * np.tan(angle)
    if np.any(discriminant <= 0.0):
        raise UsageError(
            f"{what}: no transverse load holds this shape, the arm would be compressed by half"
        )
    strain = 0.5 * (np.sqrt(discriminant) - 1.0)
    force = _fit(-arm.bending_stiffness_n_m2 * rate / ((1.0 + strain) * np.cos(angle)))
    return _fit(strain), -legendre.legder(force) * 2.0 / arm.length_m


def _normal(arm: Arm, curvature: Array, what: str) -> tuple[Array, Array]:
    """Strain and load of a load f along the normal: N = EA e t + Q n, Q = -EI theta'' / (1 + e), f = -N'.n.

    N'.t = 0 is EA e' = theta' Q, so e + e^2 / 2 = -(EI / EA) theta'^2 / 2 (zero at the tip, as theta' is).
    """
    nodes, _ = _gauss()
    bend = legendre.legval(nodes, curvature)
    ratio = arm.bending_stiffness_n_m2 / arm.axial_stiffness_n
    square = 1.0 - ratio * bend**2
    if np.any(square <= 0.25):
        raise UsageError(f"{what}: no load holds this shape, the arm would be compressed by half")
    strain = np.sqrt(square) - 1.0
    shear = _fit(-arm.bending_stiffness_n_m2 * _curvature_rate(arm, curvature) / (1.0 + strain))
    slope = legendre.legval(nodes, legendre.legder(shear)) * 2.0 / arm.length_m
    return _fit(strain), _fit(-slope - bend * arm.axial_stiffness_n * strain)


def _curvature_rate(arm: Arm, curvature: Array) -> Array:
    """theta'' at the Gauss points."""
    rate = legendre.legder(np.append(curvature, 0.0)) * 2.0 / arm.length_m
    return np.asarray(legendre.legval(_gauss()[0], rate))


@cache
def _gauss() -> tuple[Array, Array]:
    """Gauss points (SIZE,) and the matrix (SIZE, SIZE) from values there to Legendre coefficients."""
    nodes, weights = legendre.leggauss(SIZE)
    degrees = np.arange(SIZE)
    return nodes, ((2.0 * degrees + 1.0) / 2.0)[:, None] * (
        legendre.legvander(nodes, SIZE - 1).T * weights
    )


def _fit(values: Array) -> Array:
    return np.asarray(_gauss()[1] @ values)
