"""Real runs with --live: the page is told what is recorded, the run does not depend on it, nothing stays."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from in_process import octarm
from live_frames import check_frame
from live_page import PATIENCE_S, address, events
from ports import free_ports
from test_hosts import SSH, write_hosts

from analysis.compare import first_difference
from analysis.recording import read_recording
from chaos.aftermath import complaints
from wire.channels import Health

if TYPE_CHECKING:
    from conftest import Cli, Start

SLOWLY = ("--no-plot", "--live", "--realtime", "--period", "0.02", "--hold-ticks", "100000")
ENDLESS = ("--nodes", "4", "--ticks", "1000000", *SLOWLY)
LIVE = "octarm-live"


def port_of(cli: Cli) -> int:
    cli.wait_for("live at ")
    port = address(cli.err)
    assert port is not None
    return port


def refused(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=2).close()
    except ConnectionRefusedError:
        return True
    return False


def nothing_left(cli: Cli, port: int) -> None:
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []
    assert refused(port)
    assert complaints(cli.work) == ""


def test_frames_are_the_recorded_ticks(start: Start) -> None:
    """Ten of them, however long they take: the page's process has the cores last."""
    nodes, enough = 5, 10
    cli = start.run("--nodes", str(nodes), "--ticks", "1000000", "--initial", "chapter", *SLOWLY)
    port = port_of(cli)
    told, ticks = [], set()
    for kind, one in events(port):
        told.append((kind, one))
        if kind == "frame" and one["tick"] == one["estimate_tick"]:
            ticks.add(one["tick"])
            if len(ticks) == enough:
                cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130, cli.err
    nothing_left(cli, port)
    recording = read_recording(cli.recording())
    states = [state for kind, state in told if kind == "state"]
    frames = [frame for kind, frame in told if kind == "frame"]
    assert {state["run_id"] for state in states} == {recording.configuration.run_id}
    assert [True] * nodes in [state["alive"] for state in states]
    shown = [frame for frame in frames if frame["tick"] == frame["estimate_tick"]]
    for frame in shown:
        check_frame(frame, recording)
    if frames[0]["tick"] < KEPT_FROM_THE_FIRST:
        assert all("estimation_error" in frame for frame in shown[1:])
        begun = recording.table("/sweep/timing").by_tick(("started_wall_ns",), recording.ticks)
        wall_s = 1e-9 * (begun[:, 0] - begun[0, 0])
        assert [f["wall_s"] for f in shown[1:]] == pytest.approx(
            [wall_s[f["tick"]] for f in shown[1:]], abs=1e-4
        )
    assert frames[-1]["nodes"]["rejected"] == [0] * nodes


KEPT_FROM_THE_FIRST = 50
"""A frame of an earlier tick was made before the ring of live.process had to drop what came first: it holds
eight batches of each process, which last 0.15 s or 60 ticks in all."""


def test_the_end_of_a_run_is_told_with_its_last_tick(start: Start) -> None:
    nodes, ticks = 3, 60
    cli = start.run("--nodes", str(nodes), "--ticks", str(ticks), *SLOWLY, "--by-hand", "1")
    port = port_of(cli)
    stream = events(port)
    told = [next(stream)]  # it is looked at when the run begins
    node = started_by_hand(start, cli)
    told += stream
    code = cli.finish()
    assert code in (0, 3), cli.err  # 3: a busy machine was late
    assert node.finish() == 0, node.err
    nothing_left(cli, port)
    recording = read_recording(cli.recording())
    states = [state for kind, state in told if kind == "state"]
    frames = [frame for kind, frame in told if kind == "frame"]
    assert states[-1]["state"] == "finished"
    assert states[-1]["final"]
    assert told[-1] == ("state", states[-1])
    assert states[-1]["message"] == (
        f"all {ticks} ticks done" if code == 0 else states[-1]["message"]
    )
    last = frames[-1]
    assert last["tick"] == np.flatnonzero(~recording.late)[-1]
    if last["ticks_seen"] == ticks:
        assert last["late_ticks"] == recording.late.sum()


def started_by_hand(start: Start, cli: Cli) -> Cli:
    """Node 1 of a run that waits for it."""
    limit = time.monotonic() + PATIENCE_S
    while not (found := list(cli.work.glob("runs/*/node-1.json"))):
        assert time.monotonic() < limit
        time.sleep(0.01)
    return start.node(str(found[0]))


@pytest.mark.every
def test_a_run_that_is_watched_has_the_numbers_of_one_that_is_not(start: Start) -> None:
    same = ("--nodes", "4", "--ticks", "400", "--no-plot")
    plain = start.run(*same, "--quiet")
    assert plain.finish() == 0, plain.err
    live = start.run(*same, "--live", "--quiet", "--by-hand", "1")
    port = port_of(live)
    stream = events(port)
    told = [next(stream)]  # it is watched from the first tick on
    node = started_by_hand(start, live)
    told += stream
    assert live.finish() == 0, live.err
    assert node.finish() == 0, node.err
    assert live.err == f"live at http://127.0.0.1:{port}/\n"
    assert told[-1][1]["state"] == "finished"
    assert (
        first_difference(read_recording(plain.recording()), read_recording(live.recording()))
        is None
    )
    nothing_left(live, port)


def test_nobody_has_to_watch(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "50", "--no-plot", "--live", "--json")
    assert cli.finish() == 0, cli.err
    assert cli.json()["ticks"] == 50
    assert cli.err.startswith("live at ")
    port = address(cli.err)
    assert port is not None
    nothing_left(cli, port)


def test_in_lock_step_it_is_said_that_real_time_is_for_watching(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "20", "--no-plot", "--live")
    assert cli.finish() == 0, cli.err
    assert "to watch it add --realtime" in cli.err


def test_the_page_waits_with_the_run_for_its_nodes(start: Start) -> None:
    cli = start.run("--ticks", "30", "--no-plot", "--live", "--nodes", "3", "--by-hand", "1")
    cli.wait_for("node 1 is yours")
    port = port_of(cli)
    stream = events(port)
    kind, state = next(stream)
    assert (kind, state["state"], state["final"]) == ("state", "waiting", False)
    assert not any(state["alive"])
    cli.popen.send_signal(signal.SIGINT)
    *_, (_, last) = stream
    assert last["state"] == "failed"
    assert last["final"]
    assert cli.finish() == 130
    nothing_left(cli, port)


def frame_after(stream: Any, tick: int) -> dict[str, Any]:
    for kind, content in stream:
        if kind == "frame" and content["tick"] >= tick:
            assert isinstance(content, dict)
            return content
    raise AssertionError("the stream has ended")


def test_a_killed_page_leaves_the_run_alone(start: Start) -> None:
    cli = start.run(*ENDLESS)
    stream = events(port := port_of(cli))
    seen = frame_after(stream, 1)["tick"]
    os.kill(cli.processes()[LIVE], signal.SIGKILL)
    assert not any(kind == "state" and state["final"] for kind, state in stream)
    cli.wait_for("the live page was ended by SIGKILL: the run goes on unseen")
    cli.wait_for_more()
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130, cli.err
    assert cli.err.count("live page") == 1
    assert read_recording(cli.recording()).ticks > seen + 10
    nothing_left(cli, port)


def test_a_frozen_page_is_not_waited_for(start: Start) -> None:
    cli = start.run(*ENDLESS)
    stream = events(port := port_of(cli))
    seen = frame_after(stream, 1)["tick"]
    os.kill(cli.processes()[LIVE], signal.SIGSTOP)
    cli.wait_for_more()
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130, cli.err
    assert read_recording(cli.recording()).ticks > seen + 10
    nothing_left(cli, port)


def test_a_node_that_dies_is_seen_and_the_stop_is_explained(start: Start) -> None:
    cli = start.run(*ENDLESS)
    stream = events(port := port_of(cli))
    frame_after(stream, 20)
    os.kill(cli.processes()["octarm-node2"], signal.SIGKILL)
    states = [content for kind, content in stream if kind == "state"]
    assert cli.finish() == 4
    assert states[-1]["alive"] == [
        True,
        True,
        False,
        True,
    ]  # the others left when they were told to
    assert states[-1]["state"] == "safety_stop"
    assert "node 2 was ended by SIGKILL" in states[-1]["message"]
    assert states[-1]["message"] in cli.err
    nothing_left(cli, port)


def test_an_interrupt_is_told(start: Start) -> None:
    cli = start.run(*ENDLESS)
    stream = events(port := port_of(cli))
    frame_after(stream, 5)
    cli.popen.send_signal(signal.SIGINT)
    *_, (_, last) = stream
    assert cli.finish() == 130
    assert (last["state"], last["final"]) == ("interrupted", True)
    assert last["message"].startswith("interrupted at tick ")
    nothing_left(cli, port)


def test_a_killed_launcher_takes_the_page_with_it(start: Start) -> None:
    cli = start.run(*ENDLESS)
    stream = events(port := port_of(cli))
    frame_after(stream, 5)
    os.kill(cli.popen.pid, signal.SIGKILL)
    assert not any(kind == "state" and state["final"] for kind, state in stream)
    cli.finish()
    assert cli.gone() == {}
    assert refused(port)


def test_pages_that_come_and_go_are_served_anew(start: Start) -> None:
    cli = start.run(*ENDLESS)
    port = port_of(cli)
    first = frame_after(stream := events(port), 10)
    stream.close()  # type: ignore[attr-defined] # a generator: the connection ends
    await_rest(cli)  # noticed at the heartbeat; the process listens no more
    second = frame_after(again := events(port), 0)
    assert second["tick"] > first["tick"] + 30  # a second's, less what a frame may be behind
    assert second["estimate_tick"] == second["tick"]
    third = frame_after(again, second["tick"] + 30)
    assert third["ticks_seen"] < third["tick"]  # nobody has looked in between
    while not all(third["nodes"]["on_time"]):  # on a busy machine a tick may be late at any time
        third = frame_after(again, third["tick"] + 1)
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130


def test_links_to_another_host_are_not_measured_with_two_clocks(
    start: Start, tmp_path: Path
) -> None:
    hosts = write_hosts(tmp_path, SSH)
    cli = start.run("--nodes", "4", "--ticks", "1000000", "--hosts", hosts, *SLOWLY)
    frame = frame_after(events(port := port_of(cli)), 20)
    for way in ("forward", "backward"):
        known = [us is not None for us in frame["links"][f"{way}_us"]]
        assert known == [True, False, False]
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert cli.gone() == {}
    assert refused(port)
    health = read_recording(cli.recording()).health
    late = np.count_nonzero(~health & int(Health.ON_TIME), axis=0)  # none, on a machine with time
    assert (np.array(frame["nodes"]["late"]) <= late).all()


def wake_ups(pid: int) -> dict[str, tuple[int, bool]]:
    """How often each thread has waited for something, and whether it waits now; but for Zenoh's, which keeps
    the link alive."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the thread of a page that has gone
            if (task / "comm").read_text().strip() == LIVE:
                status = (task / "status").read_text()
                count = int(status.partition("voluntary_ctxt_switches:")[2].split()[0])
                found[task.name] = count, "State:\tS" in status
    return found


def await_rest(cli: Cli) -> dict[str, tuple[int, bool]]:
    """Wait until the page's process has waited for a whole second; its wake-ups."""
    pid = cli.processes()[LIVE]
    limit = time.monotonic() + PATIENCE_S
    while True:
        before = wake_ups(pid)
        time.sleep(1.0)
        if wake_ups(pid) == before and all(waits for _, waits in before.values()):
            return before
        assert time.monotonic() < limit, "it is always at work"


def test_while_nobody_watches_nothing_is_done(start: Start) -> None:
    cli = start.run(*ENDLESS)
    port = port_of(cli)
    before = await_rest(cli)  # it has had everybody's first tick, or has given it up
    frame_after(events(port), 0)
    assert wake_ups(cli.processes()[LIVE]) != before
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130


def test_the_page_steps_back_behind_everything(start: Start) -> None:
    cli = start.run(*ENDLESS)
    stream = events(port_of(cli))
    frame_after(stream, 5)
    pid = cli.processes()[LIVE]
    policies = {
        os.sched_getscheduler(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()
    }
    assert os.sched_getscheduler(pid) == os.SCHED_IDLE
    assert policies == {os.SCHED_IDLE, os.SCHED_OTHER}  # Zenoh's own empties the link
    assert os.getpriority(os.PRIO_PROCESS, pid) == 10
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130


def test_a_port_that_is_asked_for_is_used(start: Start) -> None:
    port = free_ports()
    cli = start.run(
        "--nodes", "3", "--ticks", "20", "--no-plot", "--live", "--live-port", str(port)
    )
    assert cli.finish() == 0, cli.err
    assert address(cli.err) == port


def test_a_port_that_is_taken_is_refused_before_anything_is_started(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        cli = start.run("--nodes", "3", "--ticks", "20", "--live", "--live-port", str(port))
        assert cli.finish() == 2
    assert f"--live-port {port}: port {port} of 127.0.0.1 cannot be used" in cli.err
    assert "give another or leave it out" in cli.err
    assert list(cli.work.iterdir()) == []
    assert cli.gone() == {}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--live-port", "8080"), "--live-port is for --live"),
        (("--live", "--live-port", "-1"), "a port up to 65535, got -1"),
        (("--live", "--live-port", "65536"), "a port up to 65535, got 65536"),
    ],
)
def test_what_makes_no_sense_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], text: str
) -> None:
    assert octarm("run", *arguments) == 2
    assert text in capsys.readouterr().err
