"""Equilibrium shapes of the arm: curvature, frame vectors and the transverse load that holds each shape.

A setpoint is a polynomial curvature kappa_e(s) with kappa_e(1) = kappa_e'(1) = 0: no moment and no shear at
the free tip (theory, section 2). Everything here is nondimensional, s in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import quad
from scipy.optimize import brentq

from design import legendre
from design.legendre import Array

FIT_SIZE = 32
"""Legendre functions for smooth quantities that are not polynomials (sines, the holding load)."""


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
        return tuple(legendre.fit(f(theta))[: degree + 1] for f in (np.cos, np.sin))  # type: ignore[return-value]

    def frame_degree(self, tolerance: float = 1e-3, most: int = 5) -> int:
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


def equilibrium_load(setpoint: Setpoint, axial_stiffness: float) -> tuple[Array, Array]:
    """Holding load f_e = -N_y' and axial strain e_e, coefficients in the orthonormal basis (theory, 5).

    The load is transverse only, so N = (0, N_y) with N_y = -theta''/((1 + e) cos theta) and
    axial_stiffness e = N_y sin theta (EI = L = 1). Raises ValueError where the arm would have to point
    along the load (cos theta <= 0), which no transverse load can hold.
    """
    nodes, _ = legendre.gauss(FIT_SIZE)
    kappa, angle = setpoint.curvature, setpoint.angle
    theta = legendre.basis(nodes, angle.size) @ angle
    if np.any(np.cos(theta) <= 0.0):
        raise ValueError(
            f"setpoint {setpoint.name}: the arm turns by {np.degrees(np.max(np.abs(theta))):.1f} degrees; "
            "a transverse load can hold less than 90"
        )
    rate = np.polynomial.legendre.legval(
        2.0 * nodes - 1.0,
        2.0 * np.polynomial.legendre.legder(legendre.to_plain(np.append(kappa, 0.0))),
    )
    strain = np.zeros_like(nodes)
    force = np.zeros_like(nodes)
    for _ in range(50):  # a contraction: the strain is of the order of 1 / axial_stiffness
        force = -rate / ((1.0 + strain) * np.cos(theta))
        new = force * np.sin(theta) / axial_stiffness
        if np.max(np.abs(new - strain)) < 1e-16:
            break
        strain = new
    series = legendre.to_plain(legendre.fit(force))
    load = -2.0 * np.polynomial.legendre.legder(series)
    return legendre.from_plain(load), legendre.fit(strain)


def tip_position(setpoint: Setpoint, strain: Array) -> Array:
    """Tip (x, y) in arm lengths: the integral of (1 + e)(cos, sin) theta_e."""
    nodes, weights = legendre.gauss(64)
    theta = legendre.basis(nodes, setpoint.angle.size) @ setpoint.angle
    stretch = (1.0 + legendre.basis(nodes, strain.size) @ strain) * weights
    return np.array([stretch @ np.cos(theta), stretch @ np.sin(theta)])


def from_shape(name: str, shape: Sequence[float], degree: int = 4) -> Setpoint:
    """Setpoint from a graph w_e(x) = sum shape[j] x^j of arc length 1 (the chapter's Fig. 2).

    The graph is cut where its ARCLENGTH reaches 1 (theory, section 1, erratum 'Fig. 2'); its curvature is
    fitted by (1 - s)^2 times a polynomial, of total degree `degree`, in least squares over s.
    Raises ValueError if w_e does not leave the root straight (w_e(0) = w_e'(0) = 0).
    """
    w = Polynomial(np.asarray(shape, dtype=np.float64))
    slope, bend = w.deriv(), w.deriv(2)
    if abs(w(0.0)) > 0.0 or abs(slope(0.0)) > 0.0:
        raise ValueError(f"setpoint {name}: w_e(0) and w_e'(0) must be zero (clamped root)")

    def length(x: float) -> float:
        return float(quad(lambda t: np.hypot(1.0, slope(t)), 0.0, x, epsabs=1e-12)[0])

    x_tip = float(brentq(lambda x: length(x) - 1.0, 1e-6, 1.0))
    x = np.linspace(0.0, x_tip, 4001)
    ds = np.hypot(1.0, slope(x))
    s = np.concatenate([[0.0], np.cumsum(0.5 * (ds[1:] + ds[:-1]) * np.diff(x))])
    kappa = bend(x) / ds**3
    powers = np.arange(degree - 1)
    matrix = (1.0 - s)[:, None] ** 2 * s[:, None] ** powers
    solution = np.linalg.lstsq(matrix, kappa, rcond=None)[0]
    fitted = Polynomial([1.0, -2.0, 1.0]) * Polynomial(solution)
    nodes, _ = legendre.gauss(degree + 1)
    return Setpoint(name=name, curvature=legendre.fit(fitted(nodes)))


CHAPTER_SHAPES: dict[str, tuple[float, ...]] = {
    "1": (0.0, 0.0, 0.55, -0.38, 0.09),
    "2": (0.0, 0.0, 2.8, -2.6, 0.94),
    "3": (0.0, 0.0, 28.8, -74.2, 71.7),
}
"""w_e(x) of the chapter's Fig. 2."""
