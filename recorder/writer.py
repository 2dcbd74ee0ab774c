"""The recording's file: an MCAP with one JSON channel per kind of number and node, readable after
any crash.

Last step of the data flow. Chunks are small and handed to the operating system on a stated period,
so that a killed recorder loses no more than that. Room for the end of the file is reserved from the
start (recorder.room): a recording on a full disk ends early, but it ends well.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Mapping, Sequence
from os import sched_yield
from pathlib import Path
from time import monotonic
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer

from recorder.merge import Row
from recorder.room import Room
from wire.channels import METADATA, SUMMARY, Channel
from wire.foxglove import EVENTS, SCENE, log_message

CHUNK_BYTES = 256 * 1024
"""Before packing. Smaller ones spend more on their indexes, a fifth of the file with 64 KiB; what a kill loses
is bounded by flushing in time."""
END_BYTES = 1 << 20
"""Reserved for the chunk that is being filled, the last events and the final counters;"""
CHANNEL_BYTES = 1024
"""and for what the index says of every channel;"""
CHUNK_INDEX_BYTES = 10
"""and of every channel in every chunk."""
MESSAGE_BYTES = 31
"""Of a message's record, before its content."""
_encode = msgspec.json.Encoder().encode


class RecordingWriter:
    """Writes ticks, events, scenes, metadata and attachments; `layout` gives the channels of each sender's
    rows."""

    def __init__(
        self, path: Path, tick_s: float, layout: Mapping[int, Sequence[Channel]], flush_s: float
    ) -> None:
        self._file = path.open("xb")  # never over an existing recording
        self._room = Room(self._file.fileno())
        self.full: str | None = None
        """Why no tick can be written any more, in the system's words: there is room for the end only."""
        self._bytes = 0
        """Written since the start, before packing."""
        self._flushes = 0
        self._channels = 0
        self._writer = Writer(
            self._file,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,  # metadata and message indexes have no other checksum
        )
        self._writer.start(profile="", library="octarm")
        self._tick_s = tick_s
        self._flush_s = flush_s
        self._flushed_at = monotonic()
        self._schemas: dict[bytes, int] = {}
        self._slices: dict[int, list[tuple[int, tuple[str, ...], int, int]]] = {}
        self._events = self._register(EVENTS)
        self._event_number = 0
        self._scenes = self._register(SCENE)
        for sender, channels in layout.items():
            at, slices = 0, []
            for channel in channels:
                fields = ("tick", "time_s", *channel.fields)
                end = at + len(channel.fields)
                slices.append((self._register(channel), fields, at, end))
                at = end
            self._slices[sender] = slices

    def _register(self, channel: Channel) -> int:
        schema = channel.schema
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(
                channel.schema_name, "jsonschema", schema
            )
        self._channels += 1
        return int(self._writer.register_channel(channel.topic, "json", self._schemas[schema]))

    def head(self, metadata: Mapping[str, str], attachments: Mapping[str, str]) -> None:
        """Write what is known before the run, and make it safe on disk; OSError if there is no room."""
        size = sum(map(len, (*metadata.values(), *attachments.values())))
        if reason := self._room.missing(0, size + self._reserve):
            raise OSError(errno.ENOSPC, reason)
        self._writer.add_metadata(METADATA, dict(metadata))
        for name, text in attachments.items():
            media = "application/json" if name.endswith(".json") else "text/plain"
            self._writer.add_attachment(0, 0, name, media, text.encode())
        self.flush()

    def tick(self, tick: int, rows: Mapping[int, Row]) -> None:
        """Write one tick: the senders in the order of the layout, each row cut into its
        channels. Nothing is written once the disk is `full`."""
        self.full = self.full or self._room.missing(self._file.tell(), self._reserve)
        if self.full is not None:
            return
        time_s = tick * self._tick_s
        log_time = self.log_time_ns(tick)
        add = self._writer.add_message
        for sender, slices in self._slices.items():
            row = rows.get(sender)
            if row is None:
                continue
            for channel, fields, begin, end in slices:
                message = dict(zip(fields, (tick, time_s, *row[begin:end]), strict=True))
                raw = _encode(message)
                add(channel, log_time, raw, log_time, tick)
                self._bytes += len(raw) + MESSAGE_BYTES
            # A node that wakes up on this core would wait for the rest of a time slice: some ms, some ticks.
            sched_yield()

    def event(self, tick: int, level: str, name: str, message: str) -> None:
        """Write one line of the run's story."""
        time_s = tick * self._tick_s
        log_time = self.log_time_ns(tick)
        text = log_message(log_time, level, name, message)
        record = {"tick": tick, "time_s": time_s, **text}
        self._event_number += 1
        self._writer.add_message(
            self._events, log_time, _encode(record), log_time, self._event_number
        )

    def scene(self, tick: int, content: Mapping[str, Any]) -> None:
        """Write a picture of the arm, see wire.foxglove.scene_update."""
        log_time = self.log_time_ns(tick)
        record = {"tick": tick, "time_s": tick * self._tick_s, **content}
        raw = _encode(record)
        self._writer.add_message(self._scenes, log_time, raw, log_time, tick)
        self._bytes += len(raw) + MESSAGE_BYTES

    def log_time_ns(self, tick: int) -> int:
        """Time of the arm at the tick's start, which everything of the tick is logged under."""
        return round(tick * self._tick_s * 1e9)

    def flush_if_due(self) -> None:
        """Flush when the stated period is over."""
        if monotonic() - self._flushed_at >= self._flush_s:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the operating system; OSError if nobody will find it."""
        self._writer.flush()
        self._flushes += 1
        self._flushed_at = monotonic()
        if not os.fstat(self._file.fileno()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "it was deleted")

    def close(self, summary: Mapping[str, str]) -> None:
        """Write the final counters and the index, and close the file."""
        self._writer.flush()
        self._writer.add_metadata(SUMMARY, dict(summary))
        self._writer.finish()
        self._file.flush()
        self._room.give_back()
        self._file.close()

    def abandon(self) -> None:
        """Leave a file that cannot be written as it is."""
        with contextlib.suppress(OSError):
            self._file.close()

    @property
    def _reserve(self) -> int:
        """Bytes that the end of the file takes at most, if it came now."""
        chunks = self._flushes + self._bytes // CHUNK_BYTES + 2
        index = chunks * (CHUNK_INDEX_BYTES * self._channels + 100)
        return END_BYTES + CHANNEL_BYTES * self._channels + index
