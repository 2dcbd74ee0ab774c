"""The values of one kind of channel in two recordings: how many differ, where first, and how far apart.

Between `analysis.alignment`, which pairs the messages, and `analysis.compare`, which goes over all kinds.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.alignment import Pairs
from analysis.table import Table
from wire.columns import unit

WALL = "_wall_ns"
"""End of the names of fields that differ from run to run."""
_LABEL = re.compile(r"/(\d+)(?=/|$)")


@dataclass(frozen=True)
class Place:
    """One value that differs: where, and what both have there."""

    topic: str
    node: int | None
    """None for a channel that belongs to no node."""
    field: str
    tick: int
    """The first recording's."""
    time_s: float
    a: Any
    b: Any
    absolute: float | None
    """|a - b| in the field's unit; None if one is missing or no number."""
    relative: float | None
    """The same over the field's largest magnitude in both recordings, at all nodes."""
    rank: tuple[int, int, int]
    """When, and then where in the file's order: places are ordered by it."""


@dataclass(frozen=True)
class FieldComparison:
    """One field of a kind of channel, at all nodes."""

    field: str
    unit: str
    compared: int
    """Values that both recordings have a message for."""
    different: int
    """Other bits, and further apart than the tolerance."""
    within: int
    """Other bits, but not further apart than the tolerance; 0 without one."""
    magnitude: float | None
    """The largest of both; None for texts."""
    first: Place | None
    largest: Place | None
    """By distance, of all with other bits, those within the tolerance included."""


@dataclass(frozen=True)
class KindComparison:
    """The channels of one kind, /node/NN/estimate for example."""

    kind: str
    messages: int
    """That both recordings have."""
    fields: tuple[FieldComparison, ...]
    lacking_a: int = 0
    """Messages that only the second recording has, within the ticks of both."""
    lacking_b: int = 0
    first_lacking: tuple[int, str, str] | None = None
    """Tick and topic of the first of those, and "a" or "b" for the recording that lacks it."""
    fields_only_a: tuple[str, ...] = ()
    fields_only_b: tuple[str, ...] = ()

    @property
    def compared(self) -> int:
        """Values compared."""
        return sum(one.compared for one in self.fields)

    @property
    def different(self) -> int:
        """Values that differ by more than the tolerance."""
        return sum(one.different for one in self.fields)

    @property
    def within(self) -> int:
        """Values with other bits that count as the same."""
        return sum(one.within for one in self.fields)

    @property
    def same(self) -> bool:
        """Nothing differs and nothing is missing."""
        lacking = self.lacking_a + self.lacking_b + self.different
        return not (lacking or self.fields_only_a or self.fields_only_b)

    @property
    def first(self) -> Place | None:
        """The first difference in time."""
        found = [one.first for one in self.fields if one.first is not None]
        return min(found, key=lambda place: place.rank, default=None)

    @property
    def largest(self) -> Place | None:
        """The largest difference, relative to its field's magnitude."""
        found = [one.largest for one in self.fields if one.largest is not None]
        return max(found, key=lambda place: place.relative or 0.0, default=None)


@dataclass(frozen=True)
class Part:
    """One topic of a kind of channel."""

    topic: str
    pairs: Pairs
    a: Table
    b: Table
    number: int
    """Of the topic in the order of the file."""


def kind_of(topic: str) -> tuple[str, int | None]:
    """The kind of a channel and its node: ("/node/NN/estimate", 3) for "/node/03/estimate"."""
    found = _LABEL.search(topic)
    return _LABEL.sub("/NN", topic), None if found is None else int(found[1])


def compare_kind(
    name: str, parts: Sequence[Part], end: int | None, tolerance: float
) -> KindComparison:
    """Compare the channels of one kind.

    `end` is the last tick of both recordings; None if their ticks are not of one length: then what only one of
    them has is no loss, and times are not compared.
    """
    fields: dict[str, list[Part]] = {}
    only: tuple[dict[str, None], dict[str, None]] = ({}, {})
    lacking = [0, 0]
    lacks: list[tuple[int, str, str]] = []
    for part in parts:
        pairs, a, b = part.pairs, part.a, part.b
        if a.rows and b.rows:
            only[0].update(dict.fromkeys(f for f in a.columns if f not in b.columns))
            only[1].update(dict.fromkeys(f for f in b.columns if f not in a.columns))
        for column in a.columns:
            wanted = column != "tick" and not column.endswith(WALL) and column in b.columns
            if wanted and (end is not None or column != "time_s"):
                fields.setdefault(column, []).append(part)
        if end is None:  # of other ticks: what one has between two instants of the other is no loss
            continue
        for side, moments in enumerate(
            (pairs.moments_b[pairs.only_b], pairs.moments_a[pairs.only_a])
        ):
            inside = moments[moments <= end]
            lacking[side] += inside.size
            if inside.size:
                lacks.append((int(inside.min()), part.topic, "ab"[side]))
    return KindComparison(
        kind=name,
        messages=sum(part.pairs.a.size for part in parts),
        fields=tuple(
            _field(column, number, having, tolerance)
            for number, (column, having) in enumerate(fields.items())
        ),
        lacking_a=lacking[0],
        lacking_b=lacking[1],
        first_lacking=min(lacks, default=None),
        fields_only_a=tuple(only[0]),
        fields_only_b=tuple(only[1]),
    )


def _field(name: str, number: int, parts: Sequence[Part], tolerance: float) -> FieldComparison:
    a = np.concatenate([part.a.columns[name][part.pairs.a] for part in parts])
    b = np.concatenate([part.b.columns[name][part.pairs.b] for part in parts])
    owner = np.repeat(np.arange(len(parts)), [part.pairs.a.size for part in parts])
    moments = np.concatenate([part.pairs.moments_a[part.pairs.a] for part in parts])
    if object in (a.dtype, b.dtype):
        other = np.array(
            [x != y for x, y in zip(a.tolist(), b.tolist(), strict=True)], dtype=np.bool_
        )
        apart, magnitude, differs = None, None, other
    else:
        a, b = a.astype(np.float64), b.astype(np.float64)
        empty = np.isnan(a), np.isnan(b)
        missing = empty[0] | empty[1]
        other = (a.view(np.int64) != b.view(np.int64)) & ~(empty[0] & empty[1])
        magnitude = float(np.nanmax(np.abs([a, b]), initial=0.0)) if a.size else 0.0
        with np.errstate(over="ignore"):  # beyond the largest double it is simply far
            apart = np.where(missing, np.inf, np.abs(a - b))
        differs = other & (apart > tolerance * magnitude) if tolerance > 0.0 else other

    def place(index: int) -> Place:
        part = parts[owner[index]]
        table = part.a
        row = int(part.pairs.a[index - int(np.searchsorted(owner, owner[index]))])
        distance = None if apart is None or not np.isfinite(apart[index]) else float(apart[index])
        share = None if distance is None else distance / magnitude if magnitude else 0.0
        return Place(
            topic=part.topic,
            node=kind_of(part.topic)[1],
            field=name,
            tick=int(table.ticks[row]) if "tick" in table.columns else row,
            time_s=float(table.columns["time_s"][row]) if "time_s" in table.columns else 0.0,
            a=_plain(a[index]),
            b=_plain(b[index]),
            absolute=distance,
            relative=share,
            rank=(int(moments[index]), part.number, number),
        )

    wrong = np.flatnonzero(differs)
    measured = np.flatnonzero(other & np.isfinite(apart)) if apart is not None else wrong[:0]
    return FieldComparison(
        field=name,
        unit=unit(name),
        compared=a.size,
        different=wrong.size,
        within=int(np.count_nonzero(other & ~differs)),
        magnitude=magnitude,
        first=place(int(wrong[np.argmin(moments[wrong])])) if wrong.size else None,
        largest=None
        if apart is None or not measured.size
        else place(int(measured[np.argmax(apart[measured])])),
    )


def _plain(value: Any) -> Any:
    """A value without numpy around it; a missing number is None."""
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and np.isnan(value) else value
