"""Writes an MCAP file from the pieces of another: numbers, names, times and payloads stay what they were.

Used by `analysis.recover`. The mcap package's own writer gives schemas and channels numbers of its own and
packs every message anew; here whole chunks are copied as they are, only indexes and statistics are made.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from analysis.mcap_records import FRAME, MAGIC, Announcement
from analysis.mcap_records import Message as Walked
from analysis.mcap_walk import PRIVATE, Piece


class McapCopy:
    """The growing file. `add` takes pieces in order, `finish` writes the index and the end mark.

    `library` goes into the header if the file that is copied has none that can be read.
    """

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream = stream
        self._offset = 0
        self._checksum = 0
        self._begun = False
        self._library = library
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._put(MAGIC)

    @property
    def messages(self) -> int:
        """Written so far."""
        return sum(self._counts.values())

    @property
    def chunks(self) -> int:
        """Written so far."""
        return len(self._chunks)

    @property
    def attachments(self) -> int:
        """Written so far."""
        return len(self._attachments)

    @property
    def metadata(self) -> int:
        """Written so far."""
        return len(self._metadata)

    def add(self, piece: Piece, raw: memoryview) -> None:
        """Write what is in a piece; `raw` is its record in the file that it came from.

        A chunk all of whose records are good keeps its packed bytes; of another what is good is packed anew.
        Indexes are not copied: they are made for this file.
        """
        value = piece.value
        self._begin(value if isinstance(value, Header) else None)
        if isinstance(value, Chunk) and not piece.partial:
            self._announce(piece.announced)
            self._chunk(
                value.compression,
                value.data,
                value.uncompressed_size,
                value.uncompressed_crc,
                piece,
            )
        elif piece.messages or piece.announced:
            self._packed(piece)
        elif isinstance(value, Metadata):
            self.add_metadata(value)
        elif isinstance(value, Attachment):
            self._add_attachment(value)
        elif piece.opcode >= PRIVATE:
            self._put(raw)

    def _begin(self, header: Header | None) -> None:
        """The header comes before everything else."""
        if not self._begun:
            self._begun = True
            self._put(_bytes((header or Header(profile="", library=self._library)).write))

    def add_metadata(self, record: Metadata) -> None:
        """Write a metadata record."""
        self._begin(None)
        offset = self._offset
        length = self._put(_bytes(record.write))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=record.name))

    def _add_attachment(self, record: Attachment) -> None:
        offset = self._offset
        length = self._put(_bytes(record.write))
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                log_time=record.log_time,
                create_time=record.create_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            )
        )

    # -- chunks -----------------------------------------------------------------------------------

    def _announce(self, announced: Sequence[Announcement]) -> None:
        for one in announced:
            known: dict[int, Any] = self._channels if isinstance(one, Channel) else self._schemas
            known[one.id] = one

    def _packed(self, piece: Piece) -> None:
        """A chunk of what is good in a piece that cannot be copied as it is."""
        builder = RecordBuilder()
        self._announce(piece.announced)
        for one in piece.announced:
            if isinstance(one, Channel) and one.schema_id not in self._schemas:
                one.schema_id = 0  # lost with a damaged chunk: a channel without a schema is valid
            one.write(builder)
        moved: list[Walked] = []
        for _, channel, sequence, log_time, publish_time, payload in piece.messages:
            moved.append((builder.count, channel, sequence, log_time, publish_time, payload))
            Message(
                channel_id=channel,
                log_time=log_time,
                data=payload,
                publish_time=publish_time,
                sequence=sequence,
            ).write(builder)
        data = builder.end()
        self._chunk("zstd", zstandard.compress(data), len(data), zlib.crc32(data), piece, moved)

    def _chunk(
        self,
        compression: str,
        packed: bytes,
        size: int,
        checksum: int,
        piece: Piece,
        moved: Sequence[Walked] | None = None,
    ) -> None:
        """Write a chunk and the indexes of its messages, whose places in it are `moved` or the piece's own."""
        messages = piece.messages if moved is None else moved
        times = [message[3] for message in messages] or [0]
        first, last = min(times), max(times)
        offset = self._offset
        length = self._put(
            _bytes(
                Chunk(
                    compression=compression,
                    data=packed,
                    message_start_time=first,
                    message_end_time=last,
                    uncompressed_crc=checksum,
                    uncompressed_size=size,
                ).write
            )
        )
        places: dict[int, list[int]] = {}
        for at, channel, _, log_time, _, _ in messages:
            places.setdefault(channel, []).extend((log_time, at))
        offsets, index_start = {}, self._offset
        for channel, pairs in places.items():
            offsets[channel] = self._offset
            self._put(_index(channel, pairs))
            self._counts[channel] = self._counts.get(channel, 0) + len(pairs) // 2
        self._chunks.append(
            ChunkIndex(
                message_start_time=first,
                message_end_time=last,
                chunk_start_offset=offset,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=self._offset - index_start,
                compression=compression,
                compressed_size=len(packed),
                uncompressed_size=size,
            )
        )
        if messages:
            self._first_ns = first if self._first_ns is None else min(self._first_ns, first)
            self._last_ns = max(self._last_ns, last)

    # -- the end ----------------------------------------------------------------------------------

    def finish(self) -> None:
        """Write end record, repetition of schemas and channels, statistics, indexes, end mark."""
        self._put(_bytes(DataEnd(data_section_crc=self._checksum).write))
        start = self._offset
        builder = RecordBuilder()
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=self.messages,
            message_end_time=self._last_ns,
            message_start_time=self._first_ns or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: tuple[tuple[Opcode, Sequence[Any]], ...] = (
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        offsets = []
        for opcode, records in groups:
            begin = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=start + begin,
                        group_length=builder.count - begin,
                    )
                )
        offset_start = start + builder.count
        for one in offsets:
            one.write(builder)
        summary = builder.end()
        footer = Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=0)
        # The checksum covers the section and the footer up to the checksum itself.
        footer.summary_crc = zlib.crc32(
            _bytes(footer.write)[: FRAME.size + 16], zlib.crc32(summary)
        )
        self._put(summary)
        self._put(_bytes(footer.write))
        self._put(MAGIC)

    def _put(self, data: bytes | memoryview) -> int:
        """Write and return the length."""
        self._stream.write(data)
        self._offset += len(data)
        self._checksum = zlib.crc32(data, self._checksum)
        return len(data)


def _index(channel: int, pairs: Sequence[int]) -> bytes:
    """A message index; `pairs` are log time and place in the chunk of each message. There are very many."""
    body = struct.pack(f"<HI{len(pairs)}Q", channel, 8 * len(pairs), *pairs)
    return FRAME.pack(Opcode.MESSAGE_INDEX, len(body)) + body


def _bytes(write: Callable[[RecordBuilder], None]) -> bytes:
    """A record of the mcap package as bytes."""
    builder = RecordBuilder()
    write(builder)
    return bytes(builder.end())
