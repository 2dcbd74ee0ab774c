"""The record splitter against the mcap package's own writer, whole files and files cut short."""

from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from analysis.mcap_file import read_mcap
from wire.errors import UsageError


def write_file(
    path: Path, compression: CompressionType, chunk_size: int = 400, *, chunked: bool = True
) -> None:
    with path.open("wb") as stream:
        writer = Writer(
            stream, chunk_size=chunk_size, compression=compression, use_chunking=chunked
        )
        writer.start(profile="", library="test")
        writer.add_metadata("facts", {"answer": "42"})
        writer.add_attachment(0, 0, "note.txt", "text/plain", b"read me")
        schema = writer.register_schema("S", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        for k in range(60):
            for channel in channels:
                writer.add_message(channel, k * 10, b'{"k":%d}' % k, k * 10)
        writer.add_metadata("facts", {"answer": "43"})
        writer.finish()


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_everything_is_read_back(
    tmp_path: Path, compression: CompressionType, chunked: bool
) -> None:
    write_file(tmp_path / "a.mcap", compression, chunked=chunked)
    content = read_mcap(tmp_path / "a.mcap")
    assert content.unfinished is None
    assert content.metadata == {"facts": {"answer": "43"}}
    assert content.attachments == {"note.txt": b"read me"}
    expected = [b'{"k":%d}' % k for k in range(60)]
    assert content.payloads == {"/a": expected, "/b": expected}
    assert content.log_times_ns["/b"] == [10 * k for k in range(60)]


def test_a_file_cut_anywhere_gives_a_prefix_and_says_so(tmp_path: Path) -> None:
    whole_path, cut_path = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    write_file(whole_path, CompressionType.ZSTD)
    raw = whole_path.read_bytes()
    whole = read_mcap(whole_path).payloads["/a"]
    counts = []
    for length in [*range(8, len(raw), 7), *range(len(raw) - 60, len(raw))]:
        cut_path.write_bytes(raw[:length])
        content = read_mcap(cut_path)
        assert content.unfinished is not None, length
        got = content.payloads.get("/a", [])
        assert got == whole[: len(got)]
        counts.append(len(got))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == len(whole)


def test_a_damaged_chunk_ends_the_reading_and_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_file(path, CompressionType.NONE)
    raw = bytearray(path.read_bytes())
    place = raw.index(b'{"k":30}')
    raw[place + 5] ^= 1
    path.write_bytes(raw)
    content = read_mcap(path)
    assert content.unfinished is not None
    assert "is damaged at byte" in content.unfinished
    assert 0 < len(content.payloads["/a"]) <= 30
    assert content.payloads["/a"] == [b'{"k":%d}' % k for k in range(len(content.payloads["/a"]))]


def test_a_damaged_attachment_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_file(path, CompressionType.NONE)
    raw = path.read_bytes().replace(b"read me", b"reed me")
    path.write_bytes(raw)
    assert "an attachment whose checksum" in str(read_mcap(path).unfinished)


@pytest.mark.parametrize("raw", [b"", b"\x89MCAP0\r", b"hello, I am a text file", b"\x00" * 64])
def test_what_is_not_mcap_is_refused(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(raw)
    with pytest.raises(UsageError, match="expected an MCAP file"):
        read_mcap(path)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.mcap: No such file"):
        read_mcap(tmp_path / "none.mcap")
    with pytest.raises(UsageError, match="Is a directory"):
        read_mcap(tmp_path)
