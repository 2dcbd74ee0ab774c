"""Cases of the error dynamics about the straight arm: origins of the gains, epsilons, and their facts.

Between `chapter.observer_straight`, which runs one, and `chapter.observer`, which puts them side by side.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from chapter.constants import CORRECTED, Constants
from chapter.lpi_gains import observer_gains
from chapter.observer_grid import CELLS, INITIAL, grid_error
from chapter.observer_straight import (
    ErrorRun,
    Origin,
    below_after_s,
    energy_system,
    first_mode_rate_per_s,
    fitted_rate_per_s,
    grid_lmi,
    growing_pairs,
    run,
    slowest_rate_per_s,
    unit_s,
)
from chapter.pde import SETPOINTS, STRAIGHT, Setpoint
from chapter.rounding import significant

Array = npt.NDArray[np.float64]

EPSILON = 1.0
"""Of the gains in Fig. 4 and 5."""
GRID_EPSILONS = (1.0, 3.0, 10.0)
"""Of (16); at 30 and above the gain is not determined to a digit, its gamma and decay are."""
UNITS = 8.0
"""Length of the runs in units of time: 300 s, or 6770 s as printed."""


def lpi_origin(constants: Constants, epsilon: float, *, drag: bool) -> Origin:
    """Gains of (18) for the first setpoint, on the chapter's grid; with the drag that they are designed
    with."""
    gains = observer_gains("1", constants, epsilon)
    s = np.arange(1, CELLS + 1) / CELLS
    gain = gains.chapter_si(s).transpose(0, 2, 1).reshape(4 * CELLS, 2)
    return Origin(f"(18){', drag' if drag else ''}", gain, gains.drag_per_s if drag else 0.0)


def lmi_origin(constants: Constants, epsilon: float) -> tuple[Origin, dict[str, float]]:
    """Gains of (16) for w on the chapter's grid, without drag. Raises ArithmeticError without a solution."""
    found, gain = grid_lmi(CORRECTED, epsilon)
    if found is None:
        raise ArithmeticError(f"(16) with epsilon {epsilon:g}: no solution")
    slower = unit_s(CORRECTED) / unit_s(constants)
    powers = np.repeat([1.0, 2.0, 1.0, 2.0], CELLS)
    facts = {
        "gamma": significant(found.gamma, 4),
        "gain_norm": significant(float(np.linalg.norm(found.gain)), 2),
        "decay": significant(found.decay, 3),
    }
    return Origin("(16) on the grid", gain * (slower**powers)[:, None]), facts


def noise_to_nothing() -> dict[str, dict[str, float]]:
    """gamma of (16), epsilon 0, as the noise weights go to the chapter's 0, and the weight of y_2."""
    found, w = {}, slice(2 * CELLS, 4 * CELLS)
    for share in (0.1, 0.01):
        system = energy_system(grid_error(STRAIGHT, CORRECTED), CORRECTED, w, share)
        gain = system.lmi(0.0)
        found[f"{share:g}"] = {
            "gamma": math.nan if gain is None else significant(gain.gamma, 3),
            "weight_of_y2": significant(float(system.noise[1]), 3),
        }
    return found


def setpoint_gains(setpoint: Setpoint) -> dict[str, bool]:
    """What (16) and a Riccati equation make of (5) at a setpoint, all four states, both outputs."""
    system = energy_system(grid_error(setpoint, CORRECTED), CORRECTED, slice(0, 4 * CELLS))
    return {
        "lmi_solved": system.lmi(EPSILON) is not None,
        "riccati_gain_above_1e6": bool(np.linalg.norm(system.riccati_gain()) > 1e6),
    }


def straight_runs(constants: Constants) -> list[ErrorRun]:
    """The four origins of Fig. 4a, under the chapter's disturbance."""
    some = [
        Origin("no correction", None),
        lpi_origin(constants, EPSILON, drag=False),
        lpi_origin(constants, EPSILON, drag=True),
        lmi_origin(constants, 10.0)[0],
    ]
    return [run(constants, one, units=UNITS) for one in some]


def grid_epsilons() -> tuple[dict[float, ErrorRun], dict[str, Any]]:
    """Runs without disturbance by epsilon of (16), and their facts."""
    runs, facts = {}, {}
    for value in GRID_EPSILONS:
        origin, found = lmi_origin(CORRECTED, value)
        runs[value] = run(CORRECTED, origin, units=UNITS, load=0.0)
        facts[f"{value:g}"] = {**found, **times_below(runs[value].times_s, runs[value].tip_m)}
    return runs, facts


def lpi_facts(value: float, one: ErrorRun) -> dict[str, Any]:
    """What (18) promises with an epsilon, and what a run with its gains does."""
    gains = observer_gains("1", CORRECTED, value)
    return {
        "gamma": significant(gains.gamma, 4),
        "certified_decay": significant(gains.certified_decay, 3),
        "first_mode_decay": significant(gains.first_mode_decay, 3),
        **times_below(one.times_s, one.tip_m),
    }


def times_below(times_s: Array, values: Array) -> dict[str, Any]:
    """The first value, and from when on the values stay below 10 % and 1 % of it."""
    found = [below_after_s(times_s, values, share) for share in (0.1, 0.01)]
    below = [None if one is None else significant(one, 3) for one in found]
    return {
        "first": significant(float(abs(values[0])), 4),
        "below_10_s": below[0],
        "below_1_s": below[1],
    }


def run_facts(constants: Constants, one: ErrorRun) -> dict[str, Any]:
    """Times, envelopes and rates of a run."""
    wanted = [share * one.times_s[-1] for share in (0.125, 0.25, 0.5)]
    rates = (
        slowest_rate_per_s(constants, one.origin),
        fitted_rate_per_s(constants, one.origin),
        first_mode_rate_per_s(constants, one.origin),
    )
    keys = ("slowest_rate_per_s", "fitted_rate_per_s", "first_mode_rate_per_s")
    width = len(one.times_s) // 10

    def largest_after(values: Array, start: float) -> float:
        first = int(np.searchsorted(one.times_s, start))
        largest: float = significant(float(np.max(np.abs(values[first : first + width]))), 2)
        return largest

    return {
        "tip": times_below(one.times_s, one.tip_m),
        "z": times_below(one.times_s, one.root),
        "tip_envelope_m": {f"{t:.0f}": largest_after(one.tip_m, t) for t in wanted},
        "z_envelope": {f"{t:.0f}": largest_after(one.root, t) for t in wanted},
        "largest_tip_m": significant(float(np.max(np.abs(one.tip_m))), 3),
        "growing_pairs": growing_pairs(constants, one.origin),
        # undamped: rounding
        **{
            key: significant(rate, 3) if abs(rate) > 1e-9 else 0.0
            for key, rate in zip(keys, rates, strict=True)
        },
    }


def initial_facts() -> dict[str, Any]:
    """The chapter's initial condition at the ends, in the outputs and in the sectors."""
    model = grid_error(SETPOINTS[0], CORRECTED)
    start = model.initial()
    tip = INITIAL(1.0)
    whole = math.degrees(math.atan2(tip, 1.0))
    beside = math.degrees(math.atan2(tip + SETPOINTS[0].w(1.0), 1.0))
    return {
        "tip_m": float(model.tip @ start),
        "z": significant(float(model.root @ start), 4),
        "z_in_the_limit": -16.0,
        "sum_of_differences": significant(float(model.mean[2] @ start), 4),
        "sum_in_the_limit": significant(-32.0 / 3.0, 4),
        "slope_at_tip": float(INITIAL.deriv()(1.0)),
        "w_ss_at_tip": float(INITIAL.deriv(2)(1.0)),
        "w_sss_at_tip": float(INITIAL.deriv(3)(1.0)),
        "largest_slope": significant(
            float(np.max(INITIAL.deriv()(np.linspace(0.0, 1.0, 1001)))), 3
        ),
        "sector_deg_if_whole": significant(whole, 3),
        "sector_deg_if_about_setpoint_1": significant(beside, 3),
    }
