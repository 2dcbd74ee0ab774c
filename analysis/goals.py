"""What the arm was asked for in a run: setpoints with their sectors and colours, active setpoint, reference.

Between `analysis.recording` and everything that draws or tells what the arm did: the plot, the
animation and the summary.
"""

from __future__ import annotations

import math
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


def sectors(recording: Recording) -> dict[int, tuple[float, float]]:
    """Per setpoint that the run visits (its index) the sector of the tip's polar angle that is its, rad.

    Boundaries are those of the run's scheduling, midway between neighbours' tips (theory, section 5); the
    outermost sectors, which have no end, are drawn as far beyond their tip as within. A single setpoint
    has none.
    """
    scheduling = recording.configuration.scheduling
    if len(scheduling.setpoints) < 2:
        return {}
    tips = [recording.artefact.setpoints[index].tip_m for index in scheduling.setpoints]
    angles = [math.atan2(y, x) for x, y in tips]
    between = [math.radians(degrees) for degrees in scheduling.boundaries_deg]
    edges = [2.0 * angles[0] - between[0], *between, 2.0 * angles[-1] - between[-1]]
    return dict(zip(scheduling.setpoints, pairwise(edges), strict=True))


def visited(recording: Recording) -> list[int]:
    """Indices of the setpoints that the run visits, by increasing angle of their tips."""
    return list(recording.configuration.scheduling.setpoints)


def active_setpoints(recording: Recording) -> Ints:
    """Index of the setpoint whose gains are in use at each tick, (K,); kept where a tick is missing."""
    used = recording.setpoints_used
    latest = np.maximum.accumulate(np.where(used >= 0, np.arange(used.size), -1))
    kept = used[np.maximum(latest, 0)]
    return np.where(latest >= 0, kept, recording.configuration.setpoint_index).astype(np.int64)


def reference_tips(recording: Recording) -> Array:
    """Where the tip was asked to be at each tick, (K, 2) in m."""
    return recording.of_plant("tip", ("reference_x_m", "reference_y_m"))
