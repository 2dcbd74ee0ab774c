"""The run's story as typed rows, whatever the format version: from the table of /event to those who tell it.

In version 3 levels are words; since then they are foxglove.Log's numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from analysis.table import Table
from wire.errors import UsageError, shown
from wire.foxglove import LEVEL_NAMES

ENDINGS = ("finished", "interrupted", "safety_stop")
"""Names of the events that say how a run ended."""
FIELDS = ("level", "name", "message")
_KINDS: dict[str, tuple[type, ...]] = {"level": (str, int), "name": (str,), "message": (str,)}


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


def ending_among(names: Iterable[str]) -> str | None:
    """How a run ended, one of `ENDINGS`, from the names of its events in order; None if they do not say."""
    endings = [name for name in names if name in ENDINGS]
    return endings[-1] if endings else None


def check_events(table: Table | None) -> None:
    """UsageError, naming the channel, unless every event has a tick, a time, and texts that can be told."""
    if table is None or not table.rows:
        return
    for name in ("tick", "time_s", *FIELDS):
        table.column(name)
    table.numbers("time_s")
    for name, kinds in _KINDS.items():
        if wrong := [one for one in table.column(name).tolist() if not isinstance(one, kinds)]:
            raise UsageError(
                f"{table.file}channel {table.topic}, field {name!r}: expected text, got {shown(wrong[0])}"
            )


def level_name(level: object) -> str:
    """The word for a level, which may be one already."""
    if isinstance(level, int) and 0 <= level < len(LEVEL_NAMES):
        return LEVEL_NAMES[level]
    return str(level)
