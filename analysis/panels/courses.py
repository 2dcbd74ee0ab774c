"""Panels of single quantities over time: estimate over truth at three nodes, regulated output, energy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from analysis.panels.frame import (
    BLUE,
    GREEN,
    VERMILION,
    Cell,
    course,
    over_time,
    positive,
    say,
    scaled,
    tidy,
)
from analysis.recording import Recording
from deploy import SegmentGrid
from deploy.grid import STATE_PLACES
from wire.channels import ENERGY, REGULATED, STATE

Array = npt.NDArray[np.float64]

TONES = (BLUE, VERMILION, GREEN)


def shown_nodes(nodes: int) -> list[int]:
    """Nodes at the root, in the middle and at the tip; with two nodes these are two."""
    return sorted({0, nodes // 2, nodes - 1})


def draw_curvature_course(cell: Cell, recording: Recording) -> None:
    """Estimated over true curvature at root, middle and tip."""
    _estimate_over_truth(cell, recording, "curvature_per_m", "curvature", "1/m")


def draw_velocity_course(cell: Cell, recording: Recording) -> None:
    """Estimated over true transverse velocity at root, middle and tip."""
    _estimate_over_truth(cell, recording, "velocity_y_m_per_s", "v_y", "m/s")


def _estimate_over_truth(
    cell: Cell, recording: Recording, field: str, symbol: str, unit: str
) -> None:
    """Above the estimate as a line in a broad pale one, the truth; below the estimate less the truth."""
    ax, below = cell.stack(2.6, 1.0)
    column = STATE.index(field)
    grid = SegmentGrid(np.asarray(recording.configuration.faces_m))
    places = grid.locations_m(STATE_PLACES[column])
    nodes = shown_nodes(recording.nodes)
    truth = recording.truth[:, nodes, column]
    both, name = scaled(np.stack([truth, recording.estimates[:, nodes, column]]), unit)
    apart, small = scaled(recording.estimates[:, nodes, column] - truth, unit)
    for i, node in enumerate(nodes):
        course(ax, recording, both[0, :, i], color=TONES[i], linewidth=3.6, alpha=0.35)
        label = f"node {node}: {places[node]:.2g} m"
        course(ax, recording, both[1, :, i], color=TONES[i], linewidth=0.9, label=label)
        course(below, recording, apart[:, i], color=TONES[i], linewidth=0.9)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.4 * (high - low))  # room for the key
    key = ax.get_legend_handles_labels()[0]
    kinds = [
        Line2D([], [], color="black", linewidth=0.9, label="estimate"),
        Line2D([], [], color="black", linewidth=3.6, alpha=0.35, label="truth"),
    ]
    # Filled column by column: the nodes in the first row.
    handles = [one for pair in zip(key, kinds, strict=False) for one in pair] + key[2:]
    ax.legend(
        handles=handles,
        loc="upper right",
        frameon=False,
        ncols=len(key),
        fontsize=8.0,
        columnspacing=0.8,
        handlelength=1.2,
    )
    ax.set(
        ylabel=f"{symbol}\n[{name}]", title=f"Estimate over truth: {symbol} at {len(nodes)} nodes"
    )
    below.set_ylabel(f"error\n[{small}]")
    below.axhline(0.0, color="black", linewidth=0.5)
    _finish((ax, below), recording)


def draw_regulated(cell: Cell, recording: Recording) -> None:
    """The regulated output of the design: both means over the arm, less the reference's."""
    axes = cell.stack(1.0, 1.0)
    values = recording.of_plant("regulated", REGULATED)
    for ax, column, symbol, unit, tone in (
        (axes[0], 0, "mean v_y", "m/s", BLUE),
        (axes[1], 1, "mean curvature", "1/m", VERMILION),
    ):
        shown, name = scaled(values[:, column], unit)
        ax.axhline(0.0, color="black", linewidth=0.5)
        course(ax, recording, shown, color=tone, linewidth=1.2)
        ax.set_ylabel(f"{symbol}\n[{name}]")
    axes[0].set_title("Regulated output, less the reference's")
    _finish(axes, recording)


def draw_energy(cell: Cell, recording: Recording) -> None:
    """Energy of the whole arm by kind."""
    ax = cell.one()
    ax.set_title("Energy of the arm")
    values = recording.of_plant("energy", ENERGY)
    if not positive(*values.T):
        say(ax, "the arm has no energy")
        return
    # The axial one swings fastest: thin, and underneath.
    for column, kind, tone, width in (
        (1, "axial", VERMILION, 0.7),
        (0, "kinetic", BLUE, 1.0),
        (2, "bending", GREEN, 1.6),
    ):
        course(ax, recording, values[:, column], color=tone, linewidth=width, label=kind)
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, 1e-9 * high), 10.0 * high)  # room for the key
    ax.set_ylabel("energy [J]")
    ax.legend(loc="upper right", ncols=3, frameon=False)
    tidy(ax)
    over_time(ax, recording)


def _finish(axes: tuple[Any, ...] | list[Any], recording: Recording) -> None:
    for ax in axes:
        tidy(ax)
        over_time(ax, recording, top=ax is axes[0], bottom=ax is axes[-1])
