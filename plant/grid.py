"""The plant's staggered grid: where its samples lie, how segments read and load them.

Stands between the segments' faces (the deployment's numbers) and the grid of the emulated arm,
which is finer and need not share a point with them. Everything here is made once, when the plant is
made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wire.errors import UsageError, shown

Array = npt.NDArray[np.float64]

CELLS_PER_SEGMENT = 4
"""The plant's grid is at least this much finer than the controller's (theory, section 6)."""
FEWEST_DEFAULT_CELLS = 40
CHAPTER_CELLS = 10
"""The grid of the source chapter (its section 4.1)."""
MOST_CHAPTER_CELLS = 400
"""All eigenvalues of its matrices are asked for."""
MOST_CELLS = 4000
"""Matrices of the grid have the square of it numbers, and substeps shrink with its square."""
_STENCIL = 4  # samples in one interpolation: local cubic polynomials


def plant_cells(segments: int, asked: int | None = None, *, exact: bool = True) -> int:
    """Number of cells of the plant's grid for a number of segments.

    Without `asked` it is max(40, 4 segments). Raises UsageError if fewer than 4 cells a segment are
    asked for (the plant would then share the controller's discretisation error and prove nothing
    about it), or more than `MOST_CELLS`. The source chapter's models (not `exact`) are for its own grid of
    10 cells, or one a segment if there are more segments, and take 4 to `MOST_CHAPTER_CELLS`.
    """
    if not exact:
        if asked is None:
            return min(max(CHAPTER_CELLS, segments), MOST_CHAPTER_CELLS)
        if not _STENCIL <= asked <= MOST_CHAPTER_CELLS:
            raise UsageError(
                f"plant cells: expected {_STENCIL}..{MOST_CHAPTER_CELLS} for the chapter's models, got "
                f"{shown(asked)}"
            )
        return asked
    fewest = max(_STENCIL, CELLS_PER_SEGMENT * segments)
    if asked is None:
        return max(FEWEST_DEFAULT_CELLS, fewest)
    if asked < fewest:
        raise UsageError(
            f"plant cells: expected at least {fewest} ({CELLS_PER_SEGMENT} for each of the "
            f"{segments} segments), got {shown(asked)}; ask for more cells or fewer segments"
        )
    if asked > MOST_CELLS:
        raise UsageError(f"plant cells: expected at most {MOST_CELLS}, got {shown(asked)}")
    return asked


def check_faces(faces_m: Sequence[float], length_m: float) -> tuple[float, ...]:
    """The faces s_0 = 0 < s_1 < ... < s_n = L as a tuple; UsageError names the first wrong one."""
    faces = tuple(float(face) for face in faces_m)
    if len(faces) < 2:
        raise UsageError(f"faces_m: expected at least 2 faces (0 and the length), got {len(faces)}")
    for index, face in enumerate(faces):
        if not math.isfinite(face) or (index > 0 and face <= faces[index - 1]):
            raise UsageError(
                f"faces_m[{index}]: expected a finite arclength greater than the one before, got "
                f"{face!r}; list the faces from the root to the tip"
            )
    tolerance = 1e-9 * length_m
    if abs(faces[0]) > tolerance or abs(faces[-1] - length_m) > tolerance:
        raise UsageError(
            f"faces_m: expected to start at 0 and end at the length {length_m!r} m, got "
            f"{faces[0]!r} and {faces[-1]!r}"
        )
    return faces


@dataclass(frozen=True)
class Grid:
    """A uniform staggered grid of `cells` cells on [0, length_m].

    Positions and velocities live at `nodes_m`, stretch and angle at `centres_m`, curvature at
    `nodes_m`: the difference of the angles beside a node, at the clamp that of the first angle and
    0 over half a cell, at the free tip 0. The curvature at the clamp is second order too: it
    carries the moment at the root itself, and the slope of the curvature that the half cell leaves
    out offsets the angles by the square of the step.
    """

    cells: int
    length_m: float

    @property
    def step_m(self) -> float:
        """Length of one cell."""
        return self.length_m / self.cells

    @property
    def nodes_m(self) -> Array:
        """Arclengths of the grid nodes 0..cells, shape (cells + 1,)."""
        return np.linspace(0.0, self.length_m, self.cells + 1)

    @property
    def centres_m(self) -> Array:
        """Arclengths of the cell centres, shape (cells,)."""
        half = 0.5 * self.step_m
        return np.linspace(half, self.length_m - half, self.cells)

    @property
    def weights_m(self) -> Array:
        """Length that each free grid node 1..cells stands for, shape (cells,); half at the tip."""
        weights = np.full(self.cells, self.step_m)
        weights[-1] *= 0.5
        return weights

    @property
    def curvature_lengths_m(self) -> Array:
        """Length over which the angle changes at grid nodes 0..cells-1, shape (cells,)."""
        lengths = np.full(self.cells, self.step_m)
        lengths[0] *= 0.5
        return lengths


def interpolation_matrix(points: Array, samples: Array) -> Array:
    """Matrix (points, samples) of interpolation by the cubic through the four samples around.

    `samples` must increase. Points outside take the outermost cubic. Fourth order in the
    distance of the samples.
    """
    width = min(_STENCIL, samples.size)
    matrix = np.zeros((points.size, samples.size))
    first = np.clip(np.searchsorted(samples, points) - width // 2, 0, samples.size - width)
    for row, (point, start) in enumerate(zip(points, first, strict=True)):
        stencil = samples[start : start + width]
        for column in range(width):
            others = np.delete(stencil, column)
            matrix[row, start + column] = np.prod((point - others) / (stencil[column] - others))
    return matrix


def load_matrix(faces_m: Array, grid: Grid) -> Array:
    """Matrix (cells, segments): force in N on the free grid nodes 1..cells per command of 1 N/m.

    The load is linear in s between the commands at the outer faces s_1..s_n and constant on [0,
    s_1]. The nodal forces are its virtual work against grid-wise linear velocities, integrated
    exactly (two Gauss points between neighbours among all faces and grid nodes).
    """
    nodes = grid.nodes_m
    breaks = np.unique(np.concatenate([nodes, np.clip(faces_m, 0.0, grid.length_m)]))
    middle, half = 0.5 * (breaks[1:] + breaks[:-1]), 0.5 * np.diff(breaks)
    offset = half / math.sqrt(3.0)
    points = np.concatenate([middle - offset, middle + offset])
    weights = np.concatenate([half, half])
    outer = faces_m[1:]
    loads = np.stack([np.interp(points, outer, row) for row in np.eye(outer.size)], axis=1)
    hats = np.stack([np.interp(points, nodes, row) for row in np.eye(nodes.size)], axis=1)
    return np.asarray((hats * weights[:, None]).T @ loads)[1:]
