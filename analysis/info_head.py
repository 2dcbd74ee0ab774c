"""The lines at the head of `octarm info`: what file and run it is, whether it is whole, what was lost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from analysis.info_text import joined, labelled, size_text

_RECORDS = {
    "chunks": "chunks",
    "message_index": "message index",
    "attachments": "attachments",
    "metadata": "metadata",
    "summary": "index at the end",
    "other": "other",
}


def info_head(facts: Mapping[str, Any]) -> list[str]:
    """Lines from the facts of `analysis.info.info`; what a file cut short does not tell is left out."""
    file, run = facts["file"], facts["run"]
    version = facts["format_version"]
    rows = [
        (
            "recording",
            f"{facts['recording']}, format {version or 'unknown'}, {size_text(file['bytes'])}",
        ),
        ("state", _state(facts)),
        (
            "run",
            joined(run["run_id"], _told("scenario ", run["scenario"]), _nodes(run), _plant(run)),
        ),
        (
            "",
            joined(
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
        (
            "attached",
            ", ".join(f"{a['name']} {size_text(a['bytes'])}" for a in facts["attachments"]),
        ),
        ("losses", _losses(facts)),
        ("health", _health(facts["health"])),
    ]
    return [labelled(label, text) for label, text in rows if text]


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
    if duration["wall_s"] and duration["ticks_per_s"] is not None:
        out += (
            f"; {duration['wall_s']:.3g} s on the wall clock, {duration['ticks_per_s']:.0f} ticks/s"
        )
    return out


def _sizes(size: Mapping[str, Any]) -> list[tuple[str, str]]:
    kinds = [
        f"{name} {size_text(size['by_record'][kind])}"
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
        lines = (
            f"{size_text(size['json_lines_bytes'])}, {size['json_lines_ratio']:.2f} times this file"
        )
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


def _health(health: Mapping[str, Any] | None) -> str:
    """Alive, on time and valid, which are three things, and what came of it where they were not."""
    if health is None:
        return ""
    counts = [
        f"{words} {health[kind]}"
        for kind, words in (("alive", "alive"), ("on_time", "on time"), ("valid", "valid"))
    ]
    parts = [f"{', '.join(counts)} of {health['node_ticks']} node ticks"]
    if health["bridged_sums"] or health["commands_held"]:
        parts.append(
            f"{health['bridged_sums']} sums bridged, {health['commands_held']} commands held"
        )
    if health["replaced"]:
        who = [
            f"node {node}" + (f" ({times} times)" if times > 1 else "")
            for node, times in health["replaced"].items()
        ]
        parts.append(f"replaced: {', '.join(who)}")
    if health["passive_from_tick"] is not None:
        parts.append(f"passive from tick {health['passive_from_tick']} on")
    return "; ".join(parts)


def _hosts(hosts: Any) -> str:
    if not isinstance(hosts, list):
        return hosts or ""
    return ", ".join(
        f"{h.get('name')} {h.get('nodes')} nodes{' (own clock)' if h.get('own_clock') else ''}"
        for h in hosts
        if isinstance(h, dict)
    )


def _plant(run: dict[str, Any]) -> str | None:
    model = run["plant_model"]
    return None if model in {None, "exact"} else f"plant model {model}"


def _told(what: str, value: Any) -> str | None:
    return None if value is None else f"{what}{value}"


def _pairs(value: Any) -> str:
    """Facts of one kind on one line: {"numpy": "2.4.6"} is "numpy 2.4.6"."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {inner}" for name, inner in value.items())
    return "" if value is None else str(value)


def _plural(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"
