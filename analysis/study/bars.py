"""Grouped bars of a study's rows, one panel a quantity; matplotlib's objects on the Agg canvas, no display."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from wire.errors import UsageError

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito
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
        figure = Figure(figsize=(12.0, 1.2 + 2.3 * len(panels)), layout=ConstrainedLayoutEngine())
        FigureCanvasAgg(figure)
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        width = _WIDTH / len(series)
        for ax, (title, values) in zip(axes, panels, strict=True):
            for k, (name, row, crossed) in enumerate(zip(series, values, missing, strict=True)):
                at = [g + (k + 0.5) * width - 0.5 * _WIDTH for g in range(len(groups))]
                colour = COLOURS[k % len(COLOURS)]
                there = [(x, v) for x, v in zip(at, row, strict=True) if math.isfinite(v)]
                ax.bar(
                    [x for x, _ in there],
                    [v for _, v in there],
                    0.92 * width,
                    color=colour,
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
            ax.set_title(title)
            ax.grid(axis="y", color="#DDDDDD", linewidth=0.6)
            ax.set_axisbelow(True)
            for side in ("top", "right"):
                ax.spines[side].set_visible(False)
        axes[-1].set_xticks(range(len(groups)), groups, rotation=25, ha="right")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=6)
        if any(wrong for row in missing for wrong in row):
            figure.supxlabel("x: not stable", fontsize=9.0, x=0.99, ha="right")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=DPI)
        except OSError as error:
            raise UsageError(
                f"plot {path}: {error.strerror or error}; choose another --out"
            ) from None
