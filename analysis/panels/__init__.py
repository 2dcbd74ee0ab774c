"""The panels of a run's figures, each with the name that `octarm plot --only` knows it by.

Each is a function that draws one thing of a recording into a place of a figure; `analysis.plot` puts them
together. A panel draws what there is and says in its place why there is nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from analysis.panels.arm import draw_shapes
from analysis.panels.courses import (
    draw_curvature_course,
    draw_energy,
    draw_regulated,
    draw_velocity_course,
)
from analysis.panels.errors import draw_estimation, draw_tip
from analysis.panels.exchange import draw_messages, draw_sweep_course, draw_sweeps
from analysis.panels.frame import Cell
from analysis.panels.health import draw_health
from analysis.panels.maps import (
    draw_commands,
    draw_curvature,
    draw_deviation,
    draw_feedback,
    draw_missed,
)
from analysis.recording import Recording

PANELS: dict[str, Callable[[Cell, Recording], None]] = {
    "shapes": draw_shapes,
    "estimation": draw_estimation,
    "tip": draw_tip,
    "curvature": draw_curvature,
    "curvature-error": draw_missed,
    "deviation": draw_deviation,
    "curvature-course": draw_curvature_course,
    "velocity-course": draw_velocity_course,
    "regulated": draw_regulated,
    "commands": draw_commands,
    "feedback": draw_feedback,
    "energy": draw_energy,
    "sweeps": draw_sweeps,
    "sweep-course": draw_sweep_course,
    "messages": draw_messages,
    "health": draw_health,
}
"""In the order in which a figure has them."""
SUMMARY = ("shapes", "estimation", "tip", "commands", "deviation", "sweeps")
"""The panels of the figure that `octarm run` leaves beside its recording."""
