"""`octarm replay` on recordings of real runs: every bit again, by mathematics and by real processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest
from altered import alter
from in_process import octarm

from analysis.recording import read_recording
from wire.channels import BATCH_TICKS, LOSS_S, WELL

if TYPE_CHECKING:
    from conftest import Cli, Start

QUIET = ("--no-plot", "--quiet")
V3 = Path(__file__).parents[1] / "data" / "recording_v3.mcap"
V4 = V3.with_name("recording_v4.mcap")
THERE_AND_BACK = """
name = "there"
start = "straight"
hold_s = 0.5
[[legs]]
to = "1"
move_s = 4.0
hold_s = 1.5
[[legs]]
to = "straight"
move_s = 4.0
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Path]:
    """A run of two nodes, long enough to be caught in the middle of its replay."""
    from conftest import one_run

    with one_run(tmp_path_factory.mktemp("run"), gains, "--nodes", "2", "--ticks", "3000") as path:
        yield path


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Path]:
    """A run that is read quickly, for what is refused when it has been read."""
    from conftest import one_run

    with one_run(tmp_path_factory.mktemp("run"), gains, "--nodes", "2", "--ticks", "30") as path:
        yield path


class Replay:
    """Replays in the test's own process, for speed, that leave nothing behind."""

    def __init__(self, capsys: pytest.CaptureFixture[str], sockets: Path) -> None:
        self._capsys = capsys
        self._sockets = sockets

    def __call__(self, *arguments: str | Path, code: int = 0) -> dict[str, object]:
        """The facts of `octarm replay` with these arguments."""
        found = octarm("replay", *arguments, "--json")
        said = self._capsys.readouterr()
        assert found == code, said.err + said.out
        assert said.err == ""
        children = [child.name() for child in psutil.Process().children(recursive=True)]
        assert [name for name in children if name in ("octarm-zygote", "octarm-node1")] == []
        assert list(self._sockets.glob("octarm-*")) == []
        facts = json.loads(said.out)
        assert isinstance(facts, dict)
        return facts


@pytest.fixture
def replay(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Replay:
    sockets = tmp_path / "s"
    sockets.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(sockets))
    return Replay(capsys, sockets)


def equal(facts: dict[str, object], *, old: bool = False) -> bool:
    """Whether a replay found everything and no difference; `old`: its messages had another version."""
    if "node" in facts:
        assert facts["rejected_messages"] == 0
        assert facts["checksums_equal"] == facts["checksums_compared"]
        assert (facts["checksums_compared"] == 0) is old
    return (facts["verdict"], facts["values_different"], facts["missing"]) == ("equal", 0, [])


def test_a_run_and_each_of_its_processes(start: Start, replay: Replay) -> None:
    nodes, ticks = 4, 40
    cli = start.run("--nodes", str(nodes), "--ticks", str(ticks), *QUIET)
    assert cli.finish() == 0, cli.err
    facts = replay(cli.recording().parent)  # the run's directory will do
    assert equal(facts)
    assert (facts["node_ticks"], facts["configurations"]) == (nodes * ticks, "recorded")
    for node in range(nodes):
        facts = replay(cli.recording(), "--node", str(node))
        assert equal(facts)
        assert (facts["node_ticks"], facts["segments"]) == (ticks, [node])


def test_a_run_with_changes_of_gains(start: Start, replay: Replay) -> None:
    scenario = start.work / "there.toml"
    scenario.write_text(THERE_AND_BACK)
    cli = start.run("--scenario", scenario, "--nodes", "4", *QUIET)
    assert cli.finish() == 0, cli.err
    assert set(read_recording(cli.recording()).setpoints_used) == {0, 1}
    assert equal(replay(cli.recording()))
    assert equal(replay(cli.recording(), "--node", "2"))


def test_a_run_whose_processes_have_several_segments(start: Start, replay: Replay) -> None:
    cli = start.run("--nodes", "5", "--ticks", "30", "--segments-per-process", "2", *QUIET)
    assert cli.finish() == 0, cli.err
    facts = replay(cli.recording())
    assert equal(facts)
    assert facts["node_ticks"] == 150
    facts = replay(cli.recording(), "--node", "3")
    assert equal(facts)
    assert (facts["segments"], facts["node_ticks"]) == ([2, 3], 60)
    assert equal(replay(cli.recording(), "--node", "4"))


def test_a_run_with_late_ticks(start: Start, replay: Replay) -> None:
    cli = start.run(
        *("--nodes", "3", "--ticks", "120", "--realtime", "--period", "0.03"),
        *("--hold-ticks", "1000", *QUIET),
    )
    cli.wait_for_ticks()
    frozen = cli.processes()["octarm-node1"]
    os.kill(frozen, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(frozen, signal.SIGCONT)
    assert cli.finish() == 3, cli.err
    late = int(read_recording(cli.recording()).table("/plant/pace").numbers("late").sum())
    assert late > 0
    facts = replay(cli.recording())
    assert equal(facts)
    assert (facts["late_ticks"], facts["node_ticks"]) == (late, 3 * (120 - late))
    assert equal(replay(cli.recording(), "--node", "1"))


def test_a_run_that_was_interrupted_or_stopped_is_replayed_to_its_end(
    start: Start, replay: Replay
) -> None:
    for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, 4)):
        cli = start.run("--nodes", "3", "--ticks", "1000000", "--no-plot")
        cli.wait_for_records()
        victim = cli.popen.pid if number == signal.SIGINT else cli.processes()["octarm-node1"]
        os.kill(victim, number)
        assert cli.finish() == code
        lost = 0
        if (
            number == signal.SIGKILL
        ):  # what node 1 had not sent to the recorder yet, the plant tells
            recording = read_recording(cli.recording())
            passive = int(np.flatnonzero(recording.passive)[0])
            swept = int(np.count_nonzero(recording.health[:passive, 1] == WELL))
            lost = swept - recording.table("/node/01/command").rows
            begun = recording.table("/sweep/timing").numbers("started_wall_ns")
            lost_s = 1e-9 * (begun[passive] - begun[passive - lost])
            # A batch; on a busy machine several may wait for the node's main thread, for no longer than stated.
            assert lost >= 0 and (lost <= BATCH_TICKS or lost_s <= LOSS_S)
        facts = replay(cli.recording(), code=3 if lost else 0)
        assert facts["values_different"] == 0
        if lost:
            assert facts["verdict"] == "incomplete"
            (text,) = (str(text) for text in _list(facts["missing"]))
            assert text.startswith("node 1: replayed up to tick ")
            assert "lost with the process that died" in text
        elif number == signal.SIGINT:
            assert equal(facts)
            assert equal(replay(cli.recording(), "--node", "1"))


def _list(value: object) -> list[object]:
    assert isinstance(value, list)
    return value


@pytest.mark.parametrize(("old", "configurations"), [(V3, "made again"), (V4, "recorded")])
def test_an_old_recording(
    replay: Replay, capsys: pytest.CaptureFixture[str], old: Path, configurations: str
) -> None:
    facts = replay(old)
    assert equal(facts)
    assert facts["configurations"] == configurations
    assert equal(replay(old, "--node", "1"), old=True)
    assert octarm("replay", old, "--node", "1") == 0
    assert (
        "checksums are of messages of an earlier version: not compared" in capsys.readouterr().out
    )


def test_what_is_printed(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm("replay", recorded, "--to", "99", "--from", "10") == 0
    out = capsys.readouterr().out
    assert "2 nodes, 3000 ticks of 0.1 s" in out
    assert "200 node-ticks with the mathematics of the nodes" in out
    assert "compared from tick 10 to tick 99" in out
    assert out.splitlines()[-1].startswith("verdict    equal: ")
    other = tmp_path / "other.mcap"
    before, after = alter(recorded, other, topic="/node/01/estimate", tick=1234, field="strain")
    assert octarm("replay", other) == 3
    out = capsys.readouterr().out
    assert (
        f"tick 1234, /node/01/estimate, strain: recorded {after!r}, node 1 gives {before!r}" in out
    )
    assert " values, 1 differ" in out
    assert out.splitlines()[-1].startswith("verdict    different: ")


def test_a_file_that_was_cut_short(recorded: Path, tmp_path: Path, replay: Replay) -> None:
    raw = recorded.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(raw[: len(raw) // 2])
    ticks = read_recording(cut).ticks
    assert 100 < ticks < 3000
    facts = replay(cut, code=3)
    assert (facts["verdict"], facts["values_different"]) == ("incomplete", 0)
    facts = replay(cut, "--node", "1", code=3)
    assert (facts["verdict"], facts["values_different"]) == ("incomplete", 0)
    assert facts["checksums_compared"] == 0  # not as many messages as in the run
    assert replay(cut, "--to", "99")["verdict"] == "equal"


def test_an_input_that_is_not_what_the_node_received_is_told_by_its_checksum(
    recorded: Path, tmp_path: Path, replay: Replay
) -> None:
    """Also where one bit of it is rounded away in all that the node makes of it."""
    other = tmp_path / "other.mcap"
    alter(recorded, other, topic="/node/00/backward_sum", tick=2000, field="d0")
    facts = replay(other, "--node", "0", code=3)
    assert facts["verdict"] == "different"
    text = str(_list(facts["done_otherwise"])[0])
    assert text.startswith("messages backward_received")
    assert "measurement_received" not in text


def test_configurations_that_are_not_there_are_made_again(recorded: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    alter(recorded, other, attachments={"nodes.json": None})
    assert octarm("replay", other, "--to", "50") == 0


def caught(start: Start, recorded: Path, *arguments: str) -> tuple[Cli, int]:
    """A replay whose node is linked, and the node's number."""
    cli = start("replay", recorded, "--node", "1", *arguments)
    cli.wait_for("node 1 is linked, process ")
    line = next(x for x in cli.err.splitlines() if x.startswith("node 1 is linked"))
    return cli, int(line.rpartition(" ")[2])


def nothing_left(cli: Cli) -> None:
    assert cli.gone(12.0) == {}
    assert [*cli.sockets.rglob("*")] == []


def test_ctrl_c_leaves_no_process_not_even_a_frozen_one(start: Start, recorded: Path) -> None:
    cli, node = caught(start, recorded, "--deadline", "60")
    os.kill(node, signal.SIGSTOP)
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert "Traceback" not in cli.err
    nothing_left(cli)


def test_a_killed_replayer_leaves_no_process(start: Start, recorded: Path) -> None:
    cli, _ = caught(start, recorded)
    os.kill(cli.popen.pid, signal.SIGKILL)
    cli.finish()
    nothing_left(cli)


def test_a_killed_node_is_named(start: Start, recorded: Path) -> None:
    cli, node = caught(start, recorded)
    os.kill(node, signal.SIGKILL)
    assert cli.finish() == 3
    assert ": node 1 was ended by SIGKILL" in cli.out
    assert "Traceback" not in cli.err
    nothing_left(cli)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--node", "2"), "--node 2: expected one of the nodes 0 to 1 of the recording"),
        (("--node", "-1"), "--node -1: expected one of the nodes"),
        (("--node", "1", "--publish"), "--node and --publish: give one of them"),
        (("--rate", "2"), "--rate is for --publish"),
        (("--loop",), "--loop is for --publish"),
        (("--at-once",), "--at-once is for --publish"),
        (("--listen", "tcp/127.0.0.1:7447"), "--listen is for --publish"),
        (("--deadline", "1"), "--deadline is for --node"),
        (("--node", "1", "--deadline", "0"), "--deadline 0: expected a positive number"),
        (("--from", "30"), "--from 30: expected a tick of the recording, 0 to 29"),
        (("--publish", "--from", "30"), "--from 30: expected a tick of the recording"),
        (("--publish", "--rate", "0"), "--rate 0: expected a positive number"),
        (("--publish", "--rate", "nan"), "--rate nan: expected a positive number"),
        (
            ("--publish", "--listen", "udp/1.2.3.4:5"),
            "expected tcp/ADDRESS:PORT or unixsock-stream",
        ),
        (("--publish", "--listen", "tcp/127.0.0.1:x"), "expected tcp/ADDRESS:PORT"),
        (("--publish", "--listen", "unixsock-stream//none/x"), "there is no directory /none"),
        (("--publish", "--listen", "unixsock-stream//tmp"), "it exists already"),
        (("--publish", "--listen", "unixsock-stream/a#b"), "expected a path without any of"),
        (("--publish", "--listen", f"unixsock-stream//tmp/{'x' * 120}"), "too long"),
    ],
)
def test_what_makes_no_sense_is_refused(
    brief: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], text: str
) -> None:
    assert octarm("replay", brief, *arguments) == 2
    assert text in capsys.readouterr().err


def test_a_file_that_is_no_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert octarm("replay", tmp_path) == 2
    assert "recording.mcap: No such file" in capsys.readouterr().err
    shutil.copy(__file__, tmp_path / "recording.mcap")
    assert octarm("replay", tmp_path) == 2
    assert "expected an MCAP file" in capsys.readouterr().err


def test_a_run_is_checked_much_faster_than_real_time(replay: Replay, recorded: Path) -> None:
    facts = replay(recorded)
    faster = facts["times_real_time"]
    assert isinstance(faster, float)
    assert np.isfinite(faster) and faster > 20.0


@pytest.mark.parametrize(
    ("given", "ticks"),
    [(("0.3s", "0.75s"), (3, 7)), (("0.31s", "0.7s"), (4, 7)), (("3", "0.9s"), (3, 9))],
)
def test_instants_of_the_arm_stand_for_ticks(
    replay: Replay, brief: Path, given: tuple[str, str], ticks: tuple[int, int]
) -> None:
    """Ticks of 0.1 s: the first at or after an instant, the last at or before one."""
    facts = replay(brief, "--from", given[0], "--to", given[1])
    assert (facts["from"], facts["to"]) == ticks


@pytest.mark.parametrize("text", ["x", "1.5", "infs", "nans", "s", "-1s"])
def test_what_is_no_instant_is_refused(
    brief: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm("replay", brief, "--from", text) == 2
    assert (
        f"--from {text.removesuffix('s') if text == '-1s' else text}"[:8] in capsys.readouterr().err
    )
