"""The recording's file: content, order, refusal to write over, and what a sudden end leaves."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from analysis.mcap_file import read_mcap
from recorder.writer import RecordingWriter
from wire.channels import label, node_channels, plant_channels, timing_fields, width
from wire.messages import PLANT

NODES = 3
LAYOUT = {i: node_channels(i, NODES, 5 * (i > 0), 4 * (i < NODES - 1)) for i in range(NODES)} | {
    PLANT: plant_channels(NODES)
}


def rows(tick: int) -> dict[int, list[float]]:
    return {
        sender: [1000.0 * sender + tick + 0.001 * j for j in range(width(channels))]
        for sender, channels in LAYOUT.items()
    }


def written(path: Path, ticks: int) -> RecordingWriter:
    writer = RecordingWriter(path, 0.1, LAYOUT, flush_s=math.inf)
    writer.head({"seed": "1"}, {"gains.json": "{}"})
    for tick in range(ticks):
        writer.tick(tick, rows(tick))
    return writer


def test_every_number_is_in_the_file_under_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = written(path, 20)
    writer.event(20, "info", "finished", "all 20 ticks done")
    writer.close({"ticks": "20"})
    content = read_mcap(path)
    assert content.unfinished is None
    assert content.metadata == {"octarm": {"seed": "1"}, "summary": {"ticks": "20"}}
    assert content.attachments == {"gains.json": b"{}"}
    for sender, channels in LAYOUT.items():
        at = 0
        for channel in channels:
            payloads = content.payloads[channel.topic]
            assert len(payloads) == 20
            for tick, payload in enumerate(payloads):
                record = json.loads(payload)
                end = at + len(channel.fields)
                assert list(record) == ["tick", "time_s", *channel.fields]
                assert (record["tick"], record["time_s"]) == (tick, tick * 0.1)
                assert [record[f] for f in channel.fields] == rows(tick)[sender][at:end]
            assert content.log_times_ns[channel.topic] == [round(k * 1e8) for k in range(20)]
            at = end
    (event,) = content.payloads["/event"]
    assert json.loads(event)["name"] == "finished"


def test_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        written(tmp_path / name, 50).close({})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_an_existing_file_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    with pytest.raises(FileExistsError):
        RecordingWriter(path, 0.1, LAYOUT, flush_s=1.0)
    assert path.read_text() == "mine"


def test_a_tick_without_one_sender_is_written_for_the_others(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = written(path, 1)
    writer.tick(1, {s: row for s, row in rows(1).items() if s != 2})
    writer.close({})
    content = read_mcap(path)
    assert len(content.payloads["/node/01/command"]) == 2
    assert len(content.payloads["/node/02/command"]) == 1


def test_what_was_flushed_survives_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "sys.path.insert(0, sys.argv[2])\n"
        "from test_writer import rows, written\n"
        "writer = written(Path(sys.argv[1]), 30)\n"
        "writer.flush()\n"
        "for tick in range(30, 33):\n"
        "    writer.tick(tick, rows(tick))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    end = subprocess.run(
        [sys.executable, "-c", script, str(path), str(Path(__file__).parent)], check=False
    )
    assert end.returncode == -9
    content = read_mcap(path)
    assert content.unfinished is not None
    assert len(content.payloads["/plant/tip"]) >= 30
    assert content.metadata["octarm"] == {"seed": "1"}


def test_labels_and_fields() -> None:
    assert [label(i, 100) for i in (0, 99)] == ["00", "99"]
    assert [label(i, 101) for i in (0, 100)] == ["000", "100"]
    assert "forward_received_wall_ns" not in timing_fields(0, 3)
    assert "backward_received_wall_ns" not in timing_fields(2, 3)
    assert len(timing_fields(1, 3)) == 4
    topics = [c.topic for channels in LAYOUT.values() for c in channels]
    assert len(set(topics)) == len(topics)
    for channels in LAYOUT.values():
        for channel in channels:
            schema = json.loads(channel.schema)
            assert list(schema["properties"]) == ["tick", "time_s", *channel.fields]
            assert schema["required"] == list(schema["properties"])
