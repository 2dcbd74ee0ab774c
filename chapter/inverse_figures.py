"""Figures of the inverse: what a polynomial R_0^-1 costs by degree, and kernels of P^-1 where R_1 != R_2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from analysis.study.figures import COLOURS
from chapter.inverse_cases import OneKernel
from chapter.inverse_rational import TOOLBOX_DEGREE, RationalRow

Array = npt.NDArray[np.float64]
FLOOR = 1e-14


def degrees(
    at: Sequence[int],
    rows: Sequence[RationalRow],
    sizes: Sequence[int],
    best: Sequence[float],
) -> Figure:
    """Left: error of P^-1 over the degree of R_0^-1; right: with one polynomial kernel for R_1 != R_2."""
    figure = Figure(figsize=(12.0, 4.8), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    d = np.asarray(at, dtype=np.float64)
    for colour, row in zip(COLOURS, rows, strict=False):
        label = f"{row.name}: $\\rho$ = {row.rho:.3f}"
        left.semilogy(d, row.errors, "o-", color=colour, lw=1.3, ms=4, label=label)
        line = row.errors[3] * row.rho ** (d[3] - d)
        left.semilogy(d, line, ":", color=colour, lw=1.0)
        left.semilogy(TOOLBOX_DEGREE, row.toolbox, "s", color=colour, ms=9, fillstyle="none")
    left.semilogy([], [], ":", color="#555555", label="$\\rho^{-d}$ through d = 8")
    left.semilogy(
        [], [], "s", color="#555555", ms=9, fillstyle="none", label="degree 6, 101 points"
    )
    left.axhline(1e-6, color="#999999", lw=0.8, ls="--")
    left.set_ylim(1e-15, 30.0)
    left.set_xlabel("degree d of the polynomial for $R_0^{-1}$")
    left.set_ylabel("error of $P^{-1}$, relative")
    left.set_title("$R_1 = R_2$: formula with $R_0^{-1}$ by polynomials", loc="left", fontsize=10.5)
    left.legend(fontsize=9, loc="lower left")
    right.loglog(sizes, best, "o-", color=COLOURS[0], lw=1.3, ms=4)
    n = np.asarray(sizes, dtype=np.float64)
    right.loglog(n, best[-1] * (n / n[-1]) ** -2.0, ":", color="#777777", lw=1.0)
    right.text(
        n[2], 1.4 * best[-1] * (n[2] / n[-1]) ** -2.0, "order 2", fontsize=9, color="#777777"
    )
    right.set_xticks(list(sizes), [str(k) for k in sizes])
    right.minorticks_off()
    right.set_xlabel("polynomials a variable = rank of the kernel")
    right.set_ylabel("error of $P^{-1}$, spectral norm, relative")
    right.set_title("$R_1 \\neq R_2$: best single kernel, same formula", loc="left", fontsize=10.5)
    for ax in (left, right):
        ax.grid(color="#DDDDDD", linewidth=0.6)
    return figure


def kernels(
    s: Array, theta: float, curves: Mapping[str, Array], rows: Sequence[OneKernel], c: float
) -> Figure:
    """Left: N(s, theta) of P^-1 for the membrane, every way; right: errors over the size c of its kernel."""
    figure = Figure(figsize=(12.0, 4.8), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    styles = {"closed form": ("-", "black", 3.0), "octarm": ("--", COLOURS[4], 1.6)}
    for k, (name, values) in enumerate(curves.items()):
        style, colour, width = styles.get(name, ("-", COLOURS[k - 2], 1.3))
        left.plot(s, values, style, color=colour, lw=width, label=_math(name))
    left.axvline(theta, color="#999999", lw=0.8, ls=":")
    left.set_xlabel("s")
    left.set_ylabel(f"kernel of $P^{{-1}}$ at $\\theta$ = {theta:g}")
    left.set_title(
        f"$R_0 = 1$, $R_1 = {c:g}\\,\\theta$, $R_2 = {c:g}\\,s$", loc="left", fontsize=10.5
    )
    left.legend(fontsize=9, loc="best")
    values_c = [row.c for row in rows]
    ways = {
        "octarm (ODE)": [row.octarm for row in rows],
        "octarm, functions": [row.octarm_functions for row in rows],
        "19 terms of Picard's series": [row.series for row in rows],
        **{_math(name): [row.one[name] for row in rows] for name in rows[0].one},
        "quadrature": [row.quadrature for row in rows],
    }
    colours = (COLOURS[4], "#7A4B2A", COLOURS[3], COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[5])
    for colour, (name, errors) in zip(colours, ways.items(), strict=True):
        shown = np.maximum(np.asarray(errors), FLOOR)
        right.loglog(values_c, shown, "o-", color=colour, lw=1.3, ms=4, label=name)
    right.axhline(1e-6, color="#999999", lw=0.8, ls="--")
    right.set_ylim(1e-15, 1e12)
    right.set_xlabel("size c of the kernel")
    right.set_ylabel("error of $P^{-1}$ on smooth functions, relative")
    right.set_title(
        "against the closed form (octarm refuses kernels at 1000)", loc="left", fontsize=10.5
    )
    right.legend(fontsize=9, loc="upper left", ncols=2)
    for ax in (left, right):
        ax.grid(color="#DDDDDD", linewidth=0.6)
    return figure


def _math(name: str) -> str:
    return name.replace("R_1", "$R_1$").replace("R_2", "$R_2$")
