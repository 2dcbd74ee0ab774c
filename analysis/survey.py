"""What is in a recording's file, counted: channels, chunks, bytes by kind of record, damage.

Between `analysis.mcap_walk` and what uses it, `analysis.info` and `analysis.recover`. No payload is decoded.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema

from analysis.mcap_records import read_bytes
from analysis.mcap_walk import DATA_DOUBT, Damage, Piece, Walk
from analysis.recorded_format import check_version, needed_topics, not_ours
from wire.channels import METADATA
from wire.config_json import loads
from wire.errors import UsageError
from wire.run_config import RunConfig

LIBRARY = "octarm"
"""What the file's header says of the program that wrote it."""
RECOVERED = "recovered"
"""Metadata record that `octarm recover` adds."""
_LINE = len('{"topic":,"log_time":,"message":}\n')


@dataclass
class ChannelCount:
    """One channel and what was recorded on it."""

    number: int
    topic: str
    message_encoding: str
    schema: str
    schema_encoding: str
    messages: int = 0
    payload_bytes: int = 0
    digits: int = 0
    """Of all log times."""
    last_ns: int = -1
    """Largest log time."""
    payloads: list[bytes] | None = None
    """Of the topics that were asked for."""

    @property
    def json_lines_bytes(self) -> int:
        """Of the same messages as lines {"topic":...,"log_time":...,"message":...}."""
        fixed = _LINE + len(json.dumps(self.topic, ensure_ascii=False).encode())
        return self.messages * fixed + self.digits + self.payload_bytes


@dataclass(frozen=True)
class AttachedFile:
    """An attachment without its content."""

    name: str
    media_type: str
    bytes: int


@dataclass
class Survey:
    """The file as a whole, and as much of it as can be read."""

    path: Path
    bytes: int
    library: str = ""
    channels: dict[str, ChannelCount] = field(default_factory=dict)
    """By topic, in the order of their announcement."""
    schemas: int = 0
    chunks: int = 0
    compressions: Counter[str] = field(default_factory=Counter)
    """Chunks by compression; "" is none."""
    compressed_bytes: int = 0
    unpacked_bytes: int = 0
    record_bytes: Counter[str] = field(default_factory=Counter)
    """Bytes in the file by kind of record (`KINDS`), framing included."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    """Per name the last record of that name."""
    metadata_records: int = 0
    attachments: list[AttachedFile] = field(default_factory=list)
    damages: list[Damage] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    unfinished: str | None = None
    """None if the file goes up to its end mark, else where and how it stops."""
    stopped_at: int = 0

    @property
    def messages(self) -> int:
        """On all channels."""
        return sum(one.messages for one in self.channels.values())

    @property
    def closed(self) -> bool:
        """Whether the file was closed properly and all its checksums fit."""
        return self.unfinished is None and not self.damages and not self.doubts

    @property
    def stops(self) -> str | None:
        """Where the file stops or is damaged, in words; None if nothing is wrong with it."""
        end = self.stopped_at if self.unfinished else -1  # the damage there is said already
        said = [
            f"is damaged at byte {d.offset} ({d.what})" for d in self.damages if d.offset != end
        ]
        said += [self.unfinished] if self.unfinished else []
        said += self.doubts
        return "; ".join([*said[:2], *(["..."] if len(said) > 3 else []), *said[2:][-1:]]) or None

    @property
    def lost_messages(self) -> int | None:
        """Messages of the file that cannot be read; None if it is not known how many."""
        lost = [one.messages for one in self.damages]
        return None if None in lost else sum(filter(None, lost))

    @property
    def lost_bytes(self) -> int:
        """Bytes of the file that cannot be read."""
        return sum(one.size for one in self.damages)


KINDS = {
    Opcode.CHUNK: "chunks",
    Opcode.MESSAGE: "chunks",
    Opcode.SCHEMA: "chunks",
    Opcode.CHANNEL: "chunks",
    Opcode.MESSAGE_INDEX: "message_index",
    Opcode.ATTACHMENT: "attachments",
    Opcode.METADATA: "metadata",
}
"""Kinds of records in the data section; what follows it is "summary", the rest "other"."""


def survey(path: Path, wanted: Callable[[str], bool] = lambda _: False) -> Survey:
    """Count what is in a recording; payloads are kept of the topics for which `wanted` is true.

    Goes on after damage as far as the framing is sound. Raises UsageError if the file cannot be opened, is no
    MCAP file, or is none of octarm's, or of a format version that this octarm does not read.
    """
    return survey_of(path, read_bytes(path), wanted)


def survey_of(path: Path, raw: bytes, wanted: Callable[[str], bool] = lambda _: False) -> Survey:
    """The same of a file that is in memory."""
    found = Survey(path, len(raw))
    sinks: dict[int, ChannelCount] = {}
    names: dict[int, Schema] = {}
    walk = Walk(memoryview(raw))
    for piece in walk:
        if isinstance(piece, Damage):
            found.damages.append(piece)
            continue
        _take(found, piece)
        for one in piece.announced:
            if isinstance(one, Channel):
                sinks[one.id] = _channel(found, one, names.get(one.schema_id), wanted)
            else:
                names[one.id] = one
                found.schemas += 1
        _count(piece, sinks)
    # Where a damage was found, the whole section's checksum has nothing to add.
    found.doubts = [d for d in walk.doubts if d != DATA_DOUBT or not found.damages]
    found.unfinished = walk.unfinished
    found.stopped_at = walk.stopped_at
    if walk.unfinished is None:
        found.record_bytes["summary"] = len(raw) - walk.stopped_at
    known = sum(found.record_bytes.values()) + sum(d.size for d in found.damages)
    found.record_bytes["other"] += len(raw) - known
    _check_ours(found)
    return found


def _take(found: Survey, piece: Piece) -> None:
    """Count a record and keep what is small of it."""
    value = piece.value
    if piece.opcode != Opcode.DATA_END:
        found.record_bytes[KINDS.get(piece.opcode, "other")] += piece.size
    if isinstance(value, Header):
        found.library = value.library
    elif isinstance(value, Metadata):
        found.metadata[value.name] = value.metadata
        found.metadata_records += 1
    elif isinstance(value, Attachment):
        found.attachments.append(AttachedFile(value.name, value.media_type, len(value.data)))
    elif isinstance(value, Chunk):
        found.chunks += 1
        found.compressions[value.compression] += 1
        found.compressed_bytes += len(value.data)
        found.unpacked_bytes += value.uncompressed_size


def _channel(
    found: Survey, channel: Channel, schema: Schema | None, wanted: Callable[[str], bool]
) -> ChannelCount:
    """The count of a topic; two channels with one topic share it."""
    new = ChannelCount(
        channel.id,
        channel.topic,
        channel.message_encoding,
        schema.name if schema else "",
        schema.encoding if schema else "",
        payloads=[] if wanted(channel.topic) else None,
    )
    return found.channels.setdefault(channel.topic, new)


def _count(piece: Piece, sinks: dict[int, ChannelCount]) -> None:
    for _, number, _, log_time, _, payload in piece.messages:
        sink = sinks[number]
        sink.messages += 1
        sink.payload_bytes += len(payload)
        sink.digits += len(str(log_time))
        sink.last_ns = max(sink.last_ns, log_time)
        if sink.payloads is not None:
            sink.payloads.append(bytes(payload))


def _check_ours(found: Survey) -> None:
    """UsageError unless the file is a recording of octarm in a version that is read."""
    facts = found.metadata.get(METADATA)
    if facts is not None:
        check_version(found.path, facts)
    elif found.library != LIBRARY or not found.messages:  # else that record alone was damaged
        raise UsageError(not_ours(found.path, found.stops, found.channels))


def configuration_of(found: Survey, notes: list[str]) -> RunConfig | None:
    """The run's configuration; None if it cannot be had, and the notes say why."""
    text = found.metadata.get(METADATA, {}).get("run")
    if text is None:
        notes.append("the run's configuration is not in the file: its metadata are damaged")
        return None
    try:
        return loads(RunConfig, text, "run configuration")
    except UsageError as error:
        notes.append(f"the run's configuration cannot be read: {error}")
        return None


def ticks_of(found: Survey, run: RunConfig) -> int:
    """Ticks from 0 on that the plant and every node have reached in this file, by the log times."""
    last = []
    for topic in needed_topics(run.nodes):
        count = found.channels.get(topic)
        last.append(-1 if count is None else count.last_ns)
    return round(min(last) * 1e-9 / run.tick_s) + 1 if min(last) >= 0 else 0
