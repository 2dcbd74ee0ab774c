"""The centralised reference: the whole observer and controller recomputed with dense products.

From the recorded measurements and the deployment alone, tick by tick,

    (xh(k+1), u(k+1)) = M ((xh(k), u(k), y(k)) - in_offset) + out_offset      chapter (5), theory 5

with one dense matrix M of shape (5n, 7n), and compared with what the nodes recorded while each of
them held its own few numbers only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.metrics import energy_norm
from analysis.recording import QUANTITIES, Recording
from deploy import DenseStep
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

_SMALLEST_SHARE = 1e-2
"""A quantity is measured against at least this share of the magnitude that, alone, would hold the
run's largest energy: at a straight setpoint v_x and e are zero, and rounding is no difference."""


@dataclass(frozen=True)
class Difference:
    """Where and how far two runs differ."""

    relative: float
    """Relative to the quantity's scale, see `compare_with_central`."""
    tick: int
    node: int
    quantity: str
    recorded: float
    central: float


@dataclass(frozen=True)
class CentralComparison:
    """Recorded distributed run against its centralised recomputation."""

    worst: Difference
    first_above_tolerance: Difference | None
    """The largest difference of the first tick beyond the tolerance: where a fault entered."""
    tolerance: float
    per_tick: Array
    """(K,) largest relative difference of each tick."""
    per_quantity: dict[str, float]
    scales: dict[str, float]
    """What each quantity's difference was divided by, SI units."""
    ticks: int
    """Ticks compared: up to the first one with a missing measurement."""
    missing: int
    """Estimates and commands in these ticks that the recorder did not get."""


def central_run(
    step: DenseStep, initial_estimates: Array, initial_commands: Array, measurements: Array
) -> tuple[Array, Array]:
    """Run the dense step over the measurements.

    initial_estimates: (n, 4); initial_commands: (n,); measurements: (K, n, 2). Returns the
    estimates xh(k), (K, n, 4), and commands u(k), (K, n), for k = 0 .. K - 1; SI units.
    """
    ticks, nodes, _ = measurements.shape
    state = np.concatenate([initial_estimates, initial_commands[:, None]], axis=1)
    out = np.empty((ticks, nodes, 5))
    for k in range(ticks):
        out[k] = state
        state = step(np.concatenate([state, measurements[k]], axis=1))
    return out[:, :, :4], out[:, :, 4]


def compare_with_central(recording: Recording, tolerance: float = 1e-12) -> CentralComparison:
    """Recompute xh(k) and u(k) of every tick and find the largest relative difference.

    Each of v_x, v_y, e, k and u is divided by its largest magnitude over all nodes and ticks of the
    central run. A state quantity that is all but absent is divided by 1 % of the magnitude that
    would hold the run's largest energy alone (v_x and e vanish at a straight setpoint).

    Raises UsageError if the recording has no complete tick.
    """
    deployment = recording.deployment
    usable = np.isfinite(recording.measurements).all(axis=(1, 2))
    ticks = int(np.argmin(usable)) if not usable.all() else usable.size
    # The values of tick k depend on measurements up to k - 1 only.
    ticks = min(ticks + 1, recording.ticks)
    if ticks == 0:
        raise UsageError(f"recording {recording.path}: no complete tick in it; nothing to compare")
    estimates, commands = central_run(
        deployment.dense[recording.configuration.setpoint_index],
        recording.initial_estimates,
        recording.initial_commands,
        recording.measurements[:ticks],
    )
    central = np.concatenate([estimates, commands[:, :, None]], axis=2)
    recorded = np.concatenate(
        [recording.estimates[:ticks], recording.commands[:ticks, :, None]], axis=2
    )
    scales = _scales(central, recording.energy_weights)
    relative = np.abs(recorded - central) / scales
    missing = np.isnan(relative)  # what the recorder did not get cannot be compared
    relative[missing] = 0.0
    per_tick: Array = relative.max(axis=(1, 2))

    def at(tick: int) -> Difference:
        node, quantity = np.unravel_index(np.argmax(relative[tick]), relative.shape[1:])
        return Difference(
            relative=float(relative[tick, node, quantity]),
            tick=tick,
            node=int(node),
            quantity=QUANTITIES[quantity],
            recorded=float(recorded[tick, node, quantity]),
            central=float(central[tick, node, quantity]),
        )

    above = np.flatnonzero(per_tick > tolerance)
    return CentralComparison(
        worst=at(int(np.argmax(per_tick))),
        first_above_tolerance=at(int(above[0])) if above.size else None,
        tolerance=tolerance,
        per_tick=per_tick,
        per_quantity=dict(zip(QUANTITIES, relative.max(axis=(0, 1)).tolist(), strict=True)),
        scales=dict(zip(QUANTITIES, scales.tolist(), strict=True)),
        ticks=ticks,
        missing=int(np.count_nonzero(missing)),
    )


def _scales(central: Array, weights: Array) -> Array:
    """What to divide the differences of each quantity by, shape (5,); central: (K, n, 5)."""
    largest = np.max(np.abs(central), axis=(0, 1))
    energy = float(np.max(energy_norm(central[:, :, :4], weights)))
    alone = energy / np.sqrt(np.max(weights, axis=0))
    largest[:4] = np.maximum(largest[:4], _SMALLEST_SHARE * alone)
    return np.where(largest > 0.0, largest, 1.0)
