"""Facts about (2) and (5) for the page: growth by cells, when (2) leaves, what gains do to (5).

Between `chapter.observer_truncation`, which finds one number, and `chapter.observer`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from chapter.constants import CORRECTED, PRINTED
from chapter.lpi_gains import observer_gains
from chapter.observer_beside import TICK_S
from chapter.observer_cases import EPSILON
from chapter.observer_grid import CELLS, INITIAL, grid_error
from chapter.observer_schedule import SEGMENTS
from chapter.observer_truncation import (
    ARM,
    FAR_M,
    bands,
    exact_growth_per_s,
    growth_per_s,
    leaves_after_s,
    stretched,
    truncation_error,
)
from chapter.pde import SETPOINTS, Setpoint
from chapter.rounding import significant
from deploy.deployment import offsets
from deploy.grid import make_grid
from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import GainsArtefact

Array = npt.NDArray[np.float64]

GRIDS = (10, 20, 40, 80, 160)
AMPLITUDES = (0.005, 0.01, 0.02, 0.05)


def ticks_until_it_leaves(artefact: GainsArtefact, model: str, most: int = 600) -> int | None:
    """Of 0.1 s, under the load that holds setpoint 1 and w(t), as in `octarm run --scenario chapter`."""
    grid = make_grid(artefact.arm.length_m, SEGMENTS, "equispaced")
    first = artefact.setpoints[0]
    held = offsets(artefact.arm, first, grid)[1][:, 4]
    plant = ArmPlant(
        PlantParameters(
            artefact.arm,
            tuple(grid.faces_m.tolist()),
            TICK_S,
            initial_shape("chapter", first, artefact.arm.length_m),
            DisturbanceSpec("chapter"),
            model=model,
            about=initial_shape("setpoint", first, artefact.arm.length_m),
            holding_n_per_m=tuple(held.tolist()),
        )
    )
    for k in range(most):
        if not np.isfinite(plant.truth()).all():
            return k
        plant.advance(held, k)
    return None


def truncation_facts(artefact: GainsArtefact) -> dict[str, Any]:
    """Growth rates of (5) by cells, their bound, those of (1); when (2) leaves; its error while it stays."""
    setpoints: dict[str, Any] = {}
    for one in SETPOINTS:
        limit = bands(one, CORRECTED)
        residual = axial_residual_n_per_m(one.w)
        setpoints[one.name] = {
            "growth_per_s": {
                f"{n}": significant(growth_per_s(one, CORRECTED, cells=n), 3) for n in GRIDS
            },
            "growth_printed_matrices_per_s": significant(
                growth_per_s(one, CORRECTED, "printed"), 3
            ),
            "growth_printed_rho_per_s": significant(growth_per_s(one, PRINTED), 3),
            "growth_with_gains_per_s": significant(growth_with_gains_per_s(one), 3),
            "growth_odd_towards_tip_per_s": significant(
                growth_per_s(one, CORRECTED, bias="tip"), 3
            ),
            "growth_four_axial_per_s": significant(
                growth_per_s(one, CORRECTED, axial_ends="four"), 3
            ),
            "largest_slope": significant(limit.slope, 3),
            "grows_below_per_m": significant(limit.below_per_m, 3),
            "grows_above_per_m": significant(limit.above_per_m, 3),
            "bound_per_s": significant(limit.growth_per_s, 3),
            "exact_model_per_s": round(exact_growth_per_s(one, CORRECTED), 6),
            "axial_residual_n_per_m": significant(residual, 3),
        }
    return {
        "setpoints": setpoints,
        "leaves_s": {
            constants.name: {
                form: significant(leaves_after_s(constants, form, until_s=until) or math.nan, 3)
                for form in ("printed", "corrected")
            }
            for constants, until in ((CORRECTED, 60.0), (PRINTED, 1400.0))
        },
        "plant_leaves_after_ticks": {
            model: ticks_until_it_leaves(artefact, model) for model in ("quadratic", "linear")
        },
        "tip_error_of_the_period": {
            f"{amplitude:g}": None if found is None else significant(found, 2)
            for amplitude in AMPLITUDES
            for found in (truncation_error(amplitude),)
        },
    }


def growth_with_gains_per_s(setpoint: Setpoint) -> float:
    """Of the error of (5) on ten cells with the gains of (18) for the same setpoint, and drag."""
    gains = observer_gains(setpoint.name, CORRECTED, EPSILON)
    model = grid_error(setpoint, CORRECTED, drag_per_s=gains.drag_per_s)
    gain = gains.chapter_si(model.points_m).transpose(0, 2, 1).reshape(4 * CELLS, 2)
    return float(np.linalg.eigvals(model.A + gain @ model.outputs).real.max())


def axial_residual_n_per_m(w: Polynomial) -> float:
    """Largest right-hand side of the first equation of (2) at (0, w): what is missing to be a solution at
    rest."""
    d = [w.deriv(j) for j in range(1, 5)]
    EA, EI = CORRECTED.axial_n, CORRECTED.bending_n_m2
    force = EA * d[0] * d[1] + EI * (d[1] * d[2] + d[0] * d[3])
    return float(np.max(np.abs(force(np.linspace(0.0, 1.0, 1001)))))


def motions() -> dict[str, tuple[Array, Array]]:
    """Largest displacement over time by (1) and (2) from the chapter's initial condition, u = 0; 40 cells."""
    faces = tuple(np.linspace(0.0, 1.0, CELLS + 1).tolist())
    found: dict[str, tuple[Array, Array]] = {}
    step_s = 0.01
    for title, model in (("exact model (1)", "exact"), ("truncated model (2)", "quadratic")):
        plant = ArmPlant(
            PlantParameters(ARM, faces, step_s, stretched(INITIAL), cells=40, model=model)
        )
        straight = np.stack([np.linspace(0.0, 1.0, 41), np.zeros(41)], axis=1)
        sizes = []
        for k in range(200):
            away = plant.shape() - straight
            sizes.append(float(np.max(np.hypot(away[:, 0], away[:, 1]))))
            if not sizes[-1] < FAR_M:
                break
            plant.advance(np.zeros(CELLS), k)
        found[title] = (np.arange(0.0, len(sizes)) * step_s, np.array(sizes))
    return found
