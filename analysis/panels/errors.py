"""Panels of the two errors that a run is about: of the estimate, and of the tip."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import FuncFormatter

from analysis.goals import active_setpoints, colour
from analysis.legs import NEAR_M, make_legs
from analysis.open_loop import THRESHOLD, ErrorCourse, EstimationErrors, compare_with_open_loop
from analysis.panels.arm import moves
from analysis.panels.frame import (
    BLUE,
    FEW,
    GREY,
    VERMILION,
    Cell,
    course,
    end_s,
    in_full,
    over_time,
    positive,
    runs_of,
    say,
    tidy,
)
from analysis.recording import Recording

Array = npt.NDArray[np.float64]


def draw_estimation(cell: Cell, recording: Recording) -> None:
    """Estimation errors of observer and open-loop model: relative, or in mm if it starts without one."""
    ax = cell.one()
    observer, model = compare_with_open_loop(recording)
    starts_right = recording.configuration.initial == "setpoint"
    (_distance if starts_right else _shares)(ax, recording, observer, model)


def _shares(
    ax: Any, recording: Recording, observer: EstimationErrors, model: EstimationErrors
) -> None:
    ax.set_title("State estimation error")
    if not positive(*(one.relative for e in (observer, model) for one in (e.shape, e.energy))):
        say(ax, "there is no error at the start that the later ones could be a share of")
        return
    both = ((observer, BLUE, "observer"), (model, VERMILION, "open loop"))
    # The shape error swings widely from tick to tick: thin, and underneath.
    for norm, width, dashes, opacity, fill in (
        ("shape", 0.8, (0, (5, 1.5)), 0.7, "white"),
        ("energy", 1.6, "-", 1.0, None),
    ):
        for errors, tone, name in both:
            one: ErrorCourse = getattr(errors, norm)
            course(
                ax,
                recording,
                one.relative,
                color=tone,
                linewidth=width,
                linestyle=dashes,
                alpha=opacity,
                label=f"{name}, {norm}",
            )
            if one.below_1_percent_s is not None:
                ax.plot(
                    one.below_1_percent_s,
                    THRESHOLD,
                    "o",
                    color=tone,
                    markerfacecolor=fill or tone,
                    markersize=6,
                    zorder=4,
                )
    ax.set_yscale("log")
    ax.axhline(THRESHOLD, color=GREY, linewidth=0.9, linestyle=":")
    ax.yaxis.set_major_formatter(FuncFormatter(_percent))
    ax.set_ylabel("share of initial error")
    ax.set_ylim(top=20.0 * ax.get_ylim()[1])  # room for the legend
    order = [2, 3, 0, 1]  # energy in the first column
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(
        [handles[i] for i in order],
        [labels[i] for i in order],
        ncols=2,
        loc="upper right",
        frameon=False,
        fontsize=8.5,
        columnspacing=1.2,
        handlelength=2.0,
    )
    tidy(ax)
    over_time(ax, recording)


def _distance(
    ax: Any, recording: Recording, observer: EstimationErrors, model: EstimationErrors
) -> None:
    """Distance of the estimated shape from the true one: for runs that start without an error."""
    ax.set_title("Shape estimation error")
    if not positive(model.shape.norm, observer.shape.norm):
        say(ax, "there is no error")
        return
    for errors, tone, name in ((model, VERMILION, "open loop"), (observer, BLUE, "observer")):
        course(ax, recording, 1e3 * errors.shape.norm, color=tone, linewidth=1.2, label=name)
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, 1e-4 * high), 5.0 * high)  # room for the legend
    ax.yaxis.set_major_formatter(FuncFormatter(in_full))
    ax.set_ylabel("rms distance [mm]")
    ax.legend(loc="upper right", ncols=2, frameon=False)
    tidy(ax)
    over_time(ax, recording)


def _percent(share: float, _: int | None) -> str:
    """Label of a tick; none where the legend is."""
    return f"{100.0 * share:g}%" if share < 5.0 else ""


def draw_tip(cell: Cell, recording: Recording) -> None:
    """Distance of the tip from where the reference has it."""
    ax = cell.one()
    if not np.isfinite(recording.tip_error_m).any():
        ax.set_title("Tip error")
        say(ax, "the tip was not recorded")
        return
    (_tip_by_leg if moves(recording) else _tip)(ax, recording)
    tidy(ax)
    over_time(ax, recording)


def _tip(ax: Any, recording: Recording) -> None:
    course(ax, recording, 1e2 * recording.tip_error_m, color=BLUE, linewidth=1.6)
    ax.set(ylabel="distance from setpoint [cm]", title="Tip error")
    ax.set_ylim(0.0, 1.02 * ax.get_ylim()[1])


def _tip_by_leg(ax: Any, recording: Recording) -> None:
    """In the colour of the gains; holds are shaded."""
    run, times = recording.configuration, recording.times_s
    error = 1e3 * recording.tip_error_m
    active = active_setpoints(recording)
    marker = {"marker": ".", "markersize": 4.0} if recording.ticks < FEW else {}
    for index, first, end in runs_of(active):
        ax.plot(times[first : end + 1], error[first : end + 1], color=colour(index), **marker)
    if positive(error):
        ax.set_yscale("log")
        low, high = ax.get_ylim()
        ax.set_ylim(max(low, 1e-3 * high), 2.5 * high)  # room for the names
        ax.yaxis.set_major_formatter(FuncFormatter(in_full))
    ax.axhline(1e3 * NEAR_M, color=GREY, linewidth=0.9, linestyle=":")
    for leg in make_legs(run.setpoint, run.first_hold_s, run.legs, end_s(recording)):
        if leg.hold_from_s < leg.until_s:
            ax.axvspan(leg.hold_from_s, leg.until_s, color=GREY, alpha=0.12, linewidth=0.0)
            middle = 0.5 * (leg.hold_from_s + leg.until_s)
            ax.text(middle, 0.98, leg.to, transform=ax.get_xaxis_transform(), ha="center", va="top")
    ax.set(ylabel="distance from reference [mm]", title="Tip error; holds are grey")
