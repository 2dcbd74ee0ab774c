"""Real runs over Zenoh: message counts, sums, determinism, two runs at once."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from mcap.reader import make_reader

from analysis.mcap_file import McapContent, read_mcap
from analysis.recording import read_recording

if TYPE_CHECKING:
    from conftest import Start


@pytest.mark.variants("2-40", "20-15")
@pytest.mark.parametrize(("nodes", "ticks"), [(2, 40), (3, 40), (10, 30), (20, 15)])
def test_exactly_two_messages_per_cut_and_tick(start: Start, nodes: int, ticks: int) -> None:
    cli = start.run("--nodes", str(nodes), "--ticks", str(ticks), "--json", "--no-plot")
    assert cli.finish() == 0, cli.err
    summary = cli.json()
    assert cli.err == ""
    assert summary["neighbour_messages"] == 2 * (nodes - 1) * ticks
    assert summary["neighbour_messages_sent"] == summary["neighbour_messages"]
    assert summary["neighbour_messages_per_tick"] == 2 * (nodes - 1)
    assert summary["rejected_messages"] == 0
    assert summary["max_difference_to_central"] <= 1e-12
    assert (summary["nodes"], summary["ticks"]) == (nodes, ticks)
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


def test_every_sum_arrives_as_it_was_sent(start: Start) -> None:
    ticks = 60
    cli = start.run("--nodes", "4", "--ticks", str(ticks))
    assert cli.finish() == 0, cli.err
    recording = read_recording(cli.recording())
    assert recording.counters is not None
    counters = [json.loads(recording.counters[f"node/{i:02d}"]) for i in range(4)]
    for left, right in pairwise(counters):
        for sender, receiver, name in ((left, right, "forward"), (right, left, "backward")):
            assert receiver[f"{name}_received_messages"] == ticks
            for figure in ("messages", "bytes", "crc32"):
                assert receiver[f"{name}_received_{figure}"] == sender[f"{name}_sent_{figure}"]
    for i, own in enumerate(counters):
        assert own["measurement_received_messages"] == ticks
        assert own["command_sent_messages"] == ticks
        assert own["forward_received_messages"] == (ticks if i > 0 else 0)
        assert own["backward_received_messages"] == (ticks if i < 3 else 0)
    assert recording.unfinished is None
    assert (cli.recording().parent / "plot.png").stat().st_size > 10_000


def _numbers(content: McapContent) -> dict[str, tuple[list[bytes], list[int]]]:
    """Everything but wall-clock channels, byte by byte."""
    return {
        topic: (content.payloads[topic], content.log_times_ns[topic])
        for topic in content.payloads
        if not topic.endswith("/timing")
    }


def test_one_seed_gives_one_recording_also_side_by_side(start: Start) -> None:
    same = ["--nodes", "4", "--ticks", "80", "--no-plot", "--quiet"]
    both = [start.run(*same), start.run(*same)]
    other = start.run(*same[:3], "80", "--no-plot", "--quiet", "--seed", "2")
    assert [cli.finish() for cli in (*both, other)] == [0, 0, 0], [c.err for c in (*both, other)]
    first, second, third = (read_mcap(cli.recording()) for cli in (*both, other))
    assert _numbers(first) == _numbers(second)
    assert _numbers(first).keys() == _numbers(third).keys()
    assert _numbers(first) != _numbers(third)
    assert first.attachments["gains.json"] == second.attachments["gains.json"]


def test_tcp_gives_the_same_numbers_as_unix_sockets(start: Start) -> None:
    same = ["--nodes", "3", "--ticks", "50", "--no-plot", "--quiet"]
    unix, tcp = start.run(*same), start.run(*same, "--transport", "tcp")
    assert [unix.finish(), tcp.finish()] == [0, 0], unix.err + tcp.err
    assert _numbers(read_mcap(unix.recording())) == _numbers(read_mcap(tcp.recording()))


def test_the_recording_is_an_ordinary_mcap_file(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "30", "--no-plot", "--quiet")
    assert cli.finish() == 0, cli.err
    times: list[int] = []
    topics: set[str] = set()
    with cli.recording().open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            fields = json.loads(schema.data)["properties"]
            record = msgspec.json.decode(message.data, type=dict[str, Any])
            assert record.keys() == fields.keys()
            assert message.log_time == round(float(record["time_s"]) * 1e9)
            times.append(message.log_time)
            topics.add(channel.topic)
        names = {m.name for m in reader.iter_metadata()}
        attached = {a.name for a in reader.iter_attachments()}
    assert times == sorted(times)
    assert names == {"octarm", "summary"}
    assert attached == {"gains.json", "run.json", "nodes.json"}
    assert {"/node/00/backward_sum", "/node/02/forward_sum", "/plant/shape", "/event"} <= topics
    assert "/node/00/forward_sum" not in topics
    assert "/node/02/backward_sum" not in topics


def test_a_node_can_be_started_by_hand(start: Start, tmp_path: Path) -> None:
    cli = start.run("--nodes", "3", "--ticks", "40", "--no-plot", "--by-hand", "1")
    cli.wait_for("node 1 is yours to start: python -m node ")
    line = next(x for x in cli.err.splitlines() if x.startswith("node 1 is yours"))
    configuration = line.rpartition(" ")[2]
    node = start.node(configuration)
    assert cli.finish() == 0, cli.err
    assert node.finish() == 0, node.err
    assert "neighbour messages" in cli.out
