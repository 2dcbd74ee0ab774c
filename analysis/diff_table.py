"""The facts of `analysis.diff` as text: verdict, both runs, what differs, figures; nothing is computed here."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from analysis.compare import short
from analysis.text_table import aligned

MOST_ROWS = 12
"""So many keys of the configuration are shown unless all are asked for."""
_NUMBERS = re.compile(r"[-+.\de]+|-")


def diff_table(facts: dict[str, Any], *, everything: bool) -> str:
    """The facts as text; `everything` shows what is the same as well, field by field."""
    parts = [
        [facts["sentence"], *(_run(facts, side) for side in "ab")],
        _facts("configuration", facts["configuration"], everything),
        _facts("versions and machine", facts["about"], everything),
        _channels(facts, everything),
        _figures(facts["figures"]),
    ]
    return "\n\n".join("\n".join(part) for part in parts if part)


def _run(facts: dict[str, Any], side: str) -> str:
    run = facts[side]
    state = "complete" if run["complete"] else f"not complete: {run['stops'] or 'no counters'}"
    return (
        f"{side.upper()}: {run['recording']}, {run['nodes']} nodes, ticks 0 to {run['last_tick']} of "
        f"{run['tick_s']:g} s, seed {run['seed']}, gains {run['artefact_sha256'][:16]}, format "
        f"{run['format_version']}, {state}"
    )


def _facts(title: str, rows: Sequence[dict[str, Any]], everything: bool) -> list[str]:
    if not rows:
        return []
    shown = rows if everything else rows[:MOST_ROWS]
    notes = {True: "", False: "does not count"}
    lines = [
        [r["key"], short(r["a"]), short(r["b"]), "within" if r["within"] else notes[r["counts"]]]
        for r in shown
    ]
    out = _table([title, "A", "B", ""], lines)
    if len(rows) > len(shown):
        out.append(f"and {len(rows) - len(shown)} more (--all)")
    return out


def _channels(facts: dict[str, Any], everything: bool) -> list[str]:
    head = ["channel", "values", "different", "largest", "", "relative", "at", "first"]
    lines = []
    for kind in facts["channels"]:
        if everything:
            rows = [(f"{kind['kind']} {field['field']}", field) for field in kind["fields"]]
        elif kind["same"] and not kind["within_tolerance"]:
            continue
        else:
            rows = [(kind["kind"], kind)]
        lines += [_channel(name, row, facts["tolerance"]) for name, row in rows]
    out = _table(head, lines) if lines else []
    for kind in facts["channels"]:
        for side in "ab":
            if missing := kind[f"messages_missing_in_{side}"]:
                out.append(f"{kind['kind']}: {missing} messages missing in {side.upper()}")
            if fields := kind[f"fields_only_in_{side}"]:
                out.append(f"{kind['kind']}: only {side.upper()} has {', '.join(fields)}")
    for side in "ab":
        if topics := facts[f"channels_only_in_{side}"]:
            out.append(f"only {side.upper()} has {', '.join(topics)}")
    if facts["channels_not_compared"]:
        out.append(
            f"not compared, because the segments end at other places: "
            f"{', '.join(facts['channels_not_compared'])}"
        )
    same = [kind for kind in facts["channels"] if kind["same"] and not kind["within_tolerance"]]
    if same and not everything:
        values = sum(kind["values"] for kind in same)
        out.append(f"bit for bit the same: {values} values of {len(same)} kinds of channel (--all)")
    return out


def _channel(name: str, row: dict[str, Any], tolerance: float | None) -> list[str]:
    largest, first = row["largest"], row["first"]
    different = str(row["different"])
    if tolerance is not None and row["within_tolerance"]:
        different += f" (+{row['within_tolerance']} within)"
    out = [name, str(row["values"]), different]
    if largest is None:
        out += ["-", "", "-", ""]
    else:
        unit = row["unit"] if "unit" in row else _unit_of(largest, row)
        field = "" if "field" in row else f" {largest['field']}"
        out += [
            f"{largest['absolute']:.2e}",
            f"{unit}{field}".strip(),
            f"{largest['relative']:.1e}",
            _at(largest),
        ]
    if first is None:
        return [*out, ""]
    field = "" if "field" in row else f"{first['field']} "
    return [*out, f"{_at(first)}: {field}{short(first['a'])} | {short(first['b'])}"]


def _unit_of(place: dict[str, Any], kind: dict[str, Any]) -> str:
    return next(str(f["unit"]) for f in kind["fields"] if f["field"] == place["field"])


def _at(place: dict[str, Any]) -> str:
    node = "" if place["node"] is None else f", node {place['node']}"
    return f"tick {place['tick']}{node}"


def _figures(rows: Sequence[dict[str, Any]]) -> list[str]:
    lines = [
        [
            f"{r['figure']} [{r['unit']}]" if r["unit"] else r["figure"],
            _number(r["a"]),
            _number(r["b"]),
            "-" if r["ratio"] is None else f"{r['ratio']:.4g}",
        ]
        for r in rows
    ]
    return _table(["figure", "A", "B", "B / A"], lines)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.6g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Its lines; columns of numbers to the right."""
    words = [
        i for i in range(len(head)) if not (rows and all(_NUMBERS.fullmatch(r[i]) for r in rows))
    ]
    return aligned(head, rows, left=words)
