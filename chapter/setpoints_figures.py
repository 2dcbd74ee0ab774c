"""Fig. 1 and Fig. 2 redrawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Wedge

from analysis.study.figures import COLOURS, DPI
from chapter import fig_one, fig_two
from chapter.constants import RADIUS_M
from chapter.fig_two import Shape
from chapter.pde import SETPOINTS

STYLE = {"font.size": 10.0, "axes.titlesize": 10.5, "axes.titlelocation": "left"}
SHADE = "#DDDDDD"
SECTOR_DEG = 30.0


def reach(boundary: fig_one.Array) -> Figure:
    """Fig. 1: one segment, two segments, and the continuum."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 4.2), dpi=DPI, layout=ConstrainedLayoutEngine())
        FigureCanvasAgg(figure)
        left, middle, right = figure.subplots(1, 3)
        circle = np.linspace(0.0, 2.0 * np.pi, 361)
        left.plot(np.cos(circle), np.sin(circle), color=COLOURS[0], lw=2.0)
        left.plot([0.0, np.cos(0.6)], [0.0, np.sin(0.6)], "o-", color="black", lw=2.0)
        left.set_title("One segment: the circle")
        least = fig_one.least_distance(2)
        middle.add_patch(
            Wedge((0.0, 0.0), 1.0, 0.0, 360.0, width=1.0 - least, color=COLOURS[0], alpha=0.25)
        )
        tips = fig_one.sampled_tips(2, 1500, seed=1)
        middle.plot(tips[:, 0], tips[:, 1], ".", color=COLOURS[0], markersize=2.0)
        for joint, start in ((90.0, 0.4), (130.0, 2.2), (180.0, 4.3)):
            turn = np.radians(180.0 - joint)
            elbow = 0.5 * np.array([np.cos(start), np.sin(start)])
            end = elbow + 0.5 * np.array([np.cos(start + turn), np.sin(start + turn)])
            middle.plot(
                [0.0, elbow[0], end[0]], [0.0, elbow[1], end[1]], "o-", color="black", lw=2.0
            )
            middle.annotate(f"{joint:.0f}°", elbow, xytext=(6, -12), textcoords="offset points")
        middle.set_title(f"Two segments, joint 90° or more: {least:.3f} r to r")
        right.add_patch(
            Wedge(
                (0.0, 0.0), 1.0, 0.0, 360.0, color=COLOURS[0], alpha=0.18, label="root free to turn"
            )
        )
        right.fill(*boundary.T, color=COLOURS[1], alpha=0.25, label="root clamped along x")
        right.plot(*boundary.T, color=COLOURS[1], lw=1.2)
        for k in (0.0, 2.5, 4.4, 2.0 * np.pi):
            s = np.linspace(0.0, 1.0, 101)
            x, y = (np.sin(k * s) / k, (1.0 - np.cos(k * s)) / k) if k else (s, 0.0 * s)
            right.plot(x, y, color="black", lw=1.5)
        right.set_title(f"Continuum, curvature at most {1.0 / RADIUS_M:.0f}/r")
        right.legend(loc="lower center", bbox_to_anchor=(0.52, 0.14), fontsize=9.0)
        for ax in (left, middle, right):
            ax.set_aspect("equal")
            ax.set_xlim(-1.12, 1.12)
            ax.set_ylim(-1.12, 1.12)
            ax.set_xlabel("x / r")
            ax.grid(color=SHADE, linewidth=0.6)
            ax.set_axisbelow(True)
        left.set_ylabel("y / r")
    return figure


def shapes(rows: Sequence[Shape]) -> Figure:
    """Fig. 2: the graphs and where 1 m of arm ends; octarm's setpoints; curvatures."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 4.9), dpi=DPI, layout=ConstrainedLayoutEngine())
        FigureCanvasAgg(figure)
        left, middle, right = figure.subplots(1, 3, width_ratios=[1.0, 1.0, 1.1])
        for ax in (left, middle):
            _sectors(ax)
        for position, (colour, s, row) in enumerate(zip(COLOURS, SETPOINTS, rows, strict=False)):
            x = np.linspace(0.0, row.tip[0], 201)
            beyond = np.linspace(row.tip[0], 1.0, 101)
            left.plot(beyond, s.w(beyond), ":", color=colour, lw=1.4)
            left.plot(
                x, s.w(x), color=colour, lw=2.2, label=f"{row.name}: tip at {row.tip_angle:.2f}°"
            )
            left.plot(*row.tip, "o", color=colour)
            middle.plot(x, s.w(x), color=colour, lw=5.0, alpha=0.3)
            arc, line = fig_two.octarm_centre_line(position)
            middle.plot(
                *line.T,
                color=colour,
                lw=1.6,
                label=f"{row.name}: {1e3 * row.tip_distance:.1f} mm away",
            )
            middle.plot(*row.octarm_tip, "o", color=colour, markersize=5.0)
            along = np.array([fig_two.arc_length(s.w, float(v)) for v in x])
            right.plot(along, fig_two.curvature(s.w, x), ":", color=colour, lw=2.0)
            theta = np.unwrap(np.arctan2(*np.gradient(line, arc, axis=0, edge_order=2).T[::-1]))
            bend = np.gradient(theta, arc, edge_order=2)
            right.plot(arc[2:-2], bend[2:-2], color=colour, lw=1.6)
        left.set_title(
            "Printed: dotted on to x = 1 (3: to 26.3 m)\nsolid where the arclength is below 1 m"
        )
        middle.set_title("octarm's setpoints, held by their load\nwide: printed, cut")
        right.axhline(1.0 / RADIUS_M, color="black", lw=1.2)
        right.annotate("1/radius", (0.98, 1.1 / RADIUS_M), ha="right")
        right.set_title("Curvature\ndotted: printed; solid: octarm's")
        right.set_xlabel("arclength [m]")
        right.set_ylabel("[1/m], linear below 1")
        right.set_yscale("symlog", linthresh=1.0)
        right.set_ylim(-1.2, 1e2)
        right.grid(color=SHADE, linewidth=0.6)
        for ax in (left, middle):
            ax.legend(loc="lower left", bbox_to_anchor=(0.33, 0.76), fontsize=9.0)
    return figure


def _sectors(ax: Any) -> None:
    for k, grey in enumerate(("#E4E4E4", "#F2F2F2", "#E4E4E4")):
        ax.add_patch(Wedge((0.0, 0.0), 1.0, k * SECTOR_DEG, (k + 1) * SECTOR_DEG, color=grey, lw=0))
    ax.set_aspect("equal")
    ax.set_xlim(-0.02, 1.15)
    ax.set_ylim(-0.02, 1.4)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
