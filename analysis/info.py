"""What a recording is, in one dictionary: `octarm info --json`. `analysis.info_table` makes text of it.

Last step of the analysis, beside `analysis.summary`: that one says how well the arm did, this one what the file
holds, whole or cut short. Of the payloads only timing, pace, health, flags and events are decoded.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from analysis.events import ending_among, level_name
from analysis.facts import fact
from analysis.info_flow import message_kinds, process_rows, total_of
from analysis.info_health import health_facts
from analysis.link_times import link_facts, percentiles_ms
from analysis.survey import RECOVERED, Survey, configuration_of, survey, ticks_of
from analysis.table import LAST_TICK, Table, check_ticks, decode_table
from wire.channels import METADATA, PACE, SUMMARY, SWEEP_TIMING
from wire.config_json import finite
from wire.errors import UsageError, shown
from wire.foxglove import EVENTS
from wire.link_latency import Array
from wire.run_config import RunConfig

_NUMBERS = re.compile(r"/\d+(?=/|$)")


def info(path: Path) -> dict[str, Any]:
    """What is in the recording: run, file, channels, messages, latencies, processes, events.

    `whole` is False if anything of the run is missing: the file was cut or damaged, or has no final counters. A
    figure that cannot be had is None. Raises UsageError as `analysis.survey.survey` does.
    """
    found = survey(path, _wanted)
    notes: list[str] = []
    run = configuration_of(found, notes)
    tables = {
        topic: table
        for topic, count in found.channels.items()
        if count.payloads
        and topic != EVENTS.topic
        and (table := _table(topic, count.payloads, notes))
    }
    try:
        check_ticks(tables.values())
    except UsageError as error:
        notes.append(str(error))
        tables = {}
    counters = found.metadata.get(SUMMARY)
    ticks = None if run is None else ticks_of(found, run)
    channels = _channels(found, run, ticks)
    events = _events(found, run, notes)
    facts = {
        "recording": str(path),
        "format_version": found.metadata.get(METADATA, {}).get("format_version"),
        "whole": found.closed and counters is not None and _nothing_left_out(found),
        "file": _file(found),
        "run": _run(found, run),
        "duration": _duration(run, ticks, tables.get("/sweep/timing")),
        "size": _size(found, ticks),
        "channels": channels,
        "channel_groups": channel_groups(channels),
        "ended": ending_among(event["name"] for event in events),
        "messages": message_kinds(counters, run, notes),
        "sweep_ms": _sweep(tables.get("/sweep/timing")),
        "links": None if run is None else link_facts(tables, run, found.metadata[METADATA], notes),
        "losses": _losses(counters, tables.get("/plant/pace"), notes),
        "health": None if run is None else health_facts(tables, run.nodes),
        "processes": None if run is None else process_rows(counters, run, notes),
        "events": events,
        "attachments": [dataclasses.asdict(one) for one in found.attachments],
        "notes": list(dict.fromkeys(notes)),
    }
    return {key: finite(value) for key, value in facts.items()}


def channel_groups(channels: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The channels with node numbers put together, in the order of the file, as /node/NN/estimate.

    `channels` says how many they are, `hz` is the rate of one, the other figures are sums.
    """
    groups: dict[str, dict[str, Any]] = {}
    for one in channels:
        topic = _NUMBERS.sub("/NN", one["topic"])
        group = groups.setdefault(
            topic,
            {
                "topic": topic,
                "channels": 0,
                "messages": 0,
                "messages_per_tick": None,
                "hz": None,
                "payload_bytes": 0,
                "share": 0.0,
                "schema": one["schema"],
                "schema_encoding": one["schema_encoding"],
                "encoding": one["encoding"],
            },
        )
        group["channels"] += 1
        for name in ("messages", "messages_per_tick", "hz", "payload_bytes", "share"):
            if one[name] is not None:
                group[name] = (group[name] or 0) + one[name]
    for group in groups.values():
        if group["hz"] is not None:
            group["hz"] /= group["channels"]
    return list(groups.values())


def _wanted(topic: str) -> bool:
    judged = ("/plant/pace", "/plant/health", "/plant/guard")
    return topic in (EVENTS.topic, *judged) or topic.endswith(("/timing", "/degraded"))


def _table(topic: str, payloads: list[bytes], notes: list[str]) -> Table | None:
    try:
        table = decode_table(topic, payloads)
        _ = table.ticks
    except UsageError as error:
        notes.append(str(error))
        return None
    return table


def _nothing_left_out(found: Survey) -> bool:
    """Whether the file is no copy of a damaged one that had lost something or was altered."""
    said = found.metadata.get(RECOVERED, {})
    return not said.get("doubt") and all(
        said.get(f"left_out_{what}", "0") == "0" for what in ("bytes", "messages")
    )


def _file(found: Survey) -> dict[str, Any]:
    return {
        "bytes": found.bytes,
        "closed": found.closed,
        "stops": found.stops,
        "stopped_at": None if found.unfinished is None else found.stopped_at,
        "lost_bytes": found.lost_bytes,
        "lost_messages": found.lost_messages,
        "damages": [
            {"offset": d.offset, "bytes": d.size, "what": d.what, "messages": d.messages}
            for d in found.damages
        ],
        "has_summary": SUMMARY in found.metadata,
        "recovered": found.metadata.get(RECOVERED),
    }


def _run(found: Survey, run: RunConfig | None) -> dict[str, Any]:
    """What the metadata say of the run; JSON in them as values."""
    facts = found.metadata.get(METADATA, {})
    out: dict[str, Any] = {
        "run_id": facts.get("run_id"),
        "scenario": run and run.scenario,
        "plant_model": run and run.plant_model,
        "seed": run and run.seed,
        "nodes": run and run.nodes,
        "node_processes": run and len(run.firsts),
        "realtime": run and run.pace is not None,
        "started_at": facts.get("started_at"),
        "artefact_sha256": facts.get("artefact_sha256"),
        "git_revision": facts.get("git_revision"),
    }
    for name in ("versions", "machine", "hosts"):
        out[name] = fact(facts.get(name))
    return out


def _duration(run: RunConfig | None, ticks: int | None, sweep: Table | None) -> dict[str, Any]:
    wall_s = None
    if sweep is not None:
        with_times = _columns(sweep, ("started_wall_ns", "duration_wall_ns"))
        if with_times is not None:
            started, duration = with_times
            there = np.isfinite(started) & np.isfinite(duration)
            if there.any():
                wall_s = 1e-9 * float((started + duration)[there].max() - started[there].min())
    return {
        "ticks": ticks,
        "ticks_asked_for": run and run.ticks,
        "tick_s": run and run.tick_s,
        "arm_s": None if run is None or ticks is None else ticks * run.tick_s,
        "wall_s": wall_s,
        "ticks_per_s": sweep.rows / wall_s if sweep is not None and wall_s else None,
    }


def _columns(table: Table, fields: Iterable[str]) -> list[Array] | None:
    """The fields as numbers; None if one is not there, or none."""
    try:
        return [table.numbers(field) for field in fields]
    except UsageError:
        return None


def _size(found: Survey, ticks: int | None) -> dict[str, Any]:
    lines = sum(one.json_lines_bytes for one in found.channels.values())
    chunks = found.record_bytes["chunks"]
    return {
        "bytes": found.bytes,
        "by_record": {kind: size for kind, size in found.record_bytes.items() if size},
        "chunks": found.chunks,
        "compressions": {name or "none": count for name, count in found.compressions.items()},
        "compressed_bytes": found.compressed_bytes,
        "unpacked_bytes": found.unpacked_bytes,
        "compression_ratio": _ratio(found.unpacked_bytes, found.compressed_bytes),
        "bytes_per_tick": {"chunks": _ratio(chunks, ticks), "file": _ratio(found.bytes, ticks)},
        "payload_bytes": sum(one.payload_bytes for one in found.channels.values()),
        "json_lines_bytes": lines,
        "json_lines_ratio": _ratio(lines, found.bytes),
    }


def _ratio(value: float, by: float | None) -> float | None:
    return value / by if by else None


def _channels(found: Survey, run: RunConfig | None, ticks: int | None) -> list[dict[str, Any]]:
    payload = sum(one.payload_bytes for one in found.channels.values())
    seconds = ticks * run.tick_s if run is not None and ticks else None
    return [
        {
            "number": one.number,
            "topic": one.topic,
            "messages": one.messages,
            "messages_per_tick": _ratio(one.messages, ticks),
            "hz": _ratio(one.messages, seconds),
            "payload_bytes": one.payload_bytes,
            "share": one.payload_bytes / payload if payload else 0.0,
            "schema": one.schema,
            "schema_encoding": one.schema_encoding,
            "encoding": one.message_encoding,
        }
        for one in found.channels.values()
    ]


def _sweep(table: Table | None) -> dict[str, float] | None:
    """Percentiles in ms of the time from the first measurement sent to the last command received."""
    columns = None if table is None else _columns(table, (SWEEP_TIMING[2],))
    return None if columns is None else percentiles_ms(columns[0][columns[0] > 0.0])


def _losses(
    counters: Mapping[str, str] | None, pace: Table | None, notes: list[str]
) -> dict[str, int | None]:
    """Late ticks as the plant has marked them, rows that did not reach the recorder by its own count."""
    late = None if pace is None else _columns(pace, PACE)
    return {
        "late_ticks": None if late is None else int(np.count_nonzero(late[0] > 0.0)),
        "rows_lost": total_of(counters, "ticks_lost", notes),
    }


def _events(found: Survey, run: RunConfig | None, notes: list[str]) -> list[dict[str, Any]]:
    count = found.channels.get(EVENTS.topic)
    out = []
    for payload in (count and count.payloads) or []:
        try:
            event = msgspec.json.decode(payload, type=dict[str, Any])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            notes.append(f"an event cannot be read: {error}")
            continue
        level = event.get("level")
        tick = event.get("tick")
        if tick is not None and not (type(tick) is int and 0 <= tick <= LAST_TICK):
            notes.append(f"an event has the tick {shown(tick)}, which no run has")
            tick = None
        out.append(
            {
                "tick": tick,
                "time_s": tick * run.tick_s if run and tick is not None else None,
                "level": level_name(level) if isinstance(level, int) else _text(level),
                "name": _text(event.get("name")),
                "message": _text(event.get("message")),
            }
        )
    return out


def _text(value: object) -> str | None:
    """A text of an event; anything else that stands there in short."""
    return value if value is None or isinstance(value, str) else shown(value)
