"""Figures of `chapter.lpi`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from chapter.lpi_gains import ChapterGains
from chapter.lpi_own import Tried
from chapter.lpi_tables import Row
from chapter.lpi_why import Along

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#555555")  # Okabe and Ito
DPI = 100
STYLE = {"font.size": 10.0, "axes.titlesize": 10.5, "axes.titlelocation": "left"}


def why_figure(
    null: Sequence[tuple[str, Along]],
    root: Sequence[tuple[str, Along]],
    conditions: Sequence[tuple[float, float, float]],
    relaxed: Sequence[Tried],
    epsilon: float,
) -> Figure:
    """Four panels: the form along weakly null f_n, along f_n at the root, cond(P) by modes, gamma by residual.

    conditions: (omega_n^2, least cond(P) without, with the outputs) for n = 1, 2, … modes.
    """
    with mpl.rc_context(STYLE):
        figure, axes = _figure(2, 2, 760)
        ax = axes[0, 0]
        for k, (name, a) in enumerate(null):
            ax.loglog(a.n, np.abs(a.form), "o-", color=COLOURS[k], label=f"|form|, P = I, {name}")
        ax.axhline(epsilon, color="black", linestyle="--", linewidth=1.0)
        ax.text(
            0.98 * null[0][1].n[-1], 1.5 * epsilon, f"-epsilon I asks for more than {epsilon:g}",
            fontsize=9, ha="right",
        )  # fmt: skip
        _labels(ax, "(a) along f_n = phi_n, weakly null", "n", "form / |f_n|^2")
        ax.set_xticks(null[0][1].n, map(str, null[0][1].n))
        ax.minorticks_off()
        ax = axes[0, 1]
        for k, (name, a) in enumerate(root):
            ax.loglog(a.n, a.bound, "o-", color=COLOURS[k], label=f"bound of the form, {name}")
        ax.loglog(root[0][1].n, root[0][1].mean, "s--", color=COLOURS[3], label="|C1 f_n|")
        _labels(ax, "(c) along f_n = (n+1)(1-s)^n in w: all vanishes but the mean", "n", "")
        ax.set_xticks(root[0][1].n, map(str, root[0][1].n))
        ax.minorticks_off()
        ax.set_ylim(bottom=1e-5)
        ax = axes[1, 0]
        n = range(1, len(conditions) + 1)
        ax.semilogy(n, [c[0] for c in conditions], "--", color="black", label="omega_n^2")
        ax.semilogy(n, [c[1] for c in conditions], "o", color=COLOURS[0], label="without outputs")
        ax.semilogy(n, [c[2] for c in conditions], "s-", color=COLOURS[1], label="any Z, y of (22)")
        ax.set_xticks(list(n))
        _labels(ax, "(b) least cond(P) of the straight beam", "modes of the beam", "cond(P)")
        ax = axes[1, 1]
        done = [t for t in relaxed if np.isfinite(t.gamma)]
        at = [t.tolerance for t in done]
        ax.loglog(at, [t.gamma for t in done], "o-", color=COLOURS[0], label="gamma")
        ax.loglog(
            at, [t.eigenvalue for t in done], "s-", color=COLOURS[1], label="violation of (18) / |f|^2"
        )  # fmt: skip
        ax.invert_xaxis()
        _labels(ax, "the solver, straight beam: no limit", "allowed residual of the equalities", "")
        for a, place in zip(
            axes.ravel(), ("lower left", "lower left", "best", "best"), strict=True
        ):
            a.legend(fontsize=9, frameon=False, loc=place)
        return figure


def epsilon_figure(rows: Sequence[Row], half_drag: float, least: float) -> Figure:
    """Gamma, rates and gains against the certified decay, for rising epsilon and for a decay required."""
    with mpl.rc_context(STYLE):
        figure, axes = _figure(1, 3, 420)
        for required, marker, name in ((False, "o-", "-eps T*T"), (True, "s--", "+2 beta T*PT")):
            of = [r for r in rows if (r.decay_required > 0.0) is required and np.isfinite(r.gamma)]
            x = [r.certified_decay for r in of]
            axes[0].semilogy(
                x, [r.gamma for r in of], marker, color=COLOURS[0], label=f"certified, {name}"
            )
            axes[0].semilogy(
                x, [r.achieved for r in of], marker, color=COLOURS[1], label=f"achieved, {name}"
            )
            axes[1].plot(
                x,
                [r.first_mode_decay for r in of],
                marker,
                color=COLOURS[2],
                label=f"first mode, {name}",
            )
            axes[1].plot(
                x,
                [r.slowest_decay for r in of],
                marker,
                color=COLOURS[3],
                label=f"slowest mode, {name}",
            )
            axes[2].plot(
                x, [r.gain_1 for r in of], marker, color=COLOURS[0], label=f"|L|, y1, {name}"
            )
            axes[2].plot(
                x, [r.gain_2 for r in of], marker, color=COLOURS[4], label=f"|L|, y2, {name}"
            )
        axes[0].axhline(
            least, color="black", linestyle=":", linewidth=1.0, label="least of all observers"
        )
        axes[1].axhline(
            half_drag, color="black", linestyle=":", linewidth=1.0, label="half the drag"
        )
        for ax, title, y in zip(
            axes,
            ("H-infinity norm", "decay on the grid", "gain"),
            ("gamma", "rate", "L2 norm"),
            strict=True,
        ):
            _labels(ax, title, "certified decay", y)
            ax.legend(fontsize=8, frameon=False, loc="best")
            ax.set_ylim(top=ax.get_ylim()[1] * (4.0 if ax is axes[0] else 1.45))
        return figure  # fmt: skip


def gains_figure(gains: Sequence[ChapterGains]) -> Figure:
    """L(s) in SI units: the two outputs by rows, the four energy states by columns, the setpoints by colour."""
    names = ("v_x", "v_y", "strain", "curvature")
    units = (("1/s^2", "1/s^2", "1/(m s)", "1/(m^2 s)"), ("m^3/s^2", "m^3/s^2", "m^2/s", "m/s"))
    s = np.linspace(0.0, 1.0, 301)
    with mpl.rc_context(STYLE):
        figure, axes = _figure(2, 4, 620)
        for color, g in zip(COLOURS, gains, strict=False):
            values = g.energy_si(s)
            for i in range(2):
                for j in range(4):
                    axes[i, j].plot(s, values[j, i], color=color, label=f"setpoint {g.setpoint}")
        for i in range(2):
            for j in range(4):
                _labels(axes[i, j], f"y{i + 1} into {names[j]}", "s [m]" if i else "", units[i][j])
                axes[i, j].axhline(0.0, color="#999999", linewidth=0.6)
                axes[i, j].ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
        return figure


def _figure(rows: int, columns: int, height: int) -> tuple[Figure, Any]:
    figure = Figure(figsize=(12.0, height / DPI), dpi=DPI, layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)


def _labels(ax: Any, title: str, x: str, y: str) -> None:
    ax.set_title(title)
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(visible=True, color="#dddddd", linewidth=0.6)
