"""How far the estimated arm lies from the true one, in metres: shapes rebuilt from node states.

The second measure of the estimation beside the energy norm. That norm weighs a bending mode by the
curvature in it, so it counts motion that is too fast for the grid as much as motion that moves the
arm; a distance counts only what can be seen. Pure mathematics between `analysis.recording` and
`analysis.open_loop`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from deploy import Place, SegmentGrid
from wire.channels import STATE
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

STRAIN, CURVATURE = STATE.index("strain"), STATE.index("curvature_per_m")


def face_positions(states: Array, faces_m: Array) -> Array:
    """Where the segments' outer faces are, from absolute node states (theory, sections 2 and 6).

    The clamp is at (0, 0), the arm leaves it along x. On the staggered grid the curvature of an
    inner face, times the width of its dual cell, turns the tangent from one segment's centre to the
    next, and each segment is straight:

        theta_i = sum_{j <= i} k_j dual_j,   r_i = sum_{j <= i} (1 + e_j) (cos, sin)(theta_j) width_j.

    states: (..., n, 4), strain 1 and curvature 1/m as in `wire.channels.STATE`; faces_m: (n + 1,).
    Returns (..., n, 2), x and y in m, root to tip. NaN in a node's state is NaN from there on.
    Raises UsageError if the shapes do not fit.
    """
    if states.shape[-2:] != (faces_m.size - 1, len(STATE)):
        raise UsageError(
            f"face positions: expected states of shape (..., {faces_m.size - 1}, {len(STATE)}) for "
            f"{faces_m.size} faces, got {states.shape}"
        )
    grid = SegmentGrid(faces_m)
    angle = np.cumsum(states[..., CURVATURE] * grid.dual_widths_m(Place.INNER_FACE), axis=-1)
    length = (1.0 + states[..., STRAIN]) * grid.cell_widths_m
    steps = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)
    positions: Array = np.cumsum(steps, axis=-2)
    return positions


def shape_error(estimates: Array, truth: Array, faces_m: Array) -> Array:
    """Root-mean-square distance of estimated and true outer faces, in m, shape (...).

    estimates, truth: (..., n, 4), absolute, SI. Both are rebuilt by `face_positions`, so that what
    the straight segments leave out of the arm's shape is in both and cancels.
    """
    apart = face_positions(estimates, faces_m) - face_positions(truth, faces_m)
    squares: Array = np.mean(np.sum(apart**2, axis=-1), axis=-1)
    return np.sqrt(squares)
