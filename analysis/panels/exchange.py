"""Panels of the exchange between the processes: how long a sweep takes, what was sent and what arrived."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import FuncFormatter, MaxNLocator

from analysis.panels.frame import (
    BLUE,
    FEW,
    GREEN,
    GREY,
    VERMILION,
    Cell,
    in_full,
    over_time,
    say,
    tidy,
)
from analysis.recording import Recording

Array = npt.NDArray[np.float64]

PERCENTILES = (50.0, 95.0, 99.0, 99.9)
DRAWN = {50.0: (GREEN, "-"), 99.0: (VERMILION, (0, (5, 1.5)))}
"""Percentiles that have a line; the others are only in the key."""


def draw_sweeps(cell: Cell, recording: Recording) -> None:
    """Histogram of the sweeps' durations with percentiles."""
    ax = cell.one()
    ax.set_title("Sweep duration")
    durations = recording.sweep_durations_ms
    durations = durations[np.isfinite(durations)]
    if durations.size == 0:
        say(ax, "no sweep was completed")
        return
    # Fewer than a thousand know nothing of one in a thousand.
    told = PERCENTILES[: 4 if durations.size >= 1000 else 3]
    values = dict(zip(told, np.percentile(durations, told), strict=True))
    end = 1.3 * float(values[99.0])
    ax.hist(durations[durations <= end], bins=40, range=(0.0, end), color=BLUE, alpha=0.75)
    for percentile, value in values.items():
        label = f"p{percentile:g} = {value:.3g} ms"
        if percentile in DRAWN:
            tone, dashes = DRAWN[percentile]
            ax.axvline(value, color=tone, linestyle=dashes, linewidth=1.8, label=label)
        else:
            ax.plot([], [], " ", label=label)
    beyond = int(np.count_nonzero(durations > end))
    slowest = f"{float(durations.max()):.3g} ms"
    ax.plot(
        [], [], " ", label=f"{beyond} beyond, up to {slowest}" if beyond else f"max = {slowest}"
    )
    ax.set(xlabel="wall-clock time [ms]", ylabel="ticks")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlim(0.0, end)
    ax.legend(loc="upper left" if values[50.0] > 0.5 * end else "upper right", framealpha=0.9)
    ax.spines[["top", "right"]].set_visible(False)


def draw_sweep_course(cell: Cell, recording: Recording) -> None:
    """Every sweep's duration over the ticks, with percentiles and, in real time, the period."""
    ax = cell.one()
    ax.set_title("Sweep duration over the run")
    durations = recording.sweep_durations_ms
    finite = durations[np.isfinite(durations)]
    if finite.size == 0:
        say(ax, "no sweep was completed")
        return
    size = 5.0 if finite.size < FEW else 2.5
    ax.plot(recording.times_s, durations, ".", color=BLUE, markersize=size, alpha=0.6)
    for percentile, (tone, dashes) in DRAWN.items():
        value = float(np.percentile(finite, percentile))
        ax.axhline(value, color=tone, linestyle=dashes, linewidth=1.4, label=f"p{percentile:g}")
    pace = recording.configuration.pace
    if pace is not None:
        label = f"period, {1e3 * pace.period_s:g} ms"
        ax.axhline(1e3 * pace.period_s, color="black", linewidth=1.0, linestyle=":", label=label)
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.set_ylim(0.8 * low, 2.5 * high)  # room for the key
    ax.yaxis.set_major_formatter(FuncFormatter(in_full))
    ax.yaxis.set_minor_formatter(FuncFormatter(_sparse))
    ax.set_ylabel("wall-clock time [ms]")
    ax.legend(loc="upper right", ncols=3, frameon=False)
    tidy(ax)
    over_time(ax, recording)


def _sparse(value: float, _: int | None) -> str:
    """Labels between the powers of ten: at 2 and 5 times one."""
    leading = f"{value:.0e}"[0]
    return f"{value:g}" if leading in "25" else ""


def draw_messages(cell: Cell, recording: Recording) -> None:
    """Messages by kind and by link, as the receivers counted them, against what is expected."""
    links, sweeps = recording.links(), recording.sweeps()
    if links is None or sweeps is None:
        ax = cell.one()
        ax.set_title("Messages, counted by receivers")
        if recording.counters is None:
            reason = "the file ends before the final counters,\nwhich the recorder writes last"
        else:
            there = recording.counter("nodes_reporting")
            reason = f"the final counters of {there} of {recording.nodes} nodes arrived"
        say(ax, f"no counts: {reason}")
        return
    kinds, along = cell.stack(1.0, 1.15, shared=False)
    _by_kind(kinds, recording, sweeps)
    _by_link(along, recording, sweeps)


def _by_kind(ax: Any, recording: Recording, sweeps: int) -> None:
    processes = len(recording.configuration.firsts)
    counts = {
        "forward sums": (recording.total("forward_received_messages"), processes - 1),
        "backward sums": (recording.total("backward_received_messages"), processes - 1),
        "measurements": (recording.counter("measurement_messages"), processes),
        "commands": (recording.counter("command_messages"), processes),
    }
    most = max(max(count or 0, each * sweeps) for count, each in counts.values()) or 1
    for row, (count, each) in enumerate(counts.values()):
        expected = each * sweeps
        ax.barh(row, count or 0, height=0.62, color=BLUE, alpha=0.75)
        ax.plot([expected, expected], [row - 0.4, row + 0.4], color=VERMILION, linewidth=2.0)
        shown = "unknown" if count is None else f"{count}"
        if count is not None and sweeps:
            shown += f" = {count / sweeps:.4g} a tick"
        ax.text(0.02 * most, row, shown, va="center", fontsize=8.5, color="black")
    ax.set_yticks(range(len(counts)), list(counts))
    ax.set_ylim(len(counts) - 0.5, -0.5)
    ax.set_xlim(0.0, 1.08 * most)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.set_xlabel("messages (line: expected)")
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    ax.set_title(f"Messages; sums: {2 * (processes - 1)} a tick expected")


def _by_link(ax: Any, recording: Recording, sweeps: int) -> None:
    """What each link delivered, over its number from the root; a link whose ends differ is ringed."""
    links = recording.links() or []
    size = max(2.0, 5.0 - len(links) / 40.0)
    for way, marker, tone in (("forward", "^", BLUE), ("backward", "v", GREEN)):
        mine = [link for link in links if link.way == way]
        at = [min(link.sender, link.receiver) + 0.5 for link in mine]
        ax.plot(
            at, [link.received for link in mine], marker, color=tone, markersize=size, label=way
        )
    broken = [link for link in links if not link.intact]
    ax.plot(
        [min(link.sender, link.receiver) + 0.5 for link in broken],
        [link.received for link in broken],
        "o",
        color=VERMILION,
        markerfacecolor="none",
        markersize=11,
        label=f"ends differ ({len(broken)})",
    )
    ax.axhline(sweeps, color=VERMILION, linewidth=1.4, zorder=0.8)
    most = max([sweeps, *(link.received for link in links)]) or 1
    ax.set_ylim(0.0, 1.15 * most)
    ax.set_xlim(-0.5, recording.nodes - 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    ax.set(xlabel="node (a link lies between two)", ylabel="messages")
    handles = ax.get_legend_handles_labels()[0]
    ax.legend(
        handles=handles if broken else handles[:2],
        loc="lower center",
        ncols=3,
        fontsize=8.5,
        framealpha=0.9,
        columnspacing=1.0,
    )
    if not links:
        ax.text(
            0.5,
            0.6,
            "all segments are in one process",
            transform=ax.transAxes,
            ha="center",
            color=GREY,
        )
    passed = recording.counter("passed_messages")
    refused = recording.counter("rejected_messages")
    words = [f"{refused} refused"]
    if passed:
        words.append(f"{passed} passed in memory")
    ax.set_title(f"By link; {', '.join(words)}", fontsize="medium", loc="left")
    tidy(ax)
