"""Single records of an MCAP file: framing, decoding, and what is in a chunk.

Under `analysis.mcap_walk`, which goes through a whole file with them. The contents of the records are decoded
by the mcap package.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema

from wire.errors import UsageError

MAGIC = b"\x89MCAP0\r\n"
FRAME = struct.Struct("<BQ")
"""Opcode and length before each record."""
Message = tuple[int, int, int, int, int, memoryview]
"""Offset of its record in the unpacked chunk, channel number, sequence, log time, publish time, payload. A
plain tuple: there are hundreds of thousands."""
LARGEST_CHUNK = 1 << 26
"""Bytes in a chunk; the recorder's have a quarter of a megabyte. A kilobyte of zstd may claim any number, and
unpack to gigabytes."""
Announcement: TypeAlias = Schema | Channel
DECODING = (McapError, UnicodeDecodeError, struct.error, OverflowError, MemoryError)
"""What the functions here raise for a record that cannot be read."""
READ: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_CHUNK_DATA = struct.Struct("<Q")


class CutError(Exception):
    """The data end in the middle of a record."""


def read_bytes(path: Path) -> bytes:
    """The content of an MCAP file. Raises UsageError if it cannot be opened or is none."""
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
    return raw


def frame(data: memoryview, offset: int) -> tuple[int, int]:
    """Opcode and end of the record at `offset`; raises CutError if it is not all there."""
    if offset + FRAME.size > len(data):
        raise CutError
    opcode, length = FRAME.unpack_from(data, offset)
    end = offset + FRAME.size + length
    if end > len(data):
        raise CutError
    return opcode, end


def decoded(opcode: int, content: memoryview) -> Any:
    """The record as the mcap package has it; McapError and others if that cannot be."""
    if opcode == Opcode.ATTACHMENT and zlib.crc32(content[:-4]) != int.from_bytes(
        content[-4:], "little"
    ):
        raise McapError("an attachment whose checksum does not fit")
    value = READ[opcode](ReadDataStream(BytesIO(content)))
    builder = RecordBuilder()
    value.write(builder)
    if (
        builder.end()[FRAME.size :] != content
    ):  # the package takes what is there of a field that is too long
        raise McapError("a record whose lengths contradict each other")
    return value


def message(content: memoryview, offset: int) -> Message:
    """A message's record taken apart; struct.error if it is too short."""
    return (offset, *_MESSAGE.unpack_from(content), content[_MESSAGE.size :])


def split(inside: memoryview) -> tuple[list[Announcement], list[Message], bool]:
    """Schemas and channels, messages, and whether there is a rest that is no whole record."""
    announced: list[Announcement] = []
    messages: list[Message] = []
    offset, size, head = 0, len(inside), FRAME.size
    while offset + head <= size:
        opcode, length = FRAME.unpack_from(inside, offset)
        begin = offset + head
        end = begin + length
        if end > size:
            break
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise McapError("a message that is too short")
            payload = inside[begin + _MESSAGE.size : end]
            messages.append((offset, *_MESSAGE.unpack_from(inside, begin), payload))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            announced.append(decoded(opcode, inside[begin:end]))
        elif opcode == 0:  # millions of zeros would be millions of records
            raise McapError("a record of kind 0, which there is not")
        offset = end
    return announced, messages, offset < size


def chunk_of(content: memoryview) -> Chunk:
    """A chunk's record, its messages still packed; McapError and others if it cannot be read."""
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    if len(content) != _CHUNK_HEAD.size + len(chunk.compression) + 8 + len(chunk.data):
        raise McapError("a chunk whose lengths contradict each other")
    return chunk


def unpacked(chunk: Chunk) -> memoryview:
    """The records in a chunk; McapError if it cannot be unpacked or its checksum does not fit."""
    try:
        inside = _unpack(chunk.compression, chunk.data)
    except Exception as error:  # each compression library has exceptions of its own
        raise McapError(f"a chunk that cannot be unpacked: {error}") from None
    if len(inside) > LARGEST_CHUNK:
        raise McapError(f"a chunk that holds more than {LARGEST_CHUNK} bytes")
    if chunk.uncompressed_crc and zlib.crc32(inside) != chunk.uncompressed_crc:
        raise McapError("a chunk whose checksum does not fit")
    return memoryview(inside)


def _unpack(compression: str, data: bytes | memoryview) -> bytes:
    """The bytes of packed data, up to the limit and one more; what it claims of its size is not believed."""
    most = LARGEST_CHUNK + 1
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            return reader.read(most)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most))
    if compression == "":
        return bytes(data[:most])
    raise McapError(f"compression {compression[:20]!r} is not known")


def begun(content: memoryview) -> memoryview:
    """What can be unpacked of a chunk whose end is missing.

    zstd gives whole blocks only, of up to 128 KiB: nothing of a chunk that is smaller.
    """
    try:
        length = _CHUNK_HEAD.unpack_from(content)[-1]
        at = _CHUNK_HEAD.size + length
        compression = bytes(content[_CHUNK_HEAD.size : at])
        (wanted,) = _CHUNK_DATA.unpack_from(content, at)
        data = content[at + _CHUNK_DATA.size :][:wanted]
        if compression == b"zstd":
            return memoryview(_unpack("zstd", data)[:LARGEST_CHUNK])
    except (struct.error, zstandard.ZstdError):
        return memoryview(b"")
    return data if compression == b"" else memoryview(b"")
