"""The picture of the study of growth: four log-log panels over the number of segments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from analysis.study.figures import COLOURS

LEAST = 1e-3
"""Smaller seconds and MiB are none."""
_STYLES = {1: "-o", 10: "--s", 100: ":^"}


def draw_growth(facts: dict[str, Any], path: Path) -> None:
    """Draw the facts of `analysis.study.growth` into a PNG."""
    rows, dense = facts["rows"], facts["dense"]
    counts = [row["nodes"] for row in rows]
    figure = Figure(figsize=(12.0, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    (time, memory), (sweep, size) = figure.subplots(2, 2)
    for axes, title, key, old in (
        (time, "deployment, processor time [s]", "deploy_cpu_seconds", "cpu_seconds"),
        (memory, "deployment, peak memory [MiB]", "deploy_peak_mib", "peak_mib"),
    ):
        for place, found, field, label in (
            (0, rows, key, "structured"),
            (1, dense, old, "dense (octarm deploy)"),
        ):
            there = [(one["nodes"], one[field]) for one in found if one[field] >= LEAST]
            if there:
                at, values = zip(*there, strict=True)
                axes.loglog(at, values, "o-", color=COLOURS[place], label=label)
        axes.set_title(title, loc="left", fontsize=10)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, frameon=False)
    names = list(dict.fromkeys(one["hosts"] for row in rows for one in row["cases"]))
    for colour, name in zip(COLOURS, names, strict=False):
        for segments, style in _STYLES.items():
            points = [
                (row["nodes"], one["p99_ms"])
                for row in rows
                for one in row["cases"]
                if (one["hosts"], one["segments"]) == (name, segments)
            ]
            if points:
                at, p99 = zip(*points, strict=True)
                legend = name if segments == 1 else None
                sweep.loglog(
                    at, p99, style, color=colour, markersize=3.5, linewidth=1.1, label=legend
                )
    sweep.axhline(1e3 * facts["tick_s"], color="0.4", linewidth=1.0)
    sweep.set_title(
        "sweep, p99 [ms]: 1 (line), 10 (dashed), 100 (dotted) segments a process; grey: tick",
        loc="left", fontsize=9,
    )  # fmt: skip
    sweep.legend(fontsize=8, frameon=False)
    for k, (key, label) in enumerate(
        (
            ("message_bytes_max", "message, longest"),
            ("message_bytes_mean", "message, mean"),
            ("factor_bytes", "factors of a node"),
            ("object_bytes", "objects of a node"),
        )
    ):
        size.loglog(
            counts, [row[key] for row in rows], "-o", color=COLOURS[k], markersize=4, label=label
        )
    size.set_title("bytes", loc="left", fontsize=10)
    size.set_ylim(bottom=50.0)
    size.legend(fontsize=8, frameon=False)
    for axes in (time, memory, sweep, size):
        axes.set_xlabel("segments n", fontsize=9)
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8)
    figure.savefig(path, dpi=90, format="png")
