"""One channel of a recording as columns: JSON payloads in, numpy arrays out.

Between `analysis.mcap_file`, which splits the file, and `analysis.recording`, which knows the
channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from wire.errors import UsageError

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Column = npt.NDArray[Any]

_decode_rows = msgspec.json.Decoder(list[dict[str, Any]]).decode


@dataclass(frozen=True)
class Table:
    """The messages of one topic, in file order."""

    topic: str
    columns: Mapping[str, Column]
    """Per field an array of shape (messages,): int64 where all are integers, float64 where all are
    numbers (null becomes NaN), objects otherwise."""

    @property
    def rows(self) -> int:
        """Number of messages."""
        return next((column.size for column in self.columns.values()), 0)

    @property
    def ticks(self) -> Ints:
        """The tick of each message, shape (messages,)."""
        return self.column("tick").astype(np.int64, copy=False) if self.columns else _NO_TICKS

    def column(self, field: str) -> Column:
        """The field's values; UsageError naming topic and field if the messages do not have it."""
        try:
            return self.columns[field]
        except KeyError:
            raise UsageError(
                f"channel {self.topic} has no field {field!r}; it has: "
                f"{', '.join(self.columns) or 'no messages'}"
            ) from None

    def numbers(self, field: str) -> Array:
        """The field's values as float64; UsageError if they are not numbers."""
        values = self.column(field)
        if values.dtype == object:
            raise UsageError(f"channel {self.topic}, field {field!r}: not numbers")
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


_NO_TICKS: Ints = np.zeros(0, dtype=np.int64)


def decode_table(topic: str, payloads: Sequence[bytes]) -> Table:
    """Decode the JSON payloads of one topic.

    Raises UsageError naming topic and message number where a payload is not a flat JSON object or
    has other fields than the first.
    """
    if not payloads:
        return Table(topic, {})
    try:
        rows = _decode_rows(b"[" + b",".join(payloads) + b"]")
    except (msgspec.DecodeError, UnicodeDecodeError):
        rows = _decode_one_by_one(topic, payloads)
    names = rows[0].keys()
    for number, row in enumerate(rows):
        if row.keys() != names:
            raise UsageError(
                f"channel {topic}, message {number}: expected the fields "
                f"{', '.join(names)}, got {', '.join(row)}"
            )
    return Table(topic, {name: _as_column([row[name] for row in rows]) for name in names})


def _decode_one_by_one(topic: str, payloads: Sequence[bytes]) -> list[dict[str, Any]]:
    """Find the payload that is at fault and name it."""
    rows = []
    for number, payload in enumerate(payloads):
        try:
            rows.append(msgspec.json.decode(payload, type=dict[str, Any]))
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise UsageError(
                f"channel {topic}, message {number}: expected a JSON object, got "
                f"{payload[:40]!r} ({error})"
            ) from None
    return rows


def _as_column(values: list[Any]) -> Column:
    kinds = set(map(type, values))
    if kinds == {int}:
        return np.array(values, dtype=np.int64)
    if kinds <= {int, float, type(None)}:
        return np.array([np.nan if v is None else v for v in values], dtype=np.float64)
    return np.fromiter(values, dtype=object, count=len(values))  # lists among them stay lists
