"""Is the sampled loop stable at this tick? The last check of `deploy` before factors are handed
out.

Observer and plant model are stepped alike, so error and state separate: the nominal loop is stable
exactly if the map of the observer's error and the map of the controlled state both have spectral
radius below 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deploy.step import Loop, Step, make_step

MARGIN = 1e-9
"""Spectral radii up to 1 + MARGIN pass: the arm's own undamped motion is no fault of the tick."""
LONGEST_TICK_S = 1e3
SHORTEST_TICK_S = 1e-6


@dataclass(frozen=True)
class SpectralRadius:
    """Spectral radii per tick of the two halves of the nominal closed loop at one setpoint."""

    observer_error: float
    controlled_state: float

    @property
    def largest(self) -> float:
        """The larger of the two."""
        return max(self.observer_error, self.controlled_state)

    @property
    def stable(self) -> bool:
        """True if nothing grows from tick to tick."""
        return self.largest <= 1.0 + MARGIN


def spectral_radius(step: Step) -> SpectralRadius:
    """Spectral radii of one tick at one setpoint."""
    radii = [
        float(np.max(np.abs(np.linalg.eigvals(matrix))))
        for matrix in (step.observer_error(), step.controlled_state())
    ]
    return SpectralRadius(observer_error=radii[0], controlled_state=radii[1])


def all_stable(loops: Sequence[Loop], tick_s: float) -> bool:
    """True if the loops of all setpoints are stable at this tick."""
    return all(spectral_radius(make_step(loop, tick_s)).stable for loop in loops)


def longest_stable_tick(loops: Sequence[Loop], below_s: float = LONGEST_TICK_S) -> float:
    """The longest tick, s, to 1 %, from which on down the loops of all setpoints are stable.

    Ticks are tried downwards from `below_s` by halving, then bisected. Returns inf if
    `LONGEST_TICK_S` itself is stable, 0 if not even `SHORTEST_TICK_S` is.
    """
    unstable = below_s
    if all_stable(loops, unstable):
        return math.inf if below_s >= LONGEST_TICK_S else below_s
    stable = 0.5 * unstable
    while not all_stable(loops, stable):
        unstable, stable = stable, 0.5 * stable
        if stable < SHORTEST_TICK_S:
            return 0.0
    while unstable > 1.01 * stable:
        middle = math.sqrt(stable * unstable)
        if all_stable(loops, middle):
            stable = middle
        else:
            unstable = middle
    return stable
