"""Figures of `chapter.observer`: the chapter's Fig. 4 and 5, the effect of epsilon, and what (2) and (5) do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from chapter.observer_schedule import Observed
from chapter.observer_straight import ErrorRun

Array = npt.NDArray[np.float64]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#555555")  # Okabe and Ito
WIDTH_IN = 12.0
_STYLE = {"font.size": 10.0, "axes.titlesize": 10.5, "axes.titlelocation": "left"}
_POINTS = 1500  # of a curve; more are not seen
_FLOOR = 1e-4


def _panels(rows: int, columns: int, height_in: float, **options: Any) -> tuple[Figure, Any]:
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), dpi=100, layout=ConstrainedLayoutEngine())
        axes = figure.subplots(rows, columns, squeeze=False, **options)
    for ax in axes.flat:
        ax.grid(color="#DDDDDD", linewidth=0.6)
        ax.set_axisbelow(True)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    return figure, axes


def _title(ax: Any, words: str) -> None:
    ax.set_title(words, fontsize=10.0, loc="left")


def _curve(ax: Any, times: Array, values: Array, **options: Any) -> None:
    every = max(1, len(times) // _POINTS)
    ax.plot(times[::every], values[::every], lw=1.3, **options)


def _envelope(ax: Any, times: Array, values: Array, **options: Any) -> None:
    """|values| without its zero crossings: the largest of a hundredth of the record around."""
    size = np.abs(values)
    count = max(1, len(size) // 150)
    blocks = len(size) // count
    tops = size[: blocks * count].reshape(blocks, count).max(axis=1)
    tops = np.maximum(tops, np.concatenate([tops[1:], tops[-1:]]))
    ax.semilogy(times[: blocks * count : count], tops, lw=1.5, **options)


def output(runs: Mapping[str, Sequence[ErrorRun]]) -> Figure:
    """Fig. 4a: z and tip error over time; a column for each set of constants."""
    figure, axes = _panels(2, len(runs), 7.0, sharex="col")
    for column, (title, some) in enumerate(runs.items()):
        above, below = axes[:, column]
        for colour, run in zip(COLOURS, some, strict=False):
            _curve(above, run.times_s, run.root, color=colour, label=run.origin.name)
            _envelope(below, run.times_s, run.tip_m, color=colour)
        _title(above, f"{title}: z = integral of d_s^4 of the error of w [1/m^2]")
        _title(below, "envelope of the error of the tip's displacement [m]")
        below.set_ylim(_FLOOR, 3.0)
        below.set_xlabel("time [s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=5)
    return figure


def shapes(
    points_m: Array,
    arm: Array,
    estimate: Array,
    times_s: Sequence[float],
    exact: Observed,
    exact_times_s: Sequence[float],
) -> Figure:
    """Fig. 4b: arm and estimate at several times, (times, n + 1) on the grid, and beside the exact arm."""
    figure, axes = _panels(1, 2, 5.2)
    left, right = axes[0]
    for k, time in enumerate(times_s):
        colour = COLOURS[k % len(COLOURS)]
        left.plot(points_m, arm[k], color=colour, lw=1.8, label=f"{time:.0f} s")
        left.plot(points_m, estimate[k], "o--", color=colour, lw=1.0, ms=3.5)
    _title(left, "grid model (4), straight, printed rho: w [m] over s [m]")
    left.set_xlabel("s [m]")
    for k, time in enumerate(exact_times_s):
        row, colour = round(time / exact.tick_s), COLOURS[k % len(COLOURS)]
        shape, guess = exact.true_shapes_m[row], exact.estimated_shapes_m[row]
        right.plot(shape[:, 0], shape[:, 1], color=colour, lw=1.8, label=f"{time:.0f} s")
        right.plot(guess[:, 0], guess[:, 1], "o--", color=colour, lw=1.0, ms=3.5)
    _title(right, "exact arm (1), rho A, released from setpoint 2: y [m] over x [m]")
    right.set_xlabel("x [m]")
    right.set_aspect("equal", adjustable="datalim")
    for ax in (left, right):
        ax.legend(title="arm (lines), estimate (dots)", ncols=2, fontsize=9.0)
    return figure


def initial(
    grid: Mapping[str, ErrorRun], exact: Mapping[str, Observed], names: Sequence[str]
) -> Figure:
    """Fig. 5: error of the tip over time from several initial conditions; changes of gains are marked."""
    figure, axes = _panels(1, 2, 5.0)
    left, right = axes[0]
    for colour, (title, run) in zip(COLOURS, grid.items(), strict=False):
        _envelope(left, run.times_s, run.tip_m, color=colour, label=title)
    _title(left, "tip error [m], grid model (4), straight, printed rho, gains of (18), drag")
    for colour, (title, one) in zip(COLOURS, exact.items(), strict=False):
        _envelope(right, one.times_s, one.tip_error_m, color=colour, label=title)
        changes = 1 + np.flatnonzero(np.diff(one.setpoints))
        for k in changes:
            right.plot(
                one.times_s[k], one.tip_error_m[k], "v", color=colour, ms=7, mec="black", mew=0.6
            )
    _title(
        right,
        f"tip error [m], exact arm (1), rho A, gains of (18) scheduled among {', '.join(names)}",
    )
    right.plot([], [], "v", color="white", mec="black", label="other gains from here on")
    for ax in (left, right):
        ax.set_xlabel("time [s]")
        ax.legend(fontsize=9.0)
        ax.set_ylim(_FLOOR, 3.0)
    return figure


def epsilon(lmi: Mapping[float, ErrorRun], lpi: Mapping[float, ErrorRun]) -> Figure:
    """Tip error over time for several epsilon, gains of (16) on the grid and of (18)."""
    figure, axes = _panels(1, 2, 4.4, sharey=True)
    titles = ("(16) on the grid, no drag", "(18) of the arm, with its drag")
    for ax, some, title in zip(axes[0], (lmi, lpi), titles, strict=True):
        for colour, (value, run) in zip(COLOURS, some.items(), strict=False):
            _envelope(ax, run.times_s, run.tip_m, color=colour, label=f"epsilon = {value:g}")
        _title(ax, f"tip error [m], rho A, no disturbance; gains of {title}")
        ax.set_xlabel("time [s]")
        ax.set_ylim(_FLOOR, 1.0)
        ax.legend()
    return figure


def origins(runs: Mapping[str, Observed]) -> Figure:
    """Tip and root error beside the exact arm for gains of several origins."""
    figure, axes = _panels(1, 2, 4.4)
    for colour, (title, one) in zip(COLOURS, runs.items(), strict=False):
        _envelope(axes[0, 0], one.times_s, one.tip_error_m, color=colour, label=title)
        _envelope(axes[0, 1], one.times_s, one.root_error, color=colour, label=title)
    _title(
        axes[0, 0], "envelope of the distance of estimated from true tip [m], exact arm (1), rho A"
    )
    axes[0, 0].set_ylim(_FLOOR, 3.0)
    _title(axes[0, 1], "envelope of z = error of -d_s kappa at the root [1/m^2]")
    for ax in axes[0]:
        ax.set_xlabel("time [s]")
    axes[0, 0].legend()
    return figure


def truncation(
    growth: Mapping[str, Mapping[int, float]],
    above: Mapping[str, float],
    motions: Mapping[str, tuple[Array, Array]],
) -> Figure:
    """Growth rate of (5) over the number of cells, and how far (2) and (1) go from the chapter's start."""
    figure, axes = _panels(1, 2, 4.6)
    left, right = axes[0]
    for colour, (name, rates) in zip(COLOURS, growth.items(), strict=False):
        left.loglog(list(rates), list(rates.values()), "o-", color=colour, label=f"setpoint {name}")
        left.axhline(above[name], color=colour, ls=":", lw=1.2)
    _title(left, "largest growth rate [1/s] of (5), rho A; dotted: fastest wave of the lower band")
    left.set_xticks(list(next(iter(growth.values()))), labels=map(str, next(iter(growth.values()))))
    left.minorticks_off()
    left.set_xlabel("cells")
    left.legend()
    for colour, (title, (times, size)) in zip(COLOURS, motions.items(), strict=False):
        right.semilogy(times, size, color=colour, lw=1.5, label=title)
    right.set_ylim(0.1, 1e4)
    _title(right, "largest displacement [m] from the chapter's initial condition, rho A, no load")
    right.set_xlabel("time [s]")
    right.legend()
    return figure
