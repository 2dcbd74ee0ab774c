"""Runs of the scheduled observer beside the exact arm: starts, origins of the gains, and their facts.

Between `chapter.observer_schedule`, which runs one, and `chapter.observer`, which puts them side by side.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from chapter.constants import AREA_M2, CORRECTED, PRINTED, Constants
from chapter.lpi_gains import observer_gains
from chapter.observer_cases import EPSILON, times_below
from chapter.observer_schedule import (
    SEGMENTS,
    Injection,
    Observed,
    chapter_ticks,
    observe,
    shipped_ticks,
)
from chapter.observer_straight import unit_s
from chapter.rounding import significant
from deploy.grid import make_grid
from plant.disturbance import DisturbanceSpec
from plant.initial import InitialShape, initial_shape
from wire.artefact import GainsArtefact

Array = npt.NDArray[np.float64]

TICK_S = 0.1
TICKS = 2000


BETWEEN_MODES = 11.0
"""Frequency, nondimensional, between the first two bending modes (3.5 and 22)."""


def lpi_injection(constants: Constants) -> Injection:
    """Gains of (18) at any setpoint."""
    return lambda name, s_m: observer_gains(name, constants, EPSILON).energy_si(s_m)


def scheduled(artefact: GainsArtefact) -> dict[str, dict[str, Observed]]:
    """Runs by start and origin of the gains; the loads hold setpoint 1, the estimate starts there."""
    grid = make_grid(artefact.arm.length_m, SEGMENTS, "equispaced")
    length, (first, second, third) = artefact.arm.length_m, artefact.setpoints
    origins = {
        "no correction": (chapter_ticks(artefact, grid, TICK_S, None), False),
        "(18)": (chapter_ticks(artefact, grid, TICK_S, lpi_injection(CORRECTED)), False),
        "octarm": (shipped_ticks(artefact, grid, TICK_S), True),
    }
    starts = {
        "chapter": initial_shape("chapter", first, length),
        "straight": initial_shape("straight", first, length),
        "setpoint 2": initial_shape("setpoint", second, length),
        "setpoint 3": initial_shape("setpoint", third, length),
    }

    def started(shape: InitialShape, name: str) -> Observed:
        ticks, own = origins[name]
        return observe(
            artefact,
            ticks,
            shape,
            tick_s=TICK_S,
            count=TICKS,
            disturbance=DisturbanceSpec("chapter"),
            own_outputs=own,
        )

    found = {
        start: {name: started(shape, name) for name in origins} for start, shape in starts.items()
    }
    found["printed rho"] = {"(18)": _heavy(artefact, starts["chapter"])}
    rest, whole = initial_shape("setpoint", first, length), starts["chapter"]
    small = InitialShape(
        lambda s: 0.9 * rest.curvature_per_m(s) + 0.1 * whole.curvature_per_m(s), rest.strain
    )
    found["a tenth of chapter"] = {"(18)": started(small, "(18)")}
    return found


def _heavy(artefact: GainsArtefact, start: InitialShape) -> Observed:
    """The arm with 1100 kg/m: slower by 22.6 in everything but the disturbance, which is w(t) in N/m."""
    slower = unit_s(PRINTED) / unit_s(CORRECTED)
    arm = artefact.arm
    heavy = msgspec.structs.replace(
        artefact,
        arm=type(arm)(
            name=arm.name,
            length_m=arm.length_m,
            radius_m=arm.radius_m,
            youngs_modulus_pa=arm.youngs_modulus_pa,
            density_kg_per_m3=arm.density_kg_per_m3 / AREA_M2,
            drag_per_s=arm.drag_per_s / slower,
        ),
    )
    grid = make_grid(arm.length_m, SEGMENTS, "equispaced")
    tick_s = TICK_S * slower
    return observe(
        heavy,
        chapter_ticks(heavy, grid, tick_s, lpi_injection(PRINTED)),
        start,
        tick_s=tick_s,
        count=TICKS,
        disturbance=DisturbanceSpec("chapter", amplitude=1.0 / AREA_M2),
        own_outputs=False,
    )


def observed_facts(one: Observed) -> dict[str, Any]:
    """Tip error and z of a run, and when its gains change."""
    changes = 1 + np.flatnonzero(np.diff(one.setpoints))
    error = one.tip_error_m
    last = len(error) // 10
    return {
        **times_below(one.times_s, error),
        "last_tenth_m": significant(float(np.max(error[-last:])), 2),
        "z_first_tenth": significant(float(np.max(np.abs(one.root_error[:last]))), 2),
        "z_last_tenth": significant(float(np.max(np.abs(one.root_error[-last:]))), 2),
        "share_of_higher_modes": {
            "tip": significant(_share_above(one, one.tip_y_error_m), 2),
            "z": round(_share_above(one, one.root_error), 4),
        },
        "setpoints": [f"{1 + int(k)}" for k in np.unique(one.setpoints)],
        "changes_s": [significant(float(one.times_s[k]), 3) for k in changes],
    }


def _share_above(one: Observed, values: Array, rad_per_unit: float = BETWEEN_MODES) -> float:
    """Share of the power of the second half of a record above a frequency in radians per unit of time."""
    late = values[len(values) // 2 :]
    power = np.abs(np.fft.rfft((late - late.mean()) * np.hanning(len(late)))) ** 2
    slower = one.tick_s / TICK_S
    frequencies = 2.0 * math.pi * np.fft.rfftfreq(len(late), one.tick_s) * slower
    return float(power[frequencies > rad_per_unit / unit_s(CORRECTED)].sum() / power.sum())
