"""The bytes of an MCAP file split into messages per channel, metadata and attachments.

First step of reading a recording; what the channels mean is the business of `analysis.recording`.
The framing (one byte of opcode, eight of length) is walked here in file order, without the index at
the end of the file, so that a file whose writer was killed gives everything up to its last whole
record. The contents of the records are decoded by the mcap package.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream

from wire.errors import UsageError

MAGIC = b"\x89MCAP0\r\n"
_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_DECODING = (McapError, UnicodeDecodeError, struct.error)


@dataclass(frozen=True)
class McapContent:
    """Everything in an MCAP file that a reader of octarm's recordings uses."""

    payloads: dict[str, list[bytes]]
    """Per topic the messages' payloads in file order; an announced topic may have none."""
    log_times_ns: dict[str, list[int]]
    order: list[str]
    """The topic of every message in file order."""
    metadata: dict[str, dict[str, str]]
    """Per name the last metadata record of that name."""
    attachments: dict[str, bytes]
    bytes_read: int
    unfinished: str | None
    """None for a file that was closed properly, else where and how it stops."""


@dataclass
class _Collector:
    payloads: dict[str, list[bytes]] = field(default_factory=dict)
    log_times_ns: dict[str, list[int]] = field(default_factory=dict)
    order: list[str] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    sinks: dict[int, tuple[str, list[bytes], list[int]]] = field(default_factory=dict)

    def take(self, opcode: int, data: memoryview) -> None:
        """Take one record into the collection; those of no interest are dropped."""
        if opcode == Opcode.MESSAGE:
            identity, _, log_time, _ = _MESSAGE.unpack_from(data)
            if identity not in self.sinks:
                raise McapError(
                    f"a message of channel number {identity}, which was never announced"
                )
            topic, payloads, times = self.sinks[identity]
            self.order.append(topic)
            payloads.append(bytes(data[_MESSAGE.size :]))
            times.append(log_time)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(data)))
            self.sinks[channel.id] = (
                channel.topic,
                self.payloads.setdefault(channel.topic, []),
                self.log_times_ns.setdefault(channel.topic, []),
            )
        elif opcode == Opcode.CHUNK:
            chunk = Chunk.read(ReadDataStream(BytesIO(data)))
            for inner_opcode, _, inner in _frames(_unpacked(chunk), 0):
                self.take(inner_opcode, inner)
        elif opcode == Opcode.METADATA:
            record = Metadata.read(ReadDataStream(BytesIO(data)))
            self.metadata[record.name] = record.metadata
        elif opcode == Opcode.ATTACHMENT:
            if zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
                raise McapError("an attachment whose checksum does not fit")
            attachment = Attachment.read(ReadDataStream(BytesIO(data)))
            self.attachments[attachment.name] = attachment.data


class _Cut(Exception):  # noqa: N818 - not an error of the program: the file simply ends here
    def __init__(self, offset: int) -> None:
        super().__init__(f"ends in the middle of a record at byte {offset}")


def _unpacked(chunk: Chunk) -> memoryview:
    """The records in a chunk; McapError if it cannot be unpacked or its checksum does not fit."""
    try:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    except Exception as error:  # each compression library has exceptions of its own
        raise McapError(f"a chunk that cannot be unpacked: {error}") from None
    return memoryview(stream.read(size))


def _frames(data: memoryview, start: int) -> Iterator[tuple[int, int, memoryview]]:
    """Yield (opcode, offset, content) of each whole record; raises _Cut at a partial one."""
    offset = start
    while offset < len(data):
        if offset + _FRAME.size > len(data):
            raise _Cut(offset)
        opcode, length = _FRAME.unpack_from(data, offset)
        end = offset + _FRAME.size + length
        if end > len(data):
            raise _Cut(offset)
        yield opcode, offset, data[offset + _FRAME.size : end]
        if opcode == Opcode.FOOTER:
            return
        offset = end


def read_mcap(path: Path) -> McapContent:
    """Read an MCAP file, finished or not.

    Raises UsageError if it cannot be opened or is not an MCAP file. Damage inside the file ends the
    reading there; `unfinished` then says where.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UsageError(
            f"recording {path}: {error.strerror or error}; "
            "give the .mcap file that a run left behind"
        ) from None
    if not raw.startswith(MAGIC):
        raise UsageError(
            f"recording {path}: expected an MCAP file, got {len(raw)} bytes starting with "
            f"{raw[:8]!r}; give the .mcap file that a run left behind"
        )
    collector = _Collector()
    data = memoryview(raw)
    offset, opcode = len(MAGIC), 0
    unfinished: str | None = None
    try:
        for opcode, offset, content in _frames(data, len(MAGIC)):  # noqa: B007 - read after the loop
            if opcode == Opcode.DATA_END:
                break
            collector.take(opcode, content)
    except _Cut as cut:
        unfinished = str(cut)
    except _DECODING as error:
        unfinished = f"is damaged at byte {offset} ({error}); what follows is left out"
    if unfinished is None and opcode != Opcode.DATA_END:
        unfinished = f"ends at byte {len(raw)} without an end record"
    elif unfinished is None and not raw.endswith(MAGIC):
        unfinished = f"ends at byte {len(raw)} in the middle of its index"
    return McapContent(
        payloads=collector.payloads,
        log_times_ns=collector.log_times_ns,
        order=collector.order,
        metadata=collector.metadata,
        attachments=collector.attachments,
        bytes_read=len(raw),
        unfinished=unfinished,
    )
