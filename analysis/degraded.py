"""What of a run was other than it should be: nodes that were out, sums that were bridged, a passive arm.

Part of `analysis.summary`: a recording in, facts out. Alive, on time and valid are three things, counted each
by itself, from what the plant said of every node in every tick (wire.channels.Health).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.lives import lives_of
from analysis.recording import Recording
from wire.channels import Degraded, Health

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_BRIDGED = int(Degraded.FORWARD_BRIDGED | Degraded.BACKWARD_BRIDGED)
KINDS = {"alive": Health.ALIVE, "on_time": Health.ON_TIME, "valid": Health.VALID}


def degraded_facts(recording: Recording) -> dict[str, Any]:
    """The keys of the summary that say what was degraded.

    `health`: per kind the node ticks (a node in a tick of the plant that had a sweep) in which it was so, and
    the nodes that were not always. `replacements`: of each the node, the first tick in which it was out, the
    one from which on the plant had its commands again, and the time between. `bridged`: what the rows say.
    `passive`: None, or from when on, and the energy above the loads at both ends.
    """
    return {
        "health": _health(recording),
        "replacements": replacements(recording),
        "bridged": _bridged(recording),
        "first_degraded_tick": recording.first_degraded,
        "passive": passive_facts(recording),
    }


def _health(recording: Recording) -> dict[str, Any] | None:
    """None before version 5, which did not say."""
    if recording.format_version < 5:
        return None
    swept = swept_ticks(recording)
    out: dict[str, Any] = {"node_ticks": int(np.count_nonzero(swept)) * recording.nodes}
    for kind, bit in KINDS.items():
        well = np.asarray((recording.health[swept] & int(bit)) != 0)
        lacks = np.count_nonzero(~well, axis=0)
        out[kind] = {
            "node_ticks": int(np.count_nonzero(well)),
            "not": {str(i): int(count) for i, count in enumerate(lacks) if count},
        }
    return out


def swept_ticks(recording: Recording) -> npt.NDArray[np.bool_]:
    """(plant ticks,) those that had a sweep: in the others nothing is asked of a node."""
    pace = recording.table("/plant/pace")
    late = pace.by_tick(("late",), len(recording.health))[:, 0]
    return np.asarray(late == 0.0)


def gaps(recording: Recording) -> list[tuple[int, int, int]]:
    """Node, first and last tick of each stretch in which a node was out (`analysis.lives`)."""
    told = np.asarray(np.isfinite(recording.estimates).all(axis=2))
    on_time, alive = recording.health_says(Health.ON_TIME), recording.health_says(Health.ALIVE)
    return [
        (node, *gap)
        for node in range(recording.nodes)
        for gap in lives_of(
            told[:, node],
            recording.late,
            on_time[:, node],
            alive[:, node],
            recording.flags[:, node],
        ).gaps
    ]


def replacements(recording: Recording) -> list[dict[str, Any]]:
    """Every replacement, in the order of the ticks in which they joined."""
    found = []
    pace = recording.configuration.pace
    joined = np.asarray((recording.flags & int(Degraded.JOINED)) != 0)
    on_time = recording.health_says(Health.ON_TIME)
    late = recording.late
    began = recording.table("/sweep/timing").by_tick(("started_wall_ns",), recording.ticks)[:, 0]
    for tick, node in np.argwhere(joined).tolist():
        first = _while(np.asarray(~on_time[:, node] | late), tick - 1)
        back = int(tick)
        while back < recording.ticks and not on_time[back, node]:
            back += 1
        last = min(back, recording.ticks - 1)
        seconds = (
            (back - first) * pace.period_s
            if pace is not None
            else float(began[last] - began[first]) * 1e-9
        )
        found.append(
            {
                "node": node,
                "out_from_tick": first,
                "joined_tick": tick,
                "back_tick": back if back < recording.ticks else None,
                "seconds": seconds,
            }
        )
    return found


def _while(out: npt.NDArray[np.bool_], tick: int) -> int:
    """The first tick of the stretch of True that ends with this one; the one after it if it is not."""
    while tick >= 0 and out[tick]:
        tick -= 1
    return tick + 1


def _bridged(recording: Recording) -> dict[str, int]:
    """Counts over nodes and ticks, from the rows that were recorded."""

    def count(flag: Degraded) -> int:
        return int(np.count_nonzero(recording.flags & int(flag)))

    return {
        "forward_sums": count(Degraded.FORWARD_BRIDGED),
        "backward_sums": count(Degraded.BACKWARD_BRIDGED),
        "commands_held": count(Degraded.HELD),
        "measurements_held": count(Degraded.MEASUREMENT_HELD),
        "ticks": int(np.count_nonzero(recording.flags & _BRIDGED, axis=1).astype(bool).sum()),
    }


def passive_facts(recording: Recording) -> dict[str, Any] | None:
    """From when on the arm was passive, and its energy with the potential of its loads at both ends of that.

    How much of it would be left at rest is not recorded: the differences count. Without disturbance it can only
    fall, by damping; `disturbed` says whether one may have been going on.
    """
    ticks = np.flatnonzero(recording.passive)
    if not ticks.size:
        return None
    energy = recording.energy_above_loads_j[ticks]
    load = recording.configuration.disturbance
    from_s = float(ticks[0]) * recording.tick_s
    over = load.name == "gust" and load.start_s + load.duration_s <= from_s
    return {
        "from_tick": int(ticks[0]),
        "ticks": int(ticks.size),
        "energy_first_j": float(energy[0]),
        "energy_last_j": float(energy[-1]),
        "fall_j": float(energy[0] - energy[-1]),
        "largest_rise_j": float(np.max(np.diff(energy), initial=0.0)),
        "disturbed": load.name != "none" and not over,
    }
