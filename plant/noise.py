"""Sensor noise, added to what the plant measures before a segment sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.random import (
    Generator,
    Philox,
    SeedSequence,
)  # now: NumPy would load it in the first tick

from wire.errors import UsageError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SensorNoise:
    """White Gaussian noise of every segment's two sensors; a function of (seed, tick) alone.

    Each tick has its own stream of a counter-based generator (Philox) whose key is the seed, so a
    tick's noise does not depend on which ticks were drawn before it, and a run can be recomputed
    from any tick. Raises UsageError for a negative seed or a standard deviation that is negative or
    not finite.
    """

    seed: int
    velocity_y_m_per_s: float = 0.0
    curvature_per_m: float = 0.0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise UsageError(f"noise seed: expected an integer of at least 0, got {self.seed!r}")
        for key in ("velocity_y_m_per_s", "curvature_per_m"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(
                    f"noise {key}: expected a standard deviation of 0 or more, got {value!r}"
                )

    def sample(self, tick: int, segments: int) -> Array:
        """Noise of one tick, shape (segments, 2): columns v_y in m/s and curvature in 1/m.

        Raises ValueError for a negative tick.
        """
        if tick < 0:
            raise ValueError(f"tick must be 0 or more, got {tick}")
        key = SeedSequence(self.seed).generate_state(2, np.uint64)
        stream = Philox(key=key, counter=[0, 0, 0, tick])
        normal: Array = Generator(stream).standard_normal((segments, 2))
        deviations = np.array([self.velocity_y_m_per_s, self.curvature_per_m])
        return np.asarray(normal * deviations)
