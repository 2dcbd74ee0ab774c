"""Are two recordings the same run, bit for bit, apart from the clock on the wall?

Two runs with the same gains, configuration and seed must be (docs/recording.md, "What repeats").
"""

from __future__ import annotations

import dataclasses

import numpy as np

from analysis.recording import Recording
from analysis.table import Column, Table

WALL = "_wall_ns"
"""End of the names of fields that differ from run to run."""
_OWN = {"run_id", "artefact_path", "segments_per_process", "pace"}
"""Parts of the configuration that name a run, or say how it was done, and nothing about its numbers."""


def first_difference(one: Recording, other: Recording) -> str | None:
    """What differs first in time (channel, tick, field, both values), None if nothing does.

    Compared are the configuration, the artefact's digest, and every field of every channel but
    wall-clock ones, bitwise and in the order of the file.
    """
    for field in dataclasses.fields(one.configuration):
        a, b = (getattr(r.configuration, field.name) for r in (one, other))
        if field.name not in _OWN and a != b:
            return f"configuration, {field.name}: {_short(a)} and {_short(b)}"
    places = []
    for number, topic in enumerate({**one.tables, **other.tables}):  # in the order of the file
        pair = one.tables.get(topic), other.tables.get(topic)
        if pair[0] is None or pair[1] is None:
            missing = "first" if pair[0] is None else "second"
            return f"{topic}: not in the {missing} recording"
        if found := _table_difference(pair[0], pair[1]):
            places.append((found[0], number, f"{topic}: {found[1]}"))
    return min(places)[2] if places else None


def _table_difference(one: Table, other: Table) -> tuple[int, str] | None:
    """The first row's tick and a description."""
    if one.columns.keys() != other.columns.keys():
        return 0, f"fields {', '.join(one.columns)} and {', '.join(other.columns)}"
    rows = min(one.rows, other.rows)
    places = []
    for number, (field, column) in enumerate(one.columns.items()):
        a, b = column[:rows], other.columns[field][:rows]
        if field.endswith(WALL):
            continue
        if a.dtype != b.dtype:
            return 0, f"{field}: {a.dtype} and {b.dtype}"
        wrong = np.flatnonzero(_bits(a) != _bits(b))
        if wrong.size:
            places.append((int(wrong[0]), number, field))
    if places:
        row, _, field = min(places)
        values = _short(one.columns[field][row]), _short(other.columns[field][row])
        tick = int(one.ticks[row])
        return tick, f"tick {tick}, {field}: {values[0]} and {values[1]}"
    if one.rows != other.rows:
        longer = one if one.rows > other.rows else other
        return int(longer.ticks[rows]), f"{one.rows} and {other.rows} messages"
    return None


def _bits(values: Column) -> Column:
    return values.view(np.int64) if values.dtype == np.float64 else values


def _short(value: object) -> str:
    value = value.item() if isinstance(value, np.generic) else value
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
