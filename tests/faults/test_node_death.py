"""Nodes of a running arm are killed: it is passive at once, or goes on while they are replaced."""

from __future__ import annotations

import os
import re
import signal
import time
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fault_runs import (
    ALIVE,
    BACKWARD_BRIDGED,
    FORWARD_BRIDGED,
    JOINED,
    SAFE_TICKS,
    Array,
    bridged_at,
    estimates_apart,
    flags_of,
    in_slow_motion,
    node_pid,
    passive_from,
)

from analysis.recording import Recording
from chaos.aftermath import Expected, event_lines

if TYPE_CHECKING:
    from conftest import Cli, Start

SAME = ("--nodes", "6", "--no-plot", "--seed", "5")
ENDLESS = (*SAME, "--ticks", "1000000")
PERIOD_S = 0.04
REALTIME = ("--realtime", "--period", str(PERIOD_S), "--hold-ticks", "20")
WAYS = {
    "lock-step": (),
    "tcp": ("--transport", "tcp"),
    "shared": ("--segments-per-process", "2"),
    "real time": REALTIME,
    "real time, tcp, shared": (*REALTIME, "--transport", "tcp", "--segments-per-process", "2"),
}
SAFE_WITHIN_S = 0.5
"""From the kill to the first passive tick, on a machine that has other things to do."""
APART = 0.2
"""Of the undisturbed run, at the end: the arm swings once a minute, and was without a segment for some seconds
of its time in the middle of it."""
TICKS = 700
"""Enough in lock-step for the estimates to agree again; until the replacement works the run is kept slow, 200
ticks a second at most."""


def kill(cli: Cli, *nodes: int) -> int:
    """Kill nodes at once; the instant on the monotonic clock, ns."""
    numbers = [node_pid(cli, node) for node in nodes]
    at_ns = time.monotonic_ns()
    for number in numbers:
        os.kill(number, signal.SIGKILL)
    return at_ns


def began_ns(recording: Recording, tick: int) -> int:
    """When a tick began, on the monotonic clock."""
    table = recording.table("/sweep/timing")
    row = int(np.flatnonzero(table.ticks == tick)[0])
    return int(table.numbers("started_wall_ns")[row]) + int(recording.facts["epoch_ns"])


# -- without replacement ---------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("node", [0, 2, -1])
def test_a_killed_node_makes_the_arm_passive_at_once(start: Start, way: str, node: int) -> None:
    last = 4 if "shared" in way else 5
    node = last if node < 0 else node
    cli = start.run(*ENDLESS, *WAYS[way])
    cli.wait_for_records()
    at_ns = kill(cli, node)
    who = rf"node {node} (is gone|was ended by SIGKILL)"
    cli.ends(Expected((4,), (rf"passive: tick \d+: {who}", rf"safety_stop: .*{who}"), (who,)))
    found = cli.recorded()
    first = passive_from(found)
    # By the clock a tick begins when it is due: the first passive one may be the one that was going on.
    earliest = -PERIOD_S if "real time" in way else 0.0
    assert earliest < (began_ns(found, first) - at_ns) * 1e-9 < SAFE_WITHIN_S
    assert len(found.table("/plant/guard").ticks) == first + SAFE_TICKS


@pytest.mark.parametrize("nodes", [(1, 2), (0, 5), (0, 1, 2, 3, 4, 5)])
def test_so_do_several(start: Start, nodes: tuple[int, ...]) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for_records()
    kill(cli, *nodes)
    cli.ends(Expected((4,), (r"passive: tick \d+: ", r"safety_stop: ")))
    passive_from(cli.recorded())


# -- with replacement ------------------------------------------------------------------------------


def back_at(recording: Recording) -> dict[int, int]:
    """The tick that each event node_back names."""
    told = [
        re.fullmatch(r"node_back: node (\d+) works again from tick (\d+) on.*", line)
        for line in event_lines(recording)
    ]
    return {int(one[1]): int(one[2]) for one in told if one}


def replaced(
    start: Start, *nodes: int, arguments: tuple[str, ...] = (), ticks: int = TICKS
) -> Recording:
    """A run in which these nodes are killed at once and replaced, checked."""
    cli = start.run(*SAME, "--ticks", str(ticks), "--restart", *arguments)
    lockstep = "--realtime" not in arguments
    with in_slow_motion(cli, but=nodes) if lockstep else nullcontext():
        cli.wait_for_records()
        kill(cli, *nodes)
        for node in nodes:
            cli.wait_for(f"node {node} works again")
    gone = tuple(rf"node_gone: .*node {node} is left out" for node in nodes)
    back = tuple(rf"node_back: node {node} works again" for node in nodes)
    named = "replaced: " + ", ".join(f"node {node}" for node in nodes)
    cli.ends(
        Expected(
            (3,), (*gone, *back, f"finished: all {ticks}"), (named, r"at most \d"), ticks=ticks
        )
    )
    found = cli.recorded()
    assert not (found.table("/plant/guard").numbers("passive") > 0.0).any()
    assert back_at(found).keys() == set(nodes)
    return found


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, gains: object) -> object:
    """The same run without a fault."""
    from conftest import Start

    starter = Start(tmp_path_factory.mktemp("alone"), gains)  # type: ignore[arg-type]
    cli = starter.run(*SAME, "--ticks", str(TICKS), "--quiet")
    try:
        assert cli.finish() == 0, cli.err
        return cli.recorded()
    finally:
        cli.close()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("node", [0, 2, -1])
def test_a_killed_node_is_replaced_while_the_others_go_on(
    start: Start, alone: Recording, way: str, node: int
) -> None:
    realtime, size = "real time" in way, 2 if "shared" in way else 1
    node = 6 - size if node < 0 else node
    ticks = 200 if realtime else TICKS
    found = replaced(start, node, arguments=WAYS[way], ticks=ticks)
    tick = back_at(found)[node]
    for segment in range(node, node + size):
        (joined,) = bridged_at(found, segment, JOINED)
        # The row is of the tick in which the node begins; its command counts, and the plant waits, from the
        # next on, which it may notice a tick later.
        # In lock-step nobody waits, and more may pass meanwhile.
        assert 0 <= tick - joined <= (2 if realtime else 200)
        before = flags_of(found)[:joined, segment]
        assert (before[-1:] == -1).all()  # nobody spoke for it
    if node > 0:
        assert bridged_at(found, node - 1, BACKWARD_BRIDGED)
    if node + size < 6:
        assert bridged_at(found, node + size, FORWARD_BRIDGED)
    health = found.table("/plant/health").numbers(f"node_{node:02d}").astype(int)
    out = np.flatnonzero(health & ALIVE == 0)
    assert out.size and out[-1] <= tick + 1
    # nobody is degraded once the node is back and its first sums have come: in lock-step nobody waits for them
    settled = 100
    assert (
        not (flags_of(found)[tick + settled :][~found.late[tick + settled :]] > 0).any() or realtime
    )
    if realtime:  # in lock-step its neighbours' states may come too late to be of the same time
        _began_between_its_neighbours(found, node, size, joined)
    apart = estimates_apart(found, alone)
    assert np.nanmax(apart[-5:]) < APART


def _began_between_its_neighbours(found: Recording, node: int, size: int, joined: int) -> None:
    """Its first estimate lies between those of its neighbours, as deviations from the reference."""

    def deviation(segment: int, tick: int) -> Array:
        reference = found.references.nodes[segment].at(tick)[:4]
        return np.asarray(found.estimates[tick, segment] - reference)

    near = range(max(0, joined - 2), joined + 3)
    left = [deviation(node - 1, k) for k in near] if node > 0 else [None]
    right = [deviation(node + size, k) for k in near] if node + size < found.nodes else [None]
    own = np.array([deviation(node + j, joined) for j in range(size)])
    shares = (np.arange(size) + 1.0)[:, None] / (size + 1.0)
    scale = np.abs(own).max()
    best = np.inf
    for a in left:
        for b in right:
            one, other = (b if a is None else a), (a if b is None else b)
            assert one is not None and other is not None
            wrong = np.abs(own - (one + shares * (other - one))).max()
            best = min(best, float(wrong) if np.isfinite(wrong) else np.inf)
    assert best <= 1e-9 * scale


@pytest.mark.parametrize("nodes", [(1, 2), (1, 4), (0, 5), (0, 1), (4, 5), (1, 3, 5)])
def test_several_at_once_are_replaced(
    start: Start, alone: Recording, nodes: tuple[int, ...]
) -> None:
    found = replaced(start, *nodes)
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < APART


@pytest.mark.every
def test_two_at_once_in_real_time(start: Start) -> None:
    replaced(start, 2, 3, arguments=REALTIME, ticks=120)


@pytest.mark.parametrize("nodes", [(0, 1, 2, 3), (0, 1, 2, 3, 4, 5)])
def test_more_than_half_are_not_replaced(start: Start, nodes: tuple[int, ...]) -> None:
    cli = start.run(*ENDLESS, "--restart")
    cli.wait_for_records()
    kill(cli, *nodes)
    cli.ends(Expected((4,), (r"passive: .*more than half", r"safety_stop: ")))
    passive_from(cli.recorded())


def _other_process(cli: Cli, node: int, than: int) -> int:
    """The next process of a node."""
    limit = time.monotonic() + 60.0
    while (pid := cli.processes().get(f"octarm-node{node}", than)) == than:
        assert time.monotonic() < limit
        time.sleep(0.002)
    return pid


@pytest.mark.parametrize("times", [3, 4])
def test_a_node_that_keeps_dying_is_replaced_three_times(start: Start, times: int) -> None:
    """In 8 s, or until the arm is passive."""
    ticks = "200" if times == 3 else "100000"
    cli = start.run(*SAME, "--ticks", ticks, "--restart", *REALTIME)
    cli.wait_for_records()
    pid = node_pid(cli, 3)
    for i in range(times):
        os.kill(pid, signal.SIGKILL)
        if i < 3:
            pid = _other_process(cli, 3, pid)
            cli.wait_for("node 3 works again", times=i + 1)
    if times == 3:
        cli.ends(Expected((3,), (r"finished: ",), (r"replaced: node 3 \(3 times\)",)))
    else:
        who = r"node 3 (is gone|was ended by SIGKILL)"
        cli.ends(Expected((4,), (rf"passive: .*{who}", rf"safety_stop: .*{who}")))
        passive_from(cli.recorded())


def test_a_replacement_that_dies_at_once_is_replaced_as_well(start: Start) -> None:
    cli = start.run(*SAME, "--ticks", "150", "--restart", *REALTIME)
    cli.wait_for_records()
    pid = node_pid(cli, 3)
    os.kill(pid, signal.SIGKILL)
    os.kill(_other_process(cli, 3, pid), signal.SIGKILL)
    cli.ends(
        Expected((3,), (r"node_back: node 3", r"finished: "), (r"replaced: node 3 \(2 times\)",))
    )


@pytest.mark.every
def test_with_a_live_page(start: Start) -> None:
    replaced(start, 2, arguments=("--live", *REALTIME), ticks=120)
