"""Panels of the arm in the plane: its shapes with the estimated ones, or the way of its tip."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from analysis.estimated_arm import estimated_arms
from analysis.goals import active_setpoints, colour, reference_tips, setpoint_shape, visited
from analysis.legs import make_legs
from analysis.panels.frame import GREY, VERMILION, Cell, end_s, runs_of, say, time_colours
from analysis.recording import Recording

Array = npt.NDArray[np.float64]

SHAPES = 16
"""Number of arm shapes drawn."""
DASHES = (0, (3, 2))
FAINT = "#B0B0B0"


def telling_ticks(shapes: Array, count: int) -> list[int]:
    """Ticks at which to draw the arm: first, last, and equal steps of the tip's path between."""
    tips = shapes[:, -1]
    steps = np.hypot(*np.diff(tips, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps))])
    chosen = np.searchsorted(way, np.linspace(0.0, way[-1], count))
    return sorted({0, *np.clip(chosen, 0, len(tips) - 1).tolist(), len(tips) - 1})


def drawable(recording: Recording) -> npt.NDArray[np.int64]:
    """Ticks of which the shape was recorded, and the estimate if there is any tick with both."""
    shape = np.isfinite(recording.shapes_m).all(axis=(1, 2))
    both = shape & np.isfinite(recording.estimates).all(axis=(1, 2))
    return np.flatnonzero(both if both.any() else shape)


def moves(recording: Recording) -> bool:
    """Whether the reference goes anywhere in this run."""
    return bool(recording.configuration.legs)


def draw_shapes(cell: Cell, recording: Recording) -> None:
    """The arm at several times, or at the end of each leg with the way of its tip; estimates dashed."""
    ax = cell.one()
    ticks = drawable(recording)
    if ticks.size == 0:
        ax.set_title("Arm shapes")
        say(ax, "no shape of the arm was recorded")
        return
    (_way if moves(recording) else _shapes)(ax, recording, ticks)
    ax.plot(0.0, 0.0, marker="s", markersize=7, color="black", clip_on=False)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x [m]", ylabel="y [m]")


def _estimates(ax: Any, recording: Recording, ticks: list[int]) -> None:
    """The arm as the nodes estimate it, dashed over the true one."""
    for arm in estimated_arms(recording, ticks):
        if np.isfinite(arm).all():
            ax.plot(*arm.T, color="black", linewidth=0.9, linestyle=DASHES, zorder=3)


def _shapes(ax: Any, recording: Recording, ticks: npt.NDArray[np.int64]) -> None:
    colours, times = time_colours(recording), recording.times_s
    shapes = recording.shapes_m[ticks]
    chosen = [int(ticks[k]) for k in telling_ticks(shapes, SHAPES)]
    for k in chosen:
        ax.plot(*recording.shapes_m[k].T, color=colours.to_rgba(times[k]), linewidth=1.9)
    ax.plot(*recording.shapes_m[:, -1].T, color=GREY, linewidth=0.6, alpha=0.7)
    _estimates(ax, recording, chosen)
    run = recording.configuration
    goal = setpoint_shape(
        recording.artefact.setpoints[run.setpoint_index], recording.artefact.arm.length_m
    )
    ax.plot(*goal.T, color=VERMILION, linewidth=1.8, linestyle=(0, (4, 2)), zorder=4)
    key = [
        Line2D([], [], color=VERMILION, linewidth=1.8, linestyle=(0, (4, 2)), label="setpoint"),
        Line2D([], [], color="black", linewidth=0.9, linestyle=DASHES, label="estimate"),
    ]
    ax.legend(handles=key, loc="upper left", frameon=False)
    ax.figure.colorbar(colours, ax=ax, label="time [s]", pad=0.02)
    ax.set_title("Arm shapes")


def _way(ax: Any, recording: Recording, ticks: npt.NDArray[np.int64]) -> None:
    """The tip's way in the colour of the gains, the way that was asked for, the arm at the end of each leg."""
    run, artefact = recording.configuration, recording.artefact
    active, tips, names = active_setpoints(recording), recording.tips_m, run.setpoint_names
    for index in visited(recording):
        shape = setpoint_shape(artefact.setpoints[index], artefact.arm.length_m)
        ax.plot(*shape.T, color=FAINT, linewidth=1.4)
    chosen = []
    for leg in make_legs(run.setpoint, run.first_hold_s, run.legs, end_s(recording)):
        before = int(
            np.searchsorted(ticks * recording.tick_s, leg.until_s - 0.5 * recording.tick_s)
        )
        k = int(ticks[max(before - 1, 0)])
        chosen.append(k)
        ax.plot(*recording.shapes_m[k].T, color=colour(int(active[k])), linewidth=2.2, alpha=0.7)
    _estimates(ax, recording, chosen)
    for index, first, end in runs_of(active):
        ax.plot(*tips[first : end + 1].T, color=colour(index), linewidth=2.2)
    ax.plot(*reference_tips(recording).T, color="black", linewidth=1.1, linestyle=(0, (1, 1.5)))
    key = [
        Line2D([], [], color=colour(index), linewidth=2.2, label=f"gains {names[index]}")
        for index in sorted(set(active.tolist()))
    ]
    key += [
        Line2D([], [], color=FAINT, linewidth=1.4, label="setpoints"),
        Line2D([], [], color="black", linewidth=1.1, linestyle=(0, (1, 1.5)), label="reference"),
        Line2D([], [], color="black", linewidth=0.9, linestyle=DASHES, label="estimate"),
    ]
    ax.plot(*(1.2 * artefact.arm.length_m * np.ones((2, 1))), " ")  # room for the key
    ax.legend(handles=key, loc="upper right", frameon=False)
    ax.set_title("Tip's way, arm at the end of each leg")
