"""Figure of sections 3.4.1 and 3.5.1: gammas against the Riccati equation, and gains without D_12."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from analysis.study.figures import COLOURS

if TYPE_CHECKING:
    from chapter.ode import Row


def gammas(table: Sequence[Row], without: Sequence[tuple[float, float, float]]) -> Figure:
    """Left: `table` relative to its Riccati column; right: (gamma, K, norm) of the scalar example."""
    figure = Figure(figsize=(12.0, 4.8), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [2.4, 1]})
    for k, problem in enumerate(("observer", "controller")):
        of = [row for row in table if row.problem == problem]
        at = np.arange(len(of)) + 0.3 * (k - 0.5)
        series = (
            ("least gamma of the LMI", "o", [row.least for row in of]),
            ("norm achieved by its gain", "x", [row.achieved for row in of]),
        )
        for name, marker, values in series:
            excess = [abs(v / row.riccati - 1.0) for v, row in zip(values, of, strict=True)]
            left.semilogy(
                at,
                np.maximum(excess, 1e-8),
                marker,
                color=COLOURS[k],
                label=f"{problem}: {name}",
                markerfacecolor="none",
            )
    labels = [
        f"{row.n}{'' if row.stable else ' u'}{' D' if row.feedthrough else ''}"
        for row in table
        if row.problem == "observer"
    ]
    left.set_xticks(range(len(labels)), labels, rotation=60, fontsize=8.5)
    left.set_xlabel("states (u: unstable, D: D₁₁ not zero)")
    left.set_ylabel("relative difference from the Riccati equation's gamma")
    left.set_ylim(5e-9, 0.3)
    left.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    left.legend(fontsize=8.5, ncols=2, loc="upper left")
    gammas = np.array([one[0] for one in without])
    grid = np.geomspace(gammas.min(), gammas.max(), 50)
    right.loglog(grid, 1.0 + 1.0 / grid, color=COLOURS[5], lw=1.0, label="1 + 1/gamma")
    right.loglog(gammas, [-one[1] for one in without], "o", color=COLOURS[1], label="LMI")
    right.set_xlabel("gamma")
    right.set_ylabel("|K|")
    right.set_title("no D₁₂: x' = x + w + u, z = x", loc="left", fontsize=10.0)
    right.grid(color="#DDDDDD", linewidth=0.6)
    right.legend(fontsize=9)
    return figure
