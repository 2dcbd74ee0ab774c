"""Figures of sections 3.1 to 3.3: the error of the printed H_1, and the kernels of T and A."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from analysis.study.figures import COLOURS
from chapter.conversion import CLAMPED_FREE, Formulas, boundary_matrix
from chapter.pde import Matrix

Array = npt.NDArray[np.float64]
Errors = Mapping[str, Mapping[str, list[float]]]


def h1_errors(errors: Errors) -> Figure:
    """Bars per row of (4): `errors[setpoint][form of H_1]` has the four rows' relative errors."""
    figure = Figure(figsize=(12.0, 4.4), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(errors), sharey=True)
    names = ("u", "u_t", "w", "w_t")
    for ax, (setpoint, forms) in zip(axes, errors.items(), strict=True):
        for k, (form, rows) in enumerate(forms.items()):
            at = np.arange(4) + 0.4 * (k - 0.5)
            ax.bar(at, np.maximum(rows, 1e-17), 0.38, color=COLOURS[1 - k], label=f"H₁ {form}")
        ax.set_yscale("log")
        ax.set_ylim(1e-17, 1e3)
        ax.axhline(np.finfo(float).eps, color="#555555", lw=0.8, ls=":")
        ax.set_xticks(range(4), [f"row of {name}" for name in names])
        ax.set_title(f"setpoint {setpoint}", loc="left")
        ax.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        ax.set_axisbelow(True)
    axes[0].set_ylabel("largest error of A f, relative to the row")
    axes[0].set_title("dotted: machine precision", loc="right", fontsize=8.5, color="#555555")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def kernels(A: tuple[Matrix, ...], setpoint: str) -> Figure:
    """G of one state, and the entry of H from d_s^4 w to u_tt, corrected and printed, over (theta, s)."""
    points = np.linspace(0.0, 1.0, 81)
    B = boundary_matrix(CLAMPED_FREE, len(A[0]))
    right, printed = Formulas(A, B, "corrected"), Formulas(A, B, "printed")

    def sampled(below: Formulas, which: str, row: int, column: int) -> Array:
        lower, upper = getattr(below, f"{which}1"), getattr(right, f"{which}2")
        return np.array(
            [[(lower if t <= s else upper)(s, t)[row, column] for t in points] for s in points]
        )

    panels = (
        ("T: G₁ (θ < s), G₂ (θ > s), each state", sampled(right, "G", 0, 0)),
        ("A: H₁, H₂ from ∂⁴w to u_tt, corrected", sampled(right, "H", 1, 2)),
        (f"the same, H₁ as printed (setpoint {setpoint})", sampled(printed, "H", 1, 2)),
    )
    figure = Figure(figsize=(12.0, 4.0), layout=ConstrainedLayoutEngine())
    FigureCanvasAgg(figure)
    for ax, (title, values) in zip(figure.subplots(1, 3), panels, strict=True):
        largest = float(np.abs(values).max())
        image = ax.imshow(
            values, origin="lower", extent=(0, 1, 0, 1), cmap="RdBu_r", vmin=-largest, vmax=largest
        )
        figure.colorbar(image, ax=ax, shrink=0.85)
        ax.plot((0, 1), (0, 1), color="black", lw=0.6)
        ax.set_title(title, loc="left", fontsize=10.0)
        ax.set_xlabel("θ [m]")
        ax.set_ylabel("s [m]")
    return figure
