"""Figures of section 4: Fig. 3 with the numbers of a recorded tick, and what the rules are worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from analysis.study.figures import COLOURS

Array = npt.NDArray[np.float64]
SMOOTH = 20
"""Ticks that the tip's error is averaged over for the eye."""
NAMES = {
    "display": "first formula, j = i under K₁",
    "transfer": "last formula, j = i left out",
    "midpoint": "corrected: midpoints, j = i halved",
}


def transfer(tick: int, x: Array, c: Array, d: Array, u: Array) -> Figure:
    """x (N, 2): (v_y, k) less the setpoint's; c (N, r), d (N, r) as received; u (N,) in N/m, of the next
    tick."""
    count = len(x)
    figure = Figure(figsize=(12.0, 4.6), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    ax.set_xlim(-0.62, count - 0.38)
    ax.set_ylim(-1.75, 1.75)
    ax.axis("off")
    for i in range(count):
        ax.add_patch(
            FancyBboxPatch(
                (i - 0.3, -0.45), 0.6, 0.9, boxstyle="round,pad=0.04", fc="#F2F2F2", ec="#555555"
            )
        )
        text = f"node {i}\n{1e3 * x[i, 0]:.1f} mm/s\n{x[i, 1]:.2f} 1/m\n{1e3 * u[i]:.2f} mN/m"
        ax.text(i, 0.0, text, ha="center", va="center", fontsize=8.0)
    for i in range(count - 1):
        for y, sign, colour, name, value in (
            (0.75, 1, COLOURS[0], f"c$_{{{i + 1}}}$", c[i + 1]),
            (-0.75, -1, COLOURS[1], f"d$_{{{i + 1}}}$", d[i]),
        ):
            start, end = (i + 0.08, i + 0.92) if sign > 0 else (i + 0.92, i + 0.08)
            ax.add_patch(
                FancyArrowPatch(
                    (start, y),
                    (end, y),
                    arrowstyle="-|>",
                    mutation_scale=12,
                    color=colour,
                    connectionstyle="arc3,rad=-0.35",
                )
            )
            ax.text(
                i + 0.5,
                y + sign * 0.42,
                f"{name}\n{np.linalg.norm(value):.2g}",
                ha="center",
                va="center",
                fontsize=8.5,
                color=colour,
            )
    rank = c.shape[1]
    ax.text(
        -0.6,
        1.62,
        f"forward: c$_{{i+1}}$ = c$_i$ + K$_{{1b}}$ x$_i$, {rank} numbers each (norm shown)",
        color=COLOURS[0],
        fontsize=10,
    )
    ax.text(
        -0.6,
        -1.7,
        f"backward: d$_i$ = d$_{{i+1}}$ + K$_{{2b}}$ x$_i$, {d.shape[1]} numbers each (norm shown)",
        color=COLOURS[1],
        fontsize=10,
    )
    ax.set_title(
        f"Fig. 3 as recorded: {2 * (count - 1)} transfers of tick {tick} between {count} processes; "
        "v, k and u in the boxes",
        loc="left",
        fontsize=11,
    )
    return figure


def rules(
    counts: Sequence[int],
    errors: Mapping[str, Sequence[float]],
    runs: Mapping[str, Any],
    tick_s: float,
) -> Figure:
    """Left: error of the commands over the number of nodes; right: the tip in real runs, `runs[rule]` in m."""
    figure = Figure(figsize=(12.0, 4.6), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for k, (rule, values) in enumerate(errors.items()):
        left.loglog(counts, values, "o-", color=COLOURS[k], label=NAMES[rule], lw=1.3)
    at = np.array([counts[0], counts[-1]], dtype=np.float64)
    for order in (1, 2):
        left.loglog(at, 0.4 * (at / at[0]) ** -order, ":", color="#999999", lw=0.9)
        left.text(
            60, 0.55 * (60 / at[0]) ** -order, f"order {order}", fontsize=8.5, color="#777777"
        )
    left.set_xlabel("nodes")
    left.set_ylabel("largest error of a command, relative")
    left.set_title("against the exact integral", loc="left", fontsize=10.5)
    left.legend(fontsize=9, loc="lower left")
    left.grid(color="#DDDDDD", linewidth=0.6)
    for k, (rule, values) in enumerate(runs.items()):
        smooth = np.convolve(values, np.full(SMOOTH, 1.0 / SMOOTH), mode="valid")
        times = tick_s * (np.arange(len(smooth)) + 0.5 * SMOOTH)
        right.semilogy(times, 1e3 * smooth, color=COLOURS[k], lw=1.2, label=NAMES[rule])
    right.set_xlabel("time [s]")
    right.set_ylabel(f"tip error, mean of {SMOOTH * tick_s:g} s [mm]")
    right.set_title(
        "the arm under each, real node processes, no observer", loc="left", fontsize=10.5
    )
    right.grid(color="#DDDDDD", linewidth=0.6)
    return figure
