"""Recordings cut or damaged anywhere: recover keeps every whole message, and info tells the same."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from unittest import mock

import in_process
import numpy as np
import pytest
import zstandard
from container import (
    Anatomy,
    Row,
    attachments_of,
    check_container,
    metadata_of,
    rows_by_index,
    rows_in_file_order,
    rows_of_prefix,
)
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from simulated_run import Scenario, write_recording

from analysis.info import info
from analysis.recording import read_recording
from analysis.recover import recover
from wire.errors import UsageError

MAGIC = b"\x89MCAP0\r\n"


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with many small chunks."""
    out = tmp_path_factory.mktemp("run") / "recording.mcap"
    with mock.patch("recorder.writer.CHUNK_BYTES", 6000):
        write_recording(out, Scenario(nodes=2, ticks=12))
    return out


@pytest.fixture(scope="module")
def rows(path: Path) -> list[Row]:
    return rows_in_file_order(path)


def outcome(path: Path, *, thorough: bool = True) -> list[Row] | None:
    """The messages after recovery, by the mcap package; None if recover and info both refuse the file."""
    out = path.with_suffix(".out.mcap")
    out.unlink(missing_ok=True)
    try:
        facts = info(path)
    except UsageError:
        with pytest.raises(UsageError):
            recover(path, out)
        assert not out.exists()
        return None
    json.dumps(facts, allow_nan=False)
    done = recover(path, out)
    assert (done["recovered"] is None) == facts["file"]["closed"]
    found = rows_in_file_order(path if done["recovered"] is None else out)
    assert len(found) == done["kept"]["messages"] == sum(c["messages"] for c in facts["channels"])
    if done["recovered"] is not None and thorough:
        check_container(out)
        assert sorted(rows_by_index(out)) == sorted(found)
        after = info(out)
        assert after["file"]["closed"]
        assert after["file"]["recovered"]["kept_messages"] == str(len(found))
        assert after["duration"] == facts["duration"]
        assert recover(out)["recovered"] is None
    return found


def passes_for_whole(path: Path) -> bool:
    """Whether the file passes for one that was closed properly."""
    try:
        return bool(info(path)["file"]["closed"])
    except UsageError:
        return False


def test_a_file_cut_at_any_record_keeps_what_is_whole(
    path: Path, rows: list[Row], tmp_path: Path
) -> None:
    raw = path.read_bytes()
    records = Anatomy.of(raw).records
    # Of the many indexes after a chunk, and of what comes again and again, a few are enough.
    begins = [at for i, (kind, at, _) in enumerate(records) if i % (24 if kind == 7 else 3) == 0]
    edges = {at + step for at in begins for step in (-1, 0, 1) if at + step > 8}
    random = np.random.default_rng(5).integers(9, len(raw), 15).tolist()
    cut = tmp_path / "cut.mcap"
    first_message = next(at + size for kind, at, size in records if kind == Opcode.CHUNK)
    counts = []
    for number, length in enumerate(sorted({*edges, *random})):
        cut.write_bytes(raw[:length])
        found = outcome(cut, thorough=number % 9 == 0)
        expected = rows_of_prefix(cut)
        if found is None:
            assert not expected
            assert length < first_message
            continue
        assert found == expected == rows[: len(expected)]
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == len(rows)


def test_a_flipped_bit_costs_its_own_chunk_or_what_follows_a_broken_frame(
    path: Path, rows: list[Row], tmp_path: Path
) -> None:
    raw = path.read_bytes()
    anatomy = Anatomy.of(raw)
    inside: list[tuple[int, int, list[Row]]] = []
    taken = 0
    for at, size in anatomy.of_kind(Opcode.CHUNK):
        chunk = Chunk.read(ReadDataStream(BytesIO(raw[at + 9 : at + size])))
        count = sum(isinstance(record, Message) for record in breakup_chunk(chunk))
        inside.append((at, at + size, rows[taken : taken + count]))
        taken += count
    assert taken == len(rows)
    damaged = tmp_path / "damaged.mcap"
    random = np.random.default_rng(23)
    frames = [at + step for _, at, _ in anatomy.records for step in (0, 1, 2)]
    places = [*random.integers(8, len(raw), 70).tolist(), *random.choice(frames, 30).tolist()]
    kept_less = 0
    for number, place in enumerate(places):
        bad = bytearray(raw)
        bad[place] ^= 1 << int(random.integers(8))
        damaged.write_bytes(bad)
        found = outcome(damaged, thorough=number % 4 == 0)
        assert not passes_for_whole(damaged)
        if found is None:  # the format version, or that this is of octarm at all
            assert place < inside[0][0]
            continue
        _, start, size = next(one for one in anatomy.records if one[1] + one[2] > place)
        framing = place < start + 9
        sure = [
            row
            for begin, end, own in inside
            for row in own
            if (end <= start if framing else not begin <= place < end)
        ]
        assert set(found) <= set(rows)
        assert set(sure) <= set(found), (place, start, size)
        kept_less += len(found) < len(rows)
    assert kept_less > 15


def test_lengths_that_cannot_be_are_damage_and_no_error(
    path: Path, rows: list[Row], tmp_path: Path
) -> None:
    """The largest number in place of the bytes of the first lengths in each kind of record: of the record's own
    every one, of those after it every third."""
    raw = path.read_bytes()
    anatomy = Anatomy.of(raw)
    damaged = tmp_path / "damaged.mcap"
    kinds = (Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
    for kind in kinds:
        at, _ = anatomy.of_kind(kind)[0]
        for place in (*range(at + 1, at + 18), *range(at + 18, at + 54, 3)):
            bad = bytearray(raw)
            bad[place] = 0xFF
            damaged.write_bytes(bad)
            found = outcome(damaged, thorough=False)
            if found is not None:
                assert set(found) <= set(rows)


def test_a_damaged_chunk_in_the_middle_is_left_out_and_what_follows_is_kept(
    path: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = bytearray(path.read_bytes())
    chunks = Anatomy.of(bytes(raw)).of_kind(Opcode.CHUNK)
    at, size = chunks[2]
    raw[at + size - 20] ^= 0x10
    damaged = tmp_path / "recording.mcap"
    damaged.write_bytes(raw)
    assert in_process.octarm("info", damaged) == 3
    said = capsys.readouterr().out
    assert f"is damaged at byte {at} (a chunk" in said
    assert in_process.octarm("recover", tmp_path, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    out = tmp_path / "recording.recovered.mcap"
    assert facts["recovered"] == str(out)
    found = rows_in_file_order(out)
    lost = facts["left_out"]["messages"]
    assert facts["left_out"] == {"messages": lost, "records": 1, "bytes": size}
    assert len(found) == len(rows) - lost == facts["kept"]["messages"]
    assert lost > 10
    assert [row for row in rows if row in set(found)] == found
    assert f"({lost} messages)" in said
    check_container(out)
    before = {(one.name, one.data, one.media_type) for one in attachments_of(path)}
    assert {(one.name, one.data, one.media_type) for one in attachments_of(out)} == before
    names = [one.name for one in metadata_of(out)]
    assert names == ["octarm", "summary", "recovered"]
    assert metadata_of(out)[:2] == metadata_of(path)
    record = metadata_of(out)[2].metadata
    assert record["from"] == "recording.mcap"
    assert record["left_out_messages"] == str(lost)
    assert record["kept_messages"] == str(len(found))
    recording = read_recording(out)
    assert recording.unfinished is None
    assert recording.counters is not None
    assert recording.ticks == 12  # NaN where the chunk was
    assert np.isnan(recording.estimates).any()
    assert in_process.octarm("info", out) == 3
    assert (
        f"recovered from recording.mcap, which is damaged at byte {at}" in capsys.readouterr().out
    )


def test_channels_that_only_a_damaged_chunk_announced_come_from_the_end_of_the_file(
    path: Path, rows: list[Row], tmp_path: Path
) -> None:
    raw = bytearray(path.read_bytes())
    (at, size), (second, _), *_ = Anatomy.of(bytes(raw)).of_kind(Opcode.CHUNK)
    raw[at + size - 20] ^= 0x10
    damaged, out = tmp_path / "a.mcap", tmp_path / "b.mcap"
    damaged.write_bytes(raw)
    done = recover(damaged, out)
    lost = done["left_out"]["messages"]
    assert rows_in_file_order(out) == rows[lost:]
    check_container(out)
    assert sum(group["channels"] for group in info(out)["channel_groups"]) == len(
        {row[0] for row in rows[lost:]}
    )
    # Without an end there is nothing that says what the channels are.
    damaged.write_bytes(raw[: second + 3000])
    cut = recover(damaged, out, force=True)
    assert rows_in_file_order(out) == []
    assert cut["kept"]["messages"] == 0
    check_container(out)


def test_a_damaged_attachment_or_index_is_named_and_the_messages_are_kept(
    path: Path, rows: list[Row], tmp_path: Path
) -> None:
    raw = path.read_bytes()
    anatomy = Anatomy.of(raw)
    damaged, out = tmp_path / "a.mcap", tmp_path / "b.mcap"
    for (at, size), what in (
        (anatomy.of_kind(Opcode.ATTACHMENT)[0], "an attachment whose checksum does not fit"),
        (anatomy.of_kind(Opcode.STATISTICS)[0], "has an index whose checksum does not fit"),
    ):
        bad = bytearray(raw)
        bad[at + size - 30] ^= 1
        damaged.write_bytes(bad)
        assert what in str(info(damaged)["file"]["stops"])
        recover(damaged, out, force=True)
        assert rows_in_file_order(out) == rows
        check_container(out)
    # The index was made anew, nothing is missing; without the gains something is.
    assert info(out)["whole"] is True
    assert len(attachments_of(out)) == 2
    facts = info(damaged)
    assert facts["file"]["lost_messages"] == facts["file"]["lost_bytes"] == 0


# -- files made by hand -------------------------------------------------------------------------------


def frame(record: object) -> bytes:
    builder = RecordBuilder()
    record.write(builder)  # type: ignore[attr-defined]
    return bytes(builder.end())


def chunk(content: bytes, compression: str = "zstd", *, checksum: bool = True) -> bytes:
    packed = zstandard.compress(content) if compression == "zstd" else content
    return frame(
        Chunk(
            compression=compression,
            data=packed,
            message_start_time=0,
            message_end_time=0,
            uncompressed_crc=zlib.crc32(content) if checksum else 0,
            uncompressed_size=len(content),
        )
    )


def head(schema: int = 7, channels: Sequence[int] = (300,)) -> bytes:
    out = frame(Schema(id=schema, name="S", encoding="jsonschema", data=b"{}"))
    for number in channels:
        one = Channel(
            id=number, topic=f"/t/{number}", message_encoding="json", schema_id=schema, metadata={}
        )
        out += frame(one)
    return out


def messages(numbers: Sequence[int], channel: int = 300, size: int = 2) -> bytes:
    return b"".join(
        frame(
            Message(
                channel_id=channel,
                sequence=1000 + k,
                log_time=10 * k,
                publish_time=10 * k + 1,
                data=b'"' + bytes(np.random.default_rng(k).integers(97, 122, size).tolist()) + b'"',
            )
        )
        for k in numbers
    )


def file_of(tmp_path: Path, *records: bytes) -> Path:
    out = tmp_path / "made.mcap"
    octarm = frame(Metadata(name="octarm", metadata={"format_version": "4", "run": "{}"}))
    out.write_bytes(
        MAGIC + frame(Header(profile="", library="octarm")) + octarm + b"".join(records)
    )
    return out


def recovered(path: Path) -> list[Row]:
    out = path.with_suffix(".out.mcap")
    recover(path, out, force=True)
    check_container(out)
    return rows_in_file_order(out)


def test_numbers_names_times_and_sequences_are_kept(tmp_path: Path) -> None:
    path = file_of(
        tmp_path,
        chunk(head(channels=(300, 4)) + messages(range(3))),
        chunk(messages(range(3, 5), 4)),
    )
    found = recovered(path)
    assert [row[:5] for row in found] == [
        (300, "/t/300", 1000, 0, 1),
        (300, "/t/300", 1001, 10, 11),
        (300, "/t/300", 1002, 20, 21),
        (4, "/t/4", 1003, 30, 31),
        (4, "/t/4", 1004, 40, 41),
    ]


def test_a_message_of_an_unannounced_channel_is_left_out_alone(tmp_path: Path) -> None:
    inside = head() + messages([0, 1]) + messages([2], channel=9) + messages([3])
    path = file_of(tmp_path, chunk(inside), chunk(messages([4])))
    assert [row[2] for row in recovered(path)] == [1000, 1001, 1003, 1004]
    facts = info(path)
    assert facts["file"]["lost_messages"] == 1
    assert "channel number 9, which was never announced" in str(facts["file"]["damages"])
    assert "configuration cannot be read" in facts["notes"][0]


@pytest.mark.parametrize("compression", ["zstd", ""])
def test_whole_messages_are_taken_out_of_the_chunk_in_which_the_file_ends(
    tmp_path: Path, compression: str
) -> None:
    """Of zstd there is something from 128 KiB on; what is there is taken only if it parses."""
    content = head() + messages(range(60), size=10_000)
    whole = chunk(content, compression)
    for share in (0.3, 0.6, 0.9):
        path = file_of(tmp_path, whole[: int(share * len(whole))])
        found = recovered(path)
        assert [row[2] for row in found] == list(range(1000, 1000 + len(found)))
        assert 0 < len(found) <= 60 * share
        assert len(found) > 60 * share - (14 if compression else 2)
        assert all(json.loads(row[5]) for row in found)
        assert read_prefix(path) == 0


def read_prefix(path: Path) -> int:
    """Messages that the reader of analysis.mcap_file, which trusts checksums only, finds."""
    from analysis.mcap_file import read_mcap

    content = read_mcap(path)
    assert content.unfinished is not None
    return sum(map(len, content.payloads.values()))


def test_a_message_without_a_checksum_is_kept_if_it_parses(tmp_path: Path) -> None:
    broken = frame(Message(channel_id=300, sequence=5, log_time=1, publish_time=1, data=b'{"a'))
    path = file_of(tmp_path, chunk(head() + messages([0]) + broken + messages([1]), checksum=False))
    assert [row[2] for row in recovered(path)] == [1000, 1001]
    assert "without a checksum that is not JSON" in str(info(path)["file"]["damages"])


def test_broken_framing_ends_the_copy(tmp_path: Path) -> None:
    good = [chunk(head() + messages([0])), chunk(messages([1])), chunk(messages([2]))]
    wrong_length = struct.pack("<BQ", 6, 2**50) + good[1][9:]
    path = file_of(tmp_path, good[0], wrong_length, good[2])
    # The chunk itself is there; where the next record begins nobody knows.
    assert [row[2] for row in recovered(path)] == [1000, 1001]
    wrong_kind = b"\x00" + good[1][1:]
    path = file_of(tmp_path, good[0], wrong_kind, good[2])
    assert [row[2] for row in recovered(path)] == [1000, 1002]  # its length is right
    assert "a record of unknown kind 0" in str(info(path)["file"]["stops"])
    path = file_of(tmp_path, good[0], struct.pack("<BQ", 0, 3), b"\x99" * 40)
    assert [row[2] for row in recovered(path)] == [1000]


def test_a_chunk_turned_into_an_end_record_does_not_end_the_file(
    path: Path, tmp_path: Path
) -> None:
    """One bit makes a chunk a footer, or a message index an end record."""
    raw = path.read_bytes()
    anatomy = Anatomy.of(raw)
    damaged = tmp_path / "a.mcap"
    for kind, other in ((Opcode.CHUNK, Opcode.FOOTER), (Opcode.MESSAGE_INDEX, Opcode.DATA_END)):
        at, _ = anatomy.of_kind(kind)[1]
        bad = bytearray(raw)
        bad[at] = other
        damaged.write_bytes(bad)
        assert info(damaged)["whole"] is False
        lost = recover(damaged, tmp_path / "b.mcap", force=True)
        later = rows_in_file_order(tmp_path / "b.mcap")
        assert later[-1] == rows_in_file_order(path)[-1]
        assert lost["left_out"]["records"] == 1


# -- the verb -----------------------------------------------------------------------------------------


def test_a_recording_that_was_closed_properly_is_left_alone(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "recording.mcap"
    shutil.copy(path, copy)
    assert in_process.octarm("recover", copy) == 0
    assert "closed properly" in capsys.readouterr().out
    assert in_process.octarm("recover", copy, "--json") == 0
    assert json.loads(capsys.readouterr().out)["recovered"] is None
    assert list(tmp_path.iterdir()) == [copy]


def test_nothing_is_written_over_unasked(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(path.read_bytes()[:-400])
    out.write_text("mine")
    for target, culprit in (
        (out, "exists already"),
        (cut, "the recording itself"),
        (tmp_path, "is a directory"),
        (tmp_path / "none" / "a.mcap", "No such file"),
    ):
        assert in_process.octarm("recover", cut, "--out", target) == 2
        assert culprit in capsys.readouterr().err
    assert in_process.octarm("recover", cut, "--out", cut, "--force") == 2
    assert out.read_text() == "mine"
    assert in_process.octarm("recover", cut, "--out", out, "--force") == 0
    assert check_container(out).message_count == len(rows_in_file_order(path))
    assert sorted(one.name for one in tmp_path.iterdir()) == ["cut.mcap", "out.mcap"]


def other_program(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/camera", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()


def other_version(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="octarm")
        writer.add_metadata("octarm", {"format_version": "99"})
        writer.finish()


@pytest.mark.parametrize(
    ("make", "culprit"),
    [
        (lambda path: path.write_bytes(b""), "expected an MCAP file, got 0 bytes"),
        (lambda path: path.mkdir(), "No such file"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(90)), "expected an MCAP file"),
        (lambda path: path.write_bytes(MAGIC), "the run did not begin"),
        (lambda path: path.write_bytes(MAGIC + b"\x01\x00"), "the run did not begin"),
        (other_program, "not of octarm (its topics: /camera)"),
        (other_version, "expected format version 3, 4 or 5, got 99"),
        (lambda path: None, "No such file"),
    ],
)
@pytest.mark.parametrize("verb", ["info", "recover"])
def test_what_is_no_recording_is_refused(
    verb: str, make: object, culprit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    make(path)  # type: ignore[operator]
    before = set(tmp_path.rglob("*"))
    assert in_process.octarm(verb, path) == 2
    out, err = capsys.readouterr()
    assert (out, "Traceback" in err, culprit in err, "a.mcap" in err) == ("", False, True, True)
    assert set(tmp_path.rglob("*")) == before


def test_footer_record_of_the_copy_says_where_its_index_is(path: Path, tmp_path: Path) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(path.read_bytes()[:-400])
    recover(cut, out)
    raw = out.read_bytes()
    anatomy = Anatomy.of(raw)
    ((at, size),) = anatomy.of_kind(Opcode.FOOTER)
    footer = Footer.read(ReadDataStream(BytesIO(raw[at + 9 : at + size])))
    ((end, length),) = anatomy.of_kind(Opcode.DATA_END)
    assert footer.summary_start == end + length
    assert footer.summary_offset_start == anatomy.of_kind(Opcode.SUMMARY_OFFSET)[0][0]
    assert footer.summary_crc == zlib.crc32(raw[footer.summary_start : at + 9 + 16])
    assert int.from_bytes(raw[end + 9 : end + 13], "little") == zlib.crc32(raw[:end])
