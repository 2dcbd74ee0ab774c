"""Sections 1 and 2.2: what an arm's tip reaches (Fig. 1), and the three shapes of Fig. 2."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from chapter import fig_one, fig_two, setpoints_figures
from chapter.constants import LENGTH_M, RADIUS_M
from chapter.fig_two import Shape
from chapter.part import Claim, Part, Tell
from chapter.pde import SETPOINTS
from chapter.rounding import gap, significant

DIGITS = 6
"""Of the facts."""
SAMPLES = 400_000
SEED = 1
CELL = 0.02
"""Grid of the reach, in arm lengths."""
BENDS = 801
SEGMENTS = (1, 2, 3, 4, 5, 6)


def part(tell: Tell) -> Part:
    """Reach by closed form and by sampling, then the shapes (a few seconds)."""
    tell("Fig. 1: reach of one, two and more segments")
    limit = LENGTH_M / RADIUS_M
    sampled = {}
    for n in SEGMENTS:
        distance = np.hypot(*fig_one.sampled_tips(n, SAMPLES, SEED).T)
        sampled[n] = (float(distance.min()), float(distance.max()))
    tell("Fig. 1: reach of the continuum")
    boundary = fig_one.clamped_boundary(limit)
    missed, cells = fig_one.missed_cells(fig_one.clamped_tips(limit, BENDS, BENDS), boundary, CELL)
    tell("Fig. 2: arc lengths, tips, curvatures")
    rows = fig_two.shapes()
    gaps = [
        math.hypot(r.tip[0] - x, r.tip[1] - y)
        for r, (x, y) in (
            (r, fig_two.arc_end_by_ode(s.w)) for r, s in zip(rows, SETPOINTS, strict=True)
        )
    ]
    facts: dict[str, Any] = {
        "segments": {
            str(n): {"least": fig_one.least_distance(n), "sampled_least": a, "sampled_most": b}
            for n, (a, b) in sampled.items()
        },
        "clamped_share_of_disc": fig_one.area(boundary) / math.pi,
        "clamped_reach_behind": float(np.hypot(*boundary[0])),
        "clamped_cells": cells,
        "clamped_cells_missed": missed,
        "closing_curvature_per_r": 2.0 * math.pi,
        "shapes": {
            r.name: vars(r) | {"tip": list(r.tip), "octarm_tip": list(r.octarm_tip)} for r in rows
        },
        "largest_gap_gauss_ode_m": gap(max(gaps), 1e-11),
    }
    figures = {
        "setpoints-reach.png": setpoints_figures.reach(boundary),
        "setpoints-shapes.png": setpoints_figures.shapes(rows),
    }
    return Part(
        "setpoints",
        "Reach and setpoints",
        "1, 2.2 (Fig. 1, Fig. 2)",
        _text(facts, rows),
        _claims(facts, rows),
        figures,
        significant(facts, DIGITS),
    )


def _claims(facts: dict[str, Any], rows: Sequence[Shape]) -> tuple[Claim, ...]:
    share = facts["clamped_share_of_disc"]
    two = facts["segments"]["2"]
    return (
        Claim("Fig. 1a", "one rigid segment reaches the circle of radius r", "so it is", True),
        Claim(
            "Fig. 1b",
            "two segments, joint above 90 degrees: every point between r/sqrt(2) and r",
            f"distance = r sin(joint/2), any direction; sampled {two['sampled_least']:.4f} to "
            f"{two['sampled_most']:.4f} r; r/sqrt(2) itself only with 90 degrees",
            True,
        ),
        Claim(
            "1",
            "more segments, more points",
            "smallest distance r, r/sqrt(2), r/3, then 0 from four segments on; after that only more "
            "configurations",
            True,
        ),
        Claim(
            "1",
            "a soft continuum reaches every point of the circle of radius r",
            f"with a root that turns, by arcs of curvature up to 2 pi/r, well below "
            f"{LENGTH_M / RADIUS_M:.0f}/r",
            True,
        ),
        Claim(
            "1 with 2.1",
            "the same for the arm of section 2, clamped at the mantle",
            f"{100 * share:.1f} % of the disc: behind the root up to {facts['clamped_reach_behind']:.3f} r "
            f"only, as "
            "turning costs length",
            False,
        ),
        Claim(
            "Fig. 2",
            "w_e(x) for x in [0, 1] is the arm of length 1 m",
            "these graphs are "
            + ", ".join(f"{r.graph_length:.3f}" for r in rows)
            + " m long; 1 m ends at x = "
            + ", ".join(f"{r.tip[0]:.4f}" for r in rows),
            False,
        ),
        Claim(
            "Fig. 2, sectors",
            "the tip lies in the cone of its setpoint",
            "cut at 1 m the tips are at "
            + ", ".join(f"{r.tip_angle:.2f}" for r in rows)
            + " degrees, the middles of three cones of 30 degrees (at x = 1: "
            + ", ".join(f"{r.end_angle:.1f}" for r in rows)
            + ", in the same cones)",
            True,
        ),
        Claim(
            "Fig. 2, free tip",
            "the setpoints satisfy w_xx = 0 at the tip",
            "w_e'' over its root value at the cut: "
            + ", ".join(f"{100 * r.bend_at_cut / r.root_curvature:.2g}" for r in rows)
            + " %; at x = 1: "
            + ", ".join(f"{100 * r.bend_at_one / r.root_curvature:.2g}" for r in rows)
            + " %. Nearly, and only if cut",
            False,
        ),
        Claim(
            "Fig. 2, setpoint 3",
            "a shape of the arm of section 4.1, radius 0.025 m",
            f"curvature {rows[2].root_curvature:.1f}/m at the root, the arm overlaps itself above "
            f"1/radius = {1.0 / RADIUS_M:.0f}/m; 1 and 2 have {rows[0].root_curvature:.1f} and "
            f"{rows[1].root_curvature:.1f}/m",
            False,
        ),
    )


def _text(facts: dict[str, Any], rows: Sequence[Shape]) -> str:
    segments = "\n".join(
        f"| {n} | {v['least']:.4f} | {v['sampled_least']:.4f} | {v['sampled_most']:.4f} |"
        for n, v in facts["segments"].items()
    )
    table = "\n".join(
        f"| {r.name} | {r.graph_length:.4f} | {r.end_angle:.2f} | {r.tip[0]:.4f}, {r.tip[1]:.4f} | "
        f"{r.tip_angle:.2f} | {r.root_curvature:.1f} | {r.bend_at_cut:.3f} | {r.bend_at_one:.3g} |"
        for r in rows
    )
    own = "\n".join(
        f"| {r.name} | {r.octarm_tip[0]:.4f}, {r.octarm_tip[1]:.4f} | {r.octarm_angle:.2f} | "
        f"{r.octarm_largest_curvature:.2f} | {1e3 * r.unstrained_distance:.2f} | {1e3 * r.tip_distance:.2f} | "
        f"{1e3 * r.line_distance:.1f} |"
        for r in rows
    )
    x = 0.05
    turned = math.degrees(math.atan(SETPOINTS[2].w.deriv()(x)))
    within = 100.0 * fig_two.arc_length(SETPOINTS[2].w, x)
    limit, share = LENGTH_M / RADIUS_M, 100.0 * facts["clamped_share_of_disc"]
    behind, apart = facts["clamped_reach_behind"], facts["largest_gap_gauss_ode_m"]
    cells, missed = facts["clamped_cells"], facts["clamped_cells_missed"]
    return f"""## Fig. 1: reach
![Points that the tip reaches: one segment, two segments, a continuum](setpoints-reach.png)

Lengths in units of r. Two segments with the angle g inside the joint put the tip at sin(g/2), in any
direction as the root turns: every distance from r/sqrt(2) (g = 90 degrees, left out by "greater than") to
r. Equal segments, joints of 90 degrees or more, against {SAMPLES} random configurations each:

| segments | smallest distance | sampled smallest | sampled largest |
|---|---|---|---|
{segments}

From four on nothing inside is missing (a square closes, at 90 degrees exactly; five segments close with
108).

A continuum that turns at its root reaches all of the disc: an arc of curvature k puts the tip at
sin(k r/2)/(k r/2) r, from r (straight) to 0 (a circle, k = 2 pi/r). For r = 1 m that is 6.3/m, a sixth of what
the chapter's arm can bend. (On a closed circle the tip touches the root; thickness takes its share, the arm is
50 mm wide.) The arm of section 2 is clamped. Its outermost points are reached by bending as hard as possible,
curvature {limit:.0f}/m, then straight on: {share:.1f} % of the disc, {behind:.3f} r straight behind the root.
Inside nothing is missing: of {cells} cells of {CELL} r, {missed} are not hit by arms of two arcs within the
limit. This is geometry; which of these shapes a load can hold is another question.

## Fig. 2: setpoints
![The three shapes, octarm's setpoints, curvatures](setpoints-shapes.png)

| setpoint | length to x = 1 | angle at x = 1 | tip at 1 m of arc | angle | w''(0), 1/m | w'' at tip | w''(1) |
|---|---|---|---|---|---|---|---|
{table}

Why cut: the arm is 1 m long, the graphs are not; cut, the tips lie in the middle of the three cones; and
the free tip wants w'' = 0, which all three nearly have at the cut, while setpoint 3 has hundreds at x = 1.
The cut by a composite Gauss rule and a root search agrees with an ODE solver's dx/ds = 1/sqrt(1 + w'^2) to
{apart:.0e} m or better.

octarm runs these (`examples/chapter_arm.toml`): curvature of degree 4 in s with no moment and no shear at
the tip, fitted to the graph's angle. Distances in mm between points of the same arclength: tips without and
with the strain of the load that holds the shape, and the largest along the arm.

| setpoint | tip, m | its angle | largest curvature, 1/m | tips, no strain | tips | along the arm |
|---|---|---|---|---|---|---|
{own}

Setpoint 3 cannot be matched by an arm of this radius: its graph turns by {turned:.0f} degrees within the
first {within:.0f} cm of arclength.
"""
