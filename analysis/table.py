"""One channel of a recording as columns: JSON payloads in, numpy arrays out.

Between `analysis.mcap_file`, which splits the file, and `analysis.recording`, which knows the
channels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from wire.errors import UsageError
from wire.run_config import MOST_TICKS

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Column = npt.NDArray[Any]

LAST_TICK = MOST_TICKS + 1000
"""That a message may have: an arm that went safe is watched for some ticks more."""
SPARSE = 1000
"""Of so many ticks at least one is there: a late one has nothing of the nodes, but its row of the plant."""

_decode_rows = msgspec.json.Decoder(list[dict[str, Any]]).decode


@dataclass(frozen=True)
class Table:
    """The messages of one topic, in file order."""

    topic: str
    columns: Mapping[str, Column]
    """Per field an array of shape (messages,): int64 where all are integers, float64 where all are
    numbers (null becomes NaN), objects otherwise."""
    file: str = ""
    """Begins every refusal: "recording PATH: ", or nothing where the reader says it."""

    @property
    def rows(self) -> int:
        """Number of messages."""
        return next((column.size for column in self.columns.values()), 0)

    @property
    def ticks(self) -> Ints:
        """The tick of each message, shape (messages,); UsageError for one that no run has."""
        if not self.rows:
            return _NO_TICKS
        ticks = self.column("tick")
        if ticks.dtype == object and all(type(one) is int for one in ticks):
            ticks = _as_column(ticks.tolist())
        if ticks.dtype != np.int64 or not 0 <= ticks.min() <= ticks.max() <= LAST_TICK:
            raise UsageError(
                f"{self.file}channel {self.topic}, field 'tick': expected whole numbers 0..{LAST_TICK} in all "
                "messages"
            )
        return ticks

    def column(self, field: str) -> Column:
        """The field's values; UsageError naming topic and field if the messages do not have it."""
        try:
            return self.columns[field]
        except KeyError:
            raise UsageError(
                f"{self.file}channel {self.topic} has no field {field!r}; it has: "
                f"{', '.join(self.columns) or 'no messages'}"
            ) from None

    def numbers(self, field: str) -> Array:
        """The field's values as float64; UsageError if they are not numbers."""
        values = self.column(field)
        if values.dtype == object:
            raise UsageError(f"{self.file}channel {self.topic}, field {field!r}: not numbers")
        return values.astype(np.float64, copy=False)

    def by_tick(self, fields: Sequence[str], ticks: int) -> Array:
        """Values of the fields at ticks 0 .. ticks - 1, shape (ticks, fields); NaN where missing.

        Of two messages for one tick the later in the file counts.
        """
        out = np.full((ticks, len(fields)), np.nan)
        if self.rows:
            at = self.ticks
            inside = (at >= 0) & (at < ticks)
            for column, field in enumerate(fields):
                out[at[inside], column] = self.numbers(field)[inside]
        return out


def check_numbers(tables: Iterable[Table]) -> None:
    """UsageError for a field that is not a number in all messages of a channel."""
    for table in tables:
        for name in table.columns:
            table.numbers(name)


def whole_numbers(values: Array, otherwise: float) -> Ints:
    """The values without their fractions; `otherwise` where there is none, or one beyond all whole doubles."""
    there = np.abs(values) <= _LARGEST_WHOLE  # False for NaN
    return np.where(there, values, otherwise).astype(np.int64)


def check_ticks(tables: Iterable[Table]) -> None:
    """UsageError for a tick that no run has, or so far beyond the rows that are there that arrays up to it have
    no place in memory: one wrong message is enough."""
    ticked = [table for table in tables if "tick" in table.columns]
    rows = max((table.rows for table in ticked), default=0)
    for table in ticked:
        if (last := int(table.ticks.max())) > SPARSE * (rows + 1):
            raise UsageError(
                f"{table.file}channel {table.topic}, field 'tick': its last one is {last}, but no channel has "
                f"more than {rows} messages; it was edited"
            )


_LARGEST_WHOLE = 2.0**53
_NO_TICKS: Ints = np.zeros(0, dtype=np.int64)


def decode_table(topic: str, payloads: Sequence[bytes], file: str = "") -> Table:
    """Decode the JSON payloads of one topic; `file` begins every refusal, also later ones of the table.

    Raises UsageError naming topic and message number where a payload is not a flat JSON object or
    has other fields than the first.
    """
    if not payloads:
        return Table(topic, {}, file)
    try:
        rows = _decode_rows(b"[" + b",".join(payloads) + b"]")
        sound = len(rows) == len(payloads)  # else one is empty, or has a comma of its own
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        sound = False
    if not sound:
        rows = _decode_one_by_one(topic, payloads, file)
    names = rows[0].keys()
    for number, row in enumerate(rows):
        if row.keys() != names:
            raise UsageError(
                f"{file}channel {topic}, message {number}: expected the fields "
                f"{', '.join(names)}, got {', '.join(row)}"
            )
    return Table(topic, {name: _as_column([row[name] for row in rows]) for name in names}, file)


def _decode_one_by_one(topic: str, payloads: Sequence[bytes], file: str) -> list[dict[str, Any]]:
    """Find the payload that is at fault and name it."""
    rows = []
    for number, payload in enumerate(payloads):
        try:
            rows.append(msgspec.json.decode(payload, type=dict[str, Any]))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise UsageError(
                f"{file}channel {topic}, message {number}: expected a JSON object, got "
                f"{payload[:40]!r} ({error})"
            ) from None
    return rows


def _as_column(values: list[Any]) -> Column:
    kinds = set(map(type, values))
    with suppress(OverflowError):  # whole numbers of more than 64 bits, or beyond all doubles
        if kinds == {int}:
            return np.array(values, dtype=np.int64)
        if kinds <= {int, float, type(None)}:
            return np.array([np.nan if v is None else v for v in values], dtype=np.float64)
    return np.fromiter(values, dtype=object, count=len(values))  # lists among them stay lists
