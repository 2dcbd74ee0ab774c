"""The results as text: one table a question (sweeps and cost, rates, targets, ratios)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from analysis.text_table import aligned, ruled

SWEEP = (
    "n",
    "pattern",
    "messages",
    "bytes",
    "p50 [us]",
    "p95",
    "p99",
    "p99.9",
    "max",
    "chain p50",
    "CPU [us]",
    "PSS [MB]",
    "total",
    "start [s]",
)
RATE = ("n", "pattern", "rate [Hz]", "finish p50 [ms]", "p99", "p99.9", "late", "ticks", "")
TARGET = ("target", "n", "measured", "wanted", "")
RATIO = ("n", "pattern", "p50", "p99", "p99.9", "chain p50", "CPU", "PSS", "start", "rate")
RATIO_KEYS = (
    "sweep_p50",
    "sweep_p99",
    "sweep_p99_9",
    "chain_p50",
    "cpu",
    "pss_per_node",
    "start",
    "rate",
)
AT_MOST = {"sweep p50, neighbour over bare": "<= ", "start-up": "< ", "memory a node, PSS": "< "}


def table(facts: dict[str, Any]) -> str:
    """All tables, for a person."""
    machine = facts["machine"]
    options = facts["options"]
    pinned = "neighbours share a core" if options["pin"] else "not pinned"
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores, {machine['virtualisation']}, kernel "
        f"{machine['kernel']}, Python {machine['python']}, Zenoh "
        f"{machine['versions']['eclipse-zenoh']}",
        f"{facts['date']}, seed {facts['seed']}, {options['repetitions']} x {options['ticks']} ticks, "
        f"SCHED_{options['sched'].upper()}, {pinned}",
        *(f"note: {note}" for note in facts["notes"]),
        "",
        *_aligned(SWEEP, [_sweep(row) for row in facts["rows"]]),
    ]
    if facts["rates"]:
        lines += ["", *_aligned(RATE, [row for rate in facts["rates"] for row in _rate(rate)])]
    if facts["targets"]:
        lines += ["", *_aligned(TARGET, [_target(t) for t in facts["targets"]])]
    if facts["compared_with"]:
        old = facts["compared_with"]
        lines += ["", f"new over old ({old['file']}, {old['date']}):"]
        lines += _aligned(RATIO, [_ratio(row) for row in facts["ratios"]])
    return "\n".join(lines) + "\n"


def _sweep(row: dict[str, Any]) -> list[str]:
    sweep, chain, memory = row["sweep_us"], row["chain_us"], row["memory_mb"]
    return [
        str(row["nodes"]),
        row["pattern"],
        _number(row["messages_per_tick"]["exchange"], 0),
        _number(row["bytes_per_tick"]["exchange"], 0),
        *(_number(sweep[name], 0) for name in ("p50", "p95", "p99", "p99_9", "max")),
        _number(chain and chain["p50"], 0),
        _number(row["cpu_us_per_tick"], 0),
        _number(memory and memory["pss_per_node"], 1),
        _number(memory and memory["pss_total"], 0),
        _number(row["start_s"], 2),
    ]


def _rate(rate: dict[str, Any]) -> list[list[str]]:
    out = []
    for trial in rate["trials"]:
        took = trial["finish_ms"]
        out.append(
            [
                str(rate["nodes"]),
                rate["pattern"],
                str(trial["hz"]),
                *(_number(took[name], 2) for name in ("p50", "p99", "p99_9")),
                str(trial["late"]),
                str(trial["ticks"]),
                "held" if trial["held"] else "not held",
            ]
        )
    found = "none" if rate["held_hz"] is None else str(rate["held_hz"])
    return [*out, [str(rate["nodes"]), rate["pattern"], found, "", "", "", "", "", "highest"]]


def _target(target: dict[str, Any]) -> list[str]:
    name = target["name"]
    sign = AT_MOST.get(name, "= " if name.startswith("messages") else ">= ")
    unit = target["unit"]
    return [
        name,
        str(target["nodes"]),
        f"{target['value']:.4g} {unit}".strip(),
        f"{sign}{target['limit']:g} {unit}".strip(),
        "met" if target["met"] else "missed",
    ]


def _ratio(row: dict[str, Any]) -> list[str]:
    values = [_number(row.get(key), 3) for key in RATIO_KEYS]
    return [str(row["nodes"]), row["pattern"], *values]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _aligned(head: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Words to the left, numbers to the right."""
    words = [place for place, name in enumerate(head) if name in ("pattern", "target", "")]
    return ruled(aligned(head, body, left=words))
