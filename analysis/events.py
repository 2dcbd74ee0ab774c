"""The run's story as typed rows, whatever the format version: from the table of /event to those who tell it.

In version 3 levels are words; since then they are foxglove.Log's numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

from analysis.table import Table
from wire.foxglove import LEVEL_NAMES

FIELDS = ("level", "name", "message")


@dataclass(frozen=True)
class Event:
    """One line of the story."""

    tick: int
    time_s: float
    level: str
    """One of wire.foxglove.LEVEL_NAMES."""
    name: str
    message: str


def read_events(table: Table | None) -> list[Event]:
    """The events of a recording in file order; none if it has no such channel or no message in it.

    Raises UsageError if a field is missing.
    """
    if table is None or not table.rows:
        return []
    columns = [table.column(name).tolist() for name in ("tick", "time_s", *FIELDS)]
    return [
        Event(int(tick), float(time_s), level_name(level), str(name), str(message))
        for tick, time_s, level, name, message in zip(*columns, strict=True)
    ]


def level_name(level: object) -> str:
    """The word for a level, which may be one already."""
    if isinstance(level, int) and 0 <= level < len(LEVEL_NAMES):
        return LEVEL_NAMES[level]
    return str(level)
