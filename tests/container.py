"""A second opinion on MCAP files, for the tests: the mcap package's own readers, and the rules of the format.

Shares no code with analysis.mcap_walk or analysis.mcap_copy. The rules are those that the MCAP project's `mcap
doctor` checks, and the message indexes besides.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import jsonschema
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream

Row = tuple[int, str, int, int, int, bytes]
"""Channel number, topic, sequence, log time, publish time, payload."""


def rows_in_file_order(path: Path) -> list[Row]:
    """Every message by the package's streaming reader, checksums verified."""
    with path.open("rb") as stream:
        found = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [_row(channel, message) for _, channel, message in found]


def rows_by_index(path: Path) -> list[Row]:
    """Every message by the package's seeking reader, through the index, checksums verified."""
    with path.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages()
        return [_row(channel, message) for _, channel, message in found]


def rows_of_prefix(path: Path) -> list[Row]:
    """Messages of the whole chunks of a file that stops somewhere, by the package's streaming reader."""
    rows: list[Row] = []
    channels: dict[int, Channel] = {}
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel):
                    channels[record.id] = record
                elif type(record).__name__ == "Message":
                    rows.append(_row(channels[record.channel_id], record))
        except Exception:  # wherever and however the package stops
            return rows
    return rows


def _row(channel: Any, message: Any) -> Row:
    return (
        channel.id,
        channel.topic,
        message.sequence,
        message.log_time,
        message.publish_time,
        bytes(message.data),
    )


@dataclass
class Anatomy:
    """The records of a properly closed file with their places."""

    records: list[tuple[int, int, int]] = field(default_factory=list)
    """(opcode, offset, size)"""

    @classmethod
    def of(cls, raw: bytes) -> Anatomy:
        found, offset = cls(), 8
        while offset < len(raw) - 8:
            opcode, length = struct.unpack_from("<BQ", raw, offset)
            found.records.append((opcode, offset, length + 9))
            offset += length + 9
        assert offset == len(raw) - 8
        assert raw[:8] == raw[-8:] == b"\x89MCAP0\r\n"
        return found

    def of_kind(self, opcode: int) -> list[tuple[int, int]]:
        """(offset, size) of each such record."""
        return [(at, size) for kind, at, size in self.records if kind == opcode]


def check_container(path: Path) -> Statistics:
    """AssertionError if the file breaks a rule of the format; its statistics record."""
    raw = path.read_bytes()
    anatomy = Anatomy.of(raw)
    kinds = [kind for kind, _, _ in anatomy.records]
    assert kinds[0] == Opcode.HEADER
    assert kinds.count(Opcode.DATA_END) == kinds.count(Opcode.FOOTER) == 1
    assert kinds[-1] == Opcode.FOOTER
    data_end = kinds.index(Opcode.DATA_END)

    def read(kind: Any, at: int, size: int) -> Any:
        return kind.read(ReadDataStream(BytesIO(raw[at + 9 : at + size])))

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    counts: Counter[int] = Counter()
    times: list[int] = []
    chunks: dict[int, tuple[Chunk, int, dict[int, list[tuple[int, int]]]]] = {}
    indexes: dict[int, dict[int, tuple[int, list[tuple[int, int]]]]] = defaultdict(dict)
    last = 0
    for kind, at, size in anatomy.records[:data_end]:
        if kind == Opcode.CHUNK:
            last = at
            chunk = read(Chunk, at, size)
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            assert length == chunk.uncompressed_size
            assert chunk.uncompressed_crc == zlib.crc32(stream.read(length)) != 0
            places: dict[int, list[tuple[int, int]]] = defaultdict(list)
            place, inside = 0, 0
            for record in breakup_chunk(chunk, validate_crc=True):
                name = type(record).__name__
                if name == "Schema":
                    assert schemas.setdefault(record.id, record) == record
                elif name == "Channel":
                    assert record.schema_id == 0 or record.schema_id in schemas
                    assert channels.setdefault(record.id, record) == record
                else:
                    assert record.channel_id in channels
                    places[record.channel_id].append((record.log_time, place))
                    times.append(record.log_time)
                    counts[record.channel_id] += 1
                    inside += 1
                place += _length(record)
            assert place == length
            own = [t for rows in places.values() for t, _ in rows] or [0]
            assert (chunk.message_start_time, chunk.message_end_time) == (min(own), max(own))
            chunks[at] = (chunk, size, places)
        elif kind == Opcode.MESSAGE_INDEX:
            index = read(MessageIndex, at, size)
            assert index.channel_id not in indexes[last]
            indexes[last][index.channel_id] = (at, index.records)
        else:
            assert kind in (Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT), kind
    for at, (_, _, places) in chunks.items():
        assert {c: rows for c, (_, rows) in indexes[at].items()} == places
    found = {at: read(ChunkIndex, at, size) for at, size in anatomy.of_kind(Opcode.CHUNK_INDEX)}
    assert [one.chunk_start_offset for one in found.values()] == list(chunks)
    for one in found.values():
        chunk, size, _ = chunks[one.chunk_start_offset]
        assert one.chunk_length == size
        assert one.message_start_time == chunk.message_start_time
        assert one.message_end_time == chunk.message_end_time
        assert one.compression == chunk.compression
        assert one.compressed_size == len(chunk.data)
        assert one.uncompressed_size == chunk.uncompressed_size
        own_indexes = indexes[one.chunk_start_offset]
        assert one.message_index_offsets == {c: place for c, (place, _) in own_indexes.items()}
    for opcode, kind, index_kind in (
        (Opcode.ATTACHMENT, AttachmentIndex, Opcode.ATTACHMENT_INDEX),
        (Opcode.METADATA, MetadataIndex, Opcode.METADATA_INDEX),
    ):
        places_found = [read(kind, at, size) for at, size in anatomy.of_kind(index_kind)]
        assert [(one.offset, one.length) for one in places_found] == anatomy.of_kind(opcode)
    for name, known in ((Opcode.SCHEMA, schemas), (Opcode.CHANNEL, channels)):
        kind = Schema if name == Opcode.SCHEMA else Channel
        repeated = [read(kind, at, size) for at, size in anatomy.of_kind(name)]
        assert {one.id: one for one in repeated} == known
    (statistics_at,) = anatomy.of_kind(Opcode.STATISTICS)
    statistics: Statistics = read(Statistics, *statistics_at)
    assert statistics.message_count == sum(counts.values()) == len(times)
    assert dict(statistics.channel_message_counts) == dict(counts)
    assert statistics.message_start_time == min(times, default=0)
    assert statistics.message_end_time == max(times, default=0)
    assert statistics.chunk_count == len(chunks)
    assert statistics.channel_count == len(channels)
    assert statistics.schema_count == len(schemas)
    assert statistics.attachment_count == kinds.count(Opcode.ATTACHMENT)
    assert statistics.metadata_count == kinds.count(Opcode.METADATA)
    with path.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None and summary.statistics == statistics
    return statistics


def _length(record: Any) -> int:
    """Bytes of a record in a chunk, framing included, by the format's description."""
    name = type(record).__name__
    if name == "Message":
        return 9 + 22 + len(record.data)
    if name == "Schema":
        return 9 + 2 + 4 + len(record.name) + 4 + len(record.encoding) + 4 + len(record.data)
    assert not record.metadata
    return 9 + 4 + 4 + len(record.topic) + 4 + len(record.message_encoding) + 4


def check_schemas(path: Path) -> int:
    """Validate every message against its channel's JSON Schema; how many there are."""
    validators: dict[int, Any] = {}
    checked = 0
    with path.open("rb") as stream:
        for schema, _, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None and schema.encoding == "jsonschema"
            if schema.id not in validators:
                content = json.loads(schema.data)
                kind = jsonschema.validators.validator_for(content, jsonschema.Draft202012Validator)
                kind.check_schema(content)
                validators[schema.id] = kind(content)
            validators[schema.id].validate(json.loads(message.data))
            checked += 1
    return checked


def metadata_of(path: Path) -> list[Metadata]:
    with path.open("rb") as stream:
        return list(make_reader(stream).iter_metadata())


def attachments_of(path: Path) -> list[Any]:
    with path.open("rb") as stream:
        return list(make_reader(stream).iter_attachments())
