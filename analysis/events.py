"""The run's story as typed rows, whatever the format version: from the table of /event to those who tell it.

Up to now levels are words; foxglove.Log, which newer recordings use, counts them and adds fields of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

from analysis.table import Table

LEVELS = ("unknown", "debug", "info", "warning", "error", "fatal")
"""In the order of foxglove.Log's numbers."""
FIELDS = ("level", "name", "message")


@dataclass(frozen=True)
class Event:
    """One line of the story."""

    tick: int
    time_s: float
    level: str
    """One of `LEVELS`."""
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
        Event(int(tick), float(time_s), _word(level), str(name), str(message))
        for tick, time_s, level, name, message in zip(*columns, strict=True)
    ]


def _word(level: object) -> str:
    if isinstance(level, int) and 0 <= level < len(LEVELS):
        return LEVELS[level]
    return str(level)
