"""Processes that die or are told to end: nothing is left, the recording can be read, the exit code
is right."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from in_process import octarm

from analysis.recording import read_recording
from chaos.aftermath import Expected, event_lines
from supervise.conductor import Conductor
from wire.channels import LOSS_S

if TYPE_CHECKING:
    from conftest import Start

ENDLESS = ("--nodes", "4", "--ticks", "1000000", "--no-plot")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_keeps_the_recording(start: Start, number: signal.Signals) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    cli.popen.send_signal(number)
    cli.ends(Expected((130,), (r"interrupted: ",), (r"interrupted at tick",)))
    assert event_lines(cli.recorded())[-1].startswith("interrupted: ")


@pytest.mark.variants("1")
@pytest.mark.parametrize("node", [0, 1, 3])
def test_killed_node_stops_the_arm(start: Start, node: int) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    os.kill(cli.processes()[f"octarm-node{node}"], signal.SIGKILL)
    how = f"node {node} was ended by SIGKILL"
    cli.ends(Expected((4,), (f"safety_stop: .*{how}",), (how,)))
    assert re.match(f"safety_stop: .*{how}", event_lines(cli.recorded())[-1])


def test_how_a_node_ended_is_waited_for(start: Start) -> None:
    """The zygote, which knows, is slower than the arm is safe: frozen for a third of the second that it has."""
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    found = cli.processes()
    os.kill(found["octarm-zygote"], signal.SIGSTOP)
    os.kill(found["octarm-node1"], signal.SIGKILL)
    time.sleep(0.33)
    os.kill(found["octarm-zygote"], signal.SIGCONT)
    how = "node 1 was ended by SIGKILL"
    cli.ends(Expected((4,), (f"safety_stop: .*{how}",), (how,)))


def test_killed_plant_stops_the_run(start: Start) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-plant"], signal.SIGKILL)
    cli.ends(
        Expected(
            (4,),
            (r"safety_stop: .*the plant was ended by SIGKILL",),
            (r"the plant was ended by SIGKILL",),
        )
    )
    assert event_lines(cli.recorded())[-1].startswith("safety_stop: ")


def test_killed_recorder_leaves_a_readable_file(start: Start) -> None:
    realtime = ("--realtime", "--tick", "0.02", "--ticks", "250", "--hold-ticks", "1000")
    cli = start.run(
        "--nodes", "3", *realtime, "--no-plot"
    )  # not over before the recorder is killed
    cli.wait_for_records()
    os.kill(cli.processes()["octarm-recorder"], signal.SIGKILL)
    how = r"the recorder was ended by SIGKILL: the run goes on unrecorded"
    cli.ends(Expected((3,), said=(how,), finished=False))


def test_a_run_that_is_killed_loses_no_more_than_is_stated(start: Start) -> None:
    """Everybody at once, in real time: the last recorded tick was due at most half a second before.

    And what plant and recorder waited for a core: that is the machine's doing.
    """
    realtime = ("--realtime", "--tick", "0.02", "--ticks", "100000", "--hold-ticks", "1000")
    cli = start.run("--nodes", "3", *realtime, "--no-plot")
    cli.wait_for_records()
    found = cli.processes()
    numbers, way = found.values(), [found["octarm-plant"], found["octarm-recorder"]]
    before_s = sum(map(waited_s, way))
    time.sleep(1.0)
    busy_s = sum(map(waited_s, way)) - before_s
    killed_ns = time.monotonic_ns()
    for number in numbers:
        os.kill(number, signal.SIGKILL)
    cli.finish()
    assert cli.gone() == {}
    recording = cli.recorded()
    assert recording.unfinished is not None
    due = recording.table("/sweep/timing").numbers("due_wall_ns")[recording.ticks - 1]
    lost_s = (killed_ns - int(recording.facts["epoch_ns"]) - due) * 1e-9
    assert recording.ticks > 20
    assert 0.0 < lost_s <= LOSS_S + recording.tick_s + busy_s


def test_an_interruption_after_the_last_process_has_ended_leaves_the_recording(
    gains: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was taken for one before the first tick, of which nothing is kept."""
    leave = Conductor.__exit__

    def interrupted(self: Conductor, *about: Any) -> None:
        leave(self, *about)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Conductor, "__exit__", interrupted)
    out = tmp_path / "out"
    same = ("--nodes", "3", "--ticks", "20", "--no-plot", "--quiet")
    assert octarm("run", "--gains", gains, *same, "--out", out) == 130
    assert capsys.readouterr().err == "octarm: interrupted\n"
    recording = read_recording(out / "recording.mcap")
    assert recording.complete
    assert recording.ticks == 20


def waited_s(pid: int) -> float:
    """How long the threads of a process have been ready to run and did not, by the kernel's account."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[1]) for task in tasks) * 1e-9


@pytest.mark.every
def test_frozen_node_is_named_within_the_deadline(start: Start) -> None:
    cli = start.run(*ENDLESS, "--deadline", "3")
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-node2"], signal.SIGSTOP)
    cli.ends(
        Expected(
            (4,),
            (r"safety_stop: .*node 2 does not answer",),
            (r"within 3 s|waited 3 s", r"node 2 does not answer"),
        )
    )


def test_killed_before_the_first_tick(start: Start) -> None:
    """A node that is never started: the launcher says which, and ends everything."""
    cli = start.run("--nodes", "3", "--ticks", "10", "--by-hand", "1", "--start-timeout", "5")
    said = ("node 1 was not started", "node 0 waits for node 1", "node 2 waits for node 1")
    cli.ends(Expected((5,), said=said, recording=False))


def test_interrupt_during_start_up(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "10", "--by-hand", "1")
    cli.wait_for("node 1 is yours")
    cli.popen.send_signal(signal.SIGINT)
    said = ("interrupted before the first tick",)
    cli.ends(Expected((130,), said=said, recording=False))
    assert list(cli.work.glob("runs/*")) == []


def test_an_interruption_does_not_hide_a_safety_stop(start: Start) -> None:
    """Ctrl-C again and again once the arm is passive: the exit code stays that of the stop."""
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-node1"], signal.SIGKILL)
    limit = time.monotonic() + 20.0
    recording = cli.recording()
    while b'"passive"' not in recording.read_bytes():
        assert time.monotonic() < limit
        time.sleep(0.002)
    while cli.popen.poll() is None:
        cli.popen.send_signal(signal.SIGINT)
        time.sleep(0.05)
    how = "node 1 was ended by SIGKILL"
    cli.ends(Expected((4,), (f"safety_stop: .*{how}",), (how,)))
