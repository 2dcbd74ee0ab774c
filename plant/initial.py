"""Initial conditions by name: curvature and strain that the emulated arm is released from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wire.artefact import Setpoint
from wire.errors import UsageError

Array = npt.NDArray[np.float64]
Profile = Callable[[Array], Array]

NAMES = ("setpoint", "chapter", "straight")


def zero(s_m: Array) -> Array:
    """The profile that is 0 at every arclength."""
    return np.zeros_like(s_m)


@dataclass(frozen=True)
class InitialShape:
    """A shape at rest: curvature in 1/m and axial strain as functions of arclengths (m,) in m."""

    curvature_per_m: Profile = zero
    strain: Profile = zero


STRAIGHT = InitialShape()


def legendre_profile(coefficients: list[float], length_m: float) -> Profile:
    """The Legendre series in 2 s / L - 1 of a gains artefact as a function of arclength in m."""
    series = np.asarray(coefficients, dtype=np.float64)

    def profile(s_m: Array) -> Array:
        return np.asarray(np.polynomial.legendre.legval(2.0 * s_m / length_m - 1.0, series))

    return profile


def chapter_curvature(length_m: float) -> Profile:
    """Curvature in 1/m of the chapter's initial deviation (its section 4.1).

    x3(s, 0) = 2 s^2 - 8/3 s^3 + s^4 is a transverse displacement over a unit length; its second
    derivative 4 - 16 s + 12 s^2, with s = arclength / L, is the curvature times L.
    """

    def profile(s_m: Array) -> Array:
        s = s_m / length_m
        return (4.0 - 16.0 * s + 12.0 * s**2) / length_m

    return profile


def initial_shape(name: str, setpoint: Setpoint, length_m: float) -> InitialShape:
    """The initial condition called `name`, relative to a setpoint of the gains artefact.

    "setpoint": the setpoint itself, curvature kappa_e and strain e_e; "chapter": the same with the
    chapter's initial curvature added; "straight": straight and unstrained whatever the setpoint.
    Raises UsageError for other names.
    """
    check_name(name)
    if name == "straight":
        return STRAIGHT
    curvature = legendre_profile(setpoint.curvature_per_m, length_m)
    strain = legendre_profile(setpoint.strain, length_m)
    if name == "setpoint":
        return InitialShape(curvature, strain)
    deviation = chapter_curvature(length_m)
    return InitialShape(lambda s_m: curvature(s_m) + deviation(s_m), strain)


def check_name(name: str) -> None:
    """Raise UsageError unless `name` is an initial condition."""
    if name not in NAMES:
        raise UsageError(f"initial shape {name!r} is not known; known: {', '.join(NAMES)}")
