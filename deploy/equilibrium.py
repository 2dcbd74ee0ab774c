"""Strain and load that go with a curvature at rest: the exact equilibrium of the arm (theory, section 5).

Between the shapes that a run passes through (`deploy.path`) and the loads that the segments command
(`deploy.held`). A setpoint of the gains artefact has the same in it, from design time; here it is computed for
any shape on the way. Functions of s are Legendre series in 2 s / L - 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from wire.artefact import Arm
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

SIZE = 96
"""Legendre functions that strain, load and positions are expanded in: smooth, but no polynomials."""
STEEPEST_RAD = np.radians(89.0)
"""A transverse load cannot hold an arm that points along it."""


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A shape at rest on [0, L]: series of `SIZE` coefficients."""

    strain: Array
    load_n_per_m: Array
    """Along the arm's actuator."""
    position_m: Array
    """(2, SIZE): x and y of the centre line."""


@dataclass(frozen=True, eq=False)
class _Basis:
    """Matrices (SIZE, SIZE) between values at Gauss points and coefficients; on [-1, 1]."""

    values: Array
    fit: Array
    integral: Array
    """Coefficients to coefficients of the integral from -1; the last one is left out."""
    derivative: Array


@cache
def _basis() -> _Basis:
    nodes, weights = legendre.leggauss(SIZE)
    values = legendre.legvander(nodes, SIZE - 1)
    identity = np.eye(SIZE)
    derivative = np.zeros((SIZE, SIZE))
    derivative[:-1] = legendre.legder(identity)
    return _Basis(
        values=np.asarray(values, dtype=np.float64),
        fit=(np.arange(SIZE) + 0.5)[:, None] * values.T * weights,
        integral=np.asarray(legendre.legint(identity, lbnd=-1.0)[:SIZE], dtype=np.float64),
        derivative=derivative,
    )


def series_of(coefficients: Sequence[float] | Array) -> Array:
    """A series as `SIZE` coefficients."""
    given = np.asarray(coefficients, dtype=np.float64)
    if given.size > SIZE:
        raise UsageError(f"a series of {given.size} coefficients, at most {SIZE} are expected")
    return np.pad(given, (0, SIZE - given.size))


def angle_at_points(arm: Arm, curvature_per_m: Array) -> Array:
    """theta (SIZE,) at the Gauss points; curvature as `series_of` gives it."""
    basis = _basis()
    return np.asarray(basis.values @ (basis.integral @ curvature_per_m) * (0.5 * arm.length_m))


def equilibrium(arm: Arm, curvature_per_m: Sequence[float] | Array, what: str) -> Equilibrium:
    """The equilibrium with this curvature; `what` names the shape in messages.

    Raises UsageError if no load of the arm's actuator holds the shape.
    """
    basis, curvature = _basis(), series_of(curvature_per_m)
    angle = angle_at_points(arm, curvature)
    balance = _normal if arm.actuator == "normal" else _transverse
    strain, load = balance(arm, curvature, angle, what)
    half = 0.5 * arm.length_m
    tangent = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (1.0 + strain)[:, None]
    position = basis.integral @ (basis.fit @ tangent) * half
    return Equilibrium(basis.fit @ strain, load, np.ascontiguousarray(position.T))


def inertia_load(arm: Arm, curvature_per_m: Array, acceleration_m_per_s2: Array) -> Array:
    """Load that must be added so that the arm keeps its shape while every point accelerates; a series.

    acceleration_m_per_s2: (2, SIZE), drag included (a = r_tt + drag r_t). The force beyond s is that of the
    load less rho A a; what bends is its part along n, which is to stay as at rest. A transverse load f must
    then make up for the inertia in x as well: with X = -int_s^L rho A a_x,

        N.n = -X sin theta + N_y cos theta   gives   f = f_rest + rho A a_y - (X tan theta)'.

    A load along n leaves a force T along t only, T' = rho A a.t and T(L) = 0, so
    f = f_rest + rho A a.n - theta' T.
    """
    basis, half = _basis(), 0.5 * arm.length_m
    mass = arm.mass_per_length_kg_per_m
    along, across = acceleration_m_per_s2
    angle = angle_at_points(arm, series_of(curvature_per_m))
    if arm.actuator == "normal":
        x, y = basis.values @ along, basis.values @ across
        so_far = basis.integral @ (basis.fit @ (np.cos(angle) * x + np.sin(angle) * y)) * half
        pull = mass * (basis.values @ so_far - np.sum(so_far))
        bend = basis.values @ series_of(curvature_per_m)
        part = mass * (np.cos(angle) * y - np.sin(angle) * x)
        return np.asarray(basis.fit @ (part - bend * pull))
    so_far = basis.integral @ along
    beyond = np.sum(so_far) - basis.values @ so_far  # every Legendre function is 1 at the tip
    lifted = basis.fit @ (mass * half * beyond * np.tan(angle))
    return np.asarray(mass * across + basis.derivative @ lifted / half)


def _transverse(arm: Arm, curvature: Array, angle: Array, what: str) -> tuple[Array, Array]:
    """Strain at the Gauss points, and load f in y: N = (0, N_y), EA e = N_y sin theta, f = -N_y'.

    N_y = -EI theta'' / ((1 + e) cos theta), so e (1 + e) = -(EI / EA) theta'' tan theta, on the branch that
    starts at e = 0.
    """
    steepest = float(np.max(np.abs(angle)))
    if steepest >= STEEPEST_RAD:
        raise UsageError(
            f"{what}: the arm turns by {np.degrees(steepest):.1f} degrees; a transverse load can hold "
            "less than 90"
        )
    basis, per_m = _basis(), 2.0 / arm.length_m
    rate = basis.values @ (basis.derivative @ curvature) * per_m
    ratio = arm.bending_stiffness_n_m2 / arm.axial_stiffness_n
    discriminant = 1.0 - 4.0 * ratio * rate * np.tan(angle)
    if np.any(discriminant <= 0.0):
        raise UsageError(
            f"{what}: no transverse load holds this shape, the arm would be compressed by half"
        )
    strain = 0.5 * (np.sqrt(discriminant) - 1.0)
    force = -arm.bending_stiffness_n_m2 * rate / ((1.0 + strain) * np.cos(angle))
    return strain, np.asarray(-(basis.derivative @ (basis.fit @ force)) * per_m)


def _normal(arm: Arm, curvature: Array, angle: Array, what: str) -> tuple[Array, Array]:  # noqa: ARG001
    """Strain at the Gauss points, and load f along n: N = EA e t + Q n, Q = -EI theta'' / (1 + e), f = -N'.n.

    N'.t = 0 is EA e' = theta' Q, so e + e^2 / 2 = -(EI / EA) theta'^2 / 2 (zero at the tip, as theta' is).
    """
    basis, per_m = _basis(), 2.0 / arm.length_m
    bend = basis.values @ curvature
    square = 1.0 - arm.bending_stiffness_n_m2 / arm.axial_stiffness_n * bend**2
    if np.any(square <= 0.25):
        raise UsageError(f"{what}: no load holds this shape, the arm would be compressed by half")
    strain = np.sqrt(square) - 1.0
    rate = basis.values @ (basis.derivative @ curvature) * per_m
    shear = -arm.bending_stiffness_n_m2 * rate / (1.0 + strain)
    slope = basis.values @ (basis.derivative @ (basis.fit @ shear)) * per_m
    return strain, np.asarray(basis.fit @ (-slope - bend * arm.axial_stiffness_n * strain))
