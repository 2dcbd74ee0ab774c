"""Nodes that are stopped, for a while or for ever, or slow: held, bridged, left out or the arm passive."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import one_run
from fault_runs import (
    FORWARD_BRIDGED,
    JOINED,
    ON_TIME,
    bridged_at,
    estimates_apart,
    flags_of,
    in_slow_motion,
    named,
    node_pid,
    passive_from,
)
from pulses import Pulses

from analysis.recording import Recording, read_recording
from chaos.aftermath import Expected
from wire.channels import Health

if TYPE_CHECKING:
    from conftest import Start

HOLD, PERIOD_S = 12, 0.04
FIVE = ("--nodes", "5", "--seed", "5")
SAME = (*FIVE, "--no-plot")
REALTIME = (*SAME, "--realtime", "--period", str(PERIOD_S), "--hold-ticks", str(HOLD))
NODES = (0, 2, 4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Recording:
    """The same run without a fault; of a shorter one the first ticks."""
    with one_run(tmp_path_factory.mktemp("alone"), gains, *FIVE, "--ticks", "200") as path:
        return read_recording(path)


@pytest.mark.parametrize("more", [(), ("--transport", "tcp")], ids=["unix", "tcp"])
@pytest.mark.parametrize("node", NODES)
def test_stopped_for_ever_the_arm_is_passive_after_the_hold(
    start: Start, node: int, more: tuple[str, ...]
) -> None:
    cli = start.run(*REALTIME, "--ticks", "100000", *more)
    cli.wait_for_records()
    os.kill(node_pid(cli, node), signal.SIGSTOP)
    text = f"{HOLD + 1} late ticks in a row, {HOLD} may be.*no command from {named(node)}"
    cli.ends(Expected((4,), (f"passive: .*{text}", "safety_stop: "), (text,)))
    found = cli.recorded()
    first = passive_from(found)
    # first as many as are waited for, without a sweep, then with one in every tick
    late = found.table("/plant/pace").numbers("late") > 0.0
    waited = (HOLD + 1) // 2
    assert late[first - HOLD : first - HOLD + waited - 1].all()
    health = found.table("/plant/health").numbers(f"node_{node:02d}").astype(int)
    assert not (health[first - HOLD : first] & ON_TIME).any()


SLOW_HOLD, SLOW_PERIOD_S = 14, 0.06
AWAY = {"waited for": 4.0, "given up": SLOW_HOLD / 2 + 4.5}


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("away", AWAY)
def test_stopped_for_a_while_within_the_hold(
    start: Start, alone: Recording, node: int, away: str
) -> None:
    """Whatever the phase: a sweep that needs the node is late for the first time at once or up to two periods
    after the stop, is given up H / 2 periods later, and makes the arm passive H later. So a stop longer than
    two periods makes a tick late, one longer than H / 2 + 2 gives a sweep up, one shorter than H does not make
    the arm passive. A busy machine has two periods or more to each of these bounds."""
    slow = ("--period", str(SLOW_PERIOD_S), "--hold-ticks", str(SLOW_HOLD))
    cli = start.run(*REALTIME, *slow, "--ticks", "110")
    cli.wait_for_records()
    pid = node_pid(cli, node)
    os.kill(pid, signal.SIGSTOP)
    time.sleep(AWAY[away] * SLOW_PERIOD_S)
    os.kill(pid, signal.SIGCONT)
    cli.ends(Expected((3,), (r"late: ", r"finished: "), (r"ticks were late",)))
    found = cli.recorded()
    if away == "given up" and node < 4:
        assert bridged_at(found, node + 1, FORWARD_BRIDGED)
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < 0.05


@pytest.mark.parametrize("node", NODES)
def test_with_replacement_a_stuck_node_is_left_out_killed_and_replaced(
    start: Start, alone: Recording, node: int
) -> None:
    cli = start.run(*REALTIME, "--ticks", "200", "--restart")
    cli.wait_for_records()
    os.kill(node_pid(cli, node), signal.SIGSTOP)
    gone = rf"node_gone: .*node {node} is left out: it is stuck"
    cli.ends(
        Expected(
            (3,),
            (gone, rf"node_back: node {node}", r"finished: "),
            (rf"replaced: .*node {node}\b",),
        )
    )
    found = cli.recorded()
    assert len(bridged_at(found, node, JOINED)) == 1
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < 0.05


@pytest.mark.parametrize("more", [(), ("--restart",)], ids=["", "restart"])
def test_a_slow_node_makes_ticks_late_and_nothing_else(
    start: Start, alone: Recording, more: tuple[str, ...]
) -> None:
    """Stopped for two and a quarter ticks of every three and three quarters.

    A stop longer than two periods holds one whole tick, from its start to its deadline, wherever it
    falls between the ticks: each makes one late at least. One and a half of every three would not
    do: the pulses keep step with the ticks then, and in half of the positions no answer is late.
    """
    cli = start.run(*REALTIME, "--ticks", "200", *more)
    cli.wait_for_records()
    pulses = Pulses(node_pid(cli, 2), 2.25 * PERIOD_S, 1.5 * PERIOD_S, most=20)
    pulses.wait()
    cli.ends(Expected((3,), (r"late: ", r"finished: ")))
    found = cli.recorded()
    health = found.table("/plant/health").numbers("node_02").astype(int)
    # The plant notes who is on time a little after the deadline; if it has no core then, it may be too late
    # for that.
    assert pulses.stops == 20
    assert np.count_nonzero(~health & Health.ON_TIME) >= pulses.stops / 2
    assert np.isfinite(found.commands[flags_of(found) >= 0]).all()
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < 0.1


@pytest.mark.every
def test_two_stopped_at_once(start: Start) -> None:
    cli = start.run(*REALTIME, "--ticks", "100000")
    cli.wait_for_records()
    for node in (1, 3):
        os.kill(node_pid(cli, node), signal.SIGSTOP)
    cli.ends(Expected((4,), (rf"passive: .*no command from {named(1, 3)}",)))
    passive_from(cli.recorded())


@pytest.mark.every
def test_two_stuck_at_once_are_replaced(start: Start) -> None:
    cli = start.run(*REALTIME, "--ticks", "150", "--restart")
    cli.wait_for_records()
    for node in (1, 2):
        os.kill(node_pid(cli, node), signal.SIGSTOP)
    said = (r"replaced: .*node 1\b.*node 2\b",)
    cli.ends(Expected((3,), (r"node_back: node 1", r"node_back: node 2"), said))


@pytest.mark.every
def test_of_several_segments_a_process(start: Start) -> None:
    cli = start.run(*REALTIME, "--ticks", "150", "--restart", "--segments-per-process", "2")
    cli.wait_for_records()
    os.kill(node_pid(cli, 2), signal.SIGSTOP)
    cli.ends(Expected((3,), (r"node_back: node 2",), (r"replaced: .*node 2\b",)))


# -- the plant -------------------------------------------------------------------------------------

DEADLINE_S = 1.0


@pytest.mark.parametrize("way", [SAME, REALTIME], ids=["lock-step", "real time"])
@pytest.mark.parametrize("more", [(), ("--restart",)], ids=["", "restart"])
def test_killed_plant(start: Start, way: tuple[str, ...], more: tuple[str, ...]) -> None:
    """Without the plant there is no arm: at once, whatever was asked for."""
    cli = start.run(*way, "--ticks", "1000000", *more)
    cli.wait_for_records()
    began = time.monotonic()
    os.kill(cli.processes()["octarm-plant"], signal.SIGKILL)
    how = r"the plant was ended by SIGKILL"
    cli.finish()
    took_s = time.monotonic() - began
    cli.ends(Expected((4,), (f"safety_stop: .*{how}",), (how,)))
    assert took_s < 10.0


@pytest.mark.parametrize("way", [SAME, REALTIME], ids=["lock-step", "real time"])
def test_stopped_plant_is_noticed_by_the_nodes(start: Start, way: tuple[str, ...]) -> None:
    """They wait three deadlines for a measurement; then the launcher waits a second for the plant to answer its
    order to stop, and ends it by force."""
    cli = start.run(*way, "--ticks", "1000000", "--deadline", str(DEADLINE_S))
    cli.wait_for_records()
    began = time.monotonic()
    os.kill(cli.processes()["octarm-plant"], signal.SIGSTOP)
    said = (r"the plant does not answer",)
    cli.ends(Expected((4,), (r"safety_stop: .*the plant does not answer",), said))
    assert 3 * DEADLINE_S - 0.5 < time.monotonic() - began < 3 * DEADLINE_S + 15.0


def test_a_plant_that_is_stopped_for_a_while_goes_on(start: Start) -> None:
    cli = start.run(*SAME, "--ticks", "600", "--deadline", "10")
    with in_slow_motion(cli):
        cli.wait_for("tick ")
        pid = cli.processes()["octarm-plant"]
        os.kill(pid, signal.SIGSTOP)
        time.sleep(1.0)
        os.kill(pid, signal.SIGCONT)
    cli.ends(Expected((0,), (r"finished: ",), ticks=600))


def test_plant_and_launcher_killed_at_once(start: Start) -> None:
    """Launcher and plant are killed at once: the nodes end by themselves."""
    one = start.run(*SAME, "--ticks", "1000000")
    one.wait_for_records()
    for pid in (one.popen.pid, one.processes()["octarm-plant"]):
        os.kill(pid, signal.SIGKILL)
    one.ends(Expected((-signal.SIGKILL,), finished=None))


def test_a_plant_that_is_stopped_while_it_watches_a_passive_arm(start: Start) -> None:
    """The nodes have ended in order and miss nobody: the launcher knows how long the watch takes."""
    cli = start.run(
        *(*SAME, "--realtime", "--period", "0.1", "--hold-ticks", "20", "--ticks", "1000000"),
    )
    cli.wait_for_records()
    os.kill(node_pid(cli, 2), signal.SIGKILL)
    time.sleep(0.5)  # 20 ticks of 0.1 s are watched
    began = time.monotonic()
    os.kill(cli.processes()["octarm-plant"], signal.SIGSTOP)
    how = r"node 2 (is gone|was ended by SIGKILL).*the plant does not answer"
    cli.ends(Expected((4,), (r"passive: .*node 2", f"safety_stop: .*{how}"), (how,)))
    assert time.monotonic() - began < 20.0


def test_a_node_that_is_out_until_the_end_is_told(start: Start) -> None:
    """A frozen zygote tells of no death and forks nobody, and the run is over before that takes too long: 4 s
    after its first tick, of the 5 s that a node may be out."""
    cli = start.run(*REALTIME, "--restart", "--ticks", "100")
    cli.wait_for_records()
    zygote = cli.processes()["octarm-zygote"]
    os.kill(zygote, signal.SIGSTOP)
    os.kill(node_pid(cli, 2), signal.SIGKILL)
    while "octarm-plant" in cli.processes():  # everybody else is ended before
        time.sleep(0.05)
    os.kill(zygote, signal.SIGKILL)  # for whose answer the launcher would wait five seconds
    said = (r"left out: node 2; node 2 did not come back before the end",)
    cli.ends(Expected((3,), (r"node_gone: .*node 2 is left out: it is gone", r"finished: "), said))
