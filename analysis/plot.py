"""The figure of a run: shapes, errors, commands, curvature and sweep times on one page.

Last step of the analysis: recording in, PNG out. Uses matplotlib's objects and the Agg canvas
directly, so that nothing depends on a display or on the state of pyplot. Colours are safe for
colour-blind readers.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from analysis.goals import active_setpoints, colour, reference_tips, setpoint_shape, visited
from analysis.legs import NEAR_M, make_legs
from analysis.open_loop import THRESHOLD, ErrorCourse, EstimationErrors, compare_with_open_loop
from analysis.recording import Recording, read_recording
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

WIDTH_IN, HEIGHT_IN, DPI = 14.0, 8.2, 100
BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"  # Okabe and Ito
SHAPES = 16
"""Number of arm shapes drawn."""
STYLE = {
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.labelsize": 10.0,
    "legend.fontsize": 9.0,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
}


def plot_run(recording_path: Path, png_path: Path) -> None:
    """Draw the figure of a run into a PNG of 1400 x 820 pixels.

    Raises UsageError if the recording cannot be read, has fewer than 2 ticks, or the PNG cannot be
    written.
    """
    plot_recording(read_recording(recording_path), png_path)


def plot_recording(recording: Recording, png_path: Path) -> None:
    """As `plot_run`, for a recording that is in memory."""
    figure = draw_run(recording)
    try:
        png_path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(png_path, dpi=DPI)
    except OSError as error:
        raise UsageError(
            f"plot {png_path}: {error.strerror or error}; give another place to write it to"
        ) from None


def draw_run(recording: Recording) -> Figure:
    """The figure of a run, not yet written anywhere."""
    if recording.ticks < 2:
        raise UsageError(
            f"recording {recording.path}: expected at least 2 complete ticks to plot, got "
            f"{recording.ticks}"
        )
    with mpl.rc_context(STYLE):
        spacing = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, wspace=0.03, hspace=0.04)
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, layout=spacing)
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, 3)
        observer, model = compare_with_open_loop(recording)
        (draw_way if moves(recording) else draw_shapes)(axes[0, 0], recording)
        starts_right = recording.configuration.initial == "setpoint"
        estimation = draw_distance if starts_right else draw_estimation
        estimation(axes[0, 1], recording, observer, model)
        (draw_tip_by_leg if moves(recording) else draw_tip)(axes[0, 2], recording)
        draw_commands(axes[1, 0], recording)
        draw_curvature(axes[1, 1], recording)
        draw_sweeps(axes[1, 2], recording)
        figure.suptitle(title(recording), fontsize=11.5)
        for letter, ax in zip("abcdef", axes.flat, strict=True):
            ax.set_title(f"({letter})  {ax.get_title()}", loc="left")
            ax.set_title("")
        # Place everything now, with the fonts of this style.
        figure.draw_without_rendering()
    return figure


def title(recording: Recording) -> str:
    """One line that says which run this is."""
    run = recording.configuration
    parts = [
        f"scenario {run.scenario!r}",
        f"{run.nodes} nodes, {recording.ticks} ticks of {run.tick_s:g} s",
        f"setpoint {' - '.join([run.setpoint, *(leg.to for leg in run.legs)])}",
        f"initial shape {run.initial!r}",
        f"disturbance {run.disturbance.name!r}",
        f"seed {run.seed}",
    ]
    if recording.unfinished is not None:
        parts.append("recording unfinished")
    return "  ·  ".join(parts)


def telling_ticks(shapes: Array, count: int) -> list[int]:
    """Ticks at which to draw the arm: first, last, and equal steps of the tip's path between."""
    tips = shapes[:, -1]
    steps = np.hypot(*np.diff(tips, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps))])
    chosen = np.searchsorted(way, np.linspace(0.0, way[-1], count))
    return sorted({0, *np.clip(chosen, 0, len(tips) - 1).tolist(), len(tips) - 1})


def draw_shapes(ax: Any, recording: Recording) -> None:
    """Arm shapes in the plane, coloured by time, with the setpoint."""
    shapes, times = recording.shapes_m, recording.times_s
    # Most of the motion is early: the square root of time gives it most of the colours.
    colours = ScalarMappable(PowerNorm(0.5, 0.0, float(times[-1])), mpl.colormaps["viridis"])
    for k in telling_ticks(shapes, SHAPES):
        ax.plot(*shapes[k].T, color=colours.to_rgba(times[k]), linewidth=1.7)
    ax.plot(*shapes[:, -1].T, color=GREY, linewidth=0.6, alpha=0.7)
    run = recording.configuration
    goal = setpoint_shape(
        recording.artefact.setpoints[run.setpoint_index], recording.artefact.arm.length_m
    )
    ax.plot(*goal.T, color=VERMILION, linewidth=1.8, linestyle=(0, (4, 2)), label="setpoint")
    ax.plot(0.0, 0.0, marker="s", markersize=7, color="black", clip_on=False)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x [m]", ylabel="y [m]", title="Arm shapes")
    ax.legend(loc="upper left", frameon=False)
    ax.figure.colorbar(colours, ax=ax, label="time [s]", pad=0.02)


def moves(recording: Recording) -> bool:
    """Whether the reference goes anywhere in this run."""
    return bool(recording.configuration.legs)


def runs_of(active: npt.NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Stretches of ticks with the same setpoint's gains: (setpoint, first tick, one past the last)."""
    edges = [0, *(np.flatnonzero(np.diff(active)) + 1).tolist(), active.size]
    return [(int(active[a]), a, b) for a, b in pairwise(edges)]


def draw_way(ax: Any, recording: Recording) -> None:
    """The tip's way in the colour of the gains, the way that was asked for, the arm at the end of each leg."""
    run, artefact = recording.configuration, recording.artefact
    active, tips, names = active_setpoints(recording), recording.tips_m, run.setpoint_names
    for index in visited(recording):
        shape = setpoint_shape(artefact.setpoints[index], artefact.arm.length_m)
        ax.plot(*shape.T, color=GREY, linewidth=0.9, linestyle=(0, (5, 2)))
    times = recording.times_s
    for leg in make_legs(
        run.setpoint, run.first_hold_s, run.legs, recording.ticks * recording.tick_s
    ):
        k = int(np.searchsorted(times, leg.until_s - 0.5 * recording.tick_s)) - 1
        ax.plot(*recording.shapes_m[k].T, color=colour(int(active[k])), linewidth=2.2, alpha=0.7)
    for index, first, end in runs_of(active):
        ax.plot(*tips[first : end + 1].T, color=colour(index), linewidth=2.2)
    ax.plot(*reference_tips(recording).T, color="black", linewidth=1.1, linestyle=(0, (4, 2)))
    ax.plot(0.0, 0.0, marker="s", markersize=7, color="black", clip_on=False)
    key = [
        Line2D([], [], color=colour(index), linewidth=2.2, label=f"gains {names[index]}")
        for index in sorted(set(active.tolist()))
    ]
    key.append(
        Line2D([], [], color="black", linewidth=1.1, linestyle=(0, (4, 2)), label="reference")
    )
    ax.plot(*(1.2 * artefact.arm.length_m * np.ones((2, 1))), " ")  # room for the key
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x [m]", ylabel="y [m]", title="Tip's way, arm at the end of each leg")
    ax.legend(handles=key, loc="upper right", frameon=False)


def draw_estimation(
    ax: Any, recording: Recording, observer: EstimationErrors, model: EstimationErrors
) -> None:
    """Estimation errors relative to their initial values, observer and open-loop model."""
    times = recording.times_s
    both = ((observer, BLUE, "observer"), (model, VERMILION, "open loop"))
    # The shape error swings widely from tick to tick: thin, and underneath.
    for norm, width, dashes, opacity, fill in (
        ("shape", 0.8, (0, (5, 1.5)), 0.7, "white"),
        ("energy", 1.6, "-", 1.0, None),
    ):
        for errors, tone, name in both:
            course: ErrorCourse = getattr(errors, norm)
            ax.semilogy(
                times,
                course.relative,
                color=tone,
                linewidth=width,
                linestyle=dashes,
                alpha=opacity,
                label=f"{name}, {norm}",
            )
            if course.below_1_percent_s is not None:
                ax.plot(
                    course.below_1_percent_s,
                    THRESHOLD,
                    "o",
                    color=tone,
                    markerfacecolor=fill or tone,
                    markersize=6,
                    zorder=4,
                )
    ax.axhline(THRESHOLD, color=GREY, linewidth=0.9, linestyle=":")
    ax.yaxis.set_major_formatter(FuncFormatter(_percent))
    ax.set(xlabel="time [s]", ylabel="share of initial error", title="State estimation error")
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
    tidy(ax, times)


def draw_distance(
    ax: Any, recording: Recording, observer: EstimationErrors, model: EstimationErrors
) -> None:
    """Distance of the estimated shape from the true one: for runs that start without an error."""
    times = recording.times_s
    for errors, tone, name in ((model, VERMILION, "open loop"), (observer, BLUE, "observer")):
        ax.semilogy(times, 1e3 * errors.shape.norm, color=tone, linewidth=1.2, label=name)
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, 1e-4 * high), 5.0 * high)  # room for the legend
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set(xlabel="time [s]", ylabel="rms distance [mm]", title="Shape estimation error")
    ax.legend(loc="upper right", ncols=2, frameon=False)
    tidy(ax, times)


def _percent(share: float, _: int | None) -> str:
    """Label of a tick; none where the legend is."""
    return f"{100.0 * share:g}%" if share < 5.0 else ""


def draw_tip(ax: Any, recording: Recording) -> None:
    """Distance of the tip from the setpoint's."""
    times = recording.times_s
    ax.plot(times, 1e2 * recording.tip_error_m, color=BLUE, linewidth=1.6)
    ax.set(xlabel="time [s]", ylabel="distance from setpoint [cm]", title="Tip error")
    ax.set_ylim(bottom=0.0)
    tidy(ax, times)


def draw_tip_by_leg(ax: Any, recording: Recording) -> None:
    """Distance of the tip from the reference's, in the colour of the gains; holds are shaded."""
    run, times = recording.configuration, recording.times_s
    error = 1e3 * recording.tip_error_m
    active = active_setpoints(recording)
    for index, first, end in runs_of(active):
        ax.semilogy(times[first : end + 1], error[first : end + 1], color=colour(index))
    ax.axhline(1e3 * NEAR_M, color=GREY, linewidth=0.9, linestyle=":")
    for leg in make_legs(
        run.setpoint, run.first_hold_s, run.legs, recording.ticks * recording.tick_s
    ):
        if leg.hold_from_s < leg.until_s:
            ax.axvspan(leg.hold_from_s, leg.until_s, color=GREY, alpha=0.12, linewidth=0.0)
            middle = 0.5 * (leg.hold_from_s + leg.until_s)
            ax.text(middle, 0.98, leg.to, transform=ax.get_xaxis_transform(), ha="center", va="top")
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, 1e-3 * high), 2.5 * high)  # room for the names
    ax.set(
        xlabel="time [s]", ylabel="distance from reference [mm]", title="Tip error; holds are grey"
    )
    tidy(ax, times)


def draw_commands(ax: Any, recording: Recording) -> None:
    """Commands of all segments over time."""
    faces = np.asarray(recording.configuration.faces_m)
    image(ax, recording, faces, 1e3 * recording.commands, "load [mN/m]")
    ax.set_title(f"Commanded {recording.artefact.arm.actuator} load")


def draw_curvature(ax: Any, recording: Recording) -> None:
    """True curvature less the reference's, over time."""
    faces = np.asarray(recording.configuration.faces_m)
    wanted = np.stack([recording.references.states(k)[:, 3] for k in range(recording.ticks)])
    image(ax, recording, faces, recording.truth[:, :, 3] - wanted, "deviation [1/m]")
    ax.set_title("Curvature less the reference's")


def image(ax: Any, recording: Recording, faces_m: Array, values: Array, label: str) -> None:
    """A quantity of the segments, (K, n), as a picture over time and arclength; 0 is white."""
    edges = np.append(recording.times_s, recording.ticks * recording.tick_s)
    largest = float(np.nanmax(np.abs(values))) or 1.0
    # A few large values at the start would leave the rest white.
    limit = max(float(np.nanpercentile(np.abs(values), 99.0)), 0.2 * largest)
    mesh = ax.pcolormesh(
        edges, faces_m, values.T, cmap="RdBu_r", vmin=-limit, vmax=limit, rasterized=True
    )
    extend = "both" if largest > limit else "neither"
    ax.figure.colorbar(mesh, ax=ax, label=label, pad=0.02, extend=extend)
    ax.set(xlabel="time [s]", ylabel="arclength from root [m]")


def draw_sweeps(ax: Any, recording: Recording) -> None:
    """Histogram of the sweeps' durations with median and 99th percentile."""
    durations = recording.sweep_durations_ms
    durations = durations[np.isfinite(durations)]
    if durations.size == 0:
        ax.set_axis_off()
        return
    p50, p99 = np.percentile(durations, [50.0, 99.0])
    end = 1.3 * float(p99)
    ax.hist(durations[durations <= end], bins=40, range=(0.0, end), color=BLUE, alpha=0.75)
    for value, tone, name in ((p50, GREEN, "p50"), (p99, VERMILION, "p99")):
        ax.axvline(value, color=tone, linewidth=1.8, label=f"{name} = {value:.2f} ms")
    beyond = int(np.count_nonzero(durations > end))
    if beyond:
        slowest = float(durations.max())
        ax.plot([], [], " ", label=f"{beyond} beyond, up to {slowest:.3g} ms")
    ax.set(xlabel="wall-clock time [ms]", ylabel="ticks", title="Sweep duration")
    ax.set_xlim(0.0, end)
    ax.legend(loc="upper left" if p50 > 0.5 * end else "upper right", framealpha=0.9)
    ax.spines[["top", "right"]].set_visible(False)


def tidy(ax: Any, times: Array) -> None:
    """Common look of the curves over time."""
    ax.set_xlim(0.0, float(times[-1]))
    ax.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    ax.spines[["top", "right"]].set_visible(False)
