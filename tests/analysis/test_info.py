"""What octarm info says of a recording, against counts by the mcap package's own reader."""

from __future__ import annotations

import json
import re
import zlib
from collections import Counter
from pathlib import Path
from typing import Any

import in_process
import numpy as np
import pytest
from altered import alter
from container import Anatomy, check_container
from degraded_run import Faults, write_degraded
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from simulated_run import Scenario, write_recording

from analysis.info import channel_groups, info
from analysis.info_table import MOST_EVENTS, info_table
from analysis.recording import read_recording
from analysis.recover import recover
from wire.channels import Health
from wire.errors import UsageError

DATA = Path(__file__).parents[1] / "data"
SCENARIO = Scenario(nodes=3, ticks=60, late=frozenset({20, 21, 40}))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(out, SCENARIO, skip=frozenset({(30, 1)}))
    return out


@pytest.fixture(scope="module")
def facts(path: Path) -> dict[str, Any]:
    return info(path)


def test_channels_are_counted_as_the_package_counts_them(path: Path, facts: dict[str, Any]) -> None:
    counts: Counter[str] = Counter()
    payload: Counter[str] = Counter()
    named = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            counts[channel.topic] += 1
            payload[channel.topic] += len(message.data)
            named[channel.topic] = (schema.name, schema.encoding, channel.message_encoding)
    found = {one["topic"]: one for one in facts["channels"] if one["messages"]}
    assert {topic: one["messages"] for topic, one in found.items()} == dict(counts)
    assert {topic: one["payload_bytes"] for topic, one in found.items()} == dict(payload)
    for topic, one in found.items():
        assert (one["schema"], one["schema_encoding"], one["encoding"]) == named[topic]
        assert one["hz"] == pytest.approx(counts[topic] / 6.0)
    assert sum(one["share"] for one in found.values()) == pytest.approx(1.0)
    assert found["/node/01/estimate"]["messages"] == 60 - 3 - 1
    assert found["/plant/tip"]["messages_per_tick"] == 1.0


def test_groups_put_the_nodes_together(facts: dict[str, Any]) -> None:
    groups = {one["topic"]: one for one in facts["channel_groups"]}
    assert groups["/node/NN/estimate"]["channels"] == 3
    assert groups["/node/NN/forward_sum"]["channels"] == 2
    assert groups["/plant/truth/NN"]["channels"] == 3
    assert groups["/plant/truth/NN"]["hz"] == pytest.approx(10.0)
    assert groups["/plant/truth/NN"]["messages_per_tick"] == pytest.approx(3.0)
    for name in ("messages", "payload_bytes"):
        assert sum(g[name] for g in groups.values()) == sum(c[name] for c in facts["channels"])
    assert channel_groups([]) == []


def test_the_json_lines_are_exactly_as_long_as_if_written(
    path: Path, facts: dict[str, Any], tmp_path: Path
) -> None:
    lines = tmp_path / "lines.jsonl"
    with path.open("rb") as stream, lines.open("w") as out:
        for _, channel, message in make_reader(stream).iter_messages():
            line = {
                "topic": channel.topic,
                "log_time": message.log_time,
                "message": json.loads(message.data),
            }
            text = json.dumps(line, separators=(",", ":"))
            # Of numbers there are several spellings: the recorded one counts.
            head = text[: text.index('"message":') + len('"message":')]
            out.write(head + message.data.decode() + "}\n")
    assert facts["size"]["json_lines_bytes"] == lines.stat().st_size
    ratio = lines.stat().st_size / path.stat().st_size
    assert facts["size"]["json_lines_ratio"] == pytest.approx(ratio)


def test_bytes_by_kind_of_record_add_up_to_the_file(path: Path, facts: dict[str, Any]) -> None:
    raw = path.read_bytes()
    anatomy = Anatomy.of(raw)
    size = facts["size"]
    kinds = size["by_record"]

    def total(kind: int) -> int:
        return sum(length for _, length in anatomy.of_kind(kind))

    assert sum(kinds.values()) == size["bytes"] == len(raw)
    assert kinds["chunks"] == total(Opcode.CHUNK)
    assert kinds["message_index"] == total(Opcode.MESSAGE_INDEX)
    assert kinds["attachments"] == total(Opcode.ATTACHMENT)
    assert kinds["metadata"] == total(Opcode.METADATA)
    assert kinds["summary"] == len(raw) - anatomy.of_kind(Opcode.DATA_END)[0][0]
    assert kinds["other"] == 8 + total(Opcode.HEADER)
    assert size["chunks"] == size["compressions"]["zstd"] == len(anatomy.of_kind(Opcode.CHUNK))
    assert size["bytes_per_tick"]["chunks"] == pytest.approx(kinds["chunks"] / 60)
    assert size["bytes_per_tick"]["file"] == pytest.approx(len(raw) / 60)


def test_a_bridged_sum_has_no_latency_and_health_is_counted(tmp_path: Path) -> None:
    path, other = tmp_path / "recording.mcap", tmp_path / "other.mcap"
    faults = Faults(cut=frozenset({(30, 2, "forward")}), dies=((0, 10, 14),), passive_from=35)
    write_degraded(path, Scenario(nodes=4, ticks=40), faults)
    for tick, longest_ms in ((30, 0.0), (25, 1e3)):  # the sum of tick 25 did come
        field = "forward_received_wall_ns"
        topic = "/node/02/timing"
        alter(path, other, topic=topic, tick=tick, field=field, change=lambda _: 1e9 + 7.0)
        links = {(x["from"], x["to"]): x["latency_ms"] for x in info(other)["links"]["links"]}
        assert links[1, 2]["max"] == pytest.approx(longest_ms)
    recording = read_recording(path)
    swept = ~recording.late
    assert info(path)["health"] == {
        "node_ticks": 35 * 4,
        "alive": int((recording.health_says(Health.ALIVE)[swept]).sum()),
        "on_time": int((recording.health_says(Health.ON_TIME)[swept]).sum()),
        "valid": 35 * 4,
        "bridged_sums": int(
            np.count_nonzero(recording.flags & 1) + np.count_nonzero(recording.flags & 2)
        ),
        "commands_held": int(np.count_nonzero(recording.flags & 4)),
        "replaced": {"0": 1},
        "passive_from_tick": 35,
        "passive_ticks": 5,
    }
    assert info(path)["health"]["alive"] == 35 * 4 - 4


def test_run_duration_losses_and_events(facts: dict[str, Any]) -> None:
    assert facts["whole"] is True
    assert facts["format_version"] == "5"
    duration = facts["duration"]
    assert (duration["ticks"], duration["ticks_asked_for"]) == (60, 60)
    assert duration["arm_s"] == pytest.approx(6.0)
    assert duration["wall_s"] == pytest.approx(59e-3, abs=5e-3)  # the simulated clock: 1 ms a tick
    assert facts["losses"] == {"late_ticks": 3, "rows_lost": 0}
    assert facts["run"]["realtime"] is True
    assert facts["ended"] == "finished"
    assert facts["events"] == [
        {
            "tick": 60,
            "time_s": 6.0,
            "level": "info",
            "name": "finished",
            "message": "every tick was done",
        }
    ]
    assert [one["name"] for one in facts["attachments"]] == ["gains.json", "nodes.json"]
    assert facts["notes"] == []
    json.dumps(facts, allow_nan=False)


def test_messages_and_processes_are_the_counters(facts: dict[str, Any]) -> None:
    messages = facts["messages"]
    assert messages["forward"]["messages"] == messages["backward"]["messages"] == 2 * 57
    assert messages["forward"]["per_tick"] == 2.0
    assert messages["forward"]["bytes"] == 2 * 57 * 71
    processes = {one["process"]: one for one in facts["processes"]}
    assert processes["node/01"]["segments"] == [1, 1]
    assert processes["node/01"]["received_messages"] == 2 * 57
    assert processes["node/01"]["sent_bytes"] == 2 * 57 * 71
    # The simulation has no counters of plant and recorder: as of processes that died.
    assert processes["plant"]["reported"] is False
    assert processes["recorder"]["received_messages"] is None
    assert "no final counters of plant, recorder" in info_table(facts)


def test_sweep_percentiles_leave_out_ticks_in_which_none_ended(
    path: Path, facts: dict[str, Any]
) -> None:
    durations = []
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=["/sweep/timing"]):
            durations.append(json.loads(message.data)["duration_wall_ns"])
    ended = np.array([d for d in durations if d > 0])
    assert 0 < ended.size < len(durations)
    for name, share in (("p50", 50), ("p90", 90), ("p99", 99), ("p99.9", 99.9), ("max", 100)):
        assert facts["sweep_ms"][name] == pytest.approx(1e-6 * np.percentile(ended, share))


def test_a_recording_of_version_3_is_read() -> None:
    """The totals are what the octarm that wrote it printed."""
    facts = info(DATA / "recording_v3.mcap")
    assert facts["format_version"] == "3"
    assert facts["whole"] is True
    assert facts["duration"]["ticks"] == 12
    assert (
        facts["messages"]["forward"]["messages"] + facts["messages"]["backward"]["messages"] == 48
    )
    assert all(one["reported"] for one in facts["processes"])
    assert facts["links"]["measured"] == 4
    assert check_container(DATA / "recording_v3.mcap").message_count == 338


def test_a_file_that_was_cut_says_where_and_how_much_is_there(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = path.read_bytes()
    cut = tmp_path / "recording.mcap"
    cut.write_bytes(raw[: int(0.6 * len(raw))])
    assert in_process.octarm("info", tmp_path) == 3
    out = " ".join(capsys.readouterr().out.split())
    assert "NOT WHOLE: it ends in the middle of a record at byte" in out
    assert "octarm recover" in out
    assert "messages: unknown" in out
    assert "no final counters of any of them" in out
    facts = info(cut)
    assert 0 < facts["duration"]["ticks"] < 60
    assert facts["file"]["stopped_at"] < len(raw)
    assert facts["messages"] is None
    assert facts["links"]["measured"] == 4
    assert facts["file"]["lost_messages"] is None


def test_a_file_cut_in_its_first_kilobytes_says_what_is_there(path: Path, tmp_path: Path) -> None:
    raw = path.read_bytes()
    (first, size), *_ = Anatomy.of(raw).of_kind(Opcode.METADATA)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(raw[: first + size + 100])
    facts = info(cut)
    assert facts["run"]["nodes"] == 3
    assert facts["duration"]["ticks"] == 0
    assert facts["attachments"] == facts["channels"] == facts["events"] == []
    assert facts["size"]["json_lines_bytes"] == 0
    text = info_table(facts)
    assert "no channels: the file stops before the first message" in text
    assert "latencies: none were recorded" in text
    cut.write_bytes(raw[: first + size - 1])
    with pytest.raises(UsageError, match="the run did not begin"):
        info(cut)


def rewrite(source: Path, target: Path, facts: dict[str, str], events: list[bytes]) -> None:
    """A recording with these metadata and events."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, compression=CompressionType.NONE)
        writer.start(library="octarm")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, {**record.metadata, **facts})
        schema = writer.register_schema("foxglove.Log", "jsonschema", b"{}")
        channel = writer.register_channel("/event", "json", schema)
        for event in events:
            writer.add_message(channel, 0, event, 0)
        writer.finish()


def test_events_as_log_messages_and_metadata_as_json(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    event = {
        "tick": 3,
        "time_s": 0.3,
        "timestamp": {"sec": 0, "nsec": 300},
        "level": 3,
        "name": "late",
        "message": "the sweep was not over",
        "file": "",
        "line": 0,
    }
    machine = {"processor": "x86_64", "cores": 2}
    rewrite(
        path,
        other,
        {"machine": json.dumps(machine), "git_revision": "abc123", "hosts": "nonsense"},
        [json.dumps(event).encode(), b"[]", b"\xff"],
    )
    facts = info(other)
    assert facts["events"] == [
        {
            "tick": 3,
            "time_s": pytest.approx(0.3),
            "level": "warning",
            "name": "late",
            "message": "the sweep was not over",
        }
    ]
    assert facts["run"]["machine"] == machine
    assert [note.split(":")[0] for note in facts["notes"]] == [
        "an event cannot be read",
        "an event cannot be read",
        "the hosts in the metadata cannot be read",
    ]
    text = info_table(facts)
    assert "machine     processor x86_64, cores 2" in text
    assert "commit abc123" in text


def test_many_events_are_folded_unless_asked_for(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    events = [
        json.dumps({"tick": k, "level": 2, "name": "late", "message": f"no. {k}"}).encode()
        for k in range(40)
    ]
    rewrite(path, other, {}, events)
    facts = info(other)
    assert len(facts["events"]) == 40
    assert f"{40 - MOST_EVENTS} more, --all shows them" in info_table(facts)
    assert "no. 20" not in info_table(facts)
    assert "no. 20" in info_table(facts, every=True)


def test_damaged_metadata_leave_what_the_file_itself_says(path: Path, tmp_path: Path) -> None:
    """The record's own lengths are wrong: neither version nor configuration are known, messages are there."""
    raw = bytearray(path.read_bytes())
    at, _ = Anatomy.of(bytes(raw)).of_kind(Opcode.METADATA)[0]
    raw[at + 9 + 4 + len("octarm")] ^= 0xFF
    damaged = tmp_path / "a.mcap"
    damaged.write_bytes(raw)
    facts = info(damaged)
    assert facts["format_version"] is None
    assert facts["duration"]["ticks"] is None
    assert sum(one["messages"] for one in facts["channels"]) == check_container(path).message_count
    assert "configuration is not in the file" in facts["notes"][0]
    text = info_table(facts, every=True)
    assert "format unknown" in text
    assert "unknown without the run's configuration" in text


def test_counters_that_cannot_be_read_are_named(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    rewrite(path, other, {"node/01": "{", "ticks_lost": "x"}, [])
    facts = info(other)
    assert facts["losses"]["rows_lost"] is None
    assert {one["process"]: one["reported"] for one in facts["processes"]}["node/01"] is False
    assert any("counters of node/01 cannot be read" in note for note in facts["notes"])


def test_json_is_one_object_and_lines_are_not_too_long(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert in_process.octarm("info", path, "--json") == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert json.loads(out)["whole"] is True
    assert in_process.octarm("info", path, "--all") == 0
    text = capsys.readouterr().out
    assert "/node/02/backward_sum" not in text
    assert "/node/01/backward_sum" in text
    assert "forward 0 -> 1" in text
    assert max(map(len, text.splitlines())) <= 118


def test_a_changed_letter_in_metadata_is_noticed(path: Path, tmp_path: Path) -> None:
    """They have no checksum of their own: the one over the data section finds it, and nobody knows where."""
    raw = path.read_bytes()
    ((end, _),) = Anatomy.of(raw).of_kind(Opcode.DATA_END)
    assert int.from_bytes(raw[end + 9 : end + 13], "little") == zlib.crc32(raw[:end])
    copy, out = tmp_path / "copy.mcap", tmp_path / "out.mcap"
    copy.write_bytes(re.sub(rb'"seed":\d', b'"seed":7', raw, count=1))
    assert copy.read_bytes() != raw
    facts = info(copy)
    assert facts["file"]["stops"] == "has a data section whose checksum does not fit"
    assert facts["whole"] is False
    recover(copy, out)
    assert check_container(out).message_count == check_container(path).message_count
    facts = info(out)
    assert (facts["file"]["closed"], facts["whole"]) == (True, False)
    assert "recovered from copy.mcap, which has a data section" in info_table(facts)
