"""Figures of the studies: grouped bars, and curves over time; no display is needed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from wire.errors import UsageError

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#555555")  # Okabe and Ito
DPI = 100
_STYLE = {"font.size": 10.0, "axes.titlesize": 10.5, "axes.titlelocation": "left"}
_WIDTH = 0.8  # of a group, where 1 is the distance between groups
_FAR = 30.0  # with a larger ratio of largest to smallest value the axis is logarithmic


def grouped_bars(
    path: Path,
    groups: Sequence[str],
    series: Sequence[str],
    panels: Sequence[tuple[str, Sequence[Sequence[float]]]],
    missing: Sequence[Sequence[bool]],
) -> None:
    """Draw the panels (title, values[series][group]) below each other into a PNG 1200 pixels wide.

    NaN makes no bar; where `missing[series][group]` a cross stands at the bottom (an unstable loop). Raises
    UsageError if the file cannot be written.
    """
    with mpl.rc_context(_STYLE):
        figure, axes = _panels([title for title, _ in panels])
        width = _WIDTH / len(series)
        for ax, (_, values) in zip(axes, panels, strict=True):
            for k, (name, row, crossed) in enumerate(zip(series, values, missing, strict=True)):
                at = [g + (k + 0.5) * width - 0.5 * _WIDTH for g in range(len(groups))]
                there = [(x, v) for x, v in zip(at, row, strict=True) if math.isfinite(v)]
                ax.bar(
                    [x for x, _ in there],
                    [v for _, v in there],
                    0.92 * width,
                    color=COLOURS[k % len(COLOURS)],
                    label=name,
                )
                crosses = [x for x, wrong in zip(at, crossed, strict=True) if wrong]
                if crosses:
                    ax.plot(
                        crosses,
                        [0.04] * len(crosses),
                        "x",
                        color="black",
                        markersize=7,
                        transform=ax.get_xaxis_transform(),
                        label="_",
                    )
            finite = [v for row in values for v in row if math.isfinite(v) and v > 0.0]
            if finite and max(finite) > _FAR * min(finite):
                ax.set_yscale("log")
        axes[-1].set_xticks(range(len(groups)), groups, rotation=25, ha="right")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=6)
        if any(wrong for row in missing for wrong in row):
            figure.supxlabel("x: not stable", fontsize=9.0, x=0.99, ha="right")
        _save(figure, path)


def curves(
    path: Path, panels: Sequence[tuple[str, Mapping[str, Sequence[float]]]], step_s: float
) -> None:
    """Draw the panels (title, values over time by name) below each other, logarithmic, a sample each `step_s`.

    Raises UsageError if the file cannot be written.
    """
    with mpl.rc_context(_STYLE):
        figure, axes = _panels([title for title, _ in panels])
        for ax, (_, lines) in zip(axes, panels, strict=True):
            for k, (name, values) in enumerate(lines.items()):
                times = [i * step_s for i in range(len(values))]
                ax.semilogy(times, values, color=COLOURS[k % len(COLOURS)], lw=1.4, label=name)
        axes[-1].set_xlabel("time [s]")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=6)
        _save(figure, path)


def _panels(titles: Sequence[str]) -> tuple[Figure, list[Any]]:
    figure = Figure(figsize=(12.0, 1.2 + 2.3 * len(titles)), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(len(titles), 1, sharex=True, squeeze=False)[:, 0])
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title)
        ax.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        ax.set_axisbelow(True)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    return figure, axes


def _save(figure: Figure, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=DPI)
    except OSError as error:
        raise UsageError(f"plot {path}: {error.strerror or error}; choose another --out") from None
