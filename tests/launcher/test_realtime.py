"""Runs by the clock: the same numbers as in lock-step, late ticks counted and held, and when it is enough."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from in_process import octarm

from analysis.central import compare_with_central
from analysis.compare import first_difference
from analysis.recording import read_recording

if TYPE_CHECKING:
    from conftest import Cli, Start

QUIET = ("--no-plot", "--quiet")


def _freeze(cli: Cli, node: int, seconds: float) -> None:
    """Stop a node for so long, as a debugger or a slow disk would."""
    pid = cli.processes()[f"octarm-node{node}"]
    os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)


def test_a_run_in_real_time_that_misses_nothing_has_the_numbers_of_lock_step(start: Start) -> None:
    same = ("--nodes", "4", "--ticks", "60", *QUIET)
    lockstep = start.run(*same)
    assert lockstep.finish() == 0, lockstep.err
    for period in ("0.02", "0.1", "0.4"):  # a busy machine may need the longer ones
        realtime = start.run(*same, "--realtime", "--period", period, "--hold-ticks", "1000")
        code = realtime.finish()
        assert code in (0, 3), realtime.err
        if code == 0:
            break
    assert code == 0, realtime.err
    one, other = read_recording(lockstep.recording()), read_recording(realtime.recording())
    assert first_difference(one, other) is None
    assert other.configuration.pace is not None
    due = other.table("/sweep/timing").by_tick(("due_wall_ns",), other.ticks)[:, 0]
    np.testing.assert_allclose(np.diff(due), float(period) * 1e9, atol=0.5)


@pytest.mark.every
def test_late_ticks_are_counted_and_held_and_the_arm_goes_on(start: Start) -> None:
    nodes, ticks = 4, 120
    cli = start.run(
        *("--nodes", str(nodes), "--ticks", str(ticks), "--no-plot", "--json"),
        *("--scenario", "hold", "--realtime", "--period", "0.03", "--hold-ticks", "1000"),
    )
    cli.wait_for_ticks()
    _freeze(cli, 2, 0.4)
    assert cli.finish() == 3, cli.err
    assert "ticks were late, their commands held" in cli.err
    summary = cli.json()
    late = summary["realtime"]["late_ticks"]
    assert summary["realtime"]["longest_hold_ticks"] >= 8
    assert summary["ticks"] == ticks
    assert summary["ticks_lost"] == 0
    assert summary["neighbour_messages"] == 2 * (nodes - 1) * (ticks - late)
    assert summary["neighbour_messages_per_tick"] == 2 * (nodes - 1)
    assert summary["intact_links"] == 2 * (nodes - 1)
    assert summary["rejected_messages"] == 0
    recording = read_recording(cli.recording())
    assert np.isnan(recording.estimates[recording.late]).all()
    assert np.isfinite(recording.estimates[~recording.late]).all()
    first = int(np.flatnonzero(recording.late)[0])
    np.testing.assert_array_equal(recording.commands[first], recording.commands[first - 1])
    # Before, across and after the gap the nodes did what one computer with all the numbers would have.
    central = compare_with_central(recording)
    assert central.worst.relative <= 1e-12
    assert central.ticks == ticks
    assert central.missing == 0
    names = recording.table("/event").column("name")
    assert "late" in names
    assert cli.gone() == {}


@pytest.mark.every
def test_too_many_late_ticks_in_a_row_make_the_arm_safe(start: Start) -> None:
    hold = 5
    cli = start.run(
        *("--nodes", "4", "--ticks", "100000", "--no-plot"),
        *("--realtime", "--period", "0.1", "--hold-ticks", str(hold)),  # a busy machine keeps that
    )
    cli.wait_for_records()
    os.kill(cli.processes()["octarm-node1"], signal.SIGSTOP)
    assert cli.finish() == 4
    assert f"{hold + 1} late ticks in a row, {hold} may be" in cli.err
    assert "the arm is passive under the loads that hold setpoint" in cli.err
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []
    recording = read_recording(cli.recording())
    late = list(recording.table("/plant/pace").column("late"))
    waited, bridged = 3, 2  # half of five, and the rest
    assert late[-20 - hold :] == [1.0] * waited + [0.0] * bridged + [1.0] * 20
    passive = list(recording.table("/plant/guard").column("passive"))
    assert passive[-21:] == [0.0] + [1.0] * 20
    events = recording.table("/event").column("name")
    assert list(events[-3:]) == ["late", "passive", "safety_stop"]


def test_a_period_that_nobody_can_hold_is_given_up_at_once(start: Start) -> None:
    cli = start.run("--nodes", "6", "--ticks", "1000", *QUIET, "--realtime", "--period", "0.00002")
    assert cli.finish() == 4
    assert "late ticks in a row, 2 may be" in cli.err
    assert cli.gone() == {}


def test_real_time_scheduling_is_used_where_it_is_permitted_and_said_where_not(
    start: Start,
) -> None:
    slowly = ("--realtime", "--period", "0.05", "--hold-ticks", "1000")  # others need the cores too
    cli = start.run("--nodes", "3", "--ticks", "100000", "--no-plot", "--sched", "fifo", *slowly)
    cli.wait_for("tick ")
    found = cli.processes()
    policies = {name: os.sched_getscheduler(pid) for name, pid in found.items()}
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    urgent = {name for name, policy in policies.items() if policy == os.SCHED_FIFO}
    if "no real-time scheduling" in cli.err:
        assert urgent == set()
        assert cli.err.count("no real-time scheduling") == 1
    else:
        assert urgent == {"octarm-node0", "octarm-node1", "octarm-node2", "octarm-plant"}


@pytest.mark.variants("3")
@pytest.mark.parametrize("per_process", [2, 3, 5])
def test_segments_that_share_a_process_do_the_same(start: Start, per_process: int) -> None:
    nodes, ticks = 6, 40
    same = ("--nodes", str(nodes), "--ticks", str(ticks), "--no-plot")
    alone = start.run(*same, "--quiet")
    shared = start.run(*same, "--json", "--segments-per-process", str(per_process))
    assert [alone.finish(), shared.finish()] == [0, 0], alone.err + shared.err
    one, other = read_recording(alone.recording()), read_recording(shared.recording())
    assert first_difference(one, other) is None
    processes = -(-nodes // per_process)
    summary = shared.json()
    assert summary["node_processes"] == processes
    assert summary["neighbour_messages"] == 2 * (processes - 1) * ticks
    assert summary["passed_messages"] == 2 * (nodes - processes) * ticks
    assert summary["intact_links"] == 2 * (processes - 1)
    assert summary["sweep_messages"]["measurement"] == processes * ticks
    assert shared.gone() == {}


def test_a_killed_process_of_several_segments_stops_the_arm(start: Start) -> None:
    cli = start.run(
        "--nodes", "6", "--ticks", "1000000", "--no-plot", "--segments-per-process", "2"
    )
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-node2"], signal.SIGKILL)
    assert cli.finish() == 4
    assert "node 2 was ended by SIGKILL" in cli.err
    assert cli.gone() == {}
    assert read_recording(cli.recording()).unfinished is None


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--period", "0.1"), "--period is for --realtime"),
        (("--realtime", "--period", "0"), "--period: expected a positive number"),
        (("--realtime", "--period", "nan"), "--period: expected a positive number"),
        (("--realtime", "--hold-ticks", "-1"), "--hold-ticks: expected at least 0, got -1"),
        (("--segments-per-process", "0"), "--segments-per-process: expected at least 1, got 0"),
        (("--segments-per-process", "10"), "expected at most 9"),
        (("--segments-per-process", "3", "--by-hand", "4"), "a multiple of 3"),
    ],
)
def test_what_makes_no_sense_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], text: str
) -> None:
    assert octarm("run", *arguments) == 2
    assert text in capsys.readouterr().err
