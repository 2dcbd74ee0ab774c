"""The results as a picture: a panel a figure, a group of bars an n, a colour a pattern."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from analysis.study.figures import grouped_bars

PANELS = (
    ("sweep, p50 [ms]", ("sweep_us", "p50"), 1e-3),
    ("sweep, p99.9 [ms]", ("sweep_us", "p99_9"), 1e-3),
    ("exchange messages a tick", ("messages_per_tick", "exchange"), 1.0),
    ("CPU time a tick, all processes [ms]", ("cpu_us_per_tick",), 1e-3),
    ("memory a node, PSS [MB]", ("memory_mb", "pss_per_node"), 1.0),
    ("start-up [s]", ("start_s",), 1.0),
)


def draw(facts: dict[str, Any], path: Path) -> None:
    """Draw all panels into a PNG; UsageError if it cannot be written."""
    nodes = sorted({row["nodes"] for row in (*facts["rows"], *facts["rates"])})
    order = [*(row["pattern"] for row in facts["rows"]), *(r["pattern"] for r in facts["rates"])]
    patterns = list(dict.fromkeys(order))
    rows = {(row["pattern"], row["nodes"]): row for row in facts["rows"]}
    panels = [
        (title, [[scale * _at(rows.get((p, n)), keys) for n in nodes] for p in patterns])
        for title, keys, scale in PANELS
    ]
    if facts["rates"]:
        held = {(rate["pattern"], rate["nodes"]): rate for rate in facts["rates"]}
        values = [[_at(held.get((p, n)), ("held_hz",)) for n in nodes] for p in patterns]
        panels.append(("highest rate held [Hz]", values))
    groups = [f"n = {n}" for n in nodes]
    grouped_bars(path, groups, patterns, panels, [[False] * len(groups) for _ in patterns])


def _at(row: Any, keys: tuple[str, ...]) -> float:
    """The figure, NaN where there is none."""
    for key in keys:
        row = None if row is None else row[key]
    return math.nan if row is None else float(row)
