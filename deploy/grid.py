"""The segment grid: where each node's state, measurement and command live (first step of deploy).

Segment i (0 .. n-1 in code) is the cell [faces[i], faces[i+1]]. Its node holds a velocity at the
outer face faces[i+1], an axial strain at the cell's centre and a curvature at the inner face
faces[i]; it measures v_y and k at these places and commands a load at the outer face
(theory, section 5: staggered grid).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from wire.errors import UsageError

if TYPE_CHECKING:
    from wire.artefact import Arm

Array = npt.NDArray[np.float64]

SMALLEST_CELL = 1e-6
"""Shortest segment that is accepted, as a fraction of the arm's length."""


class Spacing(StrEnum):
    """The named ways to place the segment boundaries."""

    EQUISPACED = "equispaced"
    CHEBYSHEV = "chebyshev"
    """Faces at L/2 (1 - cos(pi i / n)): short segments at root and tip, long ones in the middle."""


class Place(Enum):
    """Where on a segment a quantity lives."""

    OUTER_FACE = "outer face"
    CENTRE = "centre"
    INNER_FACE = "inner face"


STATE_PLACES = (Place.OUTER_FACE, Place.OUTER_FACE, Place.CENTRE, Place.INNER_FACE)
"""Places of a node's state (v_x, v_y, e, k)."""
MEASUREMENT_PLACES = (Place.OUTER_FACE, Place.INNER_FACE)
"""Places of a node's measurement (v_y, k)."""
MEASURED_STATES = [1, 3]
"""Which components of the state are measured."""
COMMAND_PLACES = (Place.OUTER_FACE,)
"""Place of a node's command, a load in N/m (`Arm.actuator`)."""


@dataclass(frozen=True, eq=False)
class SegmentGrid:
    """Segment boundaries in m, root to tip, shape (n + 1,); first 0, last the arm's length."""

    faces_m: Array

    @property
    def nodes(self) -> int:
        """The number of segments n."""
        return len(self.faces_m) - 1

    @property
    def length_m(self) -> float:
        """The arm's length."""
        return float(self.faces_m[-1])

    @property
    def cell_widths_m(self) -> Array:
        """Lengths of the segments, shape (n,)."""
        return np.diff(self.faces_m)

    @property
    def centres_m(self) -> Array:
        """Middles of the segments, shape (n,)."""
        return 0.5 * (self.faces_m[:-1] + self.faces_m[1:])

    def locations_m(self, place: Place) -> Array:
        """Arclengths of one kind of place, node by node, shape (n,)."""
        match place:
            case Place.OUTER_FACE:
                return self.faces_m[1:]
            case Place.CENTRE:
                return self.centres_m
            case Place.INNER_FACE:
                return self.faces_m[:-1]

    def dual_cells_m(self, place: Place) -> tuple[Array, Array]:
        """Start and end, each (n,), of the piece of arm that a value at each place stands for.

        A strain stands for its segment; a velocity or curvature for the stretch between the centres
        beside its face, which at root and tip is half a segment. The first half segment is left out
        for velocities, the last for curvatures: v(0) = 0 and k(L) = 0.
        """
        middle = self.centres_m
        match place:
            case Place.OUTER_FACE:
                return middle, np.append(middle[1:], self.length_m)
            case Place.CENTRE:
                return self.faces_m[:-1], self.faces_m[1:]
            case Place.INNER_FACE:
                return np.append(0.0, middle[:-1]), middle

    def dual_widths_m(self, place: Place) -> Array:
        """Lengths of the dual cells of one kind of place, shape (n,)."""
        start, end = self.dual_cells_m(place)
        return end - start

    def energy_weights(self, arm: Arm) -> Array:
        """Weights w (n, 4) such that sum(w * x**2) is the energy in J of a deviation x (n, 4).

        x = (v_x, v_y, e, k) in SI; the halves of kinetic, axial and bending energy are in w.
        """
        mass = arm.mass_per_length_kg_per_m * self.dual_widths_m(Place.OUTER_FACE)
        axial = arm.axial_stiffness_n * self.dual_widths_m(Place.CENTRE)
        bending = arm.bending_stiffness_n_m2 * self.dual_widths_m(Place.INNER_FACE)
        return 0.5 * np.stack([mass, mass, axial, bending], axis=1)


def make_grid(length_m: float, nodes: int, spacing: str | Sequence[float]) -> SegmentGrid:
    """Place n segments on an arm.

    `spacing` is the name of a `Spacing` or the n + 1 faces in m themselves, from 0 to the arm's
    length. Raises UsageError if there are fewer than 2 nodes or the faces are not a division of the
    arm.
    """
    if isinstance(nodes, bool) or not isinstance(nodes, int | np.integer) or nodes < 2:
        raise UsageError(
            f"number of nodes: expected a whole number of at least 2, got {nodes!r}; "
            "a chain needs a root and a tip segment"
        )
    if isinstance(spacing, str):
        return SegmentGrid(_named_faces(length_m, int(nodes), spacing))
    return SegmentGrid(_given_faces(length_m, int(nodes), spacing))


def _named_faces(length_m: float, nodes: int, spacing: str) -> Array:
    fractions = np.arange(nodes + 1) / nodes
    match spacing:
        case Spacing.EQUISPACED:
            faces = length_m * fractions
        case Spacing.CHEBYSHEV:
            faces = 0.5 * length_m * (1.0 - np.cos(math.pi * fractions))
        case _:
            names = ", ".join(repr(s.value) for s in Spacing)
            raise UsageError(
                f"spacing: expected {names} or a list of {nodes + 1} faces in m, got {spacing!r}"
            )
    faces[0], faces[-1] = 0.0, length_m
    return faces


def _given_faces(length_m: float, nodes: int, spacing: Sequence[float]) -> Array:
    try:
        faces = np.array(spacing, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"spacing: expected a list of numbers in m, got {spacing!r}") from None
    if faces.ndim != 1 or len(faces) != nodes + 1:
        raise UsageError(
            f"spacing: {nodes} nodes need {nodes + 1} faces in m from root to tip, "
            f"got {faces.size if faces.ndim == 1 else f'an array of shape {faces.shape}'}"
        )
    if not np.all(np.isfinite(faces)):
        place = int(np.flatnonzero(~np.isfinite(faces))[0])
        raise UsageError(f"spacing: face {place} is {faces[place]}, expected a finite number in m")
    slack = 1e-9 * length_m
    if abs(faces[0]) > slack or abs(faces[-1] - length_m) > slack:
        raise UsageError(
            f"spacing: faces must start at 0 and end at the arm's length {length_m:g} m, "
            f"got {faces[0]:g} to {faces[-1]:g} m"
        )
    faces[0], faces[-1] = 0.0, length_m
    short = np.flatnonzero(np.diff(faces) < SMALLEST_CELL * length_m)
    if len(short):
        place = int(short[0])
        raise UsageError(
            f"spacing: faces must increase by at least {SMALLEST_CELL * length_m:g} m, "
            f"but face {place} is at {faces[place]:g} m, face {place + 1} at {faces[place + 1]:g} m"
        )
    return faces
