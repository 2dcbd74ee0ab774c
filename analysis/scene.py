"""One picture of the arm in the plane: true and estimated shape, reference, setpoints, at one tick.

Between a recording and `analysis.animate`, which makes a film of such pictures. What stands still is drawn
once, what moves is drawn over it, so that a frame takes milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge

from analysis.estimated_arm import estimated_arms
from analysis.goals import (
    active_setpoints,
    colour,
    reference_tips,
    sectors,
    setpoint_shape,
    visited,
)
from analysis.recording import Recording

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

WIDTH_IN = 4.8
LEFT_IN, RIGHT_IN, TOP_IN, BOTTOM_IN = 0.52, 0.10, 0.36, 0.86
MARGIN = 0.05
"""Free space around everything, share of the arm's length."""
SECTOR = 1.03
"""Radius of the sectors over the distance of the farthest setpoint's tip."""
LETTER = 0.03
"""Room for a letter of a setpoint's name, share of the arm's length."""
TRAIL = 25
"""Number of frames for which the tip's path stays to be seen."""
STYLE = {
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "path.simplify": False,
}
INK, GREY, ROOT = "#111111", "#777777", "#444444"


class Scene:
    """The picture of one recording; `draw` gives its pixels at a tick."""

    def __init__(self, recording: Recording, ticks: Sequence[int], width_px: int, note: str = ""):
        """Prepare the frames at the given ticks; note: a few words in the corner."""
        artefact = recording.artefact
        chosen = np.asarray(ticks)
        self._ticks = {int(k): i for i, k in enumerate(ticks)}
        self._times = recording.times_s[chosen]
        self._shapes = recording.shapes_m[chosen]
        self._estimates = estimated_arms(recording, chosen.tolist())
        self._tips = recording.shapes_m[:, -1]
        self._trail_ticks = TRAIL * max(1, int(np.median(np.diff(chosen))))
        self._errors = recording.tip_error_m[chosen]
        self._active = active_setpoints(recording)[chosen]
        self._path = reference_tips(recording)
        self._reference = self._path[chosen]
        self._names = [setpoint.name for setpoint in artefact.setpoints]
        self._setpoints = artefact.setpoints
        self._length = artefact.arm.length_m
        self._sectors = sectors(recording)
        self._visited = visited(recording)
        with mpl.rc_context(STYLE):
            self._build(width_px, note)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = self._canvas.get_width_height()
        return int(width), int(height)

    @property
    def figure(self) -> Figure:
        """The figure behind the pictures."""
        figure: Figure = self._canvas.figure
        return figure

    def _build(self, width_px: int, note: str) -> None:
        low, high = self._limits()
        span = high - low
        wide = WIDTH_IN - LEFT_IN - RIGHT_IN
        tall = wide * float(span[1] / span[0])
        height = TOP_IN + tall + BOTTOM_IN
        dpi = width_px / WIDTH_IN
        figure = Figure(figsize=(WIDTH_IN, round(height * dpi) / dpi), dpi=dpi)
        self._canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes(
            (LEFT_IN / WIDTH_IN, BOTTOM_IN / height, wide / WIDTH_IN, tall / height)
        )
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
        ax.xaxis.labelpad = ax.yaxis.labelpad = 2.0
        ax.set_aspect("equal")
        ax.set_axisbelow(True)
        ax.grid(visible=True, linewidth=0.4, color="#DDDDDD")
        ax.spines[["top", "right"]].set_visible(False)
        self._wedges = self._draw_setpoints(ax)
        if np.ptp(self._path, axis=0).max() > 1e-6:
            ax.plot(*self._path.T, color=GREY, linewidth=0.9, linestyle=(0, (1, 1.5)))
        ax.plot(0.0, 0.0, marker="s", markersize=7, color=ROOT, clip_on=False, zorder=6)
        self._moving: list[Any] = list(self._wedges.values())
        self._trail = self._line(ax, GREY, 0.9)
        self._arm = self._line(ax, INK, 4.5, solid_capstyle="round", zorder=4)
        self._estimate = self._line(ax, INK, 1.2, linestyle=(0, (3, 2)), zorder=5)
        self._aim = self._line(
            ax, INK, 0.0, marker="o", markersize=8, markerfacecolor="none", zorder=7
        )
        top = 1.0 - 0.5 * TOP_IN / height
        left = LEFT_IN / WIDTH_IN
        place: dict[str, Any] = {"va": "center", "animated": True}
        self._time = figure.text(left, top, "", ha="left", **place)
        self._error = figure.text(left + 0.25, top, "", ha="left", **place)
        self._named = figure.text(
            1.0 - RIGHT_IN / WIDTH_IN, top, "", ha="right", weight="bold", **place
        )
        self._moving += [self._time, self._error, self._named]
        if note:
            bottom = 0.09 / height
            figure.text(
                1.0 - RIGHT_IN / WIDTH_IN, bottom, note, ha="right", va="bottom", color=GREY, size=8
            )
        self._legend(figure, height)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)

    def _limits(self) -> tuple[Array, Array]:
        """Corners of what is shown, (2,) each, in m."""
        goals = [setpoint_shape(self._setpoints[i], self._length) for i in self._visited]
        points = np.concatenate([*goals, self._shapes.reshape(-1, 2), self._path, np.zeros((1, 2))])
        points = points[np.isfinite(points).all(axis=1)]
        free = MARGIN * self._length
        low, high = points.min(axis=0) - free, points.max(axis=0) + free
        for index in self._sectors:
            x, y = self._name_place(index)
            wide = LETTER * self._length * len(self._setpoints[index].name)
            high = np.maximum(high, (x + wide, y + LETTER * self._length))
        # Neither a letter box nor a tower.
        short = 0.55 * (high[0] - low[0]) - (high[1] - low[1])
        if short > 0.0:
            low[1], high[1] = low[1] - 0.5 * short, high[1] + 0.5 * short
        thin = 0.9 * (high[1] - low[1]) - (high[0] - low[0])
        if thin > 0.0:
            low[0], high[0] = low[0] - 0.5 * thin, high[0] + 0.5 * thin
        return low, high

    def _name_place(self, index: int) -> tuple[float, float]:
        """Where the name of a setpoint begins: outside the arc, in the direction of its tip."""
        tip = self._setpoints[index].tip_m
        reach = 1.045 * self._radius() / math.hypot(*tip)
        return reach * tip[0], reach * tip[1]

    def _radius(self) -> float:
        return SECTOR * max(math.hypot(*self._setpoints[i].tip_m) for i in self._visited)

    def _draw_setpoints(self, ax: Any) -> dict[int, Wedge]:
        """Sectors, shapes and names of the setpoints; gives the sector to show where it is active."""
        wedges = {}
        for index in self._visited:
            setpoint, tone = self._setpoints[index], colour(index)
            shape = setpoint_shape(setpoint, self._length, 65)
            ax.plot(*shape.T, color=tone, linewidth=1.0, alpha=0.55, linestyle=(0, (5, 2)))
            if index not in self._sectors:
                continue
            low, high = self._sectors[index]
            radius, degrees = self._radius(), (math.degrees(low), math.degrees(high))
            ax.add_patch(
                Wedge((0, 0), radius, *degrees, facecolor=tone, alpha=0.06, edgecolor="none")
            )
            ax.add_patch(
                Wedge((0, 0), radius, *degrees, facecolor="none", edgecolor="white", linewidth=1.2)
            )
            active = Wedge((0, 0), radius, *degrees, facecolor=tone, alpha=0.14, animated=True)
            ax.add_patch(active)
            wedges[index] = active
            ax.text(
                *self._name_place(index),
                setpoint.name,
                color=tone,
                ha="left",
                va="center",
                weight="bold",
                clip_on=True,
            )
        return wedges

    def _line(self, ax: Any, tone: str, width: float, **style: Any) -> Line2D:
        (line,) = ax.plot([], [], color=tone, linewidth=width, animated=True, **style)
        self._moving.append(line)
        moved: Line2D = line
        return moved

    def _legend(self, figure: Any, height: float) -> None:
        handles = [
            Line2D([], [], color=colour(int(self._active[0])), linewidth=4.5),
            Line2D([], [], color=INK, linewidth=1.2, linestyle=(0, (3, 2))),
            Line2D([], [], color=INK, linewidth=0, marker="o", markerfacecolor="none"),
            Line2D([], [], color=GREY, linewidth=1.0, linestyle=(0, (5, 2))),
        ]
        labels = [
            "arm, in the colour of its gains",
            "arm as the nodes estimate it",
            "reference of the tip",
            "setpoints",
        ]
        figure.legend(
            handles,
            labels,
            loc="lower left",
            bbox_to_anchor=(0.02, 0.03 / height),
            ncols=2,
            frameon=False,
            handlelength=2.2,
            columnspacing=1.2,
            borderaxespad=0.0,
            labelspacing=0.35,
        )

    def draw(self, tick: int) -> Pixels:
        """The picture at one of the ticks given before, (height, width, 3)."""
        i = self._ticks[tick]
        active = int(self._active[i])
        tone = colour(active)
        for index, wedge in self._wedges.items():
            wedge.set_visible(index == active)
        self._trail.set_data(*self._tips[max(0, tick - self._trail_ticks) : tick + 1].T)
        self._arm.set_data(*self._shapes[i].T)
        self._arm.set_color(tone)
        self._estimate.set_data(*self._estimates[i].T)
        self._aim.set_data(*self._reference[i : i + 1].T)
        self._time.set_text(f"time {self._times[i]:.1f} s")
        self._error.set_text(f"tip error {_length(float(self._errors[i]))}")
        self._named.set_text(f"setpoint {self._names[active]}")
        self._named.set_color(tone)
        self._canvas.restore_region(self._still)
        for artist in sorted(self._moving, key=lambda one: one.get_zorder()):
            self.figure.draw_artist(artist)
        pixels: Pixels = np.asarray(self._canvas.buffer_rgba())[:, :, :3].copy()
        return pixels


def _length(metres: float) -> str:
    """A distance for a person, always in the same unit."""
    if not math.isfinite(metres):
        return "not recorded"
    return f"{1e3 * metres:.1f} mm"
