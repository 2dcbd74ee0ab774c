"""Which setpoint's gains are in use: the tip node's decision from the tip's estimated place (pure mathematics).

Between the sums, which bring the estimated arm's shape to the tip node and its decision to all others, and
`node.sweep`, which takes the gains (theory, section 5). The shape comes as turn and end of the arm so far
(`wire.joints`): every node adds its own segment, turned and stretched from what the reference says it is. So
the grid's own error, which few segments have much of, is not taken for a displacement.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

from wire.joints import ArmEnd
from wire.run_config import SchedulingConfig


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
