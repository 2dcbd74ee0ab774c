"""Does a replay give, bit for bit, what was recorded? The comparison, what was missing, and the verdict.

Last step of a replay: after `analysis.replay` (the mathematics alone) or `supervise.replay_node` (a real
process). Differences are put in the order in which a run makes its numbers, so that the first one is where to
look: in a tick first what the ticks before have made (estimate, command, schedule), then the forward sums from
the root to the tip, then the backward sums from the tip to the root.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.recorded_nodes import RecordedNodes, recorded_nodes
from analysis.recording import Recording
from analysis.replay import (
    Feed,
    Replayed,
    Rows,
    feed_of,
    name_of,
    replay_block,
    rows_of,
    topic,
)
from node.row import Y
from wire.channels import COMMAND, COMMAND_AT, MEASUREMENT, SCHEDULE, STATE, SUMS_AT, label
from wire.errors import UsageError
from wire.run_config import NodeConfig

Array = npt.NDArray[np.float64]

_FIELDS = (
    *(("measurement", field) for field in MEASUREMENT),
    *(("estimate", field) for field in STATE),
    *(("command", field) for field in COMMAND),
    *(("schedule", field) for field in SCHEDULE),
)


class Verdict(StrEnum):
    """What a replay has found."""

    EQUAL = "equal"
    DIFFERENT = "different"
    INCOMPLETE = "incomplete"
    """No difference, but not everything could be replayed."""


@dataclass(frozen=True)
class Span:
    """The ticks that are compared, both ends included; None: as far as they go."""

    first: int = 0
    last: int | None = None

    def check(self, ticks: int) -> None:
        """UsageError, naming the option, if there is no such tick among those of a recording."""
        if not 0 <= self.first < max(1, ticks):
            raise UsageError(
                f"--from {self.first}: expected a tick of the recording, 0 to {ticks - 1}"
            )
        if self.last is not None and not self.first <= self.last < ticks:
            raise UsageError(
                f"--to {self.last}: expected a tick of the recording from {self.first} on, up to {ticks - 1}"
            )


WHOLE = Span()


@dataclass(frozen=True)
class Difference:
    """One number that a replay gives otherwise."""

    tick: int
    node: int
    """Which one gives it; a sum is recorded where it was received."""
    topic: str
    field: str
    recorded: float
    replayed: float

    @property
    def ulps(self) -> int:
        """How many doubles lie between the two, and one."""
        return abs(_ordered(self.recorded) - _ordered(self.replayed))

    def facts(self) -> dict[str, Any]:
        """For --json."""
        return {**vars(self), "ulps": self.ulps}

    def __str__(self) -> str:
        return (
            f"tick {self.tick}, {self.topic}, {self.field}: recorded {self.recorded!r}, node {self.node} "
            f"gives {self.replayed!r} ({self.ulps} ulp)"
        )


@dataclass(frozen=True)
class Comparison:
    """What was compared and found."""

    values: int
    differing: int
    first: Difference | None
    node_ticks: int
    ticks: int
    """Replayed, of the node that got furthest."""
    missing: tuple[str, ...]
    """What could not be replayed, and why."""
    wrong: tuple[str, ...] = ()
    """What a node did otherwise than in the run, apart from numbers."""

    @property
    def verdict(self) -> Verdict:
        """The whole in one word."""
        if self.differing or self.wrong:
            return Verdict.DIFFERENT
        return Verdict.INCOMPLETE if self.missing else Verdict.EQUAL

    def facts(self) -> dict[str, Any]:
        """For --json."""
        return {
            "verdict": str(self.verdict),
            "ticks_replayed": self.ticks,
            "node_ticks": self.node_ticks,
            "values_compared": self.values,
            "values_different": self.differing,
            "first_difference": None if self.first is None else self.first.facts(),
            "done_otherwise": list(self.wrong),
            "missing": list(self.missing),
        }


@dataclass(frozen=True, eq=False)
class Story:
    """A recording, ready to be replayed."""

    recording: Recording
    nodes: RecordedNodes
    rows: Rows
    span: Span

    def feed(self, config: NodeConfig) -> Feed:
        """What a process got, as far as it is compared."""
        return feed_of(config, self.rows, self.span.last)


def story_of(recording: Recording, span: Span = WHOLE) -> Story:
    """Configurations and telemetry of a recording; UsageError if there is nothing of the span in it."""
    nodes = recorded_nodes(recording)
    rows = rows_of(recording, nodes.configs)
    span.check(rows.ticks)
    return Story(recording, nodes, rows, span)


def check(story: Story) -> Comparison:
    """Replay the mathematics of every node and compare everything that they give."""
    feeds = [story.feed(config) for config in story.nodes.configs]
    return compare(story, feeds, [replay_block(feed, story.rows) for feed in feeds])


def compare(
    story: Story, feeds: Sequence[Feed], replays: Sequence[Replayed], *, process: bool = False
) -> Comparison:
    """Compare what was replayed with what was recorded.

    `process`: also the commands as they were sent, and the inputs as they were recorded again.
    """
    values = differing = 0
    places: list[tuple[tuple[int, ...], Difference]] = []
    nodes = story.recording.nodes
    span = slice(story.span.first, None if story.span.last is None else story.span.last + 1)
    for replayed in replays:
        for part in _parts(replayed, story.rows, nodes, process=process):
            recorded, ours = part.recorded[span], part.replayed[span]
            there = np.isfinite(recorded) & np.isfinite(ours)
            wrong = there & (_bits(recorded) != _bits(ours))
            values += int(there.sum())
            if count := int(wrong.sum()):
                differing += count
                row, column = (int(i) for i in np.argwhere(wrong)[0])
                tick = row + story.span.first
                places.append(((tick, *part.rank, column), part.place(tick, column)))
    done = [replayed.ticks for replayed in replays]
    missing = list(_missing(story, feeds, replays))
    if not values and not missing:
        missing.append("there is nothing in these ticks to compare: they were late")
    return Comparison(
        values=values,
        differing=differing,
        first=min(places, key=lambda place: place[0])[1] if places else None,
        node_ticks=sum(n * len(feed.segments) for n, feed in zip(done, feeds, strict=True)),
        ticks=max(done, default=0),
        missing=tuple(missing),
        wrong=tuple(replayed.broke_off for replayed in replays if replayed.broke_off),
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Numbers of one node in all ticks, recorded and replayed (ticks, columns)."""

    rank: tuple[int, int]
    """When in a tick they are made."""
    node: int
    """Which gives them."""
    fields: Sequence[tuple[str, str]]
    """Topic and field of each column."""
    recorded: Array
    replayed: Array

    def place(self, tick: int, column: int) -> Difference:
        name, field = self.fields[column]
        pair = float(self.recorded[tick, column]), float(self.replayed[tick, column])
        return Difference(tick, self.node, name, field, *pair)


def _parts(replayed: Replayed, rows: Rows, nodes: int, *, process: bool) -> Iterator[_Part]:
    """Everything that one process gives."""
    segments = tuple(replayed.rows)
    first, last = segments[0], segments[-1]
    for i, own in replayed.rows.items():
        fields = [(topic(i, nodes, channel), field) for channel, field in _FIELDS]
        begin = 0 if process else Y
        yield _Part((0, i), i, fields[begin:], rows.of[i][:, begin:SUMS_AT], own[:, begin:SUMS_AT])
        # Sums between segments of one process: in memory, but recorded as any other.
        at = SUMS_AT + rows.forward[i]
        if i > first or (process and i > 0):
            yield _forward(i, rows, own[:, SUMS_AT:at], nodes)
        if i < last or (process and i < nodes - 1):
            yield _backward(i, rows, own[:, at : at + rows.backward[i]], nodes)
    if last < nodes - 1:
        yield _forward(last + 1, rows, replayed.forward, nodes)
    if first > 0:
        yield _backward(first - 1, rows, replayed.backward, nodes)
    if process:  # what was sent is the command of the next tick, unless that one is late
        for column, i in enumerate(segments):
            sent = np.full((rows.ticks, 1), np.nan)
            sent[1:, 0] = replayed.commands[: rows.ticks - 1, column]
            recorded = rows.of[i][:, COMMAND_AT : COMMAND_AT + 1]
            yield _Part((0, i), i, [(topic(i, nodes, "command"), COMMAND[0])], recorded, sent)


def _forward(receiver: int, rows: Rows, ours: Array, nodes: int) -> _Part:
    name = topic(receiver, nodes, "forward_sum")
    return _Part((1, receiver), receiver - 1, _sum(name, rows), rows.forward_sum(receiver), ours)


def _backward(receiver: int, rows: Rows, ours: Array, nodes: int) -> _Part:
    name = topic(receiver, nodes, "backward_sum")
    return _Part((2, -receiver), receiver + 1, _sum(name, rows), rows.backward_sum(receiver), ours)


def _sum(name: str, rows: Rows) -> list[tuple[str, str]]:
    return [(name, field) for field in rows.fields[name]]


def _missing(story: Story, feeds: Sequence[Feed], replays: Sequence[Replayed]) -> Iterator[str]:
    """What was not replayed, in words, and why."""
    recording, rows = story.recording, story.rows
    last = rows.ticks - 1 if story.span.last is None else story.span.last
    cut = recording.unfinished
    if cut is not None and (story.span.last is None or any(feed.stops <= last for feed in feeds)):
        reached = max((feed.ticks[-1] for feed in feeds if feed.ticks), default=-1)
        yield f"the file {cut}; nothing is there after tick {reached}"
    same: dict[str, list[str]] = {}
    for feed, replayed in zip(feeds, replays, strict=True):
        if replayed.ended is not None:
            yield replayed.ended
        elif (why := _unknown(story, feed, last)) is not None:
            upto = f"replayed up to tick {feed.ticks[-1]}" if feed.ticks else "not replayed"
            same.setdefault(f"{upto}; {why}", []).append(name_of(feed.config))
    for text, (first, *more) in same.items():
        yield f"{first}{f' and {len(more)} more' if more else ''}: {text}"
    fed = {feed.config.index for feed in feeds}
    for config in story.nodes.configs:  # whose rows have the sums that these gave
        near = {config.index - 1, config.last + 1} & {i for f in feeds for i in f.segments}
        if near and config.index not in fed:
            why = _unknown(story, story.feed(config), last)
            if why is not None:
                yield f"{name_of(config)}, which got its sums: {why}, so not all of them can be compared"
    if not any(feed.ticks for feed in feeds):
        yield "there is no tick of which a node has recorded everything"


def _unknown(story: Story, feed: Feed, last: int) -> str | None:
    """Why a process stops before tick `last`; None if it does not, or that is its end."""
    recording = story.recording
    if feed.stops > last and story.span.last is not None:
        return None
    if feed.lost:
        return f"telemetry of tick {feed.stops} was lost, and with it the state of {feed.lost} later ticks"
    if recording.unfinished is not None:
        return None  # said once for all
    counters = recording.process_counters(f"node/{label(feed.config.index, recording.nodes)}")
    if not counters:
        return "it sent no last word, and whether more followed is not known"
    done = counters.get("command_sent_messages", 0)
    if done > len(feed.ticks):
        return f"telemetry of {done - len(feed.ticks)} ticks after that was lost"
    return None


def _bits(values: Array) -> npt.NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _ordered(value: float) -> int:
    """The double's place among all doubles."""
    (bits,) = struct.unpack("<q", struct.pack("<d", value))
    return int(bits) if bits >= 0 else -(int(bits) & 0x7FFF_FFFF_FFFF_FFFF)
