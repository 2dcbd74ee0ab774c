"""The truncated model, chapter (2), and the linear models (3) on the chapter's grid: forces as polynomials.

Beside `plant.elastic`, which has the exact model (1). With u, w the displacements of the material points, both
equations of (2) are linear terms and products of two derivatives; a table lists the products, so that the
right-hand side and its derivative come from the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from plant.differences import Array, Differences

Form = Literal["printed", "corrected"]
Stiffness = Literal["EA", "EI"]

IN_U: tuple[tuple[Stiffness, int, int, float], ...] = (
    ("EA", 1, 2, 1.0),
    ("EI", 2, 3, 1.0),
    ("EI", 1, 4, 1.0),
)
"""Products d^a w d^b w in the first equation: stiffness, a, b, factor."""
_THIRD: tuple[tuple[Stiffness, int, int, float], ...] = (
    ("EA", 2, 1, 1.0),
    ("EA", 1, 2, 1.0),
    # d^3 (u_x w_x), by Leibniz
    ("EI", 4, 1, 1.0),
    ("EI", 3, 2, 3.0),
    ("EI", 2, 3, 3.0),
    ("EI", 1, 4, 1.0),
)
IN_W: dict[Form, tuple[tuple[Stiffness, int, int, float], ...]] = {
    "printed": (*_THIRD, ("EI", 2, 2, 1.0), ("EI", 1, 3, 1.0)),
    "corrected": (*_THIRD, ("EI", 2, 3, 1.0), ("EI", 1, 4, 1.0)),
}
"""Products d^a u d^b w in the second equation. Printed are EI (u_xx w_xx + u_x w_xxx), which do not have the
unit of the others; (1) has EI d(u_x w_xxx) there (theory, section 1)."""


@dataclass(frozen=True, eq=False)
class TruncatedModel:
    """Accelerations of the grid's points by (2); all arrays (cells,), SI units."""

    axial_n: float
    bending_n_m2: float
    mass_kg_m: float
    grid: Differences
    form: Form = "corrected"

    def accelerations(self, u: Array, w: Array) -> tuple[Array, Array]:
        """(u_tt, w_tt) without a load; a load f in N/m adds f / mass_kg_m to the second."""
        du, dw = self.grid.axial @ u, self.grid.transverse @ w
        along = self.axial_n * du[2]
        across = -self.bending_n_m2 * dw[4]
        for stiffness, a, b, factor in IN_U:
            along = along + factor * self._of(stiffness) * dw[a] * dw[b]
        for stiffness, a, b, factor in IN_W[self.form]:
            across = across + factor * self._of(stiffness) * du[a] * dw[b]
        return along / self.mass_kg_m, across / self.mass_kg_m

    def linear(self, du: Array, dw: Array) -> Array:
        """d(u_tt, w_tt) / d(u, w), (2 cells, 2 cells), where u and w have derivatives du, dw (5, cells).

        With the exact derivatives of a setpoint it is (3) by differences; with those of the grid, the
        Jacobian of `accelerations`.
        """
        U, W = self.grid.axial, self.grid.transverse
        cells = W.shape[1]
        found = np.zeros((2 * cells, 2 * cells))
        uu, uw = found[:cells, :cells], found[:cells, cells:]
        wu, ww = found[cells:, :cells], found[cells:, cells:]
        uu += self.axial_n * U[2]
        ww -= self.bending_n_m2 * W[4]
        for stiffness, a, b, factor in IN_U:
            weight = factor * self._of(stiffness)
            uw += weight * (dw[b][:, None] * W[a] + dw[a][:, None] * W[b])
        for stiffness, a, b, factor in IN_W[self.form]:
            weight = factor * self._of(stiffness)
            wu += weight * dw[b][:, None] * U[a]
            ww += weight * du[a][:, None] * W[b]
        return found / self.mass_kg_m

    def jacobian(self, u: Array, w: Array) -> Array:
        """Derivative of `accelerations` at a state of the grid, (2 cells, 2 cells)."""
        return self.linear(self.grid.axial @ u, self.grid.transverse @ w)

    def _of(self, stiffness: Stiffness) -> float:
        return self.axial_n if stiffness == "EA" else self.bending_n_m2


def first_order(accelerations: Array, drag_per_s: float = 0.0) -> Array:
    """A of (4), (4 cells, 4 cells), for states (u, u_t, w, w_t) from (2 cells, 2 cells) by (u, w)."""
    cells = accelerations.shape[0] // 2
    one, found = np.eye(cells), np.zeros((4 * cells, 4 * cells))
    u, u_t, w, w_t = (slice(k * cells, (k + 1) * cells) for k in range(4))
    found[u, u_t] = found[w, w_t] = one
    found[u_t, u], found[u_t, w] = accelerations[:cells, :cells], accelerations[:cells, cells:]
    found[w_t, u], found[w_t, w] = accelerations[cells:, :cells], accelerations[cells:, cells:]
    found[u_t, u_t] = found[w_t, w_t] = -drag_per_s * one
    return found
