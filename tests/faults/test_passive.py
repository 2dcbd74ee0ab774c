"""A passive arm: the static loads are in force from the first passive tick on, and what is in the arm only
falls."""

from __future__ import annotations

import os
import signal
import time
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fault_runs import SAFE_TICKS, Array, in_slow_motion, node_pid, passive_from

from analysis.recording import Recording
from chaos.aftermath import Expected

if TYPE_CHECKING:
    from conftest import Start

CALM = ("--nodes", "4", "--ticks", "1000000", "--no-plot", "--disturbance", "none", "--tick", "0.1")
REALTIME = ("--realtime", "--hold-ticks", "6")
RISE = 1e-6
"""Of the energy that moves in the passive ticks: more than the integrator's own error, which does not damp."""


def stored_j(recording: Recording) -> Array:
    """Kinetic, axial and bending energy and the loads' potential, by tick."""
    energy, guard = recording.table("/plant/energy"), recording.table("/plant/guard")
    parts = [energy.numbers(name) for name in ("kinetic_j", "axial_j", "bending_j")]
    return np.asarray(sum(parts) + guard.numbers("load_potential_j"))


def check(recording: Recording) -> None:
    first = passive_from(recording)
    passive = slice(first, first + SAFE_TICKS)
    stored = stored_j(recording)[passive]
    assert len(stored) == SAFE_TICKS
    fallen = stored[0] - stored[-1]
    assert fallen > 0.0
    assert np.diff(stored).max() <= RISE * fallen
    said = recording.table("/plant/guard").numbers("load_potential_j")
    shapes = recording.table("/plant/shape")
    y = np.stack([shapes.numbers(f"y{i:02d}_m") for i in range(33)], axis=1)
    wanted = _potential(y, recording.initial_commands, recording)
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(said[passive], wanted[passive], atol=3e-3 * scale)
    # what the nodes commanded just before was something else, so that this says something
    assert np.abs(said[:first] - wanted[:first]).max() > 2e-2 * scale


def _potential(y: Array, loads: Array, recording: Recording) -> Array:
    """The potential of loads (n,) in N/m, by tick, from the recorded shape by the trapezoidal rule.

    The loads belong to the segments' outer faces, with straight lines between them.
    """
    along = np.linspace(0.0, recording.configuration.faces_m[-1], y.shape[1])
    load = np.interp(along, recording.configuration.faces_m[1:], loads)
    return np.asarray(-np.trapezoid(load * y, along, axis=1))


@pytest.mark.parametrize("way", [(), REALTIME], ids=["lock-step", "real time"])
@pytest.mark.parametrize("node", [0, 1, 3])
def test_after_a_death(start: Start, way: tuple[str, ...], node: int) -> None:
    """While the arm still swings, in lock-step as well."""
    cli = start.run(*CALM, *way)
    with nullcontext() if way else in_slow_motion(cli, but=(node,)):
        cli.wait_for_records()
        os.kill(node_pid(cli, node), signal.SIGKILL)
    cli.ends(Expected((4,), (r"passive: ",)))
    check(cli.recorded())


@pytest.mark.parametrize("restart", [(), ("--restart",)], ids=["", "restart"])
def test_after_too_many_late_ticks(start: Start, restart: tuple[str, ...]) -> None:
    cli = start.run(*CALM, *REALTIME, *restart)
    cli.wait_for_records()
    for node in range(4) if restart else (2,):
        os.kill(node_pid(cli, node), signal.SIGSTOP)
    cli.ends(Expected((4,), (r"passive: .*late ticks in a row",)))
    check(cli.recorded())


def test_in_lock_step_after_the_deadline(start: Start) -> None:
    cli = start.run(*CALM, "--deadline", "1")
    with in_slow_motion(cli):
        cli.wait_for_records()
        os.kill(node_pid(cli, 2), signal.SIGSTOP)
    cli.ends(Expected((4,), (r"passive: .*no command within 1 s",)))
    check(cli.recorded())


def test_passive_is_for_good(start: Start) -> None:
    """Everybody is there again before the watch is over: the arm stays passive."""
    cli = start.run(*CALM, "--realtime", "--hold-ticks", "6", "--period", "0.1")
    cli.wait_for_records()
    pid = node_pid(cli, 1)
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.1 * (6 + 6))
    os.kill(pid, signal.SIGCONT)
    cli.ends(Expected((4,), (r"passive: ", r"safety_stop: ")))
    check(cli.recorded())


def test_a_user_may_end_the_watch(start: Start) -> None:
    cli = start.run(*CALM, "--realtime", "--hold-ticks", "2", "--period", "0.5")
    cli.wait_for_records()
    os.kill(node_pid(cli, 1), signal.SIGKILL)
    limit = time.monotonic() + 20
    while "octarm-node1" in cli.processes():
        assert time.monotonic() < limit
    time.sleep(1.0)
    began = time.monotonic()
    cli.popen.send_signal(signal.SIGINT)
    cli.finish()
    took_s = time.monotonic() - began
    cli.ends(Expected((4, 130)))
    assert took_s < 5.0  # of the 10 s
