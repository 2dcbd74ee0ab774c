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

from analysis.lives import Loss
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
from wire.channels import (
    COMMAND,
    COMMAND_AT,
    DEGRADED,
    MEASUREMENT,
    SCHEDULE,
    STATE,
    SUMS_AT,
    Degraded,
    label,
)
from wire.errors import UsageError
from wire.run_config import NodeConfig

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

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
    """When in a tick they are made; flags say something of the tick when it is over."""
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
        if rows.flagged:
            said = [(topic(i, nodes, "degraded"), DEGRADED[0])]
            flag = slice(-len(DEGRADED), None)
            yield _Part((3, i), i, said, rows.of[i][:, flag], own[:, flag])
        # Sums between segments of one process: in memory, but recorded as any other. And what stood for a sum
        # that did not come has the receiver made itself.
        at = SUMS_AT + rows.forward[i]
        if i > 0:
            every = process or i > first
            where = None if every else _bridged(rows, i, Degraded.FORWARD_BRIDGED)
            yield _forward(i, rows, own[:, SUMS_AT:at], nodes, i - 1 if every else i, where)
        if i < nodes - 1:
            every = process or i < last
            where = None if every else _bridged(rows, i, Degraded.BACKWARD_BRIDGED)
            end = at + rows.backward[i]
            yield _backward(i, rows, own[:, at:end], nodes, i + 1 if every else i, where)
    if last < nodes - 1:
        came = ~_bridged(rows, last + 1, Degraded.FORWARD_BRIDGED)
        yield _forward(last + 1, rows, replayed.forward, nodes, last, came)
        if rows.flagged:
            name = [(topic(last + 1, nodes, "degraded"), DEGRADED[0])]
            flags = (rows.flags(last + 1) & int(Degraded.PARTIAL)).astype(np.float64)[:, None]
            heard = _only(flags, came & rows.whole[last + 1])
            yield _Part((3, last + 1), last, name, heard, replayed.partial)
    if first > 0:
        came = ~_bridged(rows, first - 1, Degraded.BACKWARD_BRIDGED)
        yield _backward(first - 1, rows, replayed.backward, nodes, first, came)
    if (
        process
    ):  # what was sent is the command of the next tick, unless that one is late, or a replacement's
        begins = _bridged(rows, first, Degraded.JOINED)
        for column, i in enumerate(segments):
            sent = np.full((rows.ticks, 1), np.nan)
            sent[1:, 0] = replayed.commands[: rows.ticks - 1, column]
            sent[begins] = np.nan
            recorded = rows.of[i][:, COMMAND_AT : COMMAND_AT + 1]
            yield _Part((0, i), i, [(topic(i, nodes, "command"), COMMAND[0])], recorded, sent)


def _bridged(rows: Rows, node: int, flag: Degraded) -> Bools:
    """(ticks,) where a node's row has this flag."""
    return np.asarray((rows.flags(node) & int(flag)) != 0)


def _forward(
    receiver: int, rows: Rows, ours: Array, nodes: int, giver: int, where: Bools | None
) -> _Part:
    name = topic(receiver, nodes, "forward_sum")
    recorded = _only(rows.forward_sum(receiver), where)
    return _Part((1, receiver), giver, _sum(name, rows), recorded, ours)


def _backward(
    receiver: int, rows: Rows, ours: Array, nodes: int, giver: int, where: Bools | None
) -> _Part:
    name = topic(receiver, nodes, "backward_sum")
    recorded = _only(rows.backward_sum(receiver), where)
    return _Part((2, -receiver), giver, _sum(name, rows), recorded, ours)


def _only(values: Array, where: Bools | None) -> Array:
    """The values at these ticks, NaN at the others."""
    return values if where is None else np.where(where[:, None], values, np.nan)


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
        for upto, why in _unknown(story, feed, last):
            same.setdefault(f"{upto}; {why}", []).append(name_of(feed.config))
    for text, (first, *more) in same.items():
        yield f"{first}{f' and {len(more)} more' if more else ''}: {text}"
    fed = {feed.config.index for feed in feeds}
    for config in story.nodes.configs:  # whose rows have the sums that these gave
        near = {config.index - 1, config.last + 1} & {i for f in feeds for i in f.segments}
        if near and config.index not in fed:
            for _, why in _unknown(story, story.feed(config), last):
                yield f"{name_of(config)}, which got its sums: {why}, so not all of them can be compared"
    if not any(feed.ticks for feed in feeds):
        yield "there is no tick of which a node has recorded everything"


def _unknown(story: Story, feed: Feed, last: int) -> Iterator[tuple[str, str]]:
    """How far a process is replayed, and why not up to tick `last`; nothing if it is, or that is its end."""
    recording, lives = story.recording, feed.lives
    losses = [loss for loss in lives.losses if loss.first <= last]
    if losses and not (losses[-1].later or losses[-1].dead):
        losses.pop()  # or it just had not got so far when the run ended: its last word tells
    for loss in losses:
        yield _lost(feed, loss)
    if losses and losses[-1].later:
        return  # its last word has nothing to add
    if (feed.stops > last and story.span.last is not None) or recording.unfinished is not None:
        return  # said once for all
    upto = f"replayed up to tick {feed.ticks[-1]}" if feed.ticks else "not replayed"
    counters = recording.process_counters(f"node/{label(feed.config.index, recording.nodes)}")
    if not counters and not story.rows.alive[-1:, feed.config.index].all():
        return  # it was dead to the end: nothing followed
    if not counters:
        yield upto, "it sent no last word, and whether more followed is not known"
        return
    # Counters are those of the last process, which sends no command in a tick that it gives up.
    own = lives.lives[-1].ticks if lives.lives else ()
    sent = sum(not feed.flags[k] & int(Degraded.HELD) for k in own)
    if (done := counters.get("command_sent_messages", 0)) > sent:
        yield upto, f"telemetry of {done - sent} ticks after that was lost"


def _lost(feed: Feed, loss: Loss) -> tuple[str, str]:
    """Rows that are not there."""
    before = [k for k in feed.ticks if k < loss.first]
    upto = f"replayed up to tick {before[-1]}" if before else "not replayed"
    if loss.dead and not loss.later:
        ticks = _span(loss.first, loss.last)
        after = next((k for k in feed.ticks if k > loss.last), None)
        again = "" if after is None else f" and from tick {after} on"
        return f"{upto}{again}", f"telemetry of {ticks} was lost with the process that died"
    why = f"telemetry of tick {loss.first} was lost, and with it the state of {loss.later} later ticks"
    return upto, why


def _span(first: int, last: int) -> str:
    return f"tick {first}" if first == last else f"ticks {first} to {last}"


def _bits(values: Array) -> npt.NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _ordered(value: float) -> int:
    """The double's place among all doubles."""
    (bits,) = struct.unpack("<q", struct.pack("<d", value))
    return int(bits) if bits >= 0 else -(int(bits) & 0x7FFF_FFFF_FFFF_FFFF)
