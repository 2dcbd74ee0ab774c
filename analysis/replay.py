"""A recording's nodes run again: recorded inputs in, what the node's own mathematics makes of them out.

After `analysis.telemetry_rows`, before `analysis.replay_check`, which compares. A node process gets in tick k
its measurements, the forward sum of its first segment and the backward sum of its last one; all three are
recorded at the receiver. What runs is `node.block.SegmentBlock`, which the processes of a run have as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording
from analysis.telemetry_rows import late_ticks, telemetry_channels, telemetry_rows, whole
from node.block import NotFiniteError, SegmentBlock
from node.configured import sweeps_of
from node.row import Y
from node.sweep import NodeSweep, payload
from wire.channels import SETPOINT_AT, SUMS_AT, label
from wire.errors import UsageError
from wire.messages import RejectedError
from wire.run_config import NodeConfig

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

BATCH = 64


@dataclass(frozen=True, eq=False)
class Rows:
    """All telemetry of a run, and which ticks had no sweep."""

    of: dict[int, Array]
    """Per sender (ticks, columns), NaN where there is nothing (`analysis.telemetry_rows`)."""
    whole: dict[int, Bools]
    """Per sender (ticks,) whether the row is there with all its numbers."""
    late: Bools
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

    def forward_sum(self, node: int) -> Array:
        """(ticks, numbers), as the node received it."""
        return self.of[node][:, SUMS_AT : SUMS_AT + self.forward[node]]

    def backward_sum(self, node: int) -> Array:
        """(ticks, numbers), as the node received it."""
        at = SUMS_AT + self.forward[node]
        return self.of[node][:, at : at + self.backward[node]]


def rows_of(recording: Recording, configs: Sequence[NodeConfig]) -> Rows:
    """The telemetry of a recording; UsageError if its sums have other lengths than the configurations'."""
    sweeps = [sweep for config in configs for sweep in sweeps_of(config)]
    rows = telemetry_rows(recording)
    for i, sweep in enumerate(sweeps):
        sums = sweep.forward_received + sweep.backward_received
        expected = SUMS_AT + sums + 2 + (not sweep.first) + (not sweep.last)
        if rows[i].shape[1] != expected:
            if np.isfinite(rows[i]).any():
                raise UsageError(
                    f"recording {recording.path}: node {i} recorded {rows[i].shape[1]} numbers a tick, "
                    f"expected {expected} of its configuration; it was edited"
                )
            rows[i] = np.full((len(rows[i]), expected), np.nan)
    layout = telemetry_channels(recording)
    return Rows(
        of=rows,
        whole={sender: whole(own) for sender, own in rows.items()},
        late=late_ticks(rows),
        forward=tuple(sweep.forward_received for sweep in sweeps),
        backward=tuple(sweep.backward_received for sweep in sweeps),
        fields={one.topic: one.fields for channels in layout.values() for one in channels},
    )


@dataclass(frozen=True, eq=False)
class Feed:
    """What one node process received, tick by tick, up to the first tick that is not all there."""

    config: NodeConfig
    ticks: tuple[int, ...]
    """Those with a sweep, in order; late ones are not among them."""
    measurement: Array
    """(ticks of the recording, 2 segments)."""
    forward: Array
    """(ticks of the recording, numbers); no numbers at the root."""
    backward: Array
    setpoints: npt.NDArray[np.int64]
    """(ticks of the recording,) whose gains were in use; -1 where that was not recorded."""
    stops: int
    """The first tick of which something is missing; the number of ticks if nothing is."""
    lost: int
    """Ticks after that one that are there, but cannot be replayed: the state before them is not known."""

    @property
    def segments(self) -> range:
        """Its segments' indices."""
        return range(self.config.index, self.config.last + 1)


def feed_of(config: NodeConfig, rows: Rows, last: int | None = None) -> Feed:
    """The inputs of a node process up to tick `last` (None: as far as they go)."""
    segments = range(config.index, config.last + 1)
    there = np.logical_and.reduce([rows.whole[i] for i in segments])
    missing = np.flatnonzero(~there & ~rows.late)
    stops = int(missing[0]) if missing.size else rows.ticks
    end = stops if last is None else min(stops, last + 1)
    setpoints = rows.of[config.index][:, SETPOINT_AT]
    return Feed(
        config=config,
        ticks=tuple(np.flatnonzero(there[:end]).tolist()),
        measurement=np.concatenate([rows.of[i][:, :Y] for i in segments], axis=1),
        forward=rows.forward_sum(config.index),
        backward=rows.backward_sum(config.last),
        setpoints=np.where(np.isfinite(setpoints), setpoints, -1.0).astype(np.int64),
        stops=stops,
        lost=int(there[stops:].sum()),
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
    ticks: int = 0
    """How many were done."""
    broke_off: str | None = None
    """Why it did not do all that it was fed: it did otherwise than in the run."""
    ended: str | None = None
    """Why it did not, although it did nothing wrong: it was ended, or gave no answer."""


def nothing_yet(feed: Feed, sweeps: Sequence[NodeSweep], columns: Sequence[int]) -> Replayed:
    """A replay before its first tick; `columns` of each segment's rows."""
    ticks = len(feed.measurement)

    def empty(numbers: int) -> Array:
        return np.full((ticks, numbers), np.nan)

    return Replayed(
        config=feed.config,
        rows={i: empty(width) for i, width in zip(feed.segments, columns, strict=True)},
        forward=empty(sweeps[-1].forward_sent),
        backward=empty(sweeps[0].backward_sent),
        commands=empty(len(sweeps)),
    )


class _Outlet:
    """Takes a block's results and puts them where their tick is."""

    def __init__(self, into: Replayed) -> None:
        self.forward = np.zeros(into.forward.shape[1])
        self.backward = np.zeros(into.backward.shape[1])
        self.commands = np.zeros(into.commands.shape[1])
        self._into = into

    def send_forward(self, tick: int, setpoint: int) -> None:  # noqa: ARG002 - a block says both
        self._into.forward[tick] = self.forward

    def send_backward(self, tick: int, setpoint: int) -> None:  # noqa: ARG002
        self._into.backward[tick] = self.backward

    def send_commands(self, tick: int, setpoint: int) -> None:  # noqa: ARG002
        self._into.commands[tick] = self.commands
        self._into.ticks += 1

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        for kept, part in zip(self._into.rows.values(), rows, strict=True):
            kept[tick : tick + len(part)] = part

    def begins(self, tick: int, setpoint: int) -> None:
        """Nobody waits for it here."""


def replay_block(feed: Feed, rows: Rows) -> Replayed:
    """Run the mathematics of one node process on its recorded inputs.

    An input that the node refuses, or a result that is not finite, ends the replay there and is told in
    `broke_off`: in the run neither has happened.
    """
    sweeps = sweeps_of(feed.config)
    out = nothing_yet(feed, sweeps, [rows.of[i].shape[1] for i in feed.segments])
    block = SegmentBlock(sweeps, _Outlet(out), batch=BATCH)
    first, last = sweeps[0].first, sweeps[-1].last
    try:
        for k in feed.ticks:
            if k != block.tick:
                block.skip_to(k)
            block.on_measurement(payload(feed.measurement[k]), 0)
            if not first:
                block.on_forward(payload(feed.forward[k]), 0)
            if not last:
                block.on_backward(payload(feed.backward[k]), 0)
    except RejectedError as error:
        out.broke_off = (
            f"tick {block.tick}: {name_of(feed.config)} refuses what it received ({error})"
        )
    except NotFiniteError as error:
        out.broke_off = str(error)
    block.flush()
    return out


def name_of(config: NodeConfig) -> str:
    """A node process in words."""
    if config.index == config.last:
        return f"node {config.index}"
    return f"nodes {config.index} to {config.last}"


def topic(node: int, nodes: int, channel: str) -> str:
    """The name of a node's channel."""
    return f"/node/{label(node, nodes)}/{channel}"
