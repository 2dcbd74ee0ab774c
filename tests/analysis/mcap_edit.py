"""Reads and rewrites recordings message by message, with the mcap package and the json module alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Channel as McapChannel
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

Row = dict[str, Any]


def messages(path: Path) -> Iterator[tuple[str, Row]]:
    """Topic and decoded payload of every message in file order, also of a file that was cut."""
    topics: dict[int, str] = {}
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                if isinstance(record, McapChannel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    yield topics[record.channel_id], json.loads(record.data)
        except Exception:
            return


def by_tick(path: Path) -> dict[tuple[str, int], Row]:
    """The messages by topic and tick; of two for one tick the later."""
    return {(topic, row["tick"]): row for topic, row in messages(path) if "tick" in row}


def rewrite(
    source: Path,
    target: Path,
    edit: Callable[[str, Row], Row | None] = lambda _, row: row,
    *,
    arrange: Callable[[list[tuple[str, Row]]], list[tuple[str, Row]]] = lambda rows: rows,
    about: Callable[[dict[str, str]], dict[str, str]] = lambda metadata: metadata,
) -> Path:
    """The same recording with every message passed through `edit` (None: left out), then `arrange`d;
    `about` changes its metadata."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, chunk_size=16384)  # so that a cut file still has some
        writer.start()
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        writer.add_metadata("octarm", about(metadata["octarm"]))
        edited = [(topic, edit(topic, row)) for topic, row in messages(source)]
        numbers: dict[str, int] = {}
        for topic, row in arrange([(topic, row) for topic, row in edited if row is not None]):
            if topic not in numbers:
                numbers[topic] = writer.register_channel(topic, "json", 0)
            when = round(row.get("time_s", 0.0) * 1e9)
            writer.add_message(numbers[topic], when, json.dumps(row).encode(), when)
        writer.add_metadata("summary", metadata["summary"])
        writer.finish()
    return target
