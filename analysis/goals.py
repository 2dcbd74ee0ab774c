"""What the arm was asked for in a run: setpoints with their sectors and colours, active setpoint, reference.

Between `analysis.recording` and everything that draws or tells what the arm did: the plot, the
animation and the summary.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording
from wire.artefact import Setpoint

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Of the setpoints, in the artefact's order (Okabe and Ito: safe for colour-blind readers)."""


def colour(index: int) -> str:
    """The colour of a setpoint by its place in the artefact; they repeat after six."""
    return COLOURS[index % len(COLOURS)]


def setpoint_shape(setpoint: Setpoint, length_m: float, points: int = 401) -> Array:
    """Positions along the arm at the setpoint, (points, 2) in m, by integrating its curvature."""
    s = np.linspace(0.0, length_m, points)
    middle = 0.5 * (s[1:] + s[:-1])
    x = 2.0 * middle / length_m - 1.0
    legendre = np.polynomial.legendre
    angle = legendre.legval(x, 0.5 * length_m * legendre.legint(setpoint.curvature_per_m, lbnd=-1))
    stretched = (1.0 + legendre.legval(x, np.asarray(setpoint.strain))) * np.diff(s)
    steps = stretched[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def sectors(setpoints: Sequence[Setpoint]) -> dict[int, tuple[float, float]]:
    """Per setpoint (its index) the sector of the tip's polar angle in which it is active, rad.

    Boundaries lie midway between the angles of neighbouring setpoints' tips (theory, section 5); the
    outermost sectors, which have no end, are drawn as far beyond their tip as within. A single
    setpoint has none.
    """
    angles = [math.atan2(s.tip_m[1], s.tip_m[0]) for s in setpoints]
    order = sorted(range(len(angles)), key=angles.__getitem__)
    if len(order) < 2:
        return {}
    middles = [0.5 * (angles[a] + angles[b]) for a, b in pairwise(order)]
    first = 2.0 * angles[order[0]] - middles[0]
    last = 2.0 * angles[order[-1]] - middles[-1]
    edges = [first, *middles, last]
    return {index: (edges[i], edges[i + 1]) for i, index in enumerate(order)}


def active_setpoints(recording: Recording) -> Ints:
    """Index of the setpoint whose gains are in use at each tick, (K,)."""
    return np.full(recording.ticks, recording.configuration.setpoint_index, dtype=np.int64)


def reference_tips(recording: Recording) -> Array:
    """Where the tip was asked to be at each tick, (K, 2) in m: the recorded path, or the setpoint's tip."""
    setpoint = recording.artefact.setpoints[recording.configuration.setpoint_index]
    return np.tile(np.asarray(setpoint.tip_m, dtype=np.float64), (recording.ticks, 1))
