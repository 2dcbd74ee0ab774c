"""The graphs of Fig. 2: arc lengths, where 1 m of arm ends, tips, curvatures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import leggauss
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from chapter.constants import LENGTH_M
from chapter.pde import SETPOINTS
from design import legendre
from design.arm_file import axial_ratio, read_arm_file
from design.setpoint import equilibrium_load, tip_position
from supervise.shipped import DEFAULT_ARM

Array = np.ndarray[Any, np.dtype[np.float64]]
PIECES = 16
"""Pieces of the composite Gauss rule for arc lengths."""
GAUSS = 20


def arc_length(w: Polynomial, x: float) -> float:
    """Length of the graph of w over [0, x]: composite Gauss."""
    points, weights = leggauss(GAUSS)
    slope = w.deriv()
    edges = np.linspace(0.0, x, PIECES + 1)
    half = 0.5 * np.diff(edges)
    at = edges[:-1, None] + half[:, None] * (points + 1.0)
    return float(np.sum(half[:, None] * weights * np.hypot(1.0, slope(at))))


def arc_end(w: Polynomial, length: float = LENGTH_M) -> float:
    """x in (0, length] where the graph of w has that length."""
    return float(
        brentq(lambda x: arc_length(w, x) - length, 1e-9, length * (1 + 1e-12), xtol=1e-14)
    )


def arc_end_by_ode(w: Polynomial, length: float = LENGTH_M) -> tuple[float, float]:
    """(x, y) of the same point from dx/ds = 1 / sqrt(1 + w'^2), dy/ds = w' dx/ds: an independent check."""
    slope = w.deriv()

    def rate(_: float, place: Array) -> list[float]:
        d = float(slope(place[0]))
        return [1.0 / math.sqrt(1.0 + d * d), d / math.sqrt(1.0 + d * d)]

    found = solve_ivp(rate, (0.0, length), [0.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-13)
    return float(found.y[0, -1]), float(found.y[1, -1])


def curvature(w: Polynomial, x: Array) -> Array:
    """Of the graph, in 1/m."""
    return np.asarray(w.deriv(2)(x) / (1.0 + w.deriv()(x) ** 2) ** 1.5)


@dataclass(frozen=True)
class Shape:
    """One shape of Fig. 2, read both ways, and the setpoint that octarm runs in its place; metres, degrees."""

    name: str
    graph_length: float
    """Of the graph over [0, 1]."""
    end_angle: float
    """Direction of the graph's point at x = 1 from the root."""
    end_height: float
    tip: tuple[float, float]
    """Where the arclength is 1 m."""
    tip_angle: float
    root_curvature: float
    bend_at_cut: float
    """w_e'' there, zero at a free tip."""
    bend_at_one: float
    """w_e'' at x = 1."""
    octarm_tip: tuple[float, float]
    """With the strain of the holding load."""
    octarm_angle: float
    octarm_root_curvature: float
    octarm_largest_curvature: float
    tip_distance: float
    """Between octarm's tip and the graph's."""
    unstrained_distance: float
    """The same without the holding load's strain: what the fit of degree 4 leaves."""
    line_distance: float
    """Largest distance of points of the same arclength, octarm's (held) and the graph's."""


def shapes() -> tuple[Shape, ...]:
    """All three, in the order of the chapter and of examples/chapter_arm.toml."""
    found = []
    arm = read_arm_file(DEFAULT_ARM)
    stiffness = axial_ratio(arm.arm()) ** 2
    for position, (printed, own) in enumerate(zip(SETPOINTS, arm.design_setpoints(), strict=True)):
        w = printed.w
        x = arc_end(w)
        tip = (x, float(w(x)))
        _, strain = equilibrium_load(own, stiffness, arm.actuators.force)
        held = tip_position(own, strain)
        bare = tip_position(own, np.zeros(1))
        bend = legendre.basis(np.linspace(0.0, 1.0, 201), own.curvature.size) @ own.curvature
        found.append(
            Shape(
                printed.name,
                arc_length(w, LENGTH_M),
                math.degrees(math.atan2(w(LENGTH_M), LENGTH_M)),
                float(w(LENGTH_M)),
                tip,
                math.degrees(math.atan2(tip[1], tip[0])),
                float(curvature(w, np.zeros(1))[0]),
                float(w.deriv(2)(x)),
                float(w.deriv(2)(LENGTH_M)),
                (float(held[0]), float(held[1])),
                math.degrees(math.atan2(held[1], held[0])),
                float(bend[0]),
                float(np.max(np.abs(bend))),
                float(np.hypot(held[0] - tip[0], held[1] - tip[1])),
                float(np.hypot(bare[0] - tip[0], bare[1] - tip[1])),
                _line_distance(w, position),
            )
        )
    return tuple(found)


def octarm_centre_line(position: int, count: int = 201) -> tuple[Array, Array]:
    """(s, points of shape (count, 2)) of the setpoint at that place of the arm file, held by its load."""
    arm = read_arm_file(DEFAULT_ARM)
    own = arm.design_setpoints()[position]
    _, strain = equilibrium_load(own, axial_ratio(arm.arm()) ** 2, arm.actuators.force)
    s = np.linspace(0.0, 1.0, count)
    rule, weights = legendre.gauss(GAUSS)
    points = np.empty((count, 2))
    for i, end in enumerate(s):
        at = end * rule
        theta = legendre.basis(at, own.angle.size) @ own.angle
        stretch = (1.0 + legendre.basis(at, strain.size) @ strain) * weights * end
        points[i] = stretch @ np.cos(theta), stretch @ np.sin(theta)
    return s, points


def _line_distance(w: Polynomial, position: int) -> float:
    arc, line = octarm_centre_line(position, 51)
    x = np.array([arc_end(w, float(s)) if s > 0.0 else 0.0 for s in arc])
    return float(np.max(np.hypot(line[:, 0] - x, line[:, 1] - w(x))))
