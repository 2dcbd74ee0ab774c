"""The shape that n commands really hold, as near as possible to the one that is wanted.

Between the equilibrium of a smooth load (`deploy.equilibrium`) and the reference of a run (`deploy.path`). The
segments' load is piecewise linear, and where the wanted load changes within a segment (setpoint 3) its L2
projection holds the tip a centimetre beside the wanted place. Here the commands are chosen by the shape instead:
least squares of the angle over the arm, with the exact statics, on a grid much finer than the segments'.

The load is transverse and dead, so the internal force is known before the shape: N = (0, N_y), N_y = the load
beyond s. What is left is one equation for the angle (theory, section 5),

    EI theta'' + N_y (1 + e) cos theta = 0,   EA e = N_y sin theta,   theta(0) = 0, theta'(L) = 0,

solved by Newton's method with a tridiagonal matrix; the commands by Gauss-Newton around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.linalg import solve_banded

from deploy.equilibrium import Equilibrium
from deploy.feedforward import holding, holding_commands, profiles
from deploy.grid import Place, SegmentGrid
from deploy.model import tangent_angle
from wire.artefact import Arm
from wire.errors import OctarmError

Array = npt.NDArray[np.float64]

CELLS = 800
"""Of the grid that the statics are solved on."""
NEWTON = 40
GAUSS_NEWTON = 12
CONVERGED = 1e-10
"""Change of the angle in rad, and of the commands relative to the largest, that ends an iteration."""
WEAKEST = 1e-5
"""Loads that turn the arm less than this share of the most effective one keep their first values."""


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
    angle_rad: Array | None = None
    """(CELLS,): for the next shape to start from."""


class Holder:
    """Finds commands and held shapes of an arm on a grid of segments, one shape after the other."""

    def __init__(self, arm: Arm, grid: SegmentGrid) -> None:
        self._arm, self._grid = arm, grid
        self._statics = _Statics(arm, grid) if arm.actuator == "transverse" else None

    def hold(self, curvature_per_m: Array, rest: Equilibrium, near: Held | None = None) -> Held:
        """Commands whose shape is as near as possible to this one, and the shape that they hold.

        curvature_per_m (Legendre series) and its equilibrium; `near`: a similar shape, to start from. Loads
        along the normal are chosen by their moment, to first order (`deploy.feedforward.holding`). Raises
        OctarmError if no shape is found.
        """
        grid = self._grid
        if self._statics is not None:
            first = holding_commands(rest.load_n_per_m, grid)
            angle = None if near is None else near.angle_rad
            return self._statics.hold(curvature_per_m, first, angle)
        found = holding(self._arm, curvature_per_m, rest.strain, rest.load_n_per_m, grid)
        outer, centre, inner = (
            2.0 * grid.locations_m(place) / grid.length_m - 1.0
            for place in (Place.OUTER_FACE, Place.CENTRE, Place.INNER_FACE)
        )
        return Held(
            command_n_per_m=found.commands_n_per_m,
            strain=legendre.legval(centre, rest.strain),
            curvature_per_m=legendre.legval(inner, curvature_per_m) + found.curvature_change_per_m,
            position_m=legendre.legval(outer, rest.position_m.T),
        )


class _Statics:
    """Shapes of an arm on a fine grid under the transverse loads of n segments."""

    def __init__(self, arm: Arm, grid: SegmentGrid) -> None:
        self._arm, self._grid = arm, grid
        self._step = arm.length_m / CELLS
        self.centres_m = (np.arange(CELLS) + 0.5) * self._step
        halves = (np.arange(2 * CELLS) + 0.5) * 0.5 * self._step
        pieces = profiles(grid, halves) * (0.5 * self._step)
        beyond = np.cumsum(pieces[::-1], axis=0)[::-1]
        self._force = beyond[1::2]  # (CELLS, n): N_y at the cells' centres per command
        self._ends = np.arange(CELLS + 1) * self._step

    def hold(
        self, curvature_per_m: Array, first_n_per_m: Array, angle_rad: Array | None = None
    ) -> Held:
        """Commands whose shape has nearly this curvature (Legendre series), and that shape.

        first_n_per_m: commands to start from, which matter only where they hardly turn the arm; angle_rad
        (CELLS,): a shape to start from. Raises OctarmError if no shape is found.
        """
        wanted = tangent_angle(curvature_per_m, self.centres_m, self._arm.length_m)
        command, angle = first_n_per_m, wanted if angle_rad is None else angle_rad
        angle, strain, matrix = self._shape(command, angle)
        misfit = float(np.linalg.norm(angle - wanted))
        for _ in range(GAUSS_NEWTON):
            turns = self._sensitivity(angle, strain, matrix)
            weight = WEAKEST * np.linalg.norm(turns, 2) * np.eye(len(command))
            change = np.linalg.lstsq(
                np.vstack([turns, weight]),
                np.concatenate([wanted - angle, weight @ (first_n_per_m - command)]),
                rcond=None,
            )[0]
            for _ in range(8):  # a step that makes the misfit larger is cut in half
                angle, strain, matrix = self._shape(command + change, angle)
                now = float(np.linalg.norm(angle - wanted))
                if now <= misfit * (1.0 + 1e-9) + 1e-12:
                    break
                change = 0.5 * change
            command, misfit = command + change, now
            if np.max(np.abs(change)) <= CONVERGED * max(np.max(np.abs(command)), 1e-6):
                break
        return self._held(command, angle, strain)

    def _shape(self, command: Array, angle: Array) -> tuple[Array, Array, Array]:
        """Angle and strain (CELLS,) under commands, and the Jacobian's bands (3, CELLS)."""
        arm, step = self._arm, self._step
        bending, axial = arm.bending_stiffness_n_m2, arm.axial_stiffness_n
        force = self._force @ command
        bands = np.full((3, CELLS), bending / step**2)
        for _ in range(NEWTON):
            sine, cosine = np.sin(angle), np.cos(angle)
            strain = force * sine / axial
            residual = bending * np.diff(self._curvature(angle)) / step
            residual += force * (1.0 + strain) * cosine
            bands[1] = -2.0 * bending / step**2
            bands[1] += force * (force * cosine**2 / axial - (1.0 + strain) * sine)
            bands[1, 0] -= bending / step**2
            bands[1, -1] += bending / step**2
            change = solve_banded((1, 1), bands, residual, check_finite=False)
            angle = angle - change
            if not np.isfinite(angle).all():
                break
            if np.max(np.abs(change)) < CONVERGED:
                return angle, force * np.sin(angle) / axial, bands
        raise OctarmError("no shape of the arm balances the load of the segments on the way")

    def _sensitivity(self, angle: Array, strain: Array, bands: Array) -> Array:
        """Change of the angle per command, (CELLS, n)."""
        pull = ((1.0 + 2.0 * strain) * np.cos(angle))[:, None] * self._force
        return np.asarray(solve_banded((1, 1), bands, -pull, check_finite=False))

    def _curvature(self, angle: Array) -> Array:
        """At the cells' ends (CELLS + 1,); the arm leaves the clamp straight, its tip bears no moment."""
        out = np.zeros(CELLS + 1)
        out[0] = 2.0 * angle[0] / self._step
        out[1:-1] = np.diff(angle) / self._step
        return out

    def _held(self, command: Array, angle: Array, strain: Array) -> Held:
        grid = self._grid
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
            angle_rad=angle,
        )
