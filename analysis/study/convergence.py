"""Does the loop on n segments converge to the one that was designed? The study of the spacing.

From one gains artefact: every number of nodes on every spacing, what `analysis.study.refinement` measures
there, and the observed order, log(e_1 / e_2) / log(n_2 / n_1). The verb `octarm study convergence` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.study.continuum import POINTS
from analysis.study.loop import chosen_setpoints
from analysis.study.refinement import QUANTITIES, Choices, Limit, grid_errors, limit
from analysis.study.workers import call_all
from deploy import Spacing
from plant.grid import CELLS_PER_SEGMENT
from plant.initial import NAMES
from wire.artefact import GainsArtefact, digest
from wire.errors import UsageError

NODES = (5, 10, 20, 40, 80)
GRADED = "graded"
GRADING = 1.5
"""The example of a spacing that a user gives: faces at L (i / n)^1.5, short segments at the root."""
SPACINGS = (Spacing.EQUISPACED.value, Spacing.CHEBYSHEV.value, GRADED)
TICKS = 200
TICK_S = 0.1
FEWEST_CELLS = CELLS_PER_SEGMENT * (POINTS + 1)
"""The reference reads the arm at every Gauss point."""
FLOOR = 3.0
"""Errors within so many times the reference's own error say nothing about the order."""
IN_TIME = ("tip", "estimated shape", "tip at rest")
ORDER = 2
"""What every quadrature on the grid has; the plot draws it as a guide. The tip at rest has none of its own:
its commands are found for the shape that they hold (`deploy.held`)."""


def faces(length_m: float, nodes: int, spacing: str) -> str | tuple[float, ...]:
    """What `deploy` takes for one of `SPACINGS`."""
    if spacing != GRADED:
        return spacing
    inner = length_m * (np.arange(nodes + 1) / nodes) ** GRADING
    return tuple(inner.tolist())


def run(
    artefact: GainsArtefact,
    progress: Callable[[str], None],
    *,
    nodes: Sequence[int] = NODES,
    setpoints: Sequence[str] = (),
    spacings: Sequence[str] = SPACINGS,
    ticks: int = TICKS,
    tick_s: float = TICK_S,
    initial: str = "mode",
    jobs: int | None = None,
) -> dict[str, Any]:
    """Facts of the study, ready for JSON.

    setpoints: names, none for all. ticks: of the sampled loop, 0 to leave it out; initial: "mode" (a smooth
    deviation, `refinement.start`) or a name of `plant.initial`. jobs: processes, default one a processor.
    Raises UsageError for a choice that does not exist or fit.
    """
    counts = sorted(set(nodes))
    names = chosen_setpoints(artefact, list(dict.fromkeys(setpoints)))
    _check(counts, spacings, ticks, initial)
    for weight in ("measurement_noise", "control_effort"):
        if weight not in artefact.weights:
            raise UsageError(
                f"gains: their weights lack {weight!r}, without which there is no norm"
            )
    cells = max(FEWEST_CELLS, CELLS_PER_SEGMENT * counts[-1])
    choices = Choices(tick_s, ticks, cells, initial) if ticks else None
    progress(f"{len(names)} references without segments")
    limits = dict(
        zip(names, call_all(limit, [(artefact, one, choices) for one in names], jobs), strict=True)
    )
    cases = [(n, spacing, name) for n in counts[::-1] for spacing in spacings for name in names]
    errors = call_all(
        grid_errors,
        [
            (artefact, name, n, faces(artefact.arm.length_m, n, spacing), limits[name], choices)
            for n, spacing, name in cases
        ],
        jobs,
        lambda done: progress(f"{done} of {len(cases)} grids"),
    )
    found = dict(zip(cases, errors, strict=True))
    quantities = [q for q in QUANTITIES if choices or q not in IN_TIME]
    return {
        "gains_sha256": digest(artefact),
        "nodes": counts,
        "tick_s": tick_s,
        "ticks": ticks,
        "initial": initial,
        "plant_cells": cells,
        "grading": GRADING,
        "quantities": {q: QUANTITIES[q] for q in quantities},
        "references": {name: _reference(limits[name]) for name in names},
        "rows": [
            _row(
                q, name, spacing, counts, [found[n, spacing, name][q] for n in counts], limits[name]
            )
            for q in quantities
            for name in names
            for spacing in spacings
        ],
    }


def _check(counts: Sequence[int], spacings: Sequence[str], ticks: int, initial: str) -> None:
    if len(counts) < 2 or counts[0] < 2:
        raise UsageError(
            f"nodes: expected at least two numbers of at least 2, got {list(counts)}; "
            "an order needs two grids"
        )
    if not spacings:
        raise UsageError("spacings: expected at least one")
    for spacing in spacings:
        if spacing not in SPACINGS:
            raise UsageError(f"spacing {spacing!r}: expected {', '.join(SPACINGS)}")
    if ticks < 0:
        raise UsageError(f"ticks: expected 0 or more, got {ticks}")
    if initial not in ("mode", *NAMES):
        raise UsageError(f"initial {initial!r}: expected mode, {', '.join(NAMES)}")


def _reference(one: Limit) -> dict[str, Any]:
    return {
        "gamma": list(one.gamma),
        "slowest_per_s": list(one.slowest_per_s),
        "eigenvalues": [[[v.real, v.imag] for v in values] for values in one.eigenvalues],
        "own_error": one.accuracy,
        "tip_moves_with_half_tick_mm": None if one.halved_mm is None else list(one.halved_mm),
    }


def _row(
    quantity: str,
    name: str,
    spacing: str,
    counts: Sequence[int],
    errors: Sequence[float | None],
    reference: Limit,
) -> dict[str, Any]:
    floor = FLOOR * reference.accuracy.get(quantity, 0.0)
    return {
        "quantity": quantity,
        "setpoint": name,
        "spacing": spacing,
        "errors": list(errors),
        "orders": orders(counts, errors, floor),
    }


def orders(
    counts: Sequence[int], errors: Sequence[float | None], floor: float = 0.0
) -> list[float | None]:
    """Observed order from each grid to the next; None where an error is missing or below the floor."""
    found: list[float | None] = []
    for k in range(len(counts) - 1):
        coarse, fine = errors[k], errors[k + 1]
        if coarse is None or fine is None or min(coarse, fine) <= floor:
            found.append(None)
        else:
            found.append(math.log(coarse / fine) / math.log(counts[k + 1] / counts[k]))
    return found


def table(facts: dict[str, Any]) -> str:
    """Errors and orders as text, one block a quantity."""
    counts = facts["nodes"]
    lines = [
        f"{len(counts)} grids on {len(facts['references'])} setpoints from one artefact, "
        f"SHA-256 {facts['gains_sha256'][:16]}"
    ]
    if facts["ticks"]:
        lines.append(
            f"sampled loop: tick {facts['tick_s']:g} s, {facts['ticks']} ticks from "
            f"{facts['initial']!r}, arm on {facts['plant_cells']} cells, no noise"
        )
    lines.append(
        "order: observed between each two grids; - where the reference is no better than the grid;\n"
        "none: no stable loop on this grid, or no rest found"
    )
    head = f"{'setpoint':<10} {'spacing':<11}" + "".join(f"{f'n = {n}':>10}" for n in counts)
    head += "   order"
    lines += ["", f"{'without segments':<22} {'gamma':>9} {'slowest mode [1/s]':>20}"]
    for name, one in facts["references"].items():
        for role, gamma, decay in zip(
            ("observer", "controller"), one["gamma"], one["slowest_per_s"], strict=True
        ):
            lines.append(f"{name:<10} {role:<11} {gamma:>9.5f} {decay:>20.5f}")
    for name, one in facts["references"].items():
        if moves := one["tip_moves_with_half_tick_mm"]:
            order = math.log2(moves[0] / moves[1])
            lines.append(
                f"{name:<10} tip with half the tick {moves[0]:.2g} mm off, with a quarter another "
                f"{moves[1]:.2g} mm: order {order:.1f} in time"
            )
    for quantity, meaning in facts["quantities"].items():
        lines += ["", f"{quantity}: {meaning}", head, "─" * (len(head) + 5 * len(counts) - 9)]
        lines += [
            f"{row['setpoint']:<10} {row['spacing']:<11}"
            + "".join(f"{_number(e):>10}" for e in row["errors"])
            + "  "
            + "".join("    -" if o is None else f"{o:5.1f}" for o in row["orders"])
            for row in facts["rows"]
            if row["quantity"] == quantity
        ]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _number(error: float | None) -> str:
    return "none" if error is None else f"{error:.2g}" if error >= 1e-3 else f"{error:.1e}"


def plot(facts: dict[str, Any], path: Path) -> None:
    """Log-log plot of every quantity over the number of nodes, with a guide of the expected order."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullLocator

    counts, quantities = facts["nodes"], list(facts["quantities"])
    names = list(facts["references"])
    spacings = list(dict.fromkeys(row["spacing"] for row in facts["rows"]))
    colours = {name: f"C{i}" for i, name in enumerate(names)}
    styles = dict(zip(SPACINGS, (("-", "o"), ("--", "s"), (":", "^")), strict=True))
    across = 3
    down = math.ceil(len(quantities) / across)
    figure = Figure(figsize=(4.0 * across, 2.9 * down + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    for place, quantity in enumerate(quantities):
        axes = figure.add_subplot(down, across, place + 1)
        rows = [row for row in facts["rows"] if row["quantity"] == quantity]
        largest = [0.0] * len(counts)
        for row in rows:
            line, marker = styles[row["spacing"]]
            values = [math.nan if e is None else e for e in row["errors"]]
            largest = [max(a, b or 0.0) for a, b in zip(largest, row["errors"], strict=True)]
            axes.loglog(
                counts, values, line, color=colours[row["setpoint"]], marker=marker, markersize=3.5,
                linewidth=1.0,
            )  # fmt: skip
        if largest[-1] > 0.0 and quantity != "tip at rest":
            guide = [1.8 * largest[-1] * (counts[-1] / n) ** ORDER for n in counts]
            axes.loglog(counts, guide, color="0.6", linewidth=4.0, alpha=0.5, zorder=0)
        axes.set_title(f"{quantity} [{'mm' if quantity in IN_TIME else 'relative'}]", fontsize=10)
        axes.set_xticks(counts, [str(n) for n in counts])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.3)
        if place >= len(quantities) - across:
            axes.set_xlabel("nodes n", fontsize=9)
    handles = [Line2D([], [], color=colours[name], label=f"setpoint {name}") for name in names]
    handles += [
        Line2D(
            [], [], color="0.2", linestyle=styles[s][0], marker=styles[s][1], markersize=4, label=s
        )
        for s in spacings
    ]
    handles.append(Line2D([], [], color="0.6", linewidth=4.0, alpha=0.5, label=f"order {ORDER}"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    figure.savefig(path, dpi=80)
