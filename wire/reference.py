"""The reference that a run follows, as polynomials in the progress of a leg: made by `deploy`, evaluated every
tick by nodes and plant.

A leg leads from one rest to the next. Its progress sigma goes from 0 to 1 by the quintic time law, whose
velocity and acceleration vanish at both ends; what is wanted at tick k is

    q(k) = a0(sigma) + a1(sigma) sigma' + a2(sigma) sigma'^2 + a3(sigma) sigma''

with one Chebyshev series in 2 sigma - 1 for each a and quantity (theory, section 5: which quantities, and what
the a are made of, is said where the tables are made, in deploy.path).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from wire.errors import UsageError

Array = npt.NDArray[np.float64]

TERMS = 4
"""Factors of the series: 1, sigma', sigma'^2, sigma''."""


def progress(fraction: float) -> tuple[float, float, float]:
    """sigma and its first two derivatives by the fraction of the leg's time, in [0, 1]: the quintic time law.

    sigma = 10 x^3 - 15 x^4 + 6 x^5: velocity and acceleration vanish at both ends.
    """
    x, rest = fraction, 1.0 - fraction
    return (
        x * x * x * (10.0 + x * (6.0 * x - 15.0)),
        30.0 * x * x * rest * rest,
        60.0 * x * rest * (1.0 - 2.0 * x),
    )


@dataclass(frozen=True, eq=False)
class Leg:
    """One move: it begins at begin_s and takes move_s (0: a rest from begin_s on).

    coefficients: (4, quantities, degree + 1), see the module's text. UsageError if they do not fit.
    """

    begin_s: float
    move_s: float
    coefficients: Array

    def __post_init__(self) -> None:
        shape = self.coefficients.shape
        if len(shape) != 3 or shape[0] != TERMS or shape[2] < 1:
            raise UsageError(
                f"reference: expected coefficients of shape ({TERMS}, quantities, degree + 1), got "
                f"{shape}; deploy the gains again"
            )
        if not (math.isfinite(self.begin_s) and 0.0 <= self.move_s < math.inf):
            raise UsageError(
                f"reference: a leg from {self.begin_s!r} s that takes {self.move_s!r} s; expected finite "
                "times that are not negative"
            )
        if not np.isfinite(self.coefficients).all():
            raise UsageError("reference: a coefficient is not finite; deploy the gains again")


class Reference:
    """What a run wants at each tick; `at(k)` gives the quantities (q,), read-only, the same array at rest.

    The quantity `held` is a command, which stays as it is for a tick: it is taken in the tick's middle.
    """

    def __init__(self, tick_s: float, legs: Sequence[Leg], held: int | None = None) -> None:
        if not legs:
            raise UsageError("reference: no leg; a rest is one of 0 s")
        if not (math.isfinite(tick_s) and tick_s > 0.0):
            raise UsageError(f"reference: expected a tick of a positive time, got {tick_s!r} s")
        shapes = {leg.coefficients.shape[1] for leg in legs}
        if len(shapes) > 1 or not (held is None or 0 <= held < min(shapes)):
            raise UsageError(
                f"reference: legs of {sorted(shapes)} quantities, of which number {held} is held; expected "
                "legs of the same quantities"
            )
        begins = [leg.begin_s for leg in legs]
        ends = [leg.begin_s + leg.move_s for leg in legs]
        if any(after < before - 1e-9 for before, after in zip(ends, begins[1:], strict=False)):
            raise UsageError(
                f"reference: legs begin at {begins} s and end at {ends} s: they overlap"
            )
        self.tick_s = tick_s
        self.legs = tuple(legs)
        self.held = held
        self._begins, self._ends = begins, ends
        self._flat = [leg.coefficients.reshape(-1, leg.coefficients.shape[2]) for leg in legs]
        self._orders = [np.arange(leg.coefficients.shape[2], dtype=np.float64) for leg in legs]
        self._last = [self._moving(i, 1.0) for i in range(len(legs))]
        self._first = self._moving(0, 0.0) if legs[0].move_s > 0.0 else self._last[0]
        # Outside of these ticks nothing moves, which is most of the time and needs no search.
        self._moves_from = begins[0] / tick_s - 1.0
        self._rests_from = ends[-1] / tick_s + 1.0

    def at(self, tick: int) -> Array:
        """The quantities (q,) at the start of a tick, the one that is held in its middle."""
        if tick < self._moves_from:
            return self._first
        if tick > self._rests_from:
            return self._last[-1]
        now = self._when(tick * self.tick_s)
        if self.held is None:
            return now
        middle = self._when((tick + 0.5) * self.tick_s)
        if middle is now:
            return now
        out = now.copy()
        out[self.held] = middle[self.held]
        out.flags.writeable = False
        return out

    def rests(self, tick: int) -> bool:
        """Whether nothing moves at the start of a tick."""
        t = tick * self.tick_s
        index = bisect_left(self._begins, t) - 1
        return index < 0 or t >= self._ends[index]

    def _when(self, t: float) -> Array:
        index = bisect_left(self._begins, t) - 1
        if index < 0:
            return self._first
        if t >= self._ends[index]:
            return self._last[index]
        return self._moving(index, (t - self._begins[index]) / self.legs[index].move_s)

    def _moving(self, index: int, fraction: float) -> Array:
        sigma, rate, second = progress(fraction)
        pace = 1.0 / self.legs[index].move_s if self.legs[index].move_s > 0.0 else 0.0
        rate *= pace
        # T_j(x) = cos(j arccos x), exact to rounding on [-1, 1]
        waves = np.cos(self._orders[index] * math.acos(min(1.0, max(-1.0, 2.0 * sigma - 1.0))))
        values = (self._flat[index] @ waves).reshape(TERMS, -1)
        out: Array = np.array([1.0, rate, rate * rate, second * pace * pace]) @ values
        out.flags.writeable = False
        return out

    def to_plain(self) -> dict[str, Any]:
        """As a dictionary of numbers, lists and bytes (little-endian float64)."""
        legs = [
            [leg.begin_s, leg.move_s, *leg.coefficients.shape, _bytes(leg.coefficients)]
            for leg in self.legs
        ]
        return {"tick_s": self.tick_s, "held": self.held, "legs": legs}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Reference:
        """From `to_plain`; UsageError if something is missing or damaged."""
        try:
            legs = [
                Leg(begin, move, np.frombuffer(raw, dtype="<f8").reshape(shape).astype(np.float64))
                for begin, move, *shape, raw in plain["legs"]
            ]
            held = plain["held"]
            return cls(float(plain["tick_s"]), legs, None if held is None else int(held))
        except (KeyError, TypeError, ValueError, OverflowError, MemoryError) as error:
            raise UsageError(f"reference: damaged ({error}); deploy the gains again") from None


def _bytes(array: Array) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()
