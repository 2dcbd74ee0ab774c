"""The records of an MCAP file in file order, of a whole file and of what is left of one.

First step of everything that reads a recording: `analysis.mcap_file` takes its messages up to the first damage,
`analysis.survey` counts what is there, `analysis.recover` copies it. The framing is walked without the index at
the end of the file, so that a file whose writer was killed gives everything up to its last whole record.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from typing import Any

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Schema

from analysis.mcap_records import (
    DECODING,
    FRAME,
    MAGIC,
    READ,
    Announcement,
    CutError,
    Message,
    begun,
    chunk_of,
    decoded,
    frame,
    message,
    split,
    unpacked,
)

PRIVATE = 0x80
"""Opcodes from here on are other programs' own records, which a reader passes over."""
_SIZES = {int(Opcode.DATA_END): 4, int(Opcode.FOOTER): 20}
"""Records of one size: their opcodes decide where the reading ends."""
_INDEX_HEAD, _INDEX_ENTRY = 6, 16
"""Bytes of a message index before its entries, and of an entry."""
DATA_DOUBT = "has a data section whose checksum does not fit"
_KNOWN = frozenset(map(int, Opcode))
_END_SIZE = FRAME.size + _SIZES[Opcode.FOOTER] + len(MAGIC)


@dataclass(frozen=True)
class Piece:
    """One record of the file, or a chunk's indexes; a chunk comes with all that is in it."""

    opcode: int
    offset: int
    size: int
    """In the file, framing included."""
    value: Any = None
    """Header, metadata, attachment or chunk as the mcap package has it; None for other kinds."""
    announced: tuple[Announcement, ...] = ()
    """Schemas and channels that were not known before, in the order in which they must be written."""
    messages: tuple[Message, ...] | list[Message] = ()
    partial: bool = False
    """Not all of the chunk's records are in `messages` and `announced`, or those are not all in the chunk."""


@dataclass(frozen=True)
class Damage:
    """Something in the file that cannot be used."""

    offset: int
    size: int
    what: str
    opcode: int
    messages: int | None = 0
    """How many were in it; None if that is not known."""


@dataclass
class Walk:
    """Iterate once: yields the pieces of the data section in file order, and the damages between them.

    What the walk says of the whole file is there when the iteration has ended.
    """

    data: memoryview
    channels: dict[int, Channel] = field(default_factory=dict)
    """Announced so far."""
    unfinished: str | None = None
    """None if the file goes up to its end record and end mark, else where and how it stops."""
    stopped_at: int = 0
    """Offset of what could not be read any more, or of the end record."""
    doubts: list[str] = field(default_factory=list)
    """What is wrong with a file that is all there: checksums of its data section and its index."""
    _schemas: dict[int, Schema] = field(default_factory=dict)
    _waiting: Damage | None = None
    """A damaged chunk: the indexes that follow it say how many messages were in it."""

    def __iter__(self) -> Iterator[Piece | Damage]:
        offset, opcode, ended = len(MAGIC), 0, False
        while offset < len(self.data) and not ended:
            self.stopped_at = offset
            try:
                opcode, end = frame(self.data, offset)
            except CutError:
                self.unfinished = f"ends in the middle of a record at byte {offset}"
                yield from self._settle()
                yield from self._cut(offset)
                return
            if opcode == Opcode.MESSAGE_INDEX:
                end = self._indexes(offset)
                yield Piece(opcode, offset, end - offset)
            elif self._misread(opcode, end - offset - FRAME.size):
                what = f"a record of unknown kind {opcode}"
                if not self._plausible(end):
                    self.unfinished = f"is damaged at byte {offset} ({what})"
                    yield from self._settle()
                    yield Damage(offset, len(self.data) - offset, what, opcode, None)
                    return
                yield from self._settle()
                yield Damage(offset, end - offset, what, opcode, None)
            else:
                yield from self._record(opcode, offset, end)
                ended = opcode in _SIZES
            offset = end
        yield from self._settle()
        self._ending(offset, complete=ended and opcode == Opcode.DATA_END)

    # -- one record -------------------------------------------------------------------------------

    def _record(self, opcode: int, offset: int, end: int) -> Iterator[Piece | Damage]:
        content = self.data[offset + FRAME.size : end]
        size = end - offset
        yield from self._settle()
        try:
            if opcode == Opcode.CHUNK:
                yield from self._chunk(content, offset, size)
            elif opcode == Opcode.MESSAGE:
                yield from self._taken(opcode, offset, size, [], [message(content, 0)])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._taken(opcode, offset, size, [decoded(opcode, content)], [])
            elif opcode in READ:
                yield Piece(opcode, offset, size, decoded(opcode, content))
            else:
                yield Piece(opcode, offset, size)
        except DECODING as error:
            what = str(error) or type(error).__name__
            if opcode == Opcode.CHUNK:
                self._waiting = Damage(offset, size, what, opcode, None)
            else:
                yield Damage(offset, size, what, opcode)

    def _chunk(self, content: memoryview, offset: int, size: int) -> Iterator[Piece | Damage]:
        chunk = chunk_of(content)
        inside = unpacked(chunk)
        chunk.uncompressed_size = len(inside)  # has no checksum of its own
        announced, messages, rest = split(inside)
        if rest:
            raise McapError("a chunk that ends in the middle of a record")
        verified = chunk.uncompressed_crc != 0
        yield from self._taken(
            Opcode.CHUNK, offset, size, announced, messages, chunk, verified=verified
        )

    def _taken(
        self,
        opcode: int,
        offset: int,
        size: int,
        announced: list[Announcement],
        messages: list[Message],
        chunk: Chunk | None = None,
        *,
        verified: bool = False,
        partial: bool = False,
    ) -> Iterator[Piece | Damage]:
        """The piece with those messages whose channel is known, and the others as damage."""
        new = [one for one in announced if self._announce(one)]
        partial |= len(new) < len(announced)
        unknown = {m[1] for m in messages} - self.channels.keys()
        if unknown or any(self._lacks_schema(one) for one in new):
            more = self._from_summary(unknown, new)
            new = sorted([*more, *new], key=lambda one: isinstance(one, Channel))
            partial |= bool(more)
            unknown -= self.channels.keys()
        good = messages
        if unknown:
            good = [m for m in messages if m[1] not in unknown]
        if not verified:
            good = [m for m in good if self._parses(m)]
        partial |= len(good) < len(messages)
        yield Piece(opcode, offset, size, chunk, tuple(new), good, partial)
        if lost := len(messages) - len(good):
            what = (
                f"a message of channel number {min(unknown)}, which was never announced"
                if unknown
                else "a message without a checksum that is not JSON"
            )
            yield Damage(offset, 0, what, Opcode.MESSAGE, lost)

    def _announce(self, one: Announcement) -> bool:
        """Whether it is new; a number that is announced again keeps its first meaning."""
        known: dict[int, Any] = self.channels if isinstance(one, Channel) else self._schemas
        if one.id in known:
            return False
        known[one.id] = one
        return True

    def _lacks_schema(self, one: Announcement) -> bool:
        return (
            isinstance(one, Channel) and one.schema_id != 0 and one.schema_id not in self._schemas
        )

    def _from_summary(
        self, channels: set[int], announced: list[Announcement]
    ) -> list[Announcement]:
        """What is missing because a damaged chunk had it, from its repetition at the end of the file."""
        schemas, repeated = self._repeated
        found: list[Announcement] = [repeated[i] for i in sorted(channels) if i in repeated]
        wanted = {one.schema_id for one in [*found, *announced] if isinstance(one, Channel)}
        found = [*(schemas[i] for i in sorted(wanted) if i in schemas), *found]
        return [one for one in found if self._announce(one)]

    def _parses(self, message: Message) -> bool:
        if self.channels[message[1]].message_encoding != "json":
            return True
        try:
            msgspec.json.decode(message[5])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return False
        return True

    # -- what is broken -----------------------------------------------------------------------------

    def _misread(self, opcode: int, size: int) -> bool:
        """Whether no record of this kind can be here."""
        if opcode >= PRIVATE:
            return False
        return opcode not in _KNOWN or _SIZES.get(opcode, size) != size

    def _plausible(self, offset: int) -> bool:
        """Whether a record begins here: then only the one before it is broken."""
        try:
            opcode, end = frame(self.data, offset)
        except CutError:
            return False
        return opcode in _KNOWN and not self._misread(opcode, end - offset - FRAME.size)

    def _cut(self, offset: int) -> Iterator[Piece | Damage]:
        """The record in whose middle the file ends; of a chunk its first messages may be there."""
        content = self.data[offset + FRAME.size :]
        opcode = self.data[offset]
        size = len(self.data) - offset
        if opcode == Opcode.CHUNK:
            try:
                announced, messages, _ = split(begun(content))
            except DECODING:
                announced, messages = [], []
            if messages:
                yield from self._taken(opcode, offset, 0, announced, messages, partial=True)
        yield Damage(offset, size, "the record in which the file ends", opcode, None)

    def _indexes(self, offset: int) -> int:
        """The end of the message indexes that begin here; their entries count a damaged chunk's messages.

        There are as many of them as channels in the chunk: together they are one piece.
        """
        data, size, entries = self.data, len(self.data), 0
        while offset + FRAME.size <= size:
            opcode, length = FRAME.unpack_from(data, offset)
            end = offset + FRAME.size + length
            if opcode != Opcode.MESSAGE_INDEX or end > size:
                break
            entries += max(0, length - _INDEX_HEAD) // _INDEX_ENTRY
            offset = end
        if self._waiting is not None:
            self._waiting = dataclasses.replace(self._waiting, messages=entries)
        return offset

    def _settle(self) -> Iterator[Damage]:
        if self._waiting is not None:
            yield self._waiting
            self._waiting = None

    # -- the end of the file ------------------------------------------------------------------------

    def _ending(self, offset: int, *, complete: bool) -> None:
        """What follows the data section: end record, index, end mark."""
        if not complete:
            self.stopped_at = offset
            self.unfinished = f"ends at byte {len(self.data)} without an end record"
            return
        if bytes(self.data[-len(MAGIC) :]) != MAGIC:
            self.unfinished = f"ends at byte {len(self.data)} in the middle of its index"
            return
        wanted = int.from_bytes(self.data[self.stopped_at + FRAME.size :][:4], "little")
        if wanted and zlib.crc32(self.data[: self.stopped_at]) != wanted:
            self.doubts.append(DATA_DOUBT)
        if self._summary_start() is None:
            self.doubts.append("has an index whose checksum does not fit")

    def _summary_start(self) -> int | None:
        """Where schemas and channels are repeated, in a file that was closed properly and has a sound index."""
        at = len(self.data) - _END_SIZE
        if at < len(MAGIC) or bytes(self.data[-len(MAGIC) :]) != MAGIC:
            return None
        opcode, size = FRAME.unpack_from(self.data, at)
        if (opcode, size) != (Opcode.FOOTER, _SIZES[Opcode.FOOTER]):
            return None
        footer = Footer.read(ReadDataStream(BytesIO(self.data[at + FRAME.size :])))
        start = int(footer.summary_start) or at
        if not len(MAGIC) <= start <= at:
            return None
        covered = self.data[start : at + FRAME.size + 16]
        if footer.summary_crc and zlib.crc32(covered) != footer.summary_crc:
            return None
        return start

    @cached_property
    def _repeated(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """Schemas and channels as the end of the file repeats them; empty if that cannot be used.

        Only a damaged file asks for them.
        """
        start = self._summary_start()
        if start is None:
            return {}, {}
        try:
            announced, _, _ = split(self.data[start : len(self.data) - len(MAGIC)])
        except DECODING:
            return {}, {}
        schemas = {one.id: one for one in announced if isinstance(one, Schema)}
        return schemas, {one.id: one for one in announced if isinstance(one, Channel)}
