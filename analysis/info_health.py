"""What was degraded, as `octarm info` has it: health, bridged sums, replacements, the passive arm.

Part of `analysis.info`, which also looks at files that are cut or damaged: what is not there is not counted.
The figures of a whole run are `analysis.degraded`'s.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from analysis.table import Table, whole_numbers
from wire.channels import Degraded, Health, label
from wire.errors import UsageError
from wire.link_latency import Array

KINDS = {"alive": Health.ALIVE, "on_time": Health.ON_TIME, "valid": Health.VALID}


def health_facts(tables: Mapping[str, Table], nodes: int) -> dict[str, Any] | None:
    """None of recordings before version 5, which have no such channels.

    `node_ticks` is how many nodes the plant has judged in all its ticks with a sweep; then how many of these
    were alive, on time and valid.
    """
    table = tables.get("/plant/health")
    if table is None or not table.rows:
        return None
    ticks = int(table.ticks.max()) + 1
    health = _field(table, [f"node_{label(i, nodes)}" for i in range(nodes)], ticks)
    late = _field(tables.get("/plant/pace"), ["late"], ticks)[:, 0] > 0.0
    judged = np.isfinite(health) & ~late[:, None]
    said = whole_numbers(np.where(judged, health, 0.0), 0.0)
    passive = np.flatnonzero(_field(tables.get("/plant/guard"), ["passive"], ticks)[:, 0] > 0.0)
    flags = {i: flags_of(tables, i, nodes) for i in range(nodes)}
    joined = {i: int(np.count_nonzero(own & int(Degraded.JOINED))) for i, own in flags.items()}

    def count(flag: Degraded) -> int:
        return sum(int(np.count_nonzero(own & int(flag))) for own in flags.values())

    return {
        "node_ticks": int(np.count_nonzero(judged)),
        **{kind: int(np.count_nonzero(said & int(bit))) for kind, bit in KINDS.items()},
        "bridged_sums": count(Degraded.FORWARD_BRIDGED) + count(Degraded.BACKWARD_BRIDGED),
        "commands_held": count(Degraded.HELD),
        "replaced": {str(i): times for i, times in joined.items() if times},
        "passive_from_tick": int(passive[0]) if passive.size else None,
        "passive_ticks": int(passive.size),
    }


def flags_of(
    tables: Mapping[str, Table], node: int, nodes: int
) -> np.ndarray[Any, np.dtype[np.int64]]:
    """(ticks,) wire.channels.Degraded of a node, 0 where there is none."""
    table = tables.get(f"/node/{label(node, nodes)}/degraded")
    ticks = 0 if table is None or not table.rows else int(table.ticks.max()) + 1
    return whole_numbers(_field(table, ["flags"], ticks)[:, 0], 0.0)


def _field(table: Table | None, fields: list[str], ticks: int) -> Array:
    """(ticks, fields), NaN where there is nothing that can be read."""
    try:
        if table is not None and table.rows:
            return table.by_tick(fields, ticks)
    except UsageError:
        pass
    return np.full((ticks, len(fields)), np.nan)
