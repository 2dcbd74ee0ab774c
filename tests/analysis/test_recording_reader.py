"""Reading recordings: finished, cut short anywhere, damaged, foreign, of another version."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from simulated_run import Scenario, write_recording

from analysis.recording import read_recording
from analysis.summary import summarise
from analysis.table import decode_table
from wire.channels import METADATA
from wire.errors import GainsRefusedError, OctarmError, UsageError

SCENARIO = Scenario(nodes=3, ticks=150)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(path, SCENARIO)
    return path


def test_a_finished_recording_gives_the_arrays_that_the_mcap_reader_gives(finished: Path) -> None:
    recording = read_recording(finished)
    assert recording.unfinished is None
    assert recording.counters is not None
    assert (recording.nodes, recording.ticks, recording.tick_s) == (3, 150, 0.1)
    expected = np.full((150, 3, 2), np.nan)
    with finished.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic.endswith("/measurement"):
                row = json.loads(message.data)
                values = [row["velocity_y_m_per_s"], row["curvature_per_m"]]
                expected[row["tick"], int(channel.topic.split("/")[2])] = values
    assert np.array_equal(recording.measurements, expected)
    assert recording.estimates.shape == (150, 3, 4)
    assert recording.commands.shape == (150, 3)
    assert recording.truth.shape == (150, 3, 4)
    assert recording.shapes_m.shape == (150, 33, 2)
    assert np.array_equal(recording.estimates[0], recording.initial_estimates)
    assert recording.times_s[-1] == pytest.approx(14.9)
    for array in (recording.estimates, recording.commands, recording.truth, recording.tip_error_m):
        assert np.isfinite(array).all()


def test_the_root_of_the_arm_does_not_move_and_the_tip_is_where_tip_says(finished: Path) -> None:
    recording = read_recording(finished)
    assert np.abs(recording.shapes_m[:, 0]).max() < 1e-12
    tips = recording.of_plant("tip", ("x_m", "y_m"))
    assert np.abs(recording.shapes_m[:, -1] - tips).max() < 1e-9


@pytest.mark.parametrize("share", [0.35, 0.5, 0.8, 0.97])
def test_a_recording_cut_short_is_read_up_to_there(
    finished: Path, tmp_path: Path, share: float
) -> None:
    raw = finished.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(raw[: int(share * len(raw))])
    whole, cut = read_recording(finished), read_recording(path)
    assert cut.unfinished is not None
    assert 0 < cut.ticks <= whole.ticks
    assert np.array_equal(cut.estimates, whole.estimates[: cut.ticks])
    summary = summarise(path)
    assert summary["recording_complete"] is False
    assert summary["ticks"] == cut.ticks
    assert summary["max_difference_to_central"] < 1e-12


def test_a_recorder_that_was_killed_leaves_what_it_had_flushed(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    write_recording(path, Scenario(nodes=2, ticks=20), close=False)
    summary = summarise(path)
    assert summary["ticks"] == 20
    assert summary["neighbour_messages"] is None
    assert summary["recording_complete"] is False
    assert "without an end record" in summary["recording_stops"]


def outcome(path: Path) -> str:
    """How the reading went; anything but an OctarmError is let through."""
    try:
        unfinished = read_recording(path).unfinished
    except OctarmError as error:
        return str(error)
    return "whole" if unfinished is None else f"{path} unfinished: {unfinished}"


def test_a_recording_cut_anywhere_gives_a_result_or_one_clear_refusal(
    finished: Path, tmp_path: Path
) -> None:
    raw = finished.read_bytes()
    path = tmp_path / "cut.mcap"
    for length in [*range(0, 400, 7), *range(400, len(raw), len(raw) // 40)]:
        path.write_bytes(raw[:length])
        assert "unfinished: " in outcome(path) or f"recording {path}: " in outcome(path)


def test_a_flipped_byte_anywhere_is_named_or_harmless(finished: Path, tmp_path: Path) -> None:
    raw = bytearray(finished.read_bytes())
    path = tmp_path / "damaged.mcap"
    random = np.random.default_rng(11)
    for place in random.integers(0, len(raw), 40):
        raw[place] ^= 0x20
        path.write_bytes(raw)
        raw[place] ^= 0x20
        assert outcome(path) == "whole" or str(path) in outcome(path)


def test_lost_rows_become_nan_and_do_not_count_as_differences(tmp_path: Path) -> None:
    path = tmp_path / "gaps.mcap"
    skip = frozenset({(30, 1), (31, 1), (40, 2)})
    write_recording(path, Scenario(nodes=3, ticks=60), skip=skip)
    recording = read_recording(path)
    assert recording.ticks == 60
    missing = np.argwhere(np.isnan(recording.commands)).tolist()
    assert missing == [[30, 1], [31, 1], [40, 2]]
    summary = summarise(path)
    assert summary["max_difference_to_central"] < 1e-12
    assert summary["difference_to_central"]["ticks_compared"] == 31
    assert summary["difference_to_central"]["values_missing"] == 5
    json.dumps(summary, allow_nan=False)


def rewrite(source: Path, target: Path, changes: dict[str, str | None]) -> None:
    """The head of a recording with some of its metadata changed or left out."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out)
        writer.start()
        for record in reader.iter_metadata():
            if record.name == METADATA:
                facts = record.metadata | changes
                writer.add_metadata(METADATA, {k: v for k, v in facts.items() if v is not None})
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        writer.finish()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": "99"}, "expected format version 3, 4 or 5, got 99"),
        ({"format_version": None}, "expected format version 3, 4 or 5, got none"),
        ({"run": None}, "no run configuration"),
        ({"run": "{"}, "run configuration: not JSON"),
        ({"run": '{"nodes": 3}'}, "run configuration: artefact_path is missing"),
    ],
)
def test_what_this_version_cannot_read_is_refused(
    finished: Path, tmp_path: Path, changes: dict[str, str | None], message: str
) -> None:
    rewrite(finished, tmp_path / "other.mcap", changes)
    with pytest.raises(UsageError, match=message):
        read_recording(tmp_path / "other.mcap")


def test_a_recording_without_a_tick_has_no_summary(finished: Path, tmp_path: Path) -> None:
    rewrite(finished, tmp_path / "head.mcap", {})
    assert read_recording(tmp_path / "head.mcap").ticks == 0
    with pytest.raises(UsageError, match="no tick that all nodes"):
        summarise(tmp_path / "head.mcap")


def test_an_mcap_file_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/camera", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    with pytest.raises(UsageError, match=r"not of octarm \(its topics: /camera\)"):
        read_recording(path)


def test_a_damaged_artefact_is_named_with_the_recording(finished: Path, tmp_path: Path) -> None:
    with finished.open("rb") as stream:
        reader = make_reader(stream)
        facts = next(r.metadata for r in reader.iter_metadata() if r.name == METADATA)
        gains = next(a.data for a in reader.iter_attachments() if b"octarm-gains" in a.data[:99])
    for data, error, message in (
        (gains.replace(b"0.02", b"0.03", 1), GainsRefusedError, "was damaged or edited"),
        (b"{}", UsageError, "expected the gains artefact attached, found gains.json"),
    ):
        path = tmp_path / "edited.mcap"
        with path.open("wb") as out:
            writer = Writer(out)
            writer.start()
            writer.add_metadata(METADATA, facts)
            writer.add_attachment(0, 0, "gains.json", "application/json", data)
            writer.finish()
        with pytest.raises(error, match=message) as caught:
            read_recording(path)
        assert str(path) in str(caught.value)


def test_tables_name_the_message_that_is_wrong() -> None:
    good = b'{"tick":0,"a":1.5}'
    with pytest.raises(UsageError, match=r"/x, message 1: expected a JSON object"):
        decode_table("/x", [good, b"{"])
    with pytest.raises(UsageError, match=r"/x, message 1: expected a JSON object"):
        decode_table("/x", [good, b"[]"])
    with pytest.raises(UsageError, match=r"message 1: expected the fields tick, a, got tick, b"):
        decode_table("/x", [good, b'{"tick":1,"b":2}'])
    table = decode_table("/x", [b'{"tick":2,"a":null,"t":"x"}', b'{"tick":1,"a":3,"t":"y"}'])
    assert table.by_tick(("a",), 3)[1, 0] == 3.0
    assert np.isnan(table.by_tick(("a",), 3)[[0, 2], 0]).all()
    with pytest.raises(UsageError, match=r"/x has no field 'b'; it has: tick, a"):
        table.column("b")
    with pytest.raises(UsageError, match="not numbers"):
        table.numbers("t")


def test_wall_clock_nanoseconds_keep_every_digit() -> None:
    instant = 2**60 + 1
    table = decode_table("/x", [b'{"tick":0,"at_wall_ns":%d}' % instant])
    assert int(table.column("at_wall_ns")[0]) == instant


def test_lists_of_equal_length_stay_one_value_a_message() -> None:
    table = decode_table("/x", [b'{"tick":0,"parts":[{"a":1},{}]}', b'{"tick":1,"parts":[{},{}]}'])
    assert (table.rows, table.column("parts").shape) == (2, (2,))
    assert table.column("parts").tolist() == [[{"a": 1}, {}], [{}, {}]]
    assert decode_table("/y", [b'{"entities":[]}']).rows == 1  # others' channels have no tick


def test_a_copy_elsewhere_is_enough(finished: Path, tmp_path: Path) -> None:
    shutil.copy(finished, tmp_path / "alone.mcap")
    assert read_recording(tmp_path / "alone.mcap").artefact.arm.name == "test"
