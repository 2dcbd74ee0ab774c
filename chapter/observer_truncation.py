"""What becomes of the truncated model (2), and of (5) at the curved setpoints, on the chapter's grid and finer.

The findings behind the choice of models in `chapter.observer`: (2) leaves for infinity from the chapter's
initial condition, and (5) is unstable at every curved setpoint, the exact model (1) at none of the same
shapes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp

from chapter.constants import DENSITY_KG_M3, LENGTH_M, RADIUS_M, YOUNG_PA, Constants
from chapter.observer_grid import CELLS, INITIAL, disturbance, grid_error
from chapter.pde import Form, Setpoint
from plant.differences import AxialEnds, Bias, differences
from plant.elastic import ElasticForce
from plant.grid import Grid
from plant.initial import InitialShape
from plant.model import ArmPlant, PlantParameters
from plant.truncated import TruncatedModel
from wire.artefact import Arm

Array = npt.NDArray[np.float64]

FAR_M = 100.0
"""An arm of one metre with a displacement of this size has left."""
ARM = Arm("chapter", LENGTH_M, RADIUS_M, YOUNG_PA, DENSITY_KG_M3, 0.0)


def growth_per_s(
    setpoint: Setpoint,
    constants: Constants,
    form: Form = "corrected",
    cells: int = CELLS,
    *,
    bias: Bias = "root",
    axial_ends: AxialEnds = "two",
) -> float:
    """Largest real part of an eigenvalue of (5) on the grid."""
    model = grid_error(setpoint, constants, form, cells=cells, bias=bias, axial_ends=axial_ends)
    return float(np.linalg.eigvals(model.A).real.max())


@dataclass(frozen=True)
class Bands:
    """Wave numbers at which waves of (5) grow where the slope w_e' is largest; alpha^2 = EA / EI."""

    slope: float
    below_per_m: float
    above_per_m: float
    growth_per_s: float
    """The largest in the lower band, at that slope everywhere."""


def bands(setpoint: Setpoint, constants: Constants) -> Bands:
    """From the leading terms of (5) for exp(i k x): with c = w_e',

        rho lambda^2 (u, w) = [[-EA k^2, c (EI k^4 - EA k^2)], [the same, -EI k^4]] (u, w)

    has a positive eigenvalue where alpha k < c |k^2 - alpha^2|.
    """
    slopes = setpoint.w.deriv()(np.linspace(0.0, LENGTH_M, 2001))
    c = float(np.max(np.abs(slopes)))
    alpha = math.sqrt(constants.axial_n / constants.bending_n_m2)
    root = math.sqrt(1.0 + 4.0 * c**2)
    below, above = alpha * (root - 1.0) / (2.0 * c), alpha * (root + 1.0) / (2.0 * c)
    k = np.linspace(1e-3, 1.0, 4000) * below
    axial, bending = constants.axial_n * k**2, constants.bending_n_m2 * k**4
    mixed = c * (bending - axial)
    square = 0.5 * (np.sqrt((axial - bending) ** 2 + 4.0 * mixed**2) - axial - bending)
    fastest = math.sqrt(float(square.max()) / constants.mass_kg_m)
    return Bands(c, below, above, fastest)


def exact_growth_per_s(setpoint: Setpoint, constants: Constants, cells: int = 40) -> float:
    """Largest growth rate of the exact model (1) linearised at the same shape (u_e = 0), by differences of its
    forces; prestress included."""
    grid = Grid(cells, LENGTH_M)
    force = ElasticForce(grid, constants.axial_n, constants.bending_n_m2)
    s = grid.nodes_m
    position = s + 1j * setpoint.w(s)
    step, size = 1e-6, 2 * cells
    jacobian = np.empty((size, size))
    for column in range(size):
        kicks = []
        for sign in (1.0, -1.0):
            moved = position.copy()
            moved[1 + column % cells] += sign * step * (1.0 if column < cells else 1j)
            force.evaluate(moved)
            kicks.append(np.concatenate([force.kick.real, force.kick.imag]))
        jacobian[:, column] = (kicks[0] - kicks[1]) / (2.0 * step)
    squares = np.linalg.eigvals(jacobian / (constants.mass_kg_m * grid.step_m))
    return float(np.sqrt(squares.astype(complex)).real.max())


def leaves_after_s(
    constants: Constants,
    form: Form,
    *,
    amplitude: float = 1.0,
    cells: int = CELLS,
    until_s: float,
    load: float = 1.0,
) -> float | None:
    """When (2), released from `amplitude` times the chapter's initial condition under `load` times w(t), has a
    displacement of `FAR_M`; None if it stays until `until_s`."""
    grid = differences(cells, LENGTH_M)
    model = TruncatedModel(
        constants.axial_n, constants.bending_n_m2, constants.mass_kg_m, grid, form
    )
    s = grid.step_m * np.arange(1, cells + 1)

    def rates(t: float, x: Array) -> Array:
        u, u_t, w, w_t = x.reshape(4, cells)
        along, across = model.accelerations(u, w)
        push = load * disturbance(np.array(t)) / constants.mass_kg_m
        return np.concatenate([u_t, along, w_t, across + push])

    def left(t: float, x: Array) -> float:  # noqa: ARG001
        return float(np.max(np.abs(x)) - FAR_M)

    left.terminal = True  # type: ignore[attr-defined]
    start = np.zeros(4 * cells)
    start[2 * cells : 3 * cells] = amplitude * INITIAL(s)
    found = solve_ivp(
        rates, (0.0, until_s), start, method="DOP853", rtol=1e-9, atol=1e-12, events=left
    )
    return float(found.t[-1]) if found.status == 1 else None


def stretched(w: Polynomial) -> InitialShape:
    """The arm with u = 0 and transverse displacement w: curvature and strain of the graph over the material."""
    slope, bend = w.deriv(), w.deriv(2)
    return InitialShape(
        lambda s: np.asarray(bend(s) / (1.0 + slope(s) ** 2)),
        lambda s: np.asarray(np.sqrt(1.0 + slope(s) ** 2) - 1.0),
    )


def truncation_error(amplitude: float, *, ticks: int = 134, tick_s: float = 0.5) -> float | None:
    """Largest difference of the tip's w between (2) and (1) in one period, over the largest w of (1); both
    on 40 cells, no load. None if (2) leaves."""
    faces = tuple(np.linspace(0.0, LENGTH_M, CELLS + 1).tolist())
    plants = [
        ArmPlant(
            PlantParameters(
                ARM, faces, tick_s, stretched(amplitude * INITIAL), cells=40, model=model
            )
        )
        for model in ("exact", "quadratic")
    ]
    tips = np.empty((ticks, 2))
    still = np.zeros(CELLS)
    for k in range(ticks):
        for j, plant in enumerate(plants):
            plant.advance(still, k)
            tips[k, j] = plant.tip()[1]
        if not np.isfinite(tips[k]).all() or abs(tips[k, 1]) > FAR_M:
            return None
    return float(np.max(np.abs(tips[:, 1] - tips[:, 0])) / np.max(np.abs(tips[:, 0])))
