"""Figures of a PDE and of its closed loops, with refinement: what stands beside a certified gamma.

From the matrices of `galerkin`: closed loops with given gains, the best values that any gain could reach, the
parameter where stability ends; each at several sizes, so that one sees how far to trust it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from design import legendre
from design.channel import Channel, state_feedback_optimum
from design.legendre import Array
from design.pde.galerkin import System, discretise
from design.pde.model import Pde

SIZES = (15, 23, 35)
"""Of the discretisations: odd, for which the tau method always has a solution, and of constant ratio."""


@dataclass(frozen=True)
class Refined:
    """A figure at growing sizes: as good as the agreement of its last two values."""

    sizes: tuple[int, ...]
    values: tuple[float, ...]
    tolerance: float
    seconds: float
    unit: float = 0.0
    """Differences count relative to the value, or to this if it is larger."""

    def __post_init__(self) -> None:
        if not self.values or len(self.sizes) != len(self.values):
            raise ValueError(f"{len(self.values)} values at {len(self.sizes)} sizes, not one each")

    @property
    def value(self) -> float:
        """At the largest size."""
        return self.values[-1]

    @property
    def change(self) -> float:
        """Relative difference of the last two values: what was reached; infinite if there is one only."""
        if len(self.values) < 2:
            return math.inf
        before, last = self.values[-2:]
        if before == last:
            return 0.0
        if not (math.isfinite(before) and math.isfinite(last)):
            return math.inf
        return abs(last - before) / max(abs(before), abs(last), self.unit)

    @property
    def converged(self) -> bool:
        """Whether the last two values agree to the tolerance."""
        return self.change <= self.tolerance

    @property
    def extrapolated(self) -> float:
        """The limit if the error falls by a constant factor from size to size (Aitken), else `value`."""
        if len(self.values) < 3 or not all(map(math.isfinite, self.values[-3:])):
            return self.value
        first, second = np.diff(self.values[-3:])
        if first == 0.0 or not 0.0 < second / first < 0.9:
            return self.value
        return float(self.value + second**2 / (first - second))


@dataclass(frozen=True)
class Optimum:
    """The infimum of gamma over all gains; None with the reason where no Riccati equation gives it."""

    value: float | None
    reason: str = ""


def refine(
    figure: Callable[[int], float],
    sizes: Sequence[int] = SIZES,
    tolerance: float = 1e-6,
    seconds: float = 60.0,
    unit: float = 0.0,
) -> Refined:
    """The figure at growing sizes, until two agree to the tolerance or there is no time for the next one.

    The time that a size takes is expected to grow with its cube. The first size is always done.
    """
    start = time.monotonic()

    def measured(*values: float) -> Refined:
        elapsed = time.monotonic() - start
        return Refined(tuple(sizes[: len(values)]), values, tolerance, elapsed, unit)

    result = measured(figure(sizes[0]))
    last_s = result.seconds
    for before, size in pairwise(sizes):
        if result.converged or result.seconds + last_s * (size / before) ** 3 > seconds:
            break
        used_s = result.seconds
        result = measured(*result.values, figure(size))
        last_s = result.seconds - used_s
    return result


def stability_limit(
    problem: Callable[[float], Pde],
    low: float,
    high: float,
    sizes: Sequence[int] = SIZES,
    tolerance: float = 1e-6,
    seconds: float = 60.0,
) -> Refined:
    """The parameter between `low` and `high` where modes begin to grow, or cease to, by bisection.

    Raises ValueError if at the largest size both ends are alike.
    """
    span = abs(high - low)
    alike = ""

    def grows(parameter: float, size: int) -> bool:
        return discretise(problem(parameter), size).grows()

    def limit(size: int) -> float:
        nonlocal alike
        left, right, first = low, high, grows(low, size)
        alike = ""
        if first == grows(high, size):
            alike = "grow" if first else "do not grow"
            return math.nan
        while abs(right - left) > 0.01 * tolerance * max(abs(left), abs(right), 1e-3 * span):
            middle = 0.5 * (left + right)
            left, right = (middle, right) if grows(middle, size) == first else (left, middle)
        return 0.5 * (left + right)

    result = refine(limit, sizes, tolerance, seconds, unit=1e-3 * span)
    if alike:
        raise ValueError(f"modes {alike} at both {low:g} and {high:g}: no limit between them")
    return result


def sampled_gain(system: System, finite: Array, functions: Callable[[Array], Array]) -> Array:
    """A gain in the form that `observer_loop` takes; its transpose is one for `feedback_loop`.

    finite: (odes, k). functions: from points (p,) to values (n, k, p), for the n functions. k is the number
    of scalar outputs or controls. Raises ValueError if there are not so many states.
    """
    nodes, _ = legendre.gauss(system.rows)
    coefficients = legendre.fit(functions(nodes))
    gain = np.vstack([finite, *(block.T for block in coefficients)])
    _expect("gain", gain, (len(system.state), finite.shape[1]))
    return gain


def observer_loop(system: System, L: Array) -> Channel:
    """Error e = xh - x of the observer with gain L: e_t = (A + L C2) e - (B1 + L D21) w, z = C1 e - D11 w.

    Chapter (17). L: (odes + n rows, outputs), from the outputs to a right-hand side in the form of
    `System.force`. Raises ValueError for another shape.
    """
    _expect("L", L, (len(system.state), len(system.C2)))
    gain = system.force @ L
    return Channel(
        system.A + gain @ system.C2, -system.B1 - gain @ system.D21, system.C1, -system.D11
    )


def feedback_loop(system: System, K: Array) -> Channel:
    """State feedback u = K x: x_t = (A + B2 K) x + B1 w, z = (C1 + D12 K) x + D11 w, chapter (20).

    K: (controls, odes + n rows), from the primary state as `System.state` gives it. Raises ValueError for
    another shape.
    """
    _expect("K", K, (system.B2.shape[1], len(system.state)))
    gain = K @ system.state
    return Channel(
        system.A + system.B2 @ gain, system.B1, system.C1 + system.D12 @ gain, system.D11
    )


def observer_optimum(system: System, tolerance: float = 1e-7) -> Optimum:
    """Infimum of gamma over all L in `observer_loop`: the state feedback of the transposed matrices."""
    s = system
    return _optimum(
        (s.A.T, s.C1.T, s.C2.T, s.B1.T, s.D11.T, s.D21.T),
        "measured output", "noise", tolerance,
    )  # fmt: skip


def controller_optimum(system: System, tolerance: float = 1e-7) -> Optimum:
    """Infimum of gamma over all K in `feedback_loop`."""
    s = system
    return _optimum(
        (s.A, s.B1, s.B2, s.C1, s.D11, s.D12), "control", "cost in the regulated output", tolerance
    )


def _optimum(
    matrices: tuple[Array, Array, Array, Array, Array, Array],
    what: str,
    lacks: str,
    tolerance: float,
) -> Optimum:
    """matrices: A, B1, B2, C1, D11, D12 of a state-feedback problem."""
    weights = matrices[-1]
    if weights.shape[1] == 0:
        return Optimum(None, f"there is no {what}")
    values = np.linalg.svd(weights, compute_uv=False)
    if len(weights) < weights.shape[1] or values[-1] < 1e-8 * values[0] or values[0] == 0.0:
        return Optimum(None, f"not every {what} has a {lacks} of its own")
    return Optimum(state_feedback_optimum(*matrices, tolerance=tolerance))


def _expect(name: str, array: Array, shape: tuple[int, int]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name}: expected a matrix of shape {shape}, got {array.shape}")
