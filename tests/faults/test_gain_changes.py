"""Faults in the tick in which the gains change: the two sides of a gap agree again within a few ticks."""

from __future__ import annotations

import os
import signal
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fault_runs import Array, node_pid
from interposer import Interposer, Passed

from analysis.recording import Recording
from chaos.aftermath import Expected

if TYPE_CHECKING:
    from conftest import Start

SCENARIO = """
name = "there"
start = "straight"
hold_s = 1.0
[[legs]]
to = "1"
move_s = 4.0
hold_s = 4.0
[scheduling]
hysteresis_deg = 1.0
bump_s = 0.8
"""
NODES, BY_HAND, TICKS = 5, 2, 90
HOLD = 8
MIXED_TICKS = 8
"""So many ticks at most have two sets of gains after a fault: those that are waited for, and as long as an
announcement needs."""
MIXED_WITH_A_DEATH = 20
"""The replacement begins with the setpoint of its neighbour towards the tip; after more the plant gives up."""
PERIOD_S, PERIOD_WITH_A_DEATH_S = 0.03, 0.08
"""So that 20 ticks are enough for a replacement on a busy machine: 0.36 s were measured on one whose processes
wanted six times the cores that it had."""


class AtTheChange:
    """Changes nothing until a backward sum announces another setpoint; then what the test says, for some
    ticks."""

    def __init__(self, lost: dict[str, range], act: object = None) -> None:
        self.lost = lost
        self.act = act
        self.announced = 0.0
        self.changes: list[int] = []

    def __call__(self, name: str, tick: int, raw: bytes) -> Passed:
        if name == "backward":
            (announced,) = struct.unpack_from("<d", raw, len(raw) - 8)
            if announced != self.announced:
                self.announced = announced
                self.changes.append(tick)
                if callable(self.act) and len(self.changes) == 1:
                    self.act()
        if self.changes and tick - self.changes[-1] in self.lost.get(name, range(0)):
            return ()
        return ((0.0, raw),)


def run_with(start: Start, tmp_path: Path, at: AtTheChange, kill: int | None = None) -> Recording:
    period_s = PERIOD_S if kill is None else PERIOD_WITH_A_DEATH_S
    path = tmp_path / "there.toml"
    path.write_text(SCENARIO)
    arguments = ("--scenario", path, "--nodes", str(NODES), "--no-plot", "--seed", "5")
    cli = start.run(
        *(*arguments, "--realtime", "--period", str(period_s), "--hold-ticks", str(HOLD)),
        *("--by-hand", str(BY_HAND), *(("--restart",) if kill is not None else ())),
    )
    cli.wait_for(f"node {BY_HAND} is yours")
    one = Interposer(start, cli, BY_HAND, at, plant=False)
    try:
        cli.wait_for("tick ")
        if kill is not None:
            pid = node_pid(cli, kill)
            at.act = lambda: os.kill(pid, signal.SIGKILL)
        cli.finish()
    finally:
        one.node.popen.send_signal(signal.SIGINT)
        one.node.finish()
        one.close()
    cli.ends(Expected((3,), (r"setpoint: ", r"finished: "), ticks=TICKS - HOLD))
    found = cli.recorded()
    assert not (found.table("/plant/guard").numbers("passive") > 0.0).any()
    assert at.changes
    # the same gains at the end, in all nodes
    last = active(found)[-1]
    assert (last[np.isfinite(last)] == 1.0).all()
    return found


def active(recording: Recording) -> Array:
    """Setpoint whose gains each node uses, (K, n); NaN where there is no row."""
    return recording.of_nodes("schedule", ("setpoint",))[:, :, 0]


def mixed(recording: Recording) -> int:
    """Ticks in a row, at most, in which not all nodes used the same gains; ticks without a sweep are as the one
    before."""
    longest = so_far = 0
    for row in active(recording):
        known = row[np.isfinite(row)]
        if known.size:
            so_far = so_far + 1 if len(set(known.tolist())) > 1 else 0
        elif so_far:
            so_far += 1
        longest = max(longest, so_far)
    return longest


LOST = {
    "the announcement": {"backward": range(1)},
    "the one after": {"backward": range(1, 2)},
    "several from it on": {"backward": range(4)},
    "forward sums around it": {"forward": range(1, 4)},
    "both ways": {"backward": range(3), "forward": range(1, 4)},
}


@pytest.mark.parametrize("lost", LOST)
def test_sums_are_lost_when_the_gains_change(start: Start, tmp_path: Path, lost: str) -> None:
    found = run_with(start, tmp_path, AtTheChange(LOST[lost]))
    assert mixed(found) <= MIXED_TICKS


@pytest.mark.parametrize("node", [0, 1, 3, 4])
def test_a_node_dies_when_the_gains_change(start: Start, tmp_path: Path, node: int) -> None:
    """Root and tip among them; the tip decides."""
    found = run_with(start, tmp_path, AtTheChange({}), kill=node)
    assert mixed(found) <= MIXED_WITH_A_DEATH
