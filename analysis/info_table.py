"""What `octarm info` prints: the dictionary of `analysis.info` as text; nothing is computed here but units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from analysis.info_head import info_head
from analysis.info_text import WIDTH, joined, labelled, size_text, wrapped
from analysis.link_times import SHARES
from analysis.text_table import aligned, ruled
from wire.link_latency import CLOCKS, IN_MEMORY

MOST_EVENTS = 12
"""Shown without --all: the first and the last half of them."""
_KINDS = {
    "forward": "forward sums",
    "backward": "backward sums",
    "passed": "sums in memory",
    "measurement": "measurements",
    "command": "commands",
    "telemetry": "telemetry",
    "rejected": "rejected",
}
_LEFT_OUT = {
    IN_MEMORY: "links within a process",
    CLOCKS: "links between clocks that cannot be compared",
}


def info_table(facts: Mapping[str, Any], *, every: bool = False) -> str:
    """The facts of `analysis.info.info` as text; `every`: each topic, process, link and event on a line."""
    blocks = [
        info_head(facts),
        _channels(facts["channels" if every else "channel_groups"], every=every),
        _messages(facts),
        _latencies(facts, every=every),
        _processes(facts["processes"] or [], every=every),
        _events(facts["events"], every=every),
        [labelled("note", note) for note in facts["notes"]],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def _channels(channels: Sequence[Mapping[str, Any]], *, every: bool) -> list[str]:
    if not channels:
        return ["no channels: the file stops before the first message"]
    rows = []
    for one in channels:
        many = "" if every or one["channels"] == 1 else f" x {one['channels']}"
        rows.append(
            (
                one["topic"] + many,
                str(one["messages"]),
                _figure(one["messages_per_tick"]),
                _figure(one["hz"]),
                size_text(one["payload_bytes"]),
                _figure(one["payload_bytes"] / one["messages"] if one["messages"] else None),
                f"{one['share']:.1%}",
                joined(one["schema"], one["schema_encoding"], one["encoding"]),
            )
        )
    head = ("channel", "messages", "a tick", "Hz", "payload", "B each", "share", "schema")
    return _columns(head, rows, left=(0, 7))


def _messages(facts: Mapping[str, Any]) -> list[str]:
    messages = facts["messages"]
    if messages is None:
        return ["messages: unknown, the processes' final counters are not in the file"]
    rows = [
        (
            name,
            str(messages[kind]["messages"]),
            _figure(messages[kind]["per_tick"]),
            "" if messages[kind]["bytes"] is None else size_text(messages[kind]["bytes"]),
            _each(messages[kind]),
        )
        for kind, name in _KINDS.items()
    ]
    return _columns(("messages", "number", "a tick", "bytes", "B each"), rows)


def _latencies(facts: Mapping[str, Any], *, every: bool) -> list[str]:
    links = facts["links"]
    rows = [("sweep", facts["sweep_ms"])]
    if links is not None:
        rows += [(f"{way} link", links[f"{way}_ms"]) for way in ("forward", "backward")]
        if (worst := links["worst"]) is not None:
            rows.append((f"worst: {_arrow(worst)}", worst["latency_ms"]))
        if every:
            rows += [(_arrow(link), link["latency_ms"]) for link in links["links"]]
    body = [
        (name, *(_figure(values[share]) for share in SHARES)) for name, values in rows if values
    ]
    if not body:
        return ["latencies: none were recorded"]
    lines = _columns(("latency [ms]", *SHARES), body)
    if links is not None:
        for why, count in links["left_out"].items():
            lines.append(f"left out: {count} {_LEFT_OUT[why]}")
    return lines


def _processes(processes: Sequence[Mapping[str, Any]], *, every: bool) -> list[str]:
    if not processes:
        return []
    silent = [one["process"] for one in processes if not one["reported"]]
    nodes = [one for one in processes if one["segments"] is not None]
    shown = list(processes)
    if not every and all(one["reported"] for one in nodes) and len(nodes) > 1:
        shown = [_together(nodes), *(one for one in processes if one["segments"] is None)]
    elif not every:
        shown = [one for one in processes if one["reported"]]
    rows = [
        (
            one["process"],
            _segments(one["segments"]),
            *_amount(one, "received"),
            *_amount(one, "sent"),
            "-" if one["rejected_messages"] is None else str(one["rejected_messages"]),
        )
        for one in shown
    ]
    head = ("process", "segments", "received", "bytes", "sent", "bytes", "rejected")
    lines = _columns(head, rows) if rows else []
    said = "all reported at the end"
    if silent:
        whom = "any of them" if len(silent) == len(processes) else ", ".join(silent)
        said = f"no final counters of {whom}"
    return [*lines, wrapped(f"{len(processes)} processes under the launcher, {said}", "")]


def _together(nodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The node processes as one row."""
    out: dict[str, Any] = {
        name: sum(one[name] for one in nodes)
        for name in nodes[0]
        if name not in ("process", "segments", "reported")
    }
    out["process"] = f"{nodes[0]['process']} to {nodes[-1]['process']}"
    out["segments"] = [nodes[0]["segments"][0], nodes[-1]["segments"][1]]
    return out


def _amount(one: Mapping[str, Any], way: str) -> tuple[str, str]:
    if one[f"{way}_messages"] is None:
        return "-", "-"
    return str(one[f"{way}_messages"]), size_text(one[f"{way}_bytes"])


def _segments(segments: Sequence[int] | None) -> str:
    if segments is None:
        return ""
    first, last = segments
    return str(first) if first == last else f"{first} to {last}"


def _events(events: Sequence[Mapping[str, Any]], *, every: bool) -> list[str]:
    rows = [
        (
            "-" if e["tick"] is None else str(e["tick"]),
            "-" if e["time_s"] is None else f"{e['time_s']:g}",
            str(e["level"]),
            str(e["name"]),
            str(e["message"]),
        )
        for e in events
    ]
    if not rows:
        return []
    left_out = len(rows) - MOST_EVENTS
    if left_out > 0 and not every:
        half = MOST_EVENTS // 2
        rows[half:-half] = [("...", "", "", "", f"{left_out} more, --all shows them")]
    return _columns(("tick", "time [s]", "level", "event", "message"), rows, left=(2, 3, 4))


def _columns(
    head: Sequence[str], body: Iterable[Sequence[str]], left: Sequence[int] = (0,)
) -> list[str]:
    return ruled(aligned(head, body, left=left), WIDTH)


def _arrow(link: Mapping[str, Any]) -> str:
    return f"{link['way']} {link['from']} -> {link['to']}"


def _each(kind: Mapping[str, Any]) -> str:
    return _figure(kind["bytes"] / kind["messages"]) if kind["bytes"] and kind["messages"] else ""


def _figure(value: float | None) -> str:
    """Three digits, whole numbers as such."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 100.0 or value == round(value) else f"{value:.3g}"
