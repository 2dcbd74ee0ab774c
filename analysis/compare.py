"""Are two recordings the same run, bit for bit, apart from the clock on the wall? And how far apart, if not?

Two runs with the same gains, configuration and seed must be (docs/recording.md, "What repeats"). Here are the
channels' values; configuration and versions are `analysis.compare_facts`', the verdict is `analysis.diff`'s.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.alignment import OrderDifference, Pairs, order_difference, pair
from analysis.compare_facts import configuration_differences
from analysis.compare_values import KindComparison, Part, Place, compare_kind, kind_of
from analysis.events import read_events
from analysis.recording import Recording
from analysis.table import Table
from wire.channels import DEGRADED_SINCE, FORMAT_VERSION, Channel, before_version_5
from wire.foxglove import EVENTS, SCENE

DRAWN = (SCENE.topic,)
"""Channels that only show what others hold: their absence is no difference."""
AT_NODES = ("/node/", "/plant/truth/")
"""Their values belong to places along the arm: of runs whose segments end elsewhere they are not compared."""
_STORY = ("tick", "time_s", "level", "name", "message")


@dataclass(frozen=True)
class Comparison:
    """All channels of two recordings."""

    kinds: tuple[KindComparison, ...]
    missing_a: tuple[str, ...]
    """Topics that only the second recording has."""
    missing_b: tuple[str, ...]
    left_out: tuple[str, ...]
    """Kinds that cannot be compared, because the segments of the two runs end at different places."""
    order: OrderDifference | None
    ends: tuple[int, int]
    """The last tick of each recording; of one that was cut short, the last that is complete."""

    @property
    def first(self) -> Place | None:
        """The first value in time that differs."""
        found = [kind.first for kind in self.kinds if kind.first is not None]
        return min(found, key=lambda place: place.rank, default=None)

    @property
    def same(self) -> bool:
        """Nothing differs as far as both recordings go."""
        apart = self.missing_a or self.missing_b or self.left_out or self.order
        return not apart and all(kind.same for kind in self.kinds)

    @property
    def within(self) -> int:
        """Values with other bits that count as the same."""
        return sum(kind.within for kind in self.kinds)


def compare(one: Recording, other: Recording, tolerance: float = 0.0) -> Comparison:
    """Compare every field of every channel but wall-clock ones, message by message.

    Values are the same if their bits are, or if they are no further apart than `tolerance` times the largest
    magnitude of their field (at all nodes, in both recordings). Raises UsageError if /event is not as octarm
    writes it.
    """
    tables = _comparable(one), _comparable(other)
    moved = _moved(one.configuration.faces_m, other.configuration.faces_m)
    ticks_s = one.tick_s, other.tick_s
    ends = last_tick(one), last_tick(other)
    end = min(ends) if ticks_s[0] == ticks_s[1] else None
    gathered: dict[str, list[Part]] = {}
    left_out: dict[str, None] = {}
    missing: tuple[list[str], list[str]] = ([], [])
    pairs: dict[str, Pairs] = {}
    names = sorted({**tables[0], **tables[1]}, key=lambda topic: topic == EVENTS.topic)
    for number, topic in enumerate(names):  # in the order of the file, the story last
        if moved and topic.startswith(AT_NODES):
            left_out[kind_of(topic)[0]] = None
            continue
        a, b = tables[0].get(topic), tables[1].get(topic)
        if a is None or b is None:
            lacks, there = (one, b) if a is None else (other, a)
            known = topic not in DRAWN and not _since_then(topic, lacks)
            if known and not _beyond(there, lacks, end):
                missing[a is not None].append(topic)
            continue
        pairs[topic] = pair(a, b, ticks_s)
        if topic == EVENTS.topic and ends[0] != ends[1] and end is not None:
            pairs[topic] = _until(pairs[topic], end)
        if ends[0] != ends[1] and "tick" not in a.columns:  # nobody knows what is beyond the end
            nothing = np.zeros(0, dtype=np.int64)
            pairs[topic] = dataclasses.replace(pairs[topic], only_a=nothing, only_b=nothing)
        gathered.setdefault(kind_of(topic)[0], []).append(Part(topic, pairs[topic], a, b, number))
    return Comparison(
        kinds=tuple(compare_kind(name, parts, end, tolerance) for name, parts in gathered.items()),
        missing_a=tuple(missing[0]),
        missing_b=tuple(missing[1]),
        left_out=tuple(left_out),
        order=order_difference((one.order, other.order), pairs, tables),
        ends=ends,
    )


def _since_then(topic: str, recording: Recording) -> bool:
    """Whether the format of a recording is older than a channel."""
    older = int(recording.facts.get("format_version", FORMAT_VERSION)) < DEGRADED_SINCE
    return older and before_version_5(Channel(topic, ())) is not None


def _moved(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether the segments end elsewhere, and not only by rounding."""
    return len(a) != len(b) or not np.allclose(a, b, rtol=0.0, atol=1e-12 * max(map(abs, a)))


def last_tick(recording: Recording) -> int:
    """The last tick that is in a recording, -1 if there is none; of a cut one the last complete one."""
    last = [
        int(table.ticks.max()) if table.rows else -1
        for topic, table in recording.tables.items()
        if topic not in (EVENTS.topic, *DRAWN) and (not table.rows or "tick" in table.columns)
    ]
    if recording.unfinished is not None:
        return min(last, default=-1)
    return max(last, default=-1)


def _beyond(table: Table | None, cut: Recording, end: int | None) -> bool:
    """Whether a channel that a cut recording does not have begins after its end."""
    if cut.unfinished is None or table is None or end is None:
        return False
    return not table.rows or "tick" not in table.columns or int(table.ticks.min()) > end


def _comparable(recording: Recording) -> dict[str, Table]:
    """The tables, with the story in the form that all versions share, without channels that drew nothing."""
    tables = {t: one for t, one in recording.tables.items() if one.rows or t not in DRAWN}
    if EVENTS.topic in tables:
        story = [[getattr(e, name) for name in _STORY] for e in read_events(tables[EVENTS.topic])]
        columns = [np.array(column, dtype=object) for column in zip(*story, strict=True)]
        tables[EVENTS.topic] = Table(
            EVENTS.topic, dict(zip(_STORY, columns, strict=True)) if story else {}
        )
    return tables


def _until(pairs: Pairs, end: int) -> Pairs:
    """Without what is beyond the end: how runs of different lengths end is no difference before it."""
    kept = pairs.moments_a[pairs.a] <= end
    return dataclasses.replace(pairs, a=pairs.a[kept], b=pairs.b[kept])


def first_difference(one: Recording, other: Recording) -> str | None:
    """What differs first in time (channel, tick, field, both values), None if nothing does.

    Compared are the configuration, the artefact's digest, and every field of every channel but
    wall-clock ones, bitwise, and the order of the messages.
    """
    for difference in configuration_differences(one, other):
        if difference.counts:
            a, b = short(difference.a), short(difference.b)
            return f"configuration, {difference.key}: {a} and {b}"
    found = compare(one, other)
    for which, topics in (("first", found.missing_a), ("second", found.missing_b)):
        if topics:
            return f"{topics[0]}: not in the {which} recording"
    for kind in found.kinds:
        if kind.fields_only_a or kind.fields_only_b:
            names = [", ".join(own) or "none" for own in (kind.fields_only_a, kind.fields_only_b)]
            return f"{kind.kind}: fields in one recording alone, {names[0]} and {names[1]}"
    places = [] if found.first is None else [(found.first.tick, value_line(found.first))]
    places += [
        (kind.first_lacking[0], lacking_line(*kind.first_lacking))
        for kind in found.kinds
        if kind.first_lacking is not None
    ]
    if places:
        return min(places)[1]
    if found.order is not None:
        order = found.order
        return f"order: {order.topic_a} and {order.topic_b} after {order.after} messages"
    for topic in (t for t in one.tables if t in other.tables):
        rows = one.tables[topic].rows, other.tables[topic].rows
        if rows[0] != rows[1]:
            return f"{topic}: {rows[0]} and {rows[1]} messages"
    return None


def lacking_line(tick: int, topic: str, side: str) -> str:
    """Which message is missing in which recording."""
    which = "first" if side == "a" else "second"
    return f"{topic}: tick {tick}, no message in the {which} recording"


def value_line(place: Place) -> str:
    """Channel, tick, field and both values with all their digits."""
    values = f"{short(place.a)} and {short(place.b)}"
    return f"{place.topic}: tick {place.tick}, {place.field}: {values}"


def short(value: Any) -> str:
    """A value for a line of text: every digit of a number, the beginning of what is long."""
    if value is None:
        return "missing"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
