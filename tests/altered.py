"""A recording with something changed, everything else as it was: for tests that must find exactly that."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer


def one_bit(value: float) -> float:
    """The double whose last bit is the other one."""
    (bits,) = struct.unpack("<q", struct.pack("<d", value))
    (other,) = struct.unpack("<d", struct.pack("<q", bits ^ 1))
    return float(other)


def alter(
    source: Path,
    target: Path,
    *,
    topic: str = "",
    tick: int = -1,
    field: str = "",
    change: Callable[[float], float] = one_bit,
    attachments: Mapping[str, Callable[[Any], Any] | None] | None = None,
) -> tuple[float, float]:
    """Copy a recording, one field of one message changed; attachments by name changed as JSON, or (None) left
    out. Returns the field's values before and after."""
    values: list[tuple[float, float]] = []
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, compression=CompressionType.ZSTD)
        writer.start()
        summary = reader.get_summary()
        assert summary is not None
        schemas = {
            number: writer.register_schema(one.name, one.encoding, one.data)
            for number, one in sorted(summary.schemas.items())
        }
        channels = {
            number: writer.register_channel(one.topic, one.message_encoding, schemas[one.schema_id])
            for number, one in sorted(summary.channels.items())
        }
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        for one in reader.iter_attachments():
            data, edit = one.data, (attachments or {}).get(one.name, lambda value: value)
            if edit is None:
                continue
            if one.name in (attachments or {}):
                data = json.dumps(edit(json.loads(data))).encode()
            writer.add_attachment(0, 0, one.name, one.media_type, data)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            data = message.data
            if channel.topic == topic:
                row = msgspec.json.decode(data)
                if row["tick"] == tick:
                    before = row[field]
                    row[field] = change(before)
                    values.append((before, row[field]))
                    data = msgspec.json.encode(row)
            writer.add_message(
                channels[channel.id], message.log_time, data, message.publish_time, message.sequence
            )
        writer.finish()
    if topic:
        assert len(values) == 1, f"{topic} has {len(values)} messages of tick {tick}"
        return values[0]
    return 0.0, 0.0
