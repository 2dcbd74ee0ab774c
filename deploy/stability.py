"""Is the sampled loop stable at this tick? The last check of `deploy` before factors are handed
out.

Three maps over one tick must not grow: the observer's error and the controlled state with the arm
stepped as the observer's model is (error and state separate), and the whole loop around the arm as
it is, exact in time on a finer grid (`deploy.arm`). The last is the strictest: it sees the modes
that the model has not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy.arm import ArmModes, sample
from deploy.step import Loop, Step, make_step

Array = npt.NDArray[np.float64]

GROWTH_PER_S = 1e-4
"""Growth up to this rate passes, a factor e in 10^4 s: undamped motion of the arm itself does."""
LONGEST_TICK_S = 1e3
SHORTEST_TICK_S = 1e-5
ACCURACY = 0.02
"""Relative accuracy of the longest stable tick."""


@dataclass(frozen=True)
class SpectralRadius:
    """Spectral radii over one tick at one setpoint; below 1 decays."""

    tick_s: float
    observer_error: float
    """Of xh - x, the arm stepped like the observer's model."""
    controlled_state: float
    """Of x with u = K x, the arm stepped like the observer's model."""
    arm: float
    """Of arm, observer and controller together, the arm exact in time on a finer grid."""

    @property
    def largest(self) -> float:
        """The largest of the three."""
        return max(self.observer_error, self.controlled_state, self.arm)

    @property
    def stable(self) -> bool:
        """True if nothing grows faster than `GROWTH_PER_S`."""
        return bool(self.largest <= math.exp(GROWTH_PER_S * self.tick_s))


def spectral_radius(step: Step, modes: ArmModes, tick_s: float) -> SpectralRadius:
    """Spectral radii of one tick at one setpoint."""
    return SpectralRadius(
        tick_s=tick_s,
        observer_error=_radius(step.observer_error()),
        controlled_state=_radius(step.controlled_state()),
        arm=_radius(arm_loop(step, modes, tick_s)),
    )


def arm_loop(step: Step, modes: ArmModes, tick_s: float) -> Array:
    """Map of (modes of the arm, scaled estimate) over one tick of the whole loop, square."""
    transition, force, sense = sample(modes, tick_s)
    command = step.feedback / step.command_scale[:, None]
    measured = step.measurement_scale[:, None] * sense
    observed = step.transition @ step.correction
    own = step.transition + observed @ step.measure + step.force @ step.feedback
    return np.block([[transition, force @ command], [-observed @ measured, own]])


def _radius(matrix: Array) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(matrix))))


def all_stable(loops: Sequence[tuple[Loop, ArmModes]], tick_s: float) -> bool:
    """True if the loops of all setpoints are stable at this tick."""
    return all(
        spectral_radius(make_step(loop, tick_s), modes, tick_s).stable for loop, modes in loops
    )


def longest_stable_tick(
    loops: Sequence[tuple[Loop, ArmModes]], tick_s: float, stable: bool
) -> float:
    """End of the range of stable ticks in s, accurate to `ACCURACY`, seen from a tick of known
    stability.

    From a stable tick the search goes up, from an unstable one down, by factors of 2, then by
    bisection. Returns inf if all up to `LONGEST_TICK_S` are stable, 0 if all down to
    `SHORTEST_TICK_S` are unstable.
    """
    factor = 2.0 if stable else 0.5
    near, far = tick_s, tick_s * factor
    while all_stable(loops, far) == stable:
        near, far = far, far * factor
        if far > LONGEST_TICK_S:
            return math.inf
        if far < SHORTEST_TICK_S:
            return 0.0
    low, high = min(near, far), max(near, far)
    while high > (1.0 + ACCURACY) * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if all_stable(loops, middle) else (low, middle)
    return low
