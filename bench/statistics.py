"""What is computed from measured times: percentiles, the search for the highest rate, targets, ratios.

Pure: numbers and dictionaries in, numbers and dictionaries out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "p99_9": 0.999}
LADDER_HZ = (1000, 500, 400, 333, 250, 200, 150, 125, 100, 80, 67, 50, 40, 33, 25, 20, 10)
RATE_TARGETS_HZ = {10: 250, 20: 150, 50: 50, 100: 25}
SWEEP_TARGET = 1.25
"""Sweep of the neighbour pattern over that of the bare chain, medians."""
SWEEP_NODES = (10, 50)
START_TARGET_S = 3.0
MEMORY_TARGET_MB = 10.0
START_NODES = 50


def percentile(values: Array, quantile: float) -> float:
    """The smallest value that at least this share of the values does not exceed (nearest rank)."""
    rank = max(1, math.ceil(round(quantile * len(values), 9)))
    return float(np.sort(values)[rank - 1])


def spread(values: Array, unit: float) -> dict[str, float | int]:
    """Number, mean, percentiles and maximum, in `unit` (1e3: us from ns)."""
    out: dict[str, float | int] = {"count": len(values), "mean": float(np.mean(values)) / unit}
    out |= {name: percentile(values, q) / unit for name, q in QUANTILES.items()}
    return out | {"max": float(np.max(values)) / unit}


# -- rates ----------------------------------------------------------------------------------------


def most_late(ticks: int) -> int:
    """So many ticks may be late and the rate still is held: one more and p99.9 is beyond the period."""
    return ticks - math.ceil(round(0.999 * ticks, 9))


def trial_facts(hz: int, asked: int, times_ns: Array) -> dict[str, Any]:
    """One trial: times from the due instants in ms, and whether p99.9 stayed below the period.

    A trial that was given up has fewer ticks than asked for, and is not held.
    """
    period_ns = 1e9 / hz
    late = int(np.count_nonzero(times_ns >= period_ns))
    return {
        "hz": hz,
        "ticks": len(times_ns),
        "asked": asked,
        "finish_ms": spread(times_ns, 1e6),
        "late": late,
        "held": len(times_ns) == asked and percentile(times_ns, 0.999) < period_ns,
    }


def first_rate(tick_s: float, ladder: Sequence[int] = LADDER_HZ) -> int:
    """Where the search begins: the highest rate whose period is longer than so long a tick, in seconds."""
    return next((hz for hz in sorted(ladder, reverse=True) if hz * tick_s < 1.0), min(ladder))


def highest_rate(
    trial: Callable[[int], bool], start: int, ladder: Sequence[int] = LADDER_HZ
) -> int | None:
    """The highest rate of the ladder that is held twice; None if none is.

    Upwards from `start` while rates are held, else downwards until one is; then that rate must be held
    once more, or the next lower one twice.
    """
    rates = sorted(ladder)
    at = rates.index(start)
    held = trial(rates[at])
    if held:
        while at + 1 < len(rates) and trial(rates[at + 1]):
            at += 1
    while at >= 0:
        if held and trial(rates[at]):
            return rates[at]
        at -= 1
        held = at >= 0 and trial(rates[at])
    return None


# -- targets --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """A figure that should be reached, and whether it is."""

    name: str
    nodes: int
    value: float
    """The figure as measured."""
    limit: float
    unit: str
    met: bool

    def facts(self) -> dict[str, Any]:
        """As in the JSON file."""
        return dict(vars(self))


def targets(rows: Sequence[Mapping[str, Any]], rates: Sequence[Mapping[str, Any]]) -> list[Target]:
    """All targets for which there are figures."""
    out = []
    by = {(row["pattern"], row["nodes"]): row for row in rows}
    for (pattern, nodes), row in by.items():
        counted = row["messages_per_tick"]["exchange"]
        if counted is not None:
            expected = row["expected_messages_per_tick"]
            name = f"messages a tick, {pattern}"
            out.append(Target(name, nodes, counted, expected, "", counted == expected))
    for nodes in SWEEP_NODES:
        ours, bare = by.get(("neighbour", nodes)), by.get(("bare", nodes))
        if ours and bare:
            ratio = ours["sweep_us"]["p50"] / bare["sweep_us"]["p50"]
            met = ratio <= SWEEP_TARGET
            name = "sweep p50, neighbour over bare"
            out.append(Target(name, nodes, ratio, SWEEP_TARGET, "", met))
    ours = by.get(("neighbour", START_NODES))
    if ours is not None:
        pairs = [("start-up", ours["start_s"], START_TARGET_S, "s")]
        if ours["memory_mb"] is not None:
            memory = ours["memory_mb"]["pss_per_node"]
            pairs.append(("memory a node, PSS", memory, MEMORY_TARGET_MB, "MB"))
        for name, value, limit, unit in pairs:
            out.append(Target(name, START_NODES, value, limit, unit, value < limit))
    for rate in rates:
        wanted = RATE_TARGETS_HZ.get(rate["nodes"])
        if rate["pattern"] == "neighbour" and wanted is not None:
            held = rate["held_hz"] or 0
            out.append(Target("rate held", rate["nodes"], held, wanted, "Hz", held >= wanted))
    return out


# -- comparison -----------------------------------------------------------------------------------

COMPARED = {
    "sweep_p50": ("sweep_us", "p50"),
    "sweep_p99": ("sweep_us", "p99"),
    "sweep_p99_9": ("sweep_us", "p99_9"),
    "chain_p50": ("chain_us", "p50"),
    "cpu": ("cpu_us_per_tick",),
    "pss_per_node": ("memory_mb", "pss_per_node"),
    "start": ("start_s",),
}


def ratios(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[dict[str, Any]]:
    """New over old for each pattern and n that both have; None where one lacks the figure."""
    before = {(row["pattern"], row["nodes"]): row for row in old["rows"]}
    out: list[dict[str, Any]] = []
    for row in new["rows"]:
        key = (row["pattern"], row["nodes"])
        if key in before:
            found = {name: _ratio(row, before[key], path) for name, path in COMPARED.items()}
            out.append({"pattern": key[0], "nodes": key[1], **found})
    rates = {(r["pattern"], r["nodes"]): r for r in old["rates"]}
    for rate in new["rates"]:
        key = (rate["pattern"], rate["nodes"])
        if key in rates:
            pair = [row for row in out if (row["pattern"], row["nodes"]) == key]
            for row in pair:
                row["rate"] = _ratio(rate, rates[key], ("held_hz",))
    return out


def _ratio(new: Mapping[str, Any], old: Mapping[str, Any], path: tuple[str, ...]) -> float | None:
    a, b = _at(new, path), _at(old, path)
    return None if a is None or not b else a / b


def _at(row: Any, path: tuple[str, ...]) -> float | None:
    for key in path:
        if not isinstance(row, Mapping) or key not in row:
            return None
        row = row[key]
    return float(row) if isinstance(row, int | float) else None
