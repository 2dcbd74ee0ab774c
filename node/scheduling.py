"""Which setpoint's gains are in use: the tip node's decision from the tip's estimated place (pure mathematics).

Between the sums, which bring the estimated arm's shape to the tip node and its decision to all others, and
`node.sweep`, which takes the gains (theory, section 5). The shape comes as turn and end of the arm so far:
every node adds its own segment, turned and stretched from what the reference says it is. So the grid's own
error, which few segments have much of, is not taken for a displacement.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from wire.run_config import SchedulingConfig


def grow(
    end: Sequence[float], turn_rad: float, stretch: float, chord_x_m: float, chord_y_m: float
) -> tuple[float, float, float]:
    """The end (turn, x, y) of an arm with one segment more: the reference's chord, turned by turn_rad more and
    stretched."""
    turn, x, y = end
    turn += turn_rad
    if not math.isfinite(turn):  # it has no cosine; the caller sees that nothing is right here
        return turn, math.nan, math.nan
    cosine, sine = stretch * math.cos(turn), stretch * math.sin(turn)
    return (
        turn,
        x + cosine * chord_x_m - sine * chord_y_m,
        y + sine * chord_x_m + cosine * chord_y_m,
    )


class ArmEnd(NamedTuple):
    """Where the estimated arm ends so far: its turn from the reference there, x and y of the outer face."""

    turn_rad: float
    x_m: float
    y_m: float


CLAMP = ArmEnd(0.0, 0.0, 0.0)
"""Where the arm begins."""


@dataclass(frozen=True)
class Sectors:
    """Sectors of the plane around the clamp, one a setpoint, by increasing polar angle.

    boundaries_rad: between neighbours. The setpoint in use stays until the tip is hysteresis_rad beyond its
    sector.
    """

    setpoints: tuple[int, ...]
    boundaries_rad: tuple[float, ...]
    hysteresis_rad: float

    @classmethod
    def of(cls, config: SchedulingConfig) -> Sectors:
        """From the run's configuration."""
        boundaries = tuple(math.radians(one) for one in config.boundaries_deg)
        return cls(config.setpoints, boundaries, math.radians(config.hysteresis_deg))

    @classmethod
    def only(cls, setpoint: int) -> Sectors:
        """One setpoint for ever."""
        return cls((setpoint,), (), 0.0)

    def choose(self, current: int, tip: ArmEnd) -> int:
        """The setpoint to use from now on, when `current` is in use and the tip is there."""
        angle = math.atan2(tip.y_m, tip.x_m)
        if current in self.setpoints:
            place = self.setpoints.index(current)
            low = self.boundaries_rad[place - 1] if place > 0 else -math.inf
            high = self.boundaries_rad[place] if place < len(self.boundaries_rad) else math.inf
            if low - self.hysteresis_rad <= angle <= high + self.hysteresis_rad:
                return current
        return self.setpoints[bisect_right(self.boundaries_rad, angle)]
