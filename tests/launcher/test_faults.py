"""Processes that die or are told to end: nothing is left, the recording can be read, the exit code
is right."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest

from analysis.recording import Recording, read_recording
from wire.channels import LOSS_S

if TYPE_CHECKING:
    from conftest import Cli, Start

ENDLESS = ("--nodes", "4", "--ticks", "1000000", "--no-plot")


def nothing_left(cli: Cli) -> Recording:
    """The invariants after any end; returns the recording."""
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []
    recording = read_recording(cli.recording())
    assert recording.ticks > 0
    return recording


def last_event(recording: Recording) -> tuple[str, str]:
    table = recording.table("/event")
    return str(table.column("name")[-1]), str(table.column("message")[-1])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_keeps_the_recording(start: Start, number: signal.Signals) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    cli.popen.send_signal(number)
    assert cli.finish() == 130
    assert "interrupted at tick" in cli.err
    recording = nothing_left(cli)
    assert recording.unfinished is None
    assert last_event(recording)[0] == "interrupted"


@pytest.mark.parametrize("node", [0, 1, 3])
def test_killed_node_stops_the_arm(start: Start, node: int) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    os.kill(cli.processes()[f"octarm-node{node}"], signal.SIGKILL)
    assert cli.finish() == 4
    assert f"node {node} was ended by SIGKILL" in cli.err
    recording = nothing_left(cli)
    assert recording.unfinished is None
    name, message = last_event(recording)
    assert name == "safety_stop"
    assert f"node {node} was ended by SIGKILL" in message


def test_killed_plant_stops_the_run(start: Start) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-plant"], signal.SIGKILL)
    assert cli.finish() == 4
    assert "the plant was ended by SIGKILL" in cli.err
    assert last_event(nothing_left(cli))[0] == "safety_stop"


def test_killed_recorder_leaves_a_readable_file(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "2000", "--no-plot")
    cli.wait_for_records()
    os.kill(cli.processes()["octarm-recorder"], signal.SIGKILL)
    assert cli.finish() == 3
    assert "the recorder was ended by SIGKILL" in cli.err
    assert nothing_left(cli).unfinished is not None


def test_a_run_that_is_killed_loses_no_more_than_is_stated(start: Start) -> None:
    """Everybody at once, in real time: the last recorded tick was due at most half a second before."""
    cli = start.run(
        "--nodes", "3", "--tick", "0.02", "--realtime", "--ticks", "100000", "--no-plot"
    )
    cli.wait_for_records()
    time.sleep(1.0)
    numbers = cli.processes().values()
    killed_ns = time.monotonic_ns()
    for number in numbers:
        os.kill(number, signal.SIGKILL)
    cli.finish()
    assert cli.gone() == {}
    recording = read_recording(cli.recording())
    assert recording.unfinished is not None
    due = recording.table("/sweep/timing").numbers("due_wall_ns")[recording.ticks - 1]
    lost_s = (killed_ns - int(recording.facts["epoch_ns"]) - due) * 1e-9
    assert recording.ticks > 20
    assert 0.0 < lost_s <= LOSS_S + recording.tick_s


def test_killed_launcher_leaves_nothing_alive(start: Start) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for_records()
    os.kill(cli.popen.pid, signal.SIGKILL)
    cli.finish()
    nothing_left(cli)


def test_frozen_node_is_named_within_the_deadline(start: Start) -> None:
    cli = start.run(*ENDLESS, "--deadline", "3")
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-node2"], signal.SIGSTOP)
    assert cli.finish() == 4
    assert "within 3 s" in cli.err or "waited 3 s" in cli.err
    assert "node 2 does not answer" in cli.err
    nothing_left(cli)


def test_killed_before_the_first_tick(start: Start) -> None:
    """A node that is never started: the launcher says which, and ends everything."""
    cli = start.run("--nodes", "3", "--ticks", "10", "--by-hand", "1", "--start-timeout", "5")
    assert cli.finish() == 5
    assert "node 1 was not started" in cli.err
    assert "node 0 waits for node 1" in cli.err
    assert "node 2 waits for node 1" in cli.err
    assert "Traceback" not in cli.err
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


def test_interrupt_during_start_up(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "10", "--by-hand", "1")
    cli.wait_for("node 1 is yours")
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert "interrupted before the first tick" in cli.err
    assert list(cli.work.glob("runs/*")) == []
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []
