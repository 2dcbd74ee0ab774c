"""The bytes of an MCAP file split into messages per channel, metadata and attachments.

Between `analysis.mcap_walk`, which walks the records of a file, finished or not, and `analysis.recording`,
which knows what the channels mean.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata

from analysis.mcap_records import read_bytes
from analysis.mcap_walk import Damage, Piece, Walk


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

    def take(self, piece: Piece) -> None:
        """Take one piece into the collection; those of no interest are dropped."""
        for one in piece.announced:
            if isinstance(one, Channel):
                self.sinks[one.id] = (
                    one.topic,
                    self.payloads.setdefault(one.topic, []),
                    self.log_times_ns.setdefault(one.topic, []),
                )
        for _, channel, _, log_time, _, payload in piece.messages:
            topic, payloads, times = self.sinks[channel]
            self.order.append(topic)
            payloads.append(bytes(payload))
            times.append(log_time)
        if isinstance(piece.value, Metadata):
            self.metadata[piece.value.name] = piece.value.metadata
        elif isinstance(piece.value, Attachment):
            self.attachments[piece.value.name] = piece.value.data


def read_mcap(path: Path) -> McapContent:
    """Read an MCAP file, finished or not.

    Raises UsageError if it cannot be opened or is not an MCAP file. Damage inside the file ends the
    reading there; `unfinished` then says where.
    """
    raw = read_bytes(path)
    collector = _Collector()
    walk = Walk(memoryview(raw))
    damage: Damage | None = None
    for piece in walk:
        if isinstance(piece, Damage):
            damage = piece
            break
        if piece.opcode == Opcode.CHUNK and piece.value is None:
            continue  # the beginning of a chunk whose end, and so its checksum, is missing
        collector.take(piece)
    unfinished = walk.unfinished
    if unfinished is None and damage is not None:
        unfinished = f"is damaged at byte {damage.offset} ({damage.what}); what follows is left out"
    return McapContent(
        payloads=collector.payloads,
        log_times_ns=collector.log_times_ns,
        order=collector.order,
        metadata=collector.metadata,
        attachments=collector.attachments,
        bytes_read=len(raw),
        unfinished=unfinished,
    )
