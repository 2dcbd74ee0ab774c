"""Equilibrium shapes of the arm: curvature, frame vectors and the load that holds each shape.

A setpoint is a polynomial curvature kappa_e(s) with kappa_e(1) = kappa_e'(1) = 0: no moment and no shear at
the free tip (theory, section 2). Everything here is nondimensional, s in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import legder, legval
from scipy.integrate import quad
from scipy.optimize import brentq

from design import legendre
from design.legendre import Array
from wire.artefact import ACTUATORS

FIT_SIZES = (32, 64, 128, 256)
"""Numbers of Legendre functions to try for the holding load, which is smooth but no polynomial."""
RESOLVED = 1e-8
"""The load's last coefficients are to be below this part of its largest one."""
ARC_NODES = 200
"""Gauss points along a graph that is turned into a setpoint."""


@dataclass(frozen=True)
class Setpoint:
    """One equilibrium. `curvature`: coefficients in the orthonormal basis, nondimensional (times L)."""

    name: str
    curvature: Array

    @property
    def angle(self) -> Array:
        """theta_e(s) = int_0^s kappa_e, coefficients of shape (d + 1,)."""
        return np.asarray(
            self.curvature @ legendre.integration(self.curvature.size, self.curvature.size + 1)
        )

    def frame(self, degree: int) -> tuple[Array, Array]:
        """Polynomial approximations of cos and sin of theta_e, coefficients of shape (degree + 1,) each.

        Best in L2; the virtual-work identities hold exactly for any polynomial frame (theory, section 2).
        """
        nodes, _ = legendre.gauss(64)
        theta = legendre.basis(nodes, self.angle.size) @ self.angle
        keep = degree + 1
        return legendre.fit(np.cos(theta))[:keep], legendre.fit(np.sin(theta))[:keep]

    def frame_degree(self, tolerance: float = 2e-3, most: int = 10) -> int:
        """The smallest degree whose frame is within `tolerance` of the true one in L2, at the most `most`."""
        for degree in range(most):
            if self.frame_error(degree) <= tolerance:
                return degree
        return most

    def frame_error(self, degree: int) -> float:
        """L2 distance between the polynomial frame and the true one."""
        nodes, _ = legendre.gauss(64)
        theta = legendre.basis(nodes, self.angle.size) @ self.angle
        tails = [legendre.fit(f(theta))[degree + 1 :] for f in (np.cos, np.sin)]
        return float(np.sqrt(sum(np.sum(t**2) for t in tails)))


def equilibrium_load(
    setpoint: Setpoint, axial_stiffness: float, actuator: str = ACTUATORS[0]
) -> tuple[Array, Array]:
    """Holding load f_e and axial strain e_e, coefficients in the orthonormal basis (theory, 5; EI = L = 1).

    The load per reference arclength is along y ("transverse") or along the normal of the deformed centre
    line ("normal"), see `wire.artefact.Arm.actuator`. Raises ValueError if no such load holds the shape: a
    transverse one if the arm turns by 90 degrees or more, so that it would have to point along the load,
    either if the arm is too soft along its axis.
    """
    balance = _normal_balance if actuator == "normal" else _transverse_balance
    for size in FIT_SIZES:
        load, strain = balance(setpoint, axial_stiffness, size)
        if np.max(np.abs(load[-2:])) <= RESOLVED * np.max(np.abs(load)):
            break
    return legendre.from_plain(load), strain


def _transverse_balance(
    setpoint: Setpoint, axial_stiffness: float, size: int
) -> tuple[Array, Array]:
    """Load (plain Legendre series) and strain in `size` basis functions, from the two static balances.

    N = (0, N_y) with N_y = -theta''/((1 + e) cos theta), axial_stiffness e = N_y sin theta, f_e = -N_y'.
    """
    angle = setpoint.angle
    turn = float(np.max(np.abs(legendre.basis(np.linspace(0.0, 1.0, 257), angle.size) @ angle)))
    if turn >= 0.5 * np.pi:
        raise ValueError(
            f"setpoint {setpoint.name}: the arm turns by {np.degrees(turn):.1f} degrees; "
            "a transverse load can hold less than 90"
        )
    nodes, _ = legendre.gauss(size)
    theta = legendre.basis(nodes, angle.size) @ angle
    rate = _derivative(legendre.to_plain(setpoint.curvature), nodes)
    # e (1 + e) = -theta'' tan(theta) / axial_stiffness, on the branch that starts at e = 0
    discriminant = 1.0 - 4.0 * rate * np.tan(theta) / axial_stiffness
    if np.any(discriminant <= 0.0):
        raise ValueError(
            f"setpoint {setpoint.name}: no transverse load holds this shape with axial stiffness "
            f"{axial_stiffness:g}, the arm would be compressed by half; use a stiffer arm or bend less"
        )
    strain = 0.5 * (np.sqrt(discriminant) - 1.0)
    force = legendre.fit(-rate / ((1.0 + strain) * np.cos(theta)))
    return np.asarray(-2.0 * legder(legendre.to_plain(force))), legendre.fit(strain)


def _normal_balance(setpoint: Setpoint, axial_stiffness: float, size: int) -> tuple[Array, Array]:
    """Load (plain Legendre series) and strain in `size` basis functions, from the two static balances.

    N = axial_stiffness e t + Q n with Q = -theta''/(1 + e). Nothing pulls along t: axial_stiffness e' =
    theta' Q, and as e and theta' vanish at the tip, (1 + e)^2 = 1 - theta'^2 / axial_stiffness: every
    bend compresses, at whatever angle. f_e = -Q' - theta' axial_stiffness e.
    """
    nodes, _ = legendre.gauss(size)
    series = legendre.to_plain(setpoint.curvature)
    bend, rate = legval(2.0 * nodes - 1.0, series), _derivative(series, nodes)
    square = 1.0 - bend**2 / axial_stiffness
    if np.any(square <= 0.25):
        raise ValueError(
            f"setpoint {setpoint.name}: no normal load holds this shape with axial stiffness "
            f"{axial_stiffness:g}, the arm would be compressed by half; use a stiffer arm or bend less"
        )
    stretch = np.sqrt(square)
    # e without the difference of two numbers near 1
    strain = -(bend**2) / axial_stiffness / (stretch + 1.0)
    second = _derivative(2.0 * legder(np.append(series, 0.0)), nodes)
    stretch_rate = -bend * rate / (axial_stiffness * stretch)
    load = second / stretch - rate * stretch_rate / square - bend * axial_stiffness * strain
    return legendre.to_plain(legendre.fit(load)), legendre.fit(strain)


def _derivative(series: Array, s: Array) -> Array:
    """Values of the derivative of a plain Legendre series in 2 s - 1."""
    return np.asarray(legval(2.0 * s - 1.0, 2.0 * legder(np.append(series, 0.0))))


def tip_position(setpoint: Setpoint, strain: Array) -> Array:
    """Tip (x, y) in arm lengths: the integral of (1 + e)(cos, sin) theta_e."""
    nodes, weights = legendre.gauss(64)
    theta = legendre.basis(nodes, setpoint.angle.size) @ setpoint.angle
    stretch = (1.0 + legendre.basis(nodes, strain.size) @ strain) * weights
    return np.array([stretch @ np.cos(theta), stretch @ np.sin(theta)])


def from_shape(name: str, shape: Sequence[float], degree: int = 4) -> Setpoint:
    """Setpoint from a graph w_e(x) = sum shape[j] x^j of arc length 1 (the chapter's Fig. 2).

    The graph is cut where its ARCLENGTH reaches 1 (theory, section 1, erratum 'Fig. 2'). The curvature is
    (1 - s)^2 times a polynomial, of total degree `degree`, such that its integral fits the graph's ANGLE
    in least squares over s: the angle places the tip, and a curvature that no arm can have at the root
    (setpoint 3) does not spoil the rest.
    Raises ValueError if w_e does not leave the root straight (w_e(0) = w_e'(0) = 0) or `degree` < 2.
    """
    if degree < 2:
        raise ValueError(
            f"setpoint {name}: curvature of degree {degree}; at least 2 is needed to vanish twice at the tip"
        )
    w = Polynomial(np.asarray(shape, dtype=np.float64))
    slope = w.deriv()
    if abs(w(0.0)) > 0.0 or abs(slope(0.0)) > 0.0:
        raise ValueError(f"setpoint {name}: w_e(0) and w_e'(0) must be zero (clamped root)")

    def length(x: float) -> float:
        return float(quad(lambda t: np.hypot(1.0, slope(t)), 0.0, x, epsabs=1e-12)[0])

    x_tip = float(brentq(lambda x: length(x) - 1.0, 1e-6, 1.0 + 1e-9))
    points, weights = legendre.gauss(ARC_NODES)
    ds = x_tip * np.hypot(1.0, slope(x_tip * points))
    primitive = legendre.fit(ds) @ legendre.integration(ARC_NODES, ARC_NODES + 1)
    s = legendre.basis(points, ARC_NODES + 1) @ primitive
    angle = np.arctan(slope(x_tip * points))
    vanishing = Polynomial([1.0, -2.0, 1.0])  # (1 - s)^2
    columns = [(vanishing * Polynomial.basis(j)).integ()(s) for j in range(degree - 1)]
    root = np.sqrt(weights * ds)
    solution = np.linalg.lstsq(root[:, None] * np.stack(columns, axis=1), root * angle, rcond=None)[
        0
    ]
    fitted = vanishing * Polynomial(solution)
    nodes, _ = legendre.gauss(degree + 1)
    return Setpoint(name=name, curvature=legendre.fit(fitted(nodes)))


CHAPTER_SHAPES: dict[str, tuple[float, ...]] = {
    "1": (0.0, 0.0, 0.55, -0.38, 0.09),
    "2": (0.0, 0.0, 2.8, -2.6, 0.94),
    "3": (0.0, 0.0, 28.8, -74.2, 71.7),
}
"""w_e(x) of the chapter's Fig. 2."""
