"""The truncated model (2) and the linear model (4) of the source chapter in the place of the exact forces.

Options for reproduction (theory, section 6): same positions, velocities, loads and sensors as `plant.elastic`,
other forces, on the chapter's grid. Neither has an energy that is bounded from below, so an arm that moves far
(or, linear, one that stands at a curved setpoint) leaves for infinity: that is the model. Beyond `FAR`
lengths its forces are no numbers any more, so that a run ends as with any arm that is not finite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plant.differences import differences
from plant.elastic import Array, Complex, ElasticForce
from plant.grid import Grid
from plant.truncated import Form, TruncatedModel
from wire.artefact import Arm
from wire.errors import UsageError

EXACT = "exact"
MODELS = (EXACT, "quadratic", "quadratic-printed", "linear", "linear-printed")
"""(1); (2) corrected and as printed; (4) at the setpoint of the start, corrected and as printed."""

FAR = 100.0
"""Displacement in lengths of the arm, beyond which it has left."""


def check_model(name: str) -> None:
    """Raise UsageError unless `name` is a model of the plant."""
    if name not in MODELS:
        raise UsageError(f"plant model {name!r} is not known; known: {', '.join(MODELS)}")


@dataclass(frozen=True, eq=False)
class Rest:
    """What a linear model is linear about."""

    position_m: Complex
    """(cells + 1,) of the setpoint."""
    held_m_per_s2: Array
    """(cells,): acceleration along y by the loads under which it is at rest."""


class TruncatedForce(ElasticForce):
    """Kicks of (2), or of (4) about `rest`; edges and normals are those of the shape."""

    def __init__(self, grid: Grid, arm: Arm, name: str, rest: Rest) -> None:
        self._model = truncated_model(
            grid, arm, "printed" if name.endswith("-printed") else "corrected"
        )
        self._points = grid.nodes_m[1:]
        self._far_m = FAR * grid.length_m
        self._inertia = arm.mass_per_length_kg_per_m * grid.step_m
        away = rest.position_m[1:] - self._points
        self.jacobian: Array = self._model.jacobian(away.real, away.imag)
        """At rest, (2 cells, 2 cells)."""
        if name == "linear-printed":
            self._leave_out_what_is_not_printed(away.imag)
        self._rest = rest if name.startswith("linear") else None
        super().__init__(grid, arm.axial_stiffness_n, arm.bending_stiffness_n_m2)

    def set_scale(self, scale: float) -> None:
        """Scale all following kicks."""
        super().set_scale(scale)
        self._scale = scale * self._inertia

    @property
    def clamp(self) -> tuple[complex, float]:
        """Not known: the differences are in no conservation form. Raises ValueError."""
        raise ValueError("the reaction of the clamp is known for the exact model only")

    def evaluate(self, position: Complex) -> None:
        """Fill `kick` (cells,) for grid node positions (cells + 1,) in m; node 0 is the clamp."""
        np.subtract(position[1:], position[:-1], self._edges)
        if self._rest is None:
            away = position[1:] - self._points
            along, across = self._model.accelerations(away.real, away.imag)
        else:
            away = position[1:] - self._rest.position_m[1:]
            along, across = np.split(self.jacobian @ np.concatenate([away.real, away.imag]), 2)
            across = across - self._rest.held_m_per_s2
        self.kick[:] = self._scale * (along + 1j * across)
        if not np.max(np.abs(away)) < self._far_m:
            self.kick[:] = complex(np.nan, np.nan)

    def _leave_out_what_is_not_printed(self, w: Array) -> None:
        """(5) has no entry for w_x in the first equation, (3) has one (theory, section 1)."""
        model, cells = self._model, w.size
        dw = model.grid.transverse @ w
        missing = (model.axial_n * dw[2] + model.bending_n_m2 * dw[4]) / model.mass_kg_m
        self.jacobian[:cells, cells:] -= missing[:, None] * model.grid.transverse[1]


def truncated_model(grid: Grid, arm: Arm, form: Form) -> TruncatedModel:
    """Model (2) of an arm on the chapter's differences."""
    return TruncatedModel(
        arm.axial_stiffness_n,
        arm.bending_stiffness_n_m2,
        arm.mass_per_length_kg_per_m,
        differences(grid.cells, grid.length_m),
        form,
    )
