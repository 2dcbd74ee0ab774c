"""A recording's nodes run again: recorded inputs in, what the node's own mathematics makes of them out.

After `analysis.telemetry_rows`, before `analysis.replay_check`, which compares. A node process gets in tick k
its measurements, the forward sum of its first segment and the backward sum of its last one; all three are
recorded at the receiver. What runs is `node.block.SegmentBlock`, which the processes of a run have as well.
What did not come in time is not fed: the recorded flags (wire.channels.Degraded) say what the process did
instead, and it is made to do so again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.lives import Life, Lives, lives_of
from analysis.recording import Recording
from analysis.table import whole_numbers
from analysis.telemetry_rows import late_ticks, telemetry_channels, telemetry_rows, whole
from node.block import SegmentBlock
from node.configured import sweeps_of
from node.finite import NotFiniteError
from node.row import Y
from node.sweep import NodeSweep, payload
from wire.channels import (
    DEGRADED,
    SETPOINT_AT,
    SUMS_AT,
    Degraded,
    Health,
    columns_of,
    label,
)
from wire.errors import UsageError
from wire.messages import PARTIAL, PLANT, Reason, RejectedError
from wire.run_config import NodeConfig

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

BATCH = 64
NOT_WHOLE = int(Degraded.FORWARD_BRIDGED | Degraded.PARTIAL)
"""Flags of a node whose own sum to the tip's side is not of the whole arm."""
STATE_AT = slice(Y, Y + 5)
"""Where a row has estimate and command."""


@dataclass(frozen=True, eq=False)
class Rows:
    """All telemetry of a run, and which ticks had no sweep."""

    of: dict[int, Array]
    """Per sender (ticks, columns), NaN where there is nothing (`analysis.telemetry_rows`)."""
    whole: dict[int, Bools]
    """Per sender (ticks,) whether the row is there with all its numbers."""
    late: Bools
    on_time: Bools
    """(ticks, nodes): not False unless the plant says so, as its health does;"""
    alive: Bools
    """the same."""
    flagged: bool
    """Whether the recording has flags of its own: since version 5."""
    forward: tuple[int, ...]
    """Numbers in the forward sum that each node received."""
    backward: tuple[int, ...]
    """The same of the backward sum."""
    fields: Mapping[str, tuple[str, ...]]
    """Per topic."""

    @property
    def ticks(self) -> int:
        """Ticks that anybody has reached."""
        return int(self.late.size)

    def flags(self, node: int) -> Ints:
        """(ticks,) wire.channels.Degraded; 0 where there is no row."""
        return whole_numbers(self.of[node][:, -len(DEGRADED)], 0.0)

    def lives(self, config: NodeConfig) -> Lives:
        """The lives of the process with this configuration."""
        segments = range(config.index, config.last + 1)
        return lives_of(
            np.logical_and.reduce([self.whole[i] for i in segments]),
            self.late,
            self.on_time[:, config.index],
            self.alive[:, config.index],
            self.flags(config.index),
        )

    def forward_sum(self, node: int) -> Array:
        """(ticks, numbers), as the node received it."""
        return self.of[node][:, SUMS_AT : SUMS_AT + self.forward[node]]

    def backward_sum(self, node: int) -> Array:
        """(ticks, numbers), as the node received it."""
        at = SUMS_AT + self.forward[node]
        return self.of[node][:, at : at + self.backward[node]]


def rows_of(recording: Recording, configs: Sequence[NodeConfig]) -> Rows:
    """The telemetry of a recording; UsageError if its sums have other lengths than the configurations'."""
    try:
        sweeps = [sweep for config in configs for sweep in sweeps_of(config)]
    except UsageError as error:
        raise UsageError(f"recording {recording.path}: {error}") from None
    rows = telemetry_rows(recording)
    for i, sweep in enumerate(sweeps):
        sums = sweep.forward_received + sweep.backward_received
        expected = SUMS_AT + sums + 2 + (not sweep.first) + (not sweep.last) + len(DEGRADED)
        if rows[i].shape[1] != expected:
            if np.isfinite(rows[i]).any():
                raise UsageError(
                    f"recording {recording.path}: node {i} recorded {rows[i].shape[1]} numbers a tick, "
                    f"expected {expected} of its configuration; it was edited"
                )
            rows[i] = np.full((len(rows[i]), expected), np.nan)
    layout = telemetry_channels(recording)
    health = whole_numbers(rows[PLANT][:, columns_of(layout[PLANT], "/plant/health")], -1.0)
    return Rows(
        of=rows,
        whole={sender: whole(own) for sender, own in rows.items()},
        late=late_ticks(rows),
        on_time=(health & int(Health.ON_TIME)) != 0,
        alive=(health & int(Health.ALIVE)) != 0,
        flagged=recording.format_version >= 5,
        forward=tuple(sweep.forward_received for sweep in sweeps),
        backward=tuple(sweep.backward_received for sweep in sweeps),
        fields={one.topic: one.fields for channels in layout.values() for one in channels},
    )


@dataclass(frozen=True, eq=False)
class Feed:
    """What one node process received, tick by tick, as far as that is all there."""

    config: NodeConfig
    lives: Lives
    """Ticks with a sweep; late ones are not among them."""
    measurement: Array
    """(ticks of the recording, 2 segments)."""
    forward: Array
    """(ticks of the recording, numbers); no numbers at the root."""
    backward: Array
    states: Array
    """(ticks of the recording, segments, 5) estimates and commands: what a replacement begins with."""
    setpoints: Ints
    """(ticks of the recording,) whose gains were in use; -1 where that was not recorded."""
    flags: Ints
    """(ticks of the recording,) wire.channels.Degraded."""
    stops: int
    """The first tick of which something is missing; the number of ticks if nothing is."""

    @property
    def segments(self) -> range:
        """Its segments' indices."""
        return range(self.config.index, self.config.last + 1)

    @property
    def ticks(self) -> tuple[int, ...]:
        """All ticks that can be replayed, in order."""
        return tuple(k for life in self.lives.lives for k in life.ticks)


def feed_of(config: NodeConfig, rows: Rows, last: int | None = None) -> Feed:
    """The inputs of a node process up to tick `last` (None: as far as they go)."""
    segments = range(config.index, config.last + 1)
    found = rows.lives(config)
    stops = found.losses[0].first if found.losses else rows.ticks
    if last is not None:
        cut = (
            dataclasses.replace(life, ticks=tuple(k for k in life.ticks if k <= last))
            for life in found.lives
        )
        found = dataclasses.replace(found, lives=tuple(life for life in cut if life.ticks))
    setpoints = rows.of[config.index][:, SETPOINT_AT]
    return Feed(
        config=config,
        lives=found,
        measurement=np.concatenate([rows.of[i][:, :Y] for i in segments], axis=1),
        forward=rows.forward_sum(config.index),
        backward=rows.backward_sum(config.last),
        states=np.stack([rows.of[i][:, STATE_AT] for i in segments], axis=1),
        setpoints=whole_numbers(setpoints, -1.0),
        flags=rows.flags(config.index),
        stops=stops,
    )


@dataclass
class Replayed:
    """What a node process gave for a feed; NaN in ticks that it did not do."""

    config: NodeConfig
    rows: dict[int, Array]
    """Per segment (ticks, columns), as its telemetry; the instants at the end mean nothing."""
    forward: Array
    """(ticks, numbers) sums to the tip's side; no numbers at the tip."""
    backward: Array
    commands: Array
    """(ticks, segments) u(k + 1), as sent in tick k."""
    partial: Array
    """(ticks, 1) Degraded.PARTIAL if the sum to the tip's side was said not to be of the whole arm, else 0."""
    ticks: int = 0
    """How many were done."""
    broke_off: str | None = None
    """Why it did not do all that it was fed: it did otherwise than in the run."""
    ended: str | None = None
    """Why it did not, although it did nothing wrong: it was ended, or gave no answer."""


def nothing_yet(feed: Feed, sweeps: Sequence[NodeSweep], rows: Rows) -> Replayed:
    """A replay before its first tick."""
    ticks = len(feed.measurement)

    def empty(numbers: int) -> Array:
        return np.full((ticks, numbers), np.nan)

    return Replayed(
        config=feed.config,
        rows={i: empty(rows.of[i].shape[1]) for i in feed.segments},
        forward=empty(sweeps[-1].forward_sent),
        backward=empty(sweeps[0].backward_sent),
        commands=empty(len(sweeps)),
        partial=empty(1),
    )


class _Outlet:
    """Takes a block's results and puts them where their tick is."""

    def __init__(self, into: Replayed) -> None:
        self.forward = np.zeros(into.forward.shape[1])
        self.backward = np.zeros(into.backward.shape[1])
        self.commands = np.zeros(into.commands.shape[1])
        self._into = into

    def send_forward(self, tick: int, setpoint: int) -> None:
        self._into.forward[tick] = self.forward
        self._into.partial[tick] = int(Degraded.PARTIAL) if setpoint & PARTIAL else 0

    def send_backward(self, tick: int, setpoint: int) -> None:  # noqa: ARG002 - a block says both
        self._into.backward[tick] = self.backward

    def send_commands(self, tick: int, setpoint: int) -> None:  # noqa: ARG002
        self._into.commands[tick] = self.commands

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        for kept, part in zip(self._into.rows.values(), rows, strict=True):
            kept[tick : tick + len(part)] = part

    def begins(self, tick: int, setpoint: int) -> None:
        """Nobody waits for it here."""


def replay_block(feed: Feed, rows: Rows) -> Replayed:
    """Run the mathematics of one node process on its recorded inputs, every life anew.

    An input that the node refuses, or a result that is not finite, ends the replay there and is told in
    `broke_off`: in the run neither has happened. The same of flags that cannot have been.
    """
    sweeps = sweeps_of(feed.config)
    out = nothing_yet(feed, sweeps, rows)
    for life in feed.lives.lives:
        if out.broke_off is None:
            _replay_life(feed, life, out)
    return out


def _replay_life(feed: Feed, life: Life, out: Replayed) -> None:
    sweeps, outlet = sweeps_of(feed.config), _Outlet(out)
    block = SegmentBlock(sweeps, outlet, batch=BATCH)
    try:
        for k in life.ticks:
            if life.joined and k == life.ticks[0]:
                _join(block, feed, k)
            elif k != block.tick:
                block.skip_to(k)
            if k in life.doubtful and not _skipped(sweeps, feed.states[k]):
                out.ended = (
                    f"{name_of(feed.config)}: it was late before tick {k}, and what it did in the meantime was "
                    f"lost; {sum(t >= k for t in life.ticks)} ticks of this process are not replayed"
                )
                break
            feed_tick(block, feed, k)
            if block.tick != k + 1:
                out.broke_off = (
                    f"tick {k}: {name_of(feed.config)} is not through with what it received"
                )
                break
            if feed.flags[k] & int(Degraded.HELD):  # what had gone before the tick was given up
                out.forward[k], out.backward[k] = outlet.forward, outlet.backward
                out.partial[k] = int(Degraded.PARTIAL) if feed.flags[k] & NOT_WHOLE else 0
            out.ticks += 1
    except RejectedError as error:
        out.broke_off = (
            f"tick {block.tick}: {name_of(feed.config)} refuses what it received ({error})"
        )
    except NotFiniteError as error:
        out.broke_off = str(error)
    block.flush()


def _join(block: SegmentBlock, feed: Feed, k: int) -> None:
    """Begin in place of a dead process; RejectedError for a setpoint that there is not."""
    setpoint = int(feed.setpoints[k])
    if not 0 <= setpoint < block.setpoints:
        raise RejectedError(Reason.SETPOINT, f"got {setpoint} of {block.setpoints}")
    block.join(k, setpoint, list(feed.states[k]))


def feed_tick(block: SegmentBlock, feed: Feed, k: int) -> None:
    """Give a block what its process received in a tick, and make it do without what did not come.

    A setpoint that a process took for the announced one, without the sum that announces it, stands where the
    sum has it. RejectedError, NotFiniteError as the block raises them.
    """
    flags = int(feed.flags[k])
    held = bool(flags & int(Degraded.HELD))
    no_forward = bool(flags & int(Degraded.FORWARD_BRIDGED))
    no_backward = bool(flags & int(Degraded.BACKWARD_BRIDGED))
    block.heard_forward()
    block.heard_backward()
    if flags & int(Degraded.PARTIAL):
        block.partial()
    if no_backward:
        announced = int(feed.backward[k, -1]) if feed.backward.shape[1] else -1
        if not 0 <= announced < block.setpoints:
            raise RejectedError(Reason.SETPOINT, f"got {announced} of {block.setpoints}")
        block.cut_backward(0, announced)
    if no_forward:
        block.cut_forward(0)
    if held:  # then it was not decided before the end that they do not come
        block.heard_forward()
        block.heard_backward()
    if not flags & int(Degraded.MEASUREMENT_HELD):
        block.on_measurement(payload(feed.measurement[k]), 0)
    if feed.forward.shape[1] and not no_forward:
        block.on_forward(payload(feed.forward[k]), 0)
    if feed.backward.shape[1] and not no_backward:
        block.on_backward(payload(feed.backward[k]), 0)
    if held and block.tick == k:
        block.close(0)


def _skipped(sweeps: Sequence[NodeSweep], recorded: Array) -> bool:
    """Whether any number of the recorded states (segments, 5) is what the sweeps have, bit for bit: after a
    sweep none would be."""
    ours = np.stack([sweep.state for sweep in sweeps])
    return bool((ours.view(np.int64) == np.ascontiguousarray(recorded).view(np.int64)).any())


def name_of(config: NodeConfig) -> str:
    """A node process in words."""
    if config.index == config.last:
        return f"node {config.index}"
    return f"nodes {config.index} to {config.last}"


def topic(node: int, nodes: int, channel: str) -> str:
    """The name of a node's channel."""
    return f"/node/{label(node, nodes)}/{channel}"
