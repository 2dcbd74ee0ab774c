"""Smooth arms through the states of the nodes, for pictures: what a node's few numbers say of the whole arm.

Between a recording and `analysis.scene`. Measures of the estimate use `analysis.shape_error` instead, whose
straight segments are what the nodes themselves reckon with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.interpolate import CubicSpline

from analysis.recording import Recording
from deploy import Place, SegmentGrid
from deploy.equilibrium import equilibrium
from deploy.held import Held, Holder
from deploy.path import curvature_path
from wire.channels import STATE
from wire.reference import progress

Array = npt.NDArray[np.float64]

STRAIN, CURVATURE = STATE.index("strain"), STATE.index("curvature_per_m")


@dataclass(frozen=True, eq=False)
class Near:
    """A whole arm that the estimated one is near to: what the commands of the reference hold."""

    angle: Callable[[Array], Array]
    """Of the tangent at arclengths in m, rad."""
    strain: Callable[[Array], Array]
    """At arclengths in m."""
    node_curvature_per_m: Array
    """(n,) at the inner faces."""


def arm_curve(state: Array, faces_m: Array, near: Near, points: int = 257) -> Array:
    """One arm through absolute node states (n, 4): (points, 2), x and y in m, root to tip.

    What the nodes say differently from the near arm is taken as smooth in between: of the curvature a cubic
    spline between the inner faces that ends in the free tip's zero, of the strain straight lines between the
    segments' centres. So a shape that bends within less than a segment keeps its form, which is worth 2 cm
    of the tip at setpoint 3 and ten segments. NaN in the state is NaN throughout.
    """
    if not np.isfinite(state).all():
        return np.full((points, 2), np.nan)
    s = np.linspace(0.0, float(faces_m[-1]), points)
    middle = 0.5 * (s[1:] + s[:-1])
    centres = SegmentGrid(faces_m).locations_m(Place.CENTRE)
    bend = CubicSpline(faces_m, np.append(state[:, CURVATURE] - near.node_curvature_per_m, 0.0))
    angle = near.angle(middle) + bend.antiderivative()(middle)
    stretch = np.interp(middle, centres, state[:, STRAIN] - near.strain(centres))
    lengths = (1.0 + near.strain(middle) + stretch) * np.diff(s)
    steps = lengths[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


class References:
    """The arms that the commands of a run's reference hold, one time after the other."""

    def __init__(self, recording: Recording):
        run, artefact = recording.configuration, recording.artefact
        self._arm, self._length = artefact.arm, artefact.arm.length_m
        self._holder = Holder(artefact.arm, SegmentGrid(np.asarray(run.faces_m)))
        self._held: Held | None = None
        self._latest: tuple[tuple[int, float], Near] | None = None
        begin, here = run.first_hold_s, run.setpoint
        self._moves = [(0.0, 0.0, curvature_path(artefact, (here,)))]
        for leg in run.legs:
            path = curvature_path(artefact, (here, *leg.through, leg.to))
            self._moves.append((begin, leg.move_s, path))
            begin, here = begin + leg.move_s + leg.hold_s, leg.to

    def at(self, time_s: float) -> Near:
        """The arm at rest on the way where the reference is at this time."""
        index = max(i for i, move in enumerate(self._moves) if move[0] <= time_s + 1e-9)
        begin, move_s, path = self._moves[index]
        fraction = min(1.0, max(0.0, (time_s - begin) / move_s)) if move_s > 0.0 else 0.0
        if self._latest is None or self._latest[0] != (index, fraction):
            near = self._near(path(progress(fraction)[0]), f"reference at {time_s:g} s")
            self._latest = (index, fraction), near
        return self._latest[1]

    def _near(self, curvature: Array, what: str) -> Near:
        rest = equilibrium(self._arm, curvature, what)
        self._held = held = self._holder.hold(curvature, rest, what, self._held)
        turned: Array = np.asarray(0.5 * self._length * legendre.legint(curvature, lbnd=-1))

        def along(series: Array) -> Callable[[Array], Array]:
            return lambda s: np.asarray(legendre.legval(2.0 * s / self._length - 1.0, series))

        if held.angle_rad is None:
            angle = along(turned)
        else:
            cells = len(held.angle_rad)
            places = (np.arange(cells) + 0.5) * self._length / cells
            angle = CubicSpline(np.append(0.0, places), np.append(0.0, held.angle_rad))
        return Near(angle, along(rest.strain), held.curvature_per_m)


def estimated_arms(recording: Recording, ticks: Sequence[int], points: int = 257) -> Array:
    """The arm as the nodes estimate it at these ticks, (ticks, points, 2), x and y in m, root to tip."""
    faces = np.asarray(recording.configuration.faces_m)
    references, states = References(recording), recording.estimates
    return np.stack(
        [arm_curve(states[k], faces, references.at(k * recording.tick_s), points) for k in ticks]
    )
