"""What all panels of a figure share: their place in it, colours, axes over time and their marks, maps.

Between the panels, which know what they show, and matplotlib. Colours are safe for colour-blind readers
(Okabe and Ito; viridis; red to blue).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation, blended_transform_factory

from analysis.goals import active_setpoints, colour
from analysis.recording import Recording
from wire.channels import Degraded
from wire.foxglove import EVENTS

Array = npt.NDArray[np.float64]

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"
PURPLE, MISSING = "#CC79A7", "#D0D0D0"
STRIP_PT = 4.0
"""Of the strip above the axes that has the colour of the gains in use."""
FEW = 60
"""With fewer values than this in a course each one is drawn as a point as well."""
SHORT_S = 0.05
BREAKS = ("interrupted", "safety_stop", "telemetry_lost", "disk_full", "node_gone", "passive")
"""Events that a line marks; the changes of gains and the late ticks have marks of their own."""


@dataclass(frozen=True)
class Cell:
    """The place of a panel in its figure. Its axes have the panel's name as their label."""

    place: Any
    """A SubFigure, so that a panel's labels take room from none but itself."""
    name: str

    def one(self) -> Any:
        """Axes that fill the place."""
        return self.place.subplots(subplot_kw={"label": self.name})

    def stack(self, *heights: float, shared: bool = True) -> list[Any]:
        """Axes over one another, with these shares of the height; shared: with one axis of time below all."""
        axes = self.place.subplots(
            len(heights),
            sharex=shared,
            height_ratios=heights,
            subplot_kw={"label": self.name},
        )
        if shared:
            self.place.align_ylabels(axes)
        return list(axes)


def say(ax: Any, text: str) -> None:
    """Words in place of a picture: why there is none."""
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_color(MISSING)
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color=GREY, wrap=True)


def end_s(recording: Recording) -> float:
    """Where the axes of time end: after the last tick."""
    return recording.ticks * recording.tick_s


def runs_of(active: npt.NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Stretches of ticks with the same setpoint's gains: (setpoint, first tick, one past the last)."""
    edges = [0, *(np.flatnonzero(np.diff(active)) + 1).tolist(), active.size]
    return [(int(active[a]), a, b) for a, b in pairwise(edges)]


def breaks(recording: Recording) -> dict[str, list[float]]:
    """Times in s of the events that say that something went wrong, by their names."""
    table = recording.tables.get(EVENTS.topic)
    found: dict[str, list[float]] = {}
    if table is not None and table.rows:
        for tick, name in zip(table.ticks.tolist(), table.column("name"), strict=True):
            if name in BREAKS:
                found.setdefault(name, []).append(tick * recording.tick_s)
    return found


def over_time(ax: Any, recording: Recording, *, top: bool = True, bottom: bool = True) -> None:
    """Make the horizontal axis one of time, with the gains in use, late ticks and events marked on it.

    top, bottom: whether the axes are the uppermost or lowest of a stack, which have those marks.
    """
    end = end_s(recording)
    ax.set_xlim(-0.02 * end if recording.ticks < FEW else 0.0, end)  # single points stand free
    if end < SHORT_S:
        ax.xaxis.set_major_locator(MaxNLocator(4))  # for its long labels
    across = ax.get_xaxis_transform()
    if bottom:
        ax.set_xlabel("time [s]")
        late = recording.times_s[recording.late]
        if late.size:
            ax.plot(
                late,
                np.zeros(late.size),
                "|",
                transform=across,
                color="black",
                markersize=9,
                markeredgewidth=0.8,
                clip_on=False,
                zorder=5,
                label="_late",
            )
        bridged = recording.times_s[bridged_ticks(recording)]
        if bridged.size:
            ax.plot(
                bridged,
                np.zeros(bridged.size),
                "|",
                transform=across,
                color=VERMILION,
                markersize=9,
                markeredgewidth=0.8,
                clip_on=False,
                zorder=5.1,
                label="_bridged",
            )
    for times in breaks(recording).values():
        for at in times:
            # What ended the run may have come after the last tick that all have told of.
            ax.axvline(min(at, end), color=PURPLE, linewidth=1.6, linestyle=(0, (3, 1.5)), zorder=5)
    runs = runs_of(active_setpoints(recording))
    if len(runs) < 2:
        return
    raised = ScaledTranslation(0.0, STRIP_PT / 72.0, ax.figure.dpi_scale_trans)
    above = blended_transform_factory(ax.transData, ax.transAxes + raised)
    for index, first, last in runs:
        span = [first * recording.tick_s, last * recording.tick_s]
        if top:
            ax.plot(
                span,
                [1.0, 1.0],
                transform=above,
                color=colour(index),
                linewidth=STRIP_PT,
                solid_capstyle="butt",
                clip_on=False,
                label="_gains",
            )
        if first:
            ax.axvline(span[0], color=GREY, linewidth=0.7, linestyle=(0, (1, 2)), zorder=0.5)


def key_of_marks(recording: Recording) -> list[Any]:
    """What the marks of `over_time` and `image` mean, as handles of a legend; only those that are there."""
    names = recording.configuration.setpoint_names
    active = sorted(set(active_setpoints(recording).tolist()))
    handles: list[Any] = []
    if len(active) > 1:
        handles += [Patch(color=colour(i), label=f"gains of setpoint {names[i]}") for i in active]
    late = int(np.count_nonzero(recording.late))
    if late:
        text = f"late tick ({late} of {recording.ticks})"
        handles.append(
            Line2D([], [], color="black", linewidth=0, marker="|", markersize=9, label=text)
        )
    bridged = int(np.count_nonzero(bridged_ticks(recording)))
    if bridged:
        text = f"sums bridged ({ticks_in_words(bridged)})"
        handles.append(
            Line2D([], [], color=VERMILION, linewidth=0, marker="|", markersize=9, label=text)
        )
    out = int(np.count_nonzero(recording.out.any(axis=1)))
    if out:
        handles.append(Patch(color=MISSING, label=f"a node out ({ticks_in_words(out)})"))
    missing = missing_ticks(recording)
    if missing:
        text = f"not recorded ({ticks_in_words(missing)})"
        handles.append(Patch(color=MISSING, label=text))
    for name, times in breaks(recording).items():
        when = ", ".join(f"{at:g} s" for at in times[:3]) + (", ..." if len(times) > 3 else "")
        text = f"{name.replace('_', ' ')} at {when}"
        handles.append(Line2D([], [], color=PURPLE, linestyle=(0, (3, 1.5)), label=text))
    return handles


def ticks_in_words(ticks: int) -> str:
    """So many ticks."""
    return "1 tick" if ticks == 1 else f"{ticks} ticks"


def bridged_ticks(recording: Recording) -> npt.NDArray[np.bool_]:
    """(K,) ticks in which a node bridged a sum that did not come."""
    bridged = int(Degraded.FORWARD_BRIDGED | Degraded.BACKWARD_BRIDGED)
    return np.asarray(((recording.flags & bridged) != 0).any(axis=1))


def missing_ticks(recording: Recording) -> int:
    """Ticks of which the recorder lacks what a node or the plant should have told; late ones tell less, and a
    node that is out nothing."""
    lacks = ~np.isfinite(recording.truth).all(axis=(1, 2))
    told = np.isfinite(recording.estimates).all(axis=2) | recording.out
    lacks |= ~told.all(axis=1) & ~recording.late
    return int(np.count_nonzero(lacks))


def course(ax: Any, recording: Recording, values: Array, **style: Any) -> Any:
    """A quantity over time, values: (K,). Late ticks, which have no value, do not break the line; rows that
    were not recorded do."""
    shown = np.isfinite(values) | ~recording.late
    if np.count_nonzero(np.isfinite(values)) < FEW:
        style = {"marker": ".", "markersize": 4.0} | style
    (line,) = ax.plot(recording.times_s[shown], values[shown], **style)
    return line


def tidy(ax: Any) -> None:
    """Common look of curves."""
    ax.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    ax.spines[["top", "right"]].set_visible(False)


def image(ax: Any, recording: Recording, values: Array, label: str) -> None:
    """A quantity of the segments, (K, n), as a map over time and arclength; 0 is white, missing ones grey."""
    edges = np.append(recording.times_s, end_s(recording))
    faces = np.asarray(recording.configuration.faces_m)
    sizes = np.abs(values[np.isfinite(values)])
    largest = float(sizes.max(initial=0.0)) or 1.0
    # A few large values at the start would leave the rest white.
    limit = max(float(np.percentile(sizes, 99.0)) if sizes.size else 0.0, 0.2 * largest)
    ax.set_facecolor(MISSING)
    mesh = ax.pcolormesh(
        edges, faces, values.T, cmap="RdBu_r", vmin=-limit, vmax=limit, rasterized=True
    )
    extend = "both" if largest > limit else "neither"
    ax.figure.colorbar(mesh, ax=ax, label=label, pad=0.02, extend=extend)
    ax.set_ylabel("arclength from root [m]")
    over_time(ax, recording)
    ax.set_xlim(0.0, edges[-1])


def scaled(values: Array, unit: str) -> tuple[Array, str]:
    """The values in thousandths of the unit if none reaches half of one, else as they are; and that unit."""
    sizes = np.abs(values[np.isfinite(values)])
    if sizes.max(initial=0.0) >= 0.5:
        return values, unit
    return 1e3 * values, "10$^{-3}$/m" if unit == "1/m" else f"m{unit}"


def positive(*courses: Array) -> bool:
    """Whether there is anything to draw on a logarithmic axis."""
    return any(bool((one[np.isfinite(one)] > 0.0).any()) for one in courses)


def time_colours(recording: Recording) -> Any:
    """Colours by time; most of the motion is early, so the square root of time gives it most of them."""
    norm = mpl.colors.PowerNorm(0.5, 0.0, end_s(recording))
    return mpl.cm.ScalarMappable(norm, mpl.colormaps["viridis"])


def in_full(value: float, _: int | None = None) -> str:
    """Label of a tick of a logarithmic axis."""
    return f"{value:g}"
