"""The rows of numbers that nodes and plant sent to the recorder, put together again from the channels.

Between a recording and whatever does again what the run did: replay and publication. The recorder cut every row
into channels (`recorder.writer`); here they stand side by side as `wire.channels` has them, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording
from analysis.table import Table
from wire.channels import ANNOUNCED, ARM_SO_FAR, LATE_AT, Channel, before_version_5, label
from wire.messages import PLANT
from wire.telemetry import telemetry_layout

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

_NOTHING = Table("", {})


def telemetry_channels(recording: Recording) -> dict[int, list[Channel]]:
    """The channels of each sender's rows: nodes by their index, the plant by -1 (wire.messages.PLANT).

    How long a sum is stands in its messages; of one without a message nothing but its last numbers is known.
    """
    roots = [f"/node/{label(i, recording.nodes)}" for i in range(recording.nodes)]
    return telemetry_layout(
        [_numbers(recording, f"{root}/forward_sum", len(ARM_SO_FAR)) for root in roots],
        [_numbers(recording, f"{root}/backward_sum", len(ANNOUNCED)) for root in roots],
    )


def telemetry_rows(recording: Recording) -> dict[int, Array]:
    """Each sender's rows (ticks, columns), in the order of `telemetry_channels`, from tick 0 to the last one
    that anybody has reached.

    NaN where there is nothing: in a late tick of a node, while it was out, where telemetry was lost, and past
    the end of a sender. Channels that recordings before version 5 lack say that all was well. UsageError if a
    channel has not the fields that it should have.
    """
    layout = telemetry_channels(recording)
    ticks = 1 + max(
        (_last_tick(recording, one) for channels in layout.values() for one in channels), default=-1
    )
    return {sender: _rows(recording, channels, ticks) for sender, channels in layout.items()}


def whole(rows: Array) -> Bools:
    """(ticks,) where a row has all its numbers."""
    return np.asarray(np.isfinite(rows).all(axis=1))


def late_ticks(rows: dict[int, Array]) -> Bools:
    """(ticks,) where the plant says that the tick had no sweep."""
    return np.asarray(rows[PLANT][:, LATE_AT] > 0.0)


def _numbers(recording: Recording, topic: str, least: int) -> int:
    table = recording.tables.get(topic, _NOTHING)
    return len(table.columns) - 2 if table.rows else least  # without tick and time_s


def _last_tick(recording: Recording, channel: Channel) -> int:
    table = recording.tables.get(channel.topic, _NOTHING)
    return int(table.ticks.max()) if table.rows else -1


def _rows(recording: Recording, channels: Sequence[Channel], ticks: int) -> Array:
    parts = [
        recording.tables.get(channel.topic, _NOTHING).by_tick(channel.fields, ticks)
        for channel in channels
    ]
    if recording.format_version < 5:
        there = np.isfinite(np.concatenate(parts, axis=1)).any(axis=1)
        for channel, part in zip(channels, parts, strict=True):
            if channel.topic not in recording.tables and (said := before_version_5(channel)):
                part[there] = said
    return np.concatenate(parts, axis=1)
