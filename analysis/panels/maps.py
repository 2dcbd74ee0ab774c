"""Panels that are maps over time and arclength: curvature, what the estimate misses of it, commands."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from analysis.panels.frame import Cell, image, say, scaled
from analysis.recording import Recording
from wire.channels import STATE

Array = npt.NDArray[np.float64]

CURVATURE = STATE.index("curvature_per_m")


def draw_curvature(cell: Cell, recording: Recording) -> None:
    """True curvature."""
    ax = cell.one()
    image(ax, recording, recording.truth[:, :, CURVATURE], "curvature [1/m]")
    ax.set_title("Curvature of the arm")


def draw_missed(cell: Cell, recording: Recording) -> None:
    """Curvature as estimated less the true one."""
    ax = cell.one()
    apart, unit = scaled((recording.estimates - recording.truth)[:, :, CURVATURE], "1/m")
    image(ax, recording, apart, f"estimate less truth [{unit}]")
    ax.set_title("Curvature, estimate less truth")


def draw_deviation(cell: Cell, recording: Recording) -> None:
    """True curvature less the reference's."""
    ax = cell.one()
    apart = recording.truth[:, :, CURVATURE] - _wanted(recording)[:, :, CURVATURE]
    apart, unit = scaled(apart, "1/m")
    image(ax, recording, apart, f"deviation [{unit}]")
    ax.set_title("Curvature less the reference's")


def draw_commands(cell: Cell, recording: Recording) -> None:
    """Commands of all segments."""
    ax = cell.one()
    loads, unit = scaled(recording.commands, "N/m")
    image(ax, recording, loads, f"load [{unit}]")
    ax.set_title(f"Commanded {recording.artefact.arm.actuator} load")


def draw_feedback(cell: Cell, recording: Recording) -> None:
    """Commands less what holds and moves the reference: what the feedback adds."""
    ax = cell.one()
    ax.set_title("Load less the reference's: the feedback's")
    if not recording.configuration.control:
        say(ax, "this run has no feedback")
        return
    loads, unit = scaled(recording.commands - _wanted(recording)[:, :, len(STATE)], "N/m")
    image(ax, recording, loads, f"load [{unit}]")


def _wanted(recording: Recording) -> Array:
    """State and command of the reference at each tick, (K, n, 5)."""
    return np.stack([recording.references.states(k) for k in range(recording.ticks)])
