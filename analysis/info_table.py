"""What `octarm info` prints: the dictionary of `analysis.info` as text; nothing is computed here but units."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from analysis.link_times import SHARES
from wire.link_latency import CLOCKS, IN_MEMORY

WIDTH = 118
MOST_EVENTS = 12
"""Shown without --all: the first and the last half of them."""
_LABEL = 12
_KINDS = {
    "forward": "forward sums",
    "backward": "backward sums",
    "passed": "sums in memory",
    "measurement": "measurements",
    "command": "commands",
    "telemetry": "telemetry",
    "rejected": "rejected",
}
_RECORDS = {
    "chunks": "chunks",
    "message_index": "message index",
    "attachments": "attachments",
    "metadata": "metadata",
    "summary": "index at the end",
    "other": "other",
}
_LEFT_OUT = {
    IN_MEMORY: "links within a process",
    CLOCKS: "links between clocks that cannot be compared",
}


def info_table(facts: Mapping[str, Any], *, every: bool = False) -> str:
    """The facts of `analysis.info.info` as text; `every`: each topic, process, link and event on a line."""
    blocks = [
        _head(facts),
        _channels(facts["channels" if every else "channel_groups"], every=every),
        _messages(facts),
        _latencies(facts, every=every),
        _processes(facts["processes"] or [], every=every),
        _events(facts["events"], every=every),
        [_row("note", note) for note in facts["notes"]],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def _head(facts: Mapping[str, Any]) -> list[str]:
    file, run = facts["file"], facts["run"]
    version = facts["format_version"]
    rows = [
        (
            "recording",
            f"{facts['recording']}, format {version or 'unknown'}, {_size(file['bytes'])}",
        ),
        ("state", _state(facts)),
        ("run", _joined(run["run_id"], _told("scenario ", run["scenario"]), _nodes(run))),
        (
            "",
            _joined(
                _told("seed ", run["seed"]),
                _told("started ", run["started_at"]),
                _told("ended: ", facts["ended"]),
                _told("gains ", run["artefact_sha256"] and run["artefact_sha256"][:16]),
                _told("commit ", run["git_revision"]),
            ),
        ),
        ("versions", _pairs(run["versions"])),
        ("machine", _pairs(run["machine"])),
        ("hosts", _hosts(run["hosts"])),
        ("duration", _duration(facts["duration"])),
        *_sizes(facts["size"]),
        ("attached", ", ".join(f"{a['name']} {_size(a['bytes'])}" for a in facts["attachments"])),
        ("losses", _losses(facts)),
    ]
    return [_row(label, text) for label, text in rows if text]


def _state(facts: Mapping[str, Any]) -> str:
    """Whether the file is whole; if not, where it stops and what to do."""
    file = facts["file"]
    if not file["closed"]:
        lost = f" ({file['lost_messages']} messages)" if file["lost_messages"] else ""
        if file["lost_bytes"]:
            lost = f"; {file['lost_bytes']} of {file['bytes']} bytes cannot be read{lost}"
        return (
            f"NOT WHOLE: it {file['stops']}{lost}; `octarm recover` makes a file of what is there"
        )
    if file["recovered"] is not None:
        said = file["recovered"]
        origin = f"recovered from {said.get('from', '?')}, which {said.get('stops', '?')}"
        if facts["whole"]:
            return f"whole: {origin}; nothing is missing"
        no_end = "" if file["has_summary"] else "; without the run's final counters"
        return f"NOT WHOLE: {origin}{no_end}; this file is closed properly"
    if not file["has_summary"]:
        return "NOT WHOLE: closed properly, but without the run's final counters"
    return "whole: closed properly, checksums fit"


def _nodes(run: Mapping[str, Any]) -> str | None:
    if run["nodes"] is None:
        return None
    pace = "in real time" if run["realtime"] else "in lock-step"
    return (
        f"{run['nodes']} nodes in {_plural(run['node_processes'], 'process', 'processes')}, {pace}"
    )


def _duration(duration: Mapping[str, Any]) -> str:
    if duration["ticks"] is None:
        return "unknown without the run's configuration"
    asked = duration["ticks_asked_for"]
    short = "" if asked == duration["ticks"] else f" of {asked}"
    ticks = f"{duration['ticks']}{short} ticks of {duration['tick_s']:g} s"
    out = f"{duration['arm_s']:.6g} s of the arm's time, {ticks}"
    if duration["wall_s"]:
        out += (
            f"; {duration['wall_s']:.3g} s on the wall clock, {duration['ticks_per_s']:.0f} ticks/s"
        )
    return out


def _sizes(size: Mapping[str, Any]) -> list[tuple[str, str]]:
    kinds = [
        f"{name} {_size(size['by_record'][kind])}"
        for kind, name in _RECORDS.items()
        if size["by_record"].get(kind, 0) > 0
    ]
    how = " and ".join(size["compressions"])
    ratio = f", {how} {size['compression_ratio']:.2f} : 1" if size["compression_ratio"] else ""
    out = [("file", ", ".join(kinds) + f"; {_plural(size['chunks'], 'chunk', 'chunks')}{ratio}")]
    tick = size["bytes_per_tick"]
    if tick["file"]:
        out.append(
            ("a tick", f"{tick['chunks']:.0f} B in chunks, {tick['file']:.0f} B with everything")
        )
    if size["json_lines_bytes"]:
        lines = f"{_size(size['json_lines_bytes'])}, {size['json_lines_ratio']:.2f} times this file"
        out.append(("as JSON", f"lines of text with the same messages: {lines}"))
    return out


def _losses(facts: Mapping[str, Any]) -> str:
    losses, messages = facts["losses"], facts["messages"]
    rejected = messages["rejected"]["messages"] if messages else None
    figures = (
        ("late ticks", losses["late_ticks"]),
        ("rows lost on the way to the recorder", losses["rows_lost"]),
        ("messages rejected", rejected),
    )
    return ", ".join(f"{name} {'unknown' if v is None else v}" for name, v in figures)


def _hosts(hosts: Any) -> str:
    if not isinstance(hosts, list):
        return hosts or ""
    return ", ".join(
        f"{h.get('name')} {h.get('nodes')} nodes{' (own clock)' if h.get('own_clock') else ''}"
        for h in hosts
        if isinstance(h, dict)
    )


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
                _size(one["payload_bytes"]),
                _figure(one["payload_bytes"] / one["messages"] if one["messages"] else None),
                f"{one['share']:.1%}",
                _joined(one["schema"], one["schema_encoding"], one["encoding"]),
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
            "" if messages[kind]["bytes"] is None else _size(messages[kind]["bytes"]),
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
    return [*lines, _fold(f"{len(processes)} processes under the launcher, {said}", "")]


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
    return str(one[f"{way}_messages"]), _size(one[f"{way}_bytes"])


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


# -- text ---------------------------------------------------------------------------------------------


def _columns(
    head: Sequence[str], body: Iterable[Sequence[str]], left: Sequence[int] = (0,)
) -> list[str]:
    """A table: the columns in `left` begin together, the others end together."""
    rows = [head, *body]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    lines = [
        "  ".join(
            text.ljust(width) if i in left else text.rjust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    return [lines[0], "─" * min(WIDTH, max(map(len, lines))), *lines[1:]]


def _row(label: str, text: str) -> str:
    return _fold(text, label.ljust(_LABEL))


def _fold(text: str, label: str) -> str:
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_long_words=False,
        break_on_hyphens=False,
    )


def _joined(*parts: str | None) -> str:
    return ", ".join(part for part in parts if part)


def _told(what: str, value: Any) -> str | None:
    return None if value is None else f"{what}{value}"


def _pairs(value: Any) -> str:
    """Facts of one kind on one line: {"numpy": "2.4.6"} is "numpy 2.4.6"."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {inner}" for name, inner in value.items())
    return "" if value is None else str(value)


def _arrow(link: Mapping[str, Any]) -> str:
    return f"{link['way']} {link['from']} -> {link['to']}"


def _each(kind: Mapping[str, Any]) -> str:
    return _figure(kind["bytes"] / kind["messages"]) if kind["bytes"] and kind["messages"] else ""


def _figure(value: float | None) -> str:
    """Three digits, whole numbers as such."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 100.0 or value == round(value) else f"{value:.3g}"


def _size(value: int) -> str:
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if value >= limit:
            return (
                f"{value / limit:.3g} {unit}"
                if value < 1000 * limit
                else f"{value / limit:.0f} {unit}"
            )
    return f"{value} B"


def _plural(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"
