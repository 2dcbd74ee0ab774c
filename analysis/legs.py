"""What a run did leg by leg: tip error and estimate in every hold, and what happened at every change of gains.

Pure mathematics between `analysis.recording`, which supplies the arrays, and the summary and the plot. A leg
is a move to a setpoint and the hold there; the first one is the hold at the start, without a move.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.metrics import time_below
from wire.run_config import LegConfig

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NEAR_M = 0.01
"""The tip has arrived when its error stays below this to the end of the hold."""


@dataclass(frozen=True)
class Leg:
    """One move and the hold after it, times in s from the start of the run."""

    to: str
    through: tuple[str, ...]
    move_from_s: float
    hold_from_s: float
    until_s: float

    @property
    def way(self) -> str:
        """The leg in words: "hold 1", "to 2", "by 2 to 3"."""
        if self.move_from_s == self.hold_from_s:
            return f"hold {self.to}"
        by = f"by {', '.join(self.through)} " if self.through else ""
        return f"{by}to {self.to}"


def make_legs(
    start: str, first_hold_s: float, moves: Sequence[LegConfig], end_s: float
) -> list[Leg]:
    """The legs that a run of end_s has begun; the last one lasts to the end of the run."""
    begin = first_hold_s if moves else end_s
    legs = [Leg(start, (), 0.0, 0.0, begin)]
    for move in moves:
        arrived = begin + move.move_s
        begin = arrived + move.hold_s
        legs.append(Leg(move.to, tuple(move.through), arrived - move.move_s, arrived, begin))
    legs[-1] = replace(legs[-1], until_s=max(begin, end_s))
    return [
        replace(leg, until_s=min(leg.until_s, end_s))
        for leg in legs
        if leg.move_from_s < min(leg.until_s, end_s)
    ]


def leg_facts(
    leg: Leg, times_s: Array, tip_error_m: Array, shape_error_m: Array, active: Sequence[str]
) -> dict[str, Any]:
    """Figures of one leg, keys as in the summary; null where the leg did not get to its end, or has no hold.

    times_s, tip_error_m, shape_error_m: (K,); active: (K,) names of the setpoints whose gains are in use.
    """
    # Ticks are multiples of the period up to rounding, so the ends of a leg are met within half of one.
    half = 0.5 * float(times_s[1] - times_s[0]) if times_s.size > 1 else 0.0
    moving = (times_s > leg.move_from_s - half) & (times_s < leg.hold_from_s - half)
    holding = (times_s > leg.hold_from_s - half) & (times_s < leg.until_s - half)
    errors, held = tip_error_m[holding], times_s[holding]
    near = time_below(held, errors, NEAR_M)
    mine = np.flatnonzero(holding | moving)
    at_end = mine[-1:]
    arrived = leg.until_s > leg.hold_from_s - half
    return {
        "way": leg.way,
        "to": leg.to,
        "move_from_s": leg.move_from_s,
        "hold_from_s": leg.hold_from_s,
        "until_s": leg.until_s,
        "tip_error_end_m": _last(tip_error_m[at_end]) if arrived else None,
        "tip_error_largest_in_hold_m": _largest(errors),
        "tip_error_largest_in_move_m": _largest(tip_error_m[moving]),
        "tip_below_1_cm_after_s": None if near is None else max(0.0, near - leg.hold_from_s),
        "shape_estimation_error_end_m": _last(shape_error_m[at_end]) if arrived else None,
        "gains_at_end": active[int(mine[-1])] if mine.size else None,
    }


def switch_facts(
    active: Ints, names: Sequence[str], tick_s: float, tips_m: Array, commands: Array, bumps: Array
) -> list[dict[str, Any]]:
    """Every change of gains: its tick (the first with the new ones), where the tip was, and what it did.

    active: (K,) indices into names; tips_m: (K, 2) of the true arm; commands, bumps: (K, n) in N/m, the bump
    being the part of the command that hides the change and is faded out. `command_jump_n_per_m` is the
    largest jump that the new gains would have made, `command_step_n_per_m` the largest that a command did
    make, `..._before_...` the same one tick earlier, for comparison.
    """
    steps = np.abs(np.diff(commands, axis=0))
    facts = []
    for k in (np.flatnonzero(np.diff(active)) + 1).tolist():
        after = k + 1 < len(commands)  # the first command that the new gains computed
        facts.append(
            {
                "tick": k,
                "time_s": k * tick_s,
                "from": names[active[k - 1]],
                "to": names[active[k]],
                "tip_angle_deg": math.degrees(math.atan2(tips_m[k, 1], tips_m[k, 0])),
                "command_jump_n_per_m": _largest(np.abs(bumps[k + 1])) if after else None,
                "command_step_n_per_m": _largest(steps[k]) if after else None,
                "command_step_before_n_per_m": _largest(steps[k - 1]),
            }
        )
    return facts


def _last(values: Array) -> float | None:
    return float(values[-1]) if values.size and np.isfinite(values[-1]) else None


def _largest(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else None
