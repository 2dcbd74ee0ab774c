"""The two figures of the part "model": growth of waves, frozen and on the whole arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from analysis.study.figures import COLOURS, DPI
from chapter import waves
from chapter.constants import CORRECTED, LENGTH_M
from chapter.pde import SETPOINTS

STYLE = {"font.size": 10.0, "axes.titlesize": 10.5, "axes.titlelocation": "left"}
SEGMENTS = 10
"""Of the chapter's grid."""
FLOOR = 1e-2
"""Growth rates below this are not drawn, 1/s."""


def growth(
    steep: Mapping[str, tuple[float, float]],
    bands: Mapping[str, tuple[float, float]],
    packets: Mapping[str, Sequence[tuple[float, float]]],
) -> Figure:
    """Growth rate against wave number at the steepest point of each setpoint; packets on the arm itself."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 5.0), dpi=DPI, layout=ConstrainedLayoutEngine())
        FigureCanvasAgg(figure)
        k = np.unique(np.concatenate([np.geomspace(1.0, 2000.0, 400), *bands.values()]))
        for ax, s in zip(figure.subplots(1, 3, sharey=True), SETPOINTS, strict=True):
            x, slope = steep[s.name]
            curves = (
                (
                    "(5) printed, frozen",
                    waves.frozen_growth(s, CORRECTED, "printed", x, k),
                    "-",
                    3.5,
                ),
                (
                    "(5) corrected, frozen in its energy",
                    waves.energy_growth(s, CORRECTED, "cubic", x, k),
                    "-",
                    1.5,
                ),
                (
                    "fourth derivatives alone",
                    np.array([waves.leading_growth(slope, v, CORRECTED) for v in k]),
                    ":",
                    1.5,
                ),
            )
            for colour, (label, values, style, width) in zip(
                (COLOURS[4], COLOURS[0], COLOURS[5]), curves, strict=True
            ):
                drawn = np.where(values > FLOOR, values, np.nan)
                ax.loglog(k, drawn, style, color=colour, lw=width, label=label)
            low, high = bands[s.name]
            ax.axvspan(
                low, high, color=COLOURS[2], alpha=0.18, lw=0, label="no growth, A_2 and A_4 alone"
            )
            ax.axvline(
                np.pi * SEGMENTS / LENGTH_M,
                color=COLOURS[3],
                lw=1.2,
                label="shortest wave of 10 segments",
            )
            ax.plot(
                *zip(*packets[s.name], strict=True),
                "o",
                color="black",
                markersize=4.0,
                label="wave packet on the arm (lower bound)",
            )
            exact = waves.energy_growth(s, CORRECTED, "exact", x, k)
            ax.set_title(
                f"Setpoint {s.name}: slope {slope:.2f} at x = {x:.3f} m\n"
                f"linearised (1): {'no growth' if not exact.any() else f'growth up to {exact.max():.2g}/s'}"
            )
            ax.set_xlabel("wave number [1/m]")
            ax.set_xlim(1.0, 2000.0)
            ax.set_ylim(FLOOR, 1e6)
            ax.grid(color="#DDDDDD", linewidth=0.6)
            ax.set_axisbelow(True)
            for side in ("top", "right"):
                ax.spines[side].set_visible(False)
        first = figure.axes[0]
        first.set_ylabel("growth rate [1/s]")
        figure.legend(
            *first.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9.0
        )
    return figure


def ritz(
    values: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], sizes: Sequence[int]
) -> Figure:
    """Growth rate of the whole arm against the number of shape functions, at the printed and at
    unstretched shapes."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 4.2), dpi=DPI, layout=ConstrainedLayoutEngine())
        FigureCanvasAgg(figure)
        left, right = figure.subplots(1, 2, sharey=True)
        printed = {n: by for n, by in values.items() if "," not in n}
        own = {n: by for n, by in values.items() if "," in n}
        for ax, shown, title in (
            (left, printed, "At u_e = 0, w_e as printed, x in [0, 1]"),
            (right, own, "At octarm's unstretched setpoints"),
        ):
            for colour, (name, by) in zip(COLOURS, shown.items(), strict=False):
                rates = [g for g, _ in by["cubic"]]
                label = f"setpoint {name.split(',')[0]}"
                ax.semilogy(sizes, rates, "o-", color=colour, label=label)
            worst = max(g for by in shown.values() for g, _ in by["exact"])
            exact = "no growth" if worst == 0.0 else f"growth up to {worst:.2g}/s"
            ax.set_title(f"{title}\n(5) corrected, lower bounds; linearised (1): {exact}")
            ax.set_xlabel("shape functions for each of u~ and w~")
            ax.set_xticks(sizes)
            ax.grid(axis="y", color="#DDDDDD", linewidth=0.6)
            for side in ("top", "right"):
                ax.spines[side].set_visible(False)
        left.set_ylabel("growth rate of the whole arm [1/s]")
        left.legend(frameon=False)
    return figure
