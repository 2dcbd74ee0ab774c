"""The latencies of a recorded run's links: tables of /node/NN/timing in, percentiles and the worst link out.

Part of `analysis.info`; the arithmetic is `wire.link_latency`'s.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from analysis.info_health import flags_of
from analysis.table import Table
from wire.channels import Degraded, label
from wire.errors import UsageError
from wire.link_latency import CLOCKS, IN_MEMORY, MESSAGES, Array, link_kinds, link_latencies
from wire.run_config import RunConfig

SHARES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
WORST_BY = "p99"
_NOT_CAME = (Degraded.MEASUREMENT_HELD, Degraded.FORWARD_BRIDGED, Degraded.BACKWARD_BRIDGED)
_INSTANTS = tuple(f"{what}_received_wall_ns" for what in ("measurement", "forward", "backward"))


def link_facts(
    tables: Mapping[str, Table], run: RunConfig, facts: Mapping[str, str], notes: list[str]
) -> dict[str, Any]:
    """Percentiles in ms over all links and ticks, forward and backward; the worst link by its p99; every link.

    `left_out` counts links without a latency by reason: in one process ("in memory"), or between clocks that
    cannot be compared ("clocks"); `unrecorded` have no tick with both instants.
    """
    own = own_clocks(facts.get("hosts"), run.nodes, notes)
    kinds = link_kinds(run.nodes, run.firsts, own)
    y, c, d = (
        _instants(tables, run, field, flag)
        for field, flag in zip(_INSTANTS, _NOT_CAME, strict=True)
    )
    found = link_latencies(y, c, d)
    rows: list[dict[str, Any]] = []
    pooled: dict[str, Any] = {}
    for way, latencies in (("forward", found.forward_ns), ("backward", found.backward_ns)):
        chosen = [i for i, kind in enumerate(kinds) if kind == MESSAGES]
        pooled[way] = percentiles_ms(latencies[:, chosen])
        for i in chosen:
            ends = (i, i + 1) if way == "forward" else (i + 1, i)
            values = percentiles_ms(latencies[:, i])
            rows.append({"way": way, "from": ends[0], "to": ends[1], "latency_ms": values})
    measured = [row for row in rows if row["latency_ms"] is not None]
    worst = max(measured, key=lambda row: float(row["latency_ms"][WORST_BY]), default=None)
    return {
        **{f"{way}_ms": pooled[way] for way in ("forward", "backward")},
        "measured": len(measured),
        "left_out": {why: kinds.count(why) * 2 for why in (IN_MEMORY, CLOCKS) if why in kinds},
        "unrecorded": len(rows) - len(measured),
        "worst": worst,
        "links": rows,
    }


def own_clocks(hosts: str | None, nodes: int, notes: list[str]) -> frozenset[int]:
    """Nodes whose instants count from their own first measurement; hosts have consecutive nodes.

    `hosts` is the metadata's text, None without; what is wrong with it is added to the notes.
    """
    if hosts is None:
        return frozenset()
    try:
        places = msgspec.json.decode(hosts, type=list[_Place])
    except msgspec.DecodeError as error:
        notes.append(f"the hosts in the metadata cannot be read: {error}")
        return frozenset(range(nodes))  # nothing is known of any clock
    own: set[int] = set()
    first = 0
    for place in places:
        end = min(first + place.nodes, nodes)
        if place.own_clock:
            own.update(range(first, end))
        first = end
    return frozenset(own)


class _Place(msgspec.Struct):
    """A host as the metadata have it; its other facts are of no interest here."""

    nodes: int
    own_clock: bool


def _instants(tables: Mapping[str, Table], run: RunConfig, field: str, not_came: Degraded) -> Array:
    """(K, n): one instant of every node at every tick that any of them has recorded; NaN where missing, or
    where nothing arrived: then the instant is that at which it was given up."""
    timing = [tables.get(f"/node/{label(i, run.nodes)}/timing") for i in range(run.nodes)]
    ticks = max((int(one.ticks.max()) + 1 for one in timing if one is not None), default=0)
    ticks = min(max(ticks, 0), run.ticks)  # a message without a checksum may say anything
    out = np.full((ticks, run.nodes), np.nan)
    for i, table in enumerate(timing):
        if table is None or field not in table.columns:
            continue
        try:
            out[:, i] = table.by_tick((field,), ticks)[:, 0]
        except UsageError:
            continue
        flags = flags_of(tables, i, run.nodes)[:ticks]
        out[: flags.size][(flags & int(not_came)) != 0, i] = np.nan
    return out


def percentiles_ms(durations_ns: Array) -> dict[str, float] | None:
    """The percentiles of `SHARES` in ms, NaN left out; None if nothing is left."""
    values = durations_ns[np.isfinite(durations_ns)]
    if values.size == 0:
        return None
    return dict(
        zip(SHARES, (1e-6 * np.percentile(values, [*SHARES.values()])).tolist(), strict=True)
    )
