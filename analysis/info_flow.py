"""Messages by kind and by process, from the counters that the processes reported at the end of a run.

Part of `analysis.info`; the recorder puts the counters into the metadata record `summary` (docs/recording.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from analysis.recorded_counters import counts_of, number_of
from wire.channels import label
from wire.errors import UsageError
from wire.run_config import RunConfig

KINDS = {
    "forward": "forward_received",
    "backward": "backward_received",
    "measurement": "measurement_received",
    "command": "command_sent",
    "telemetry": "telemetry_sent",
}
"""Kind of message and the nodes' counter of it: sums and measurements by receivers, the rest by senders."""
_RECEIVED = ("measurement_received", "forward_received", "backward_received")
_SENT = ("command_sent", "forward_sent", "backward_sent", "telemetry_sent")
_PLANT = (("command_received",), ("measurement_sent", "telemetry_sent"))
_RECORDER = (("telemetry_received",), ())


def counters_of(counters: Mapping[str, str], process: str, notes: list[str]) -> dict[str, int]:
    """What a process reported; empty if nothing, or nothing that can be read, which is added to the notes."""
    text = counters.get(process)
    if text is None:
        return {}
    try:
        return counts_of(text)
    except UsageError as error:
        notes.append(f"the counters of {process} cannot be read: {error}")
        return {}


def total_of(counters: Mapping[str, str] | None, name: str, notes: list[str]) -> int | None:
    """A total of the recorder; None without it, or if it cannot be read, which is added to the notes."""
    text = (counters or {}).get(name)
    if text is None:
        return None
    try:
        return number_of(text)
    except UsageError as error:
        notes.append(f"the counter {name} cannot be read: {error}")
        return None


def message_kinds(
    counters: Mapping[str, str] | None, run: RunConfig | None, notes: list[str]
) -> dict[str, Any] | None:
    """Per kind `messages`, `bytes`, `per_tick` (of the ticks that had a sweep); None without final counters.

    Telemetry has the plant's, too. `passed` are the sums between segments of one process, handed on in memory.
    """
    if counters is None or run is None:
        return None
    nodes = [counters_of(counters, f"node/{label(i, run.nodes)}", notes) for i in range(run.nodes)]
    plant = counters_of(counters, "plant", notes)
    ticks, late = (total_of(counters, name, notes) for name in ("ticks_recorded", "late_ticks"))
    sweeps = (ticks or 0) - (late or 0)
    out: dict[str, Any] = {}
    for kind, name in KINDS.items():
        rows = [*nodes, plant] if kind == "telemetry" else nodes
        messages = sum(row.get(f"{name}_messages", 0) for row in rows)
        size = sum(row.get(f"{name}_bytes", 0) for row in rows)
        out[kind] = _kind(messages, size, sweeps)
    out["passed"] = _kind(sum(row.get("passed_messages", 0) for row in nodes), None, sweeps)
    out["rejected"] = _kind(
        sum(row.get("rejected_messages", 0) for row in [*nodes, plant]), None, sweeps
    )
    return out


def process_rows(
    counters: Mapping[str, str] | None, run: RunConfig, notes: list[str]
) -> list[dict[str, Any]]:
    """A row for every process but the launcher: its segments, what it received, sent and refused.

    `reported` is False, and the figures None, for a process whose final counters are not there.
    """
    ends = [*run.firsts[1:], run.nodes]
    rows = []
    known = counters or {}
    for first, end in zip(run.firsts, ends, strict=True):
        own = [counters_of(known, f"node/{label(i, run.nodes)}", notes) for i in range(first, end)]
        rows.append(
            _process(f"node/{label(first, run.nodes)}", [first, end - 1], own, _RECEIVED, _SENT)
        )
    rows.append(_process("plant", None, [counters_of(known, "plant", notes)], *_PLANT))
    rows.append(_process("recorder", None, [counters_of(known, "recorder", notes)], *_RECORDER))
    return rows


def _process(
    name: str,
    segments: list[int] | None,
    counted: Sequence[Mapping[str, int]],
    received: Sequence[str],
    sent: Sequence[str],
) -> dict[str, Any]:
    reported = all(counted)

    def total(names: Sequence[str], what: str) -> int | None:
        if not reported:
            return None
        return sum(one.get(f"{n}_{what}", 0) for one in counted for n in names)

    return {
        "process": name,
        "segments": segments,
        "reported": reported,
        "received_messages": total(received, "messages"),
        "received_bytes": total(received, "bytes"),
        "sent_messages": total(sent, "messages"),
        "sent_bytes": total(sent, "bytes"),
        "rejected_messages": total(("rejected",), "messages"),
    }


def _kind(messages: int, size: int | None, sweeps: int) -> dict[str, Any]:
    return {
        "messages": messages,
        "bytes": size,
        "per_tick": messages / sweeps if sweeps > 0 else None,
    }
