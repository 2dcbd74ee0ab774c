"""The arm and its gains as functions of arclength, in Legendre polynomials: what segments converge to.

The independent side of `analysis.study.convergence`: no grid, no dual widths, nothing of `deploy`. The
arm is a Galerkin model in strains (theory, section 2: velocities are K of strain rates, so the clamp
holds exactly and the free tip weakly), the gains are applied by Gauss quadrature of their kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from design.verify import ArmMatrices
from wire.artefact import Arm, OperatorFactors, Setpoint

Array = npt.NDArray[np.float64]

STRAINS = 24
"""Default number of polynomials for the axial strain and for the curvature each."""
POINTS = 64
"""Gauss points along the arm."""


@dataclass(frozen=True, eq=False)
class Line:
    """Gauss points on [0, L] with what integrates functions that are given there."""

    s_m: Array
    """(m,)."""
    weights_m: Array
    """(m,): sum(weights * f) is the integral over the arm."""
    running: Array
    """(m, m): running @ f is int_0^s f at the points, exact for polynomials of degree below m."""
    basis: Array
    """(m, m): Legendre polynomials with integral of the square 1, one a column."""
    basis_integrals: Array
    """(m, m): their integrals from 0."""

    @property
    def length_m(self) -> float:
        """The arm's length."""
        return float(np.sum(self.weights_m))

    def at(self, s_m: Array) -> Array:
        """(p, m): from values at the points to values of the polynomial through them at s_m (p,)."""
        values, _ = _basis(s_m, self.length_m, len(self.s_m))
        return np.asarray(values @ (self.basis * self.weights_m[:, None]).T)

    def integral_to(self, s_m: Array) -> Array:
        """(p, m): from values at the points to the integral of that polynomial from 0 to s_m (p,)."""
        _, integrals = _basis(s_m, self.length_m, len(self.s_m))
        return np.asarray(integrals @ (self.basis * self.weights_m[:, None]).T)


def _basis(s_m: Array, length_m: float, count: int) -> tuple[Array, Array]:
    """Legendre polynomials orthonormal on [0, L] at s_m, and their integrals from 0: (p, count) each."""
    x = 2.0 * s_m / length_m - 1.0
    degree = np.arange(count)
    size = np.sqrt((2.0 * degree + 1.0) / length_m)
    higher = legendre.legvander(x, count)
    integral = np.hstack(
        [(1.0 + x)[:, None], (higher[:, 2:] - higher[:, :-2]) / (2.0 * degree[1:] + 1.0)]
    )
    return higher[:, :-1] * size, 0.5 * length_m * integral * size


def make_line(length_m: float, points: int = POINTS) -> Line:
    """Gauss-Legendre points on an arm of this length."""
    x, w = legendre.leggauss(points)
    s_m, weights = 0.5 * length_m * (x + 1.0), 0.5 * length_m * w
    basis, integrals = _basis(s_m, length_m, points)
    return Line(s_m, weights, integrals @ (basis * weights[:, None]).T, basis, integrals)


def apply_gain(factors: OperatorFactors, line: Line, s_m: Array) -> Array:
    """The operator (6) from functions at the points of the line to values at arclengths s_m.

    Returns (len(s_m), outputs, m, inputs): the multiplier takes the polynomial through the points,
    the kernels' inner integrals are integrated as polynomials and evaluated at s_m.
    """
    values, before = line.at(s_m), line.integral_to(s_m)
    length_m, after = line.length_m, line.weights_m - before
    n0 = factors.n0(s_m, length_m)
    out = n0[:, :, None, :] * values[:, None, :, None]
    for left, right, side in (
        (factors.n1a, factors.n1b, before),
        (factors.n2a, factors.n2b, after),
    ):
        if right.coefficients:  # else no terms
            kernel = np.einsum("sor,tri->soti", left(s_m, length_m), right(line.s_m, length_m))
            out = out + kernel * side[:, None, :, None]
    return np.asarray(out)


@dataclass(frozen=True, eq=False)
class Continuum:
    """The linear arm at a setpoint in coordinates in which |x|^2 is twice the energy; SI, seconds."""

    arm: Arm
    line: Line
    angle_rad: Array
    """(m,): theta_e at the points."""
    A: Array
    """(4N, 4N): x_t = A x + project(load) + gains."""
    values: Array
    """(m, 4, 4N): (v_x, v_y, e, k) at the points from the coordinates."""

    @property
    def project(self) -> Array:
        """(4N, m, 4): the coordinates nearest in energy to functions given at the points."""
        weight = self.line.weights_m[:, None, None] * densities(self.arm)[:, None]
        return np.asarray((weight * self.values).transpose(2, 0, 1))


def densities(arm: Arm) -> Array:
    """(4,): twice the energy per length of unit (v_x, v_y, e, k), SI."""
    mass = arm.mass_per_length_kg_per_m
    return np.array([mass, mass, arm.axial_stiffness_n, arm.bending_stiffness_n_m2])


def tangent(setpoint: Setpoint, length_m: float, s_m: Array) -> Array:
    """theta_e at arclengths: Gauss quadrature of the curvature from the root."""
    x, w = legendre.leggauss(len(setpoint.curvature_per_m) // 2 + 1)
    t = 0.5 * s_m[:, None] * (x + 1.0)
    series = np.asarray(setpoint.curvature_per_m, dtype=np.float64)
    curvature = legendre.legval(2.0 * t / length_m - 1.0, series)
    return np.asarray(0.5 * s_m * (curvature @ w), dtype=np.float64)


def make_continuum(
    arm: Arm, setpoint: Setpoint, strains: int = STRAINS, points: int = POINTS
) -> Continuum:
    """Galerkin model: e and k in `strains` polynomials each, v = K of as many strain rates."""
    line = make_line(arm.length_m, points)
    angle = tangent(setpoint, arm.length_m, line.s_m)
    t = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, :, None]
    n = np.stack([-np.sin(angle), np.cos(angle)], axis=1)[:, :, None]
    p, turned = line.basis[:, None, :strains], line.basis_integrals[:, None, :strains]
    slopes = np.concatenate([t * p, n * turned], axis=2)  # v' of each velocity function
    velocity = np.einsum("st,tcj->scj", line.running, slopes)
    root = np.sqrt(arm.mass_per_length_kg_per_m * line.weights_m)[:, None, None]
    # orthonormal in rho A |v|^2; only the triangle is needed: its inverse turns rates to coordinates
    triangle: Array = np.linalg.qr((root * velocity).reshape(-1, 2 * strains))[1]
    stiffness = np.repeat(np.sqrt(densities(arm)[2:]), strains)
    rates = stiffness[:, None] * np.linalg.inv(triangle)
    size = 2 * strains
    A = np.zeros((2 * size, 2 * size))
    A[:size, :size] = -arm.drag_per_s * np.eye(size) - arm.kelvin_voigt_s * rates.T @ rates
    A[:size, size:], A[size:, :size] = -rates.T, rates
    values = np.zeros((points, 4, 2 * size))
    values[:, :2, :size] = np.linalg.solve(triangle.T, velocity.reshape(-1, size).T).T.reshape(
        points, 2, size
    )
    values[:, 2, size : size + strains] = p[:, 0] / stiffness[0]
    values[:, 3, size + strains :] = p[:, 0] / stiffness[-1]
    return Continuum(arm, line, angle, A, values)


def arm_matrices(arm: Arm, setpoint: Setpoint, strains: int = STRAINS) -> ArmMatrices:
    """Arm and gains of a setpoint in the coordinates of `design.verify`, without any grid.

    Nondimensional: length L, time L^2 sqrt(rhoA/EI), load EI/L^3, norms over [0, 1] Euclidean. The
    outputs that gains read and write are polynomials too, orthonormal, a few more than the arm's.
    """
    model = make_continuum(arm, setpoint, strains)
    line, length = model.line, arm.length_m
    time = length**2 * math.sqrt(arm.mass_per_length_kg_per_m / arm.bending_stiffness_n_m2)
    energy = math.sqrt(arm.bending_stiffness_n_m2 / length)  # of one unit of the state
    load = arm.bending_stiffness_n_m2 / length**3
    speed, bend = length / time, 1.0 / length
    signals = 2 * strains
    # orthonormal over [0, 1]: columns of unit signals at the points, and the way back
    columns = line.basis[:, :signals] * math.sqrt(length)
    back = (columns * (line.weights_m / length)[:, None]).T
    units = np.array([speed, bend])
    project = model.project
    observer = apply_gain(setpoint.observer, line, line.s_m)
    controller = apply_gain(setpoint.controller, line, line.s_m)
    L = np.einsum("xsc,scti,tj,i->xij", project, observer, columns, units, optimize=True)
    K = np.einsum("ps,soti,tix->px", back, controller, model.values, optimize=True) / load
    C = np.einsum("ps,six->ipx", back, model.values[:, [1, 3]] / units[:, None])
    accelerations = project[:, :, :2] / arm.mass_per_length_kg_per_m
    normal = np.stack([-np.sin(model.angle_rad), np.cos(model.angle_rad)], axis=1)
    vertical = np.tile([0.0, 1.0], (len(line.s_m), 1))
    along = normal if arm.actuator == "normal" else vertical
    force = np.einsum("xsc,sc,sj->xj", accelerations, along, columns, optimize=True) * load
    disturbance = np.einsum("xsc,sc->x", accelerations, vertical)[:, None] * load
    size = len(model.A)
    return ArmMatrices(
        A=time * model.A,
        disturbance=time / energy * disturbance,
        force=time / energy * force,
        outputs=np.stack([C[0, 0], C[1, 0]]) * energy,
        measure=C.reshape(-1, size) * energy,
        L=time / energy * L.reshape(size, -1),
        K=K * energy,
    )
