"""The shape that n commands really hold, as near as possible to the one that is wanted.

Between the equilibrium of a smooth load (`deploy.equilibrium`) and the reference of a run (`deploy.path`).
The segments' load is piecewise linear, and where the wanted load changes within a segment (setpoint 3) its L2
projection holds the tip a centimetre beside the wanted place. Here the commands are chosen by the shape:
least squares of the angle over the arm, with the exact statics, on a grid much finer than the segments'.

The load is transverse and dead, so the internal force is known before the shape: N = (0, N_y), N_y = the load
beyond s. What is left is one equation for the angle (theory, section 5),

    EI theta'' + N_y (1 + e) cos theta = 0,   EA e = N_y sin theta,   theta(0) = 0, theta'(L) = 0,

solved by Newton's method with a tridiagonal matrix; the commands by Gauss-Newton around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.linalg import lapack

from deploy.equilibrium import SIZE, Equilibrium, equilibrium
from deploy.feedforward import holding, profiles, projection
from deploy.grid import Place, SegmentGrid
from deploy.model import tangent_angle
from wire.artefact import Arm
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

CELLS = 800
"""Of the grid that the statics are solved on."""
NEWTON = 40
GAUSS_NEWTON = 12
HALVINGS = 8
ANGLE_RAD = 1e-9
"""A change of the angle that ends Newton's method; it is quadratic, so the angle is exact to rounding then."""
CONVERGED = 1e-9
"""A change of the commands, relative to the largest, that ends Gauss-Newton."""
SMALLEST_N_PER_M = 1e-12
WEAKEST = 1e-5
"""Loads that turn the arm less than this share of the most effective one keep their first values."""

FAR_RAD = math.radians(15.0)
"""A shape whose angle is off by more somewhere is another one (two segments hold setpoint 3 to 11 degrees)."""
PARTS = 4
"""Shapes on the way to one that is not found at once."""


@dataclass(frozen=True, eq=False)
class Held:
    """What commands hold, where the nodes have their states."""

    command_n_per_m: Array
    """(n,)."""
    strain: Array
    """(n,) at the segments' centres."""
    curvature_per_m: Array
    """(n,) at the inner faces."""
    position_m: Array
    """(2, n): x and y of the outer faces."""
    misfit_n_per_m: Array | None = None
    """(n,) commands less the L2 projection of the smooth load."""
    angle_rad: Array | None = None
    """(CELLS,), both for the next shape to start from."""


class Holder:
    """Finds commands and held shapes of an arm on a grid of segments, one shape after the other."""

    def __init__(self, arm: Arm, grid: SegmentGrid) -> None:
        self._arm, self._grid = arm, grid
        self._statics = _Statics(arm, grid) if arm.actuator == "transverse" else None
        self._projection = projection(grid, SIZE)

    def hold(
        self, curvature_per_m: Array, rest: Equilibrium, what: str, near: Held | None = None
    ) -> Held:
        """Commands whose shape is as near as possible to this one, and the shape that they hold.

        curvature_per_m (Legendre series) and its equilibrium; `what`: its name in messages; `near`: a similar
        shape, to start from. Loads along the normal are chosen by their moment, to first order
        (`deploy.feedforward.holding`). Raises UsageError if no shape is found.
        """
        grid = self._grid
        if self._statics is not None:
            held = self._statics.hold(curvature_per_m, self.commands(rest.load_n_per_m), near)
            if held is None or self._statics.misfit_rad(held, curvature_per_m) > FAR_RAD:
                held = self._bent_in_parts(curvature_per_m, what)
            if held is None:
                raise UsageError(
                    f"{what}: {grid.nodes} segments hold no shape like it; use more nodes, or a curvature "
                    "that vanishes at the tip together with its slope"
                )
            return held
        found = holding(self._arm, curvature_per_m, rest.strain, rest.load_n_per_m, grid)
        outer, centre, inner = (
            2.0 * grid.locations_m(place) / grid.length_m - 1.0
            for place in (Place.OUTER_FACE, Place.CENTRE, Place.INNER_FACE)
        )
        return Held(
            command_n_per_m=found.commands_n_per_m,
            strain=_at(centre, rest.strain),
            curvature_per_m=_at(inner, curvature_per_m) + found.curvature_change_per_m,
            position_m=np.stack([_at(outer, one) for one in rest.position_m]),
        )

    def _bent_in_parts(self, curvature_per_m: Array, what: str) -> Held | None:
        """The same by way of less bent shapes: few segments need it, whose first commands hold another shape
        than the one that is wanted; None if that does not help."""
        if self._statics is None:
            return None
        held: Held | None = None
        for part in np.arange(1, PARTS + 1) / PARTS:
            curvature = part * curvature_per_m
            load = equilibrium(self._arm, curvature, what).load_n_per_m
            held = self._statics.hold(curvature, self.commands(load), held)
            if held is None or self._statics.misfit_rad(held, curvature) > FAR_RAD:
                return None
        return held

    def commands(self, load_n_per_m: Array) -> Array:
        """L2 projection (n,) of a load, a series of `SIZE` coefficients."""
        return np.asarray(self._projection @ load_n_per_m)


@dataclass(frozen=True, eq=False)
class _Shape:
    """A shape at rest on the fine grid, and what is needed for its change with the load; all (CELLS,)."""

    angle: Array
    strain: Array
    beside: Array
    """(CELLS - 1,): the Jacobian's other diagonals."""
    diagonal: Array
    pull: Array
    """Of the balance by the force N_y."""

    def turns(self, force: Array) -> Array:
        """Change of the angle (CELLS, n) per command; force: N_y (CELLS, n) per command."""
        return _tridiagonal(self.beside, self.diagonal, -self.pull[:, None] * force)


def _tridiagonal(beside: Array, diagonal: Array, right: Array) -> Array:
    return np.asarray(lapack.dgtsv(beside, diagonal, beside, right)[3], dtype=np.float64)


def _at(places: Array, series: Array) -> Array:
    return np.asarray(legendre.legval(places, series), dtype=np.float64)


class _Statics:
    """Shapes of an arm on a fine grid under the transverse loads of n segments."""

    def __init__(self, arm: Arm, grid: SegmentGrid) -> None:
        self._arm, self._grid = arm, grid
        self._step = arm.length_m / CELLS
        self.centres_m: Array = np.linspace(0.5, CELLS - 0.5, CELLS) * self._step
        halves = np.linspace(0.25, CELLS - 0.25, 2 * CELLS) * self._step
        pieces = profiles(grid, halves) * (0.5 * self._step)
        beyond = np.cumsum(pieces[::-1], axis=0)[::-1]
        self._force = beyond[1::2]  # (CELLS, n): N_y at the cells' centres per command
        self._ends = np.arange(CELLS + 1) * self._step

    def hold(self, curvature_per_m: Array, first_n_per_m: Array, near: Held | None) -> Held | None:
        """Commands whose shape has nearly this curvature (Legendre series), and that shape; None if not found.

        first_n_per_m: commands to start from, which matter only where they hardly turn the arm; near: a similar
        shape, to start from it instead.
        """
        wanted = tangent_angle(curvature_per_m, self.centres_m, self._arm.length_m)
        command, start = first_n_per_m, wanted
        if near is not None and near.misfit_n_per_m is not None and near.angle_rad is not None:
            command, start = first_n_per_m + near.misfit_n_per_m, near.angle_rad
        shape = self._shape(command, start)
        if shape is None:
            return None
        for _ in range(GAUSS_NEWTON):
            turns = shape.turns(self._force)
            # least squares of the misfit, with a little weight on the distance from the first commands
            left, singular, right = np.linalg.svd(turns, full_matrices=False)
            weight = (WEAKEST * singular[0]) ** 2
            turn = singular * (left.T @ (wanted - shape.angle))
            change = right.T @ (
                (turn + weight * (right @ (first_n_per_m - command))) / (singular**2 + weight)
            )
            misfit = float(np.linalg.norm(shape.angle - wanted))
            for _ in range(HALVINGS):  # a step that makes the misfit larger is cut in half
                after = self._shape(command + change, shape.angle)
                if after is not None:
                    now = float(np.linalg.norm(after.angle - wanted))
                    if now <= misfit * (1.0 + 1e-6) + 1e-9:
                        break
                change = 0.5 * change
            if after is None:
                break
            command, shape = command + change, after
            if np.max(np.abs(change)) <= CONVERGED * np.max(np.abs(command)) + SMALLEST_N_PER_M:
                break
        return self._held(command, first_n_per_m, shape)

    def misfit_rad(self, held: Held, curvature_per_m: Array) -> float:
        """How far the held shape's angle is from that of the wanted curvature, at the worst place."""
        if held.angle_rad is None:
            return math.inf
        wanted = tangent_angle(curvature_per_m, self.centres_m, self._arm.length_m)
        return float(np.max(np.abs(held.angle_rad - wanted)))

    def _shape(self, command: Array, angle: Array) -> _Shape | None:
        """The shape under commands, None if Newton's method does not find it from this angle (CELLS,)."""
        arm, step = self._arm, self._step
        bending, axial = arm.bending_stiffness_n_m2 / step**2, arm.axial_stiffness_n
        force = self._force @ command
        beside = np.full(CELLS - 1, bending)
        for _ in range(NEWTON):
            sine, cosine = np.sin(angle), np.cos(angle)
            strain = force * sine / axial
            residual = bending * step * np.diff(self._curvature(angle))
            residual += force * (1.0 + strain) * cosine
            diagonal = force * (force * cosine**2 / axial - (1.0 + strain) * sine) - 2.0 * bending
            diagonal[0] -= bending
            diagonal[-1] += bending
            change = _tridiagonal(beside, diagonal, residual)
            angle = angle - change
            largest = float(np.max(np.abs(change)))
            if not largest < math.pi:  # nor if it is no number
                return None
            if largest < ANGLE_RAD:
                pull = (1.0 + 2.0 * strain) * cosine
                return _Shape(angle, force * np.sin(angle) / axial, beside, diagonal, pull)
        return None

    def _curvature(self, angle: Array) -> Array:
        """At the cells' ends (CELLS + 1,); the arm leaves the clamp straight, its tip bears no moment."""
        out = np.zeros(CELLS + 1)
        out[0] = 2.0 * angle[0] / self._step
        out[1:-1] = np.diff(angle) / self._step
        return out

    def _held(self, command: Array, first: Array, shape: _Shape) -> Held:
        grid, angle, strain = self._grid, shape.angle, shape.strain
        edges = self._step * (1.0 + strain) * np.stack([np.cos(angle), np.sin(angle)])
        places = np.hstack([np.zeros((2, 1)), np.cumsum(edges, axis=1)])
        outer = grid.locations_m(Place.OUTER_FACE)
        return Held(
            command_n_per_m=command,
            strain=np.interp(grid.locations_m(Place.CENTRE), self.centres_m, strain),
            curvature_per_m=np.interp(
                grid.locations_m(Place.INNER_FACE), self._ends, self._curvature(angle)
            ),
            position_m=np.stack([np.interp(outer, self._ends, one) for one in places]),
            misfit_n_per_m=command - first,
            angle_rad=angle,
        )
