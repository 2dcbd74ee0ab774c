"""The centralised reference: the whole observer and controller recomputed with dense products.

From the recorded measurements and the deployment alone, tick by tick,

    (xh(k+1), u(k+1)) = M ((xh(k), u(k), y(k)) - in_ref(k)) + out_ref(k+1)      chapter (5), theory 5

with one dense matrix M of shape (5n, 7n) for each setpoint, and compared with what the nodes recorded
while each of them held its own few numbers only. Which setpoint's matrix is used is decided here again,
from the estimate of the whole arm. A sum that was bridged is no dense product of anything: the comparison ends
with the first tick in which the chain was not whole, and says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.metrics import energy_norm
from analysis.recording import QUANTITIES, Recording
from deploy import Place, SegmentGrid
from node.scheduling import Sectors
from wire.errors import UsageError
from wire.joints import ArmEnd

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
    """Ticks compared: up to the first one with a missing measurement, or the first degraded one."""
    degraded_from: int | None
    """The last tick compared, if the chain was not whole in it any more; its state is still a whole one's."""
    missing: int
    """Estimates and commands in these ticks that the recorder did not get."""
    changes: tuple[int, ...]
    """Ticks from which on another setpoint's gains are used, in the central run."""


@dataclass(frozen=True, eq=False)
class CentralRun:
    """What one computer with all the numbers would have done; K ticks, SI units."""

    estimates: Array
    """xh(k), (K, n, 4)."""
    commands: Array
    """u(k), (K, n)."""
    setpoints: npt.NDArray[np.int64]
    """(K,) index of the setpoint whose matrix is used in tick k."""
    bumps: Array
    """(K, n): the part of u(k) that hides a change of gains."""
    # rows of late ticks, which have no sweep, are NaN; their setpoint is the one that stays in use


def central_run(recording: Recording, ticks: int) -> CentralRun:
    """Run the dense steps over the recorded measurements for so many ticks."""
    run = recording.configuration
    bends = SegmentGrid(np.asarray(run.faces_m)).dual_widths_m(Place.INNER_FACE)
    steps, references = recording.deployment.dense, recording.references
    sectors = Sectors.of(run.scheduling)
    fade = math.exp(-run.tick_s / run.scheduling.bump_s)
    state = np.concatenate(
        [recording.initial_estimates, recording.initial_commands[:, None]], axis=1
    )
    out, bumps = np.empty((ticks, run.nodes, 5)), np.zeros((ticks, run.nodes))
    setpoints = np.empty(ticks, dtype=np.int64)
    active = announced = run.setpoint_index
    changed, bump, now = False, np.zeros(run.nodes), references.states(0)
    for k in range(ticks):
        then = references.states(k + 1)
        setpoints[k] = active
        if recording.late[k]:
            # The estimate keeps its deviation from the reference, the command is held.
            out[k], bumps[k] = np.nan, np.nan
            state[:, :4] += then[:, :4] - now[:, :4]
            now = then
            continue
        out[k], bumps[k] = state, bump
        inputs = np.concatenate([state, recording.measurements[k]], axis=1)
        following = steps[active].about(inputs, now, then)
        jump = (state[:, 4] - now[:, 4]) - (following[:, 4] - then[:, 4])
        bump = jump if changed else bump * fade
        following[:, 4] += bump
        # What the tip node announces in this tick, it has decided by the estimate of the tick before.
        tip = _tip(state, now, references.chords_m(k), bends)
        changed, active = announced != active, announced
        announced = sectors.choose(announced, ArmEnd(0.0, *tip.tolist()))
        state, now = following, then
    return CentralRun(out[:, :, :4], out[:, :, 4], setpoints, bumps)


def _tip(state: Array, wanted: Array, chords: Array, bends: Array) -> Array:
    """Estimated tip (2,): the chords (n, 2) of the reference, turned and stretched by the deviations from it.

    state, wanted: (n, 5); bends: (n,), what each curvature bends.
    """
    turns = np.cumsum((state[:, 3] - wanted[:, 3]) * bends)
    stretch = (1.0 + state[:, 2]) / (1.0 + wanted[:, 2])
    places = np.sum(stretch * np.exp(1j * turns) * (chords[:, 0] + 1j * chords[:, 1]))
    return np.array([places.real, places.imag])


def compare_with_central(recording: Recording, tolerance: float = 1e-12) -> CentralComparison:
    """Recompute xh(k) and u(k) of every tick and find the largest relative difference.

    Each of v_x, v_y, e, k and u is divided by its largest magnitude over all nodes and ticks of the
    central run. A state quantity that is all but absent is divided by 1 % of the magnitude that
    would hold the run's largest energy alone (v_x and e vanish at a straight setpoint).

    Raises UsageError if the recording has no complete tick.
    """
    usable = np.isfinite(recording.measurements).all(axis=(1, 2)) | recording.late
    ticks = int(np.argmin(usable)) if not usable.all() else usable.size
    # The values of tick k depend on measurements up to k - 1 only.
    ticks = min(ticks + 1, recording.ticks)
    degraded = recording.first_degraded
    degraded = None if degraded is None or degraded >= ticks else degraded
    if degraded is not None:
        ticks = degraded + 1
    if ticks == 0:
        raise UsageError(f"recording {recording.path}: no complete tick in it; nothing to compare")
    run = central_run(recording, ticks)
    central = np.concatenate([run.estimates, run.commands[:, :, None]], axis=2)
    recorded = np.concatenate(
        [recording.estimates[:ticks], recording.commands[:ticks, :, None]], axis=2
    )
    recorded[recording.out[:ticks]] = (
        np.nan
    )  # the plant's command in place of a node's that was out
    scales = _scales(central, recording.energy_weights)
    relative = np.abs(recorded - central) / scales
    missing = np.isnan(relative)  # what the recorder did not get cannot be compared
    relative[missing] = 0.0
    missing[recording.late[:ticks]] = False  # and in late ticks there is nothing to get
    missing[recording.out[:ticks]] = False  # nor of a node that was out
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
        degraded_from=degraded,
        missing=int(np.count_nonzero(missing)),
        changes=tuple((1 + np.flatnonzero(np.diff(run.setpoints))).tolist()),
    )


def _scales(central: Array, weights: Array) -> Array:
    """What to divide the differences of each quantity by, shape (5,); central: (K, n, 5)."""
    largest = np.nanmax(np.abs(central), axis=(0, 1))
    energy = float(np.nanmax(energy_norm(central[:, :, :4], weights)))
    alone = energy / np.sqrt(np.max(weights, axis=0))
    largest[:4] = np.maximum(largest[:4], _SMALLEST_SHARE * alone)
    return np.where(largest > 0.0, largest, 1.0)
