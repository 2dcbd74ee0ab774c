"""A man in the middle of a link of a real run: what is wrong is refused by name, what is missing is bridged,
what stays missing makes the arm passive; never does a wrong number move it."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import one_run
from fault_runs import (
    BACKWARD_BRIDGED,
    FORWARD_BRIDGED,
    HELD,
    MEASUREMENT_HELD,
    ON_TIME,
    VALID,
    bad_messages,
    bridged_at,
    counts,
    estimates_apart,
    flags_of,
    passive_from,
    rejected,
)
from interposer import Change, Interposer, Passed, unchanged

from analysis.compare import first_difference
from analysis.recording import Recording, read_recording
from chaos.aftermath import Expected
from wire.channels import Health

if TYPE_CHECKING:
    from conftest import Cli, Start

NODE = 2
"""Of four: it has two neighbours."""
FOUR = ("--nodes", "4", "--seed", "5")
SHORT = (*FOUR, "--no-plot")
HOLD = 10
PERIOD_S = 0.04
REALTIME = (*SHORT, "--realtime", "--period", str(PERIOD_S), "--hold-ticks", str(HOLD))
GIVEN_UP = HOLD / 2 + 4.0
"""Periods after which the tick of a message has been given up: with the late tick H / 2 + 1, and whoever waits
for the message hears of it with the measurement that is sent then. The rest is for a busy machine."""
FLOWS = ("forward", "backward", "measurement", "command")
REPLACING = ("not_finite", "setpoint", "length", "version")
"""What can be wrong with a message that comes in place of a good one."""
APART = 0.2
"""Held commands change the momentum of the slowest mode, which takes 67 s to go: 0.20 were measured after 18
losses with a third of all ticks held, 0.11 after eight with a fifth."""
AFTER_TICKS = 50
"""5 s of the arm's time."""
REPLACED_EVERY = 15
MOST_TICKS = 20 + 2 * len(REPLACING) * REPLACED_EVERY + AFTER_TICKS


@contextmanager
def between(start: Start, change: Change, *arguments: str, flow: str) -> Iterator[Cli]:
    """A run with this process between node 2 and its left neighbour, or the plant."""
    cli = start.run(*arguments, "--by-hand", str(NODE))
    cli.wait_for(f"node {NODE} is yours")
    one = Interposer(start, cli, NODE, change, plant=flow in ("measurement", "command"))
    try:
        yield cli
    finally:
        one.node.popen.send_signal(signal.SIGINT)
        one.node.finish()
        one.close()


def ended(
    start: Start, change: Change, *arguments: str, flow: str, expected: Expected
) -> Recording:
    """The recording of such a run, everything that must be true after it checked."""
    with between(start, change, *arguments, flow=flow) as cli:
        cli.finish()
    cli.ends(expected)
    return cli.recorded()


def receiver_of(flow: str) -> str:
    """Whose counters tell of what was refused in a flow."""
    return {"command": "plant", "backward": f"node/0{NODE - 1}"}.get(flow, f"node/0{NODE}")


def lose(flow: str, lost: Callable[[int], bool], ticks: list[int] | None = None) -> Change:
    """Lose the messages of a flow of these ticks; `ticks` is filled with them."""

    def change(name: str, tick: int, raw: bytes) -> Passed:
        if name != flow or not lost(tick):
            return ((0.0, raw),)
        if ticks is not None:
            ticks.append(tick)
        return ()

    return change


# -- what is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize("flow", FLOWS)
def test_whatever_is_wrong_with_a_message_it_is_refused_by_name_and_moves_nothing(
    start: Start, flow: str
) -> None:
    """In lock-step, one bad message a tick before the good one, then good ones twice: the numbers are those of
    a run that nobody disturbed, bit for bit."""
    first, injected = 5, []

    def change(name: str, tick: int, raw: bytes) -> Passed:
        if name != flow or tick < first:
            return ((0.0, raw),)
        bad = bad_messages(raw, announces=flow == "backward")
        if tick - first < len(bad):
            reason, message = bad[tick - first]
            injected.append(reason)
            return ((0.0, message), (0.0, raw))
        if tick % 10 == 0:
            injected.append("again")
            return ((0.0, raw), (0.0, raw))
        return ((0.0, raw),)

    same = (*SHORT, "--ticks", "120", "--deadline", "30")
    found = ended(start, change, *same, flow=flow, expected=Expected((0,), ticks=120))
    refused = rejected(found, receiver_of(flow))
    again = refused.pop("duplicate", 0)
    expected = counts(injected)
    # a good message that comes twice is refused as of this tick or, if that is over, as of an earlier one
    again += refused["stale"] - expected["stale"]
    refused["stale"] = expected["stale"]
    assert again == expected.pop("again")
    assert refused == expected
    assert len(expected) == 12  # all reasons there are, "duplicate" and "late" aside
    alone = start.run(*same)
    alone.ends(Expected((0,), ticks=120))
    difference = first_difference(alone.recorded(), found)
    if flow != "command":
        assert difference is None
    else:  # nothing but what it says of the node's health
        assert difference is not None and difference.startswith("/plant/health: tick 5, node_02")
        np.testing.assert_array_equal(alone.recorded().truth, found.truth)
        np.testing.assert_array_equal(alone.recorded().commands, found.commands)
        valid = found.table("/plant/health").numbers(f"node_0{NODE}").astype(int) & VALID
        for k, reason in enumerate(injected[: len(injected) - again], first):
            late_only = reason in ("stale", "early")
            assert bool(valid[k]) is late_only, (k, reason)


@pytest.mark.parametrize("flow", FLOWS)
def test_a_bad_message_in_place_of_a_good_one_is_bridged(
    start: Start, alone: Recording, flow: str
) -> None:
    """In real time; two of every kind, each a while after the one before. (All are refused in every place: the
    test above.)"""
    injected: list[str] = []
    at: list[int] = []

    def change(name: str, tick: int, raw: bytes) -> Passed:
        place = len(injected)
        due = at[-1] + REPLACED_EVERY if at else 20
        if name != flow or tick < due or place == 2 * len(REPLACING):
            return ((0.0, raw),)
        reason = REPLACING[place // 2]
        bad = [one for one in bad_messages(raw, announces=flow == "backward") if one[0] == reason]
        injected.append(reason)
        at.append(tick)
        return ((0.0, bad[-(place % 2)][1]),)  # the first, the last

    ticks = MOST_TICKS
    found = ended(
        *(start, change, *REALTIME, "--ticks", str(ticks)),
        flow=flow,
        expected=Expected((3,), (r"late: ", r"finished: all"), ticks=ticks - HOLD),
    )
    refused = rejected(found, receiver_of(flow))
    assert len(injected) == 2 * len(REPLACING)
    for reason, times in counts(injected).items():
        assert refused[reason] == times
    assert np.isfinite(found.truth).all()
    assert np.isfinite(found.commands).all()
    # Of a sweep that it had no time for a node has no row, and the plant no command.
    rows = flags_of(found) >= 0
    assert np.isfinite(found.estimates[rows]).all()
    assert rows[at, NODE - (flow == "backward")].all()
    on_time = found.health_says(Health.ON_TIME)
    assert rows[~found.late[:, None] & on_time].all()
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < APART


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Recording:
    """The same run as those in real time, without a fault; of a shorter one the first ticks."""
    with one_run(
        tmp_path_factory.mktemp("alone"), gains, *FOUR, "--ticks", str(MOST_TICKS)
    ) as path:
        return read_recording(path)


# -- what is missing -------------------------------------------------------------------------------


LOST = {
    "one": lambda tick: tick >= 30,
    "several in a row": lambda tick: 30 <= tick < 38,
    "periodic": lambda tick: 30 <= tick < 90 and tick % 15 == 0,
}


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("lost", LOST)
def test_a_lost_message_is_bridged_and_the_run_goes_on(
    start: Start, alone: Recording, flow: str, lost: str
) -> None:
    ticks = 90 + AFTER_TICKS
    gone: list[int] = []
    # on a busy machine tick 30 may have no sweep: then it is the next one that is lost
    once = (lambda tick: tick >= 30 and not gone) if lost == "one" else LOST[lost]
    found = ended(
        *(start, lose(flow, once, gone), *REALTIME, "--ticks", str(ticks)),
        flow=flow,
        expected=Expected((3,), (r"late: ", r"finished: all"), ticks=ticks - HOLD),
    )
    first = gone[0]
    assert found.late[first + 1 : first + 7].any()
    if flow == "forward":
        assert first in bridged_at(found, NODE, FORWARD_BRIDGED)
        assert found.process_counters(f"node/0{NODE}")["bridged_sums"] >= 1
    elif flow == "backward":
        assert first in bridged_at(found, NODE - 1, BACKWARD_BRIDGED)
        assert found.process_counters(f"node/0{NODE - 1}")["bridged_sums"] >= 1
    elif flow == "measurement":
        assert first in bridged_at(found, NODE, MEASUREMENT_HELD)
        assert first in bridged_at(found, NODE, HELD)
    else:
        health = found.table("/plant/health").numbers(f"node_0{NODE}").astype(int)
        assert not health[first] & ON_TIME
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < APART


@pytest.mark.parametrize("flow", FLOWS)
def test_messages_that_stay_away_make_the_arm_passive(start: Start, flow: str) -> None:
    """A long period, so that the time in which processes wake up is little of it."""
    lost_from, period_s = 10, 0.1
    lost: list[int] = []
    found = ended(
        *(start, lose(flow, lambda tick: tick >= lost_from, lost)),
        *(*REALTIME, "--period", str(period_s), "--ticks", "2000"),
        flow=flow,
        expected=Expected((4,), (r"passive: tick \d+: ", r"safety_stop: ")),
    )
    # H late ticks in a row; a sum may be bridged H + H / 2 + 3 periods, and nobody looks for 0.15 s at most
    bound = (
        HOLD + 3
        if flow in ("measurement", "command")
        else HOLD + HOLD // 2 + 3 + 2 + 0.15 / period_s
    )
    assert lost[0] < passive_from(found) <= lost[0] + bound


@pytest.mark.parametrize("flow", FLOWS)
def test_in_lock_step_a_lost_message_stops_the_run_after_the_deadline(
    start: Start, flow: str
) -> None:
    """Whoever waits looks at the clock: the plant, the nodes that the launcher has started, and the one that
    was started by hand, of which the plant sees that it leaves, and whose words are on its own standard
    output."""
    change = lose(flow, lambda tick: tick == 30)
    arguments = (*SHORT, "--ticks", "2000", "--deadline", "1")
    with between(start, change, *arguments, flow=flow) as cli:
        cli.finish()
    said = cli.err if f"node {NODE} is gone" not in cli.err else start.started[-1].out
    assert re.search(r"no command within 1 s from |waited 1 s for ", said), said
    cli.ends(Expected((4,), (r"passive: tick 30: ", r"safety_stop: ")))
    assert passive_from(cli.recorded()) == 30


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("periods", [0.5, 1.0, 3.0, GIVEN_UP])
def test_a_message_that_comes_late_does_no_harm(
    start: Start, alone: Recording, flow: str, periods: float
) -> None:
    def change(name: str, tick: int, raw: bytes) -> Passed:
        late = name == flow and 30 <= tick < 90 and tick % 20 == 0
        return ((periods * PERIOD_S if late else 0.0, raw),)

    ticks = 90 + AFTER_TICKS
    found = ended(
        *(start, change, *REALTIME, "--ticks", str(ticks)),
        flow=flow,
        expected=Expected(
            (0, 3) if periods < 1.0 else (3,), (r"finished: all",), ticks=ticks - HOLD
        ),
    )
    if periods == GIVEN_UP:  # and its message is refused for that alone
        assert set(rejected(found, receiver_of(flow))) <= {"stale", "late", "early", "duplicate"}
        assert bridged_at(found, NODE, FORWARD_BRIDGED | HELD) or flow in ("command", "backward")
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < APART


@pytest.mark.parametrize("flow", FLOWS)
def test_messages_in_another_order_or_twice_do_no_harm(
    start: Start, alone: Recording, flow: str
) -> None:
    """Every tenth message comes after the sweep of the next one has begun, every seventh twice; those of ticks
    that have a sweep, which none has while one is waited for."""
    done = {"later": 0, "twice": 0}

    def change(name: str, tick: int, raw: bytes) -> Passed:
        if name != flow or not 30 <= tick < 90:
            return ((0.0, raw),)
        if tick % 10 == 0:
            done["later"] += 1
            return ((GIVEN_UP * PERIOD_S, raw),)
        if tick % 7 == 0:
            done["twice"] += 1
            return ((0.0, raw), (0.0, raw))
        return ((0.0, raw),)

    ticks = 90 + AFTER_TICKS
    found = ended(
        *(start, change, *REALTIME, "--ticks", str(ticks)),
        flow=flow,
        expected=Expected((3,), (r"finished: all",), ticks=ticks - HOLD),
    )
    refused = rejected(found, receiver_of(flow))
    assert refused.keys() <= {"stale", "late", "early", "duplicate"}
    assert done["later"] >= 3
    assert done["twice"] >= 1
    assert sum(refused.values()) >= done["later"] + done["twice"]
    assert np.nanmax(estimates_apart(found, alone)[-5:]) < APART


def test_nobody_notices_a_man_in_the_middle_who_changes_nothing(start: Start) -> None:
    """The bench itself adds nothing."""
    same = (*SHORT, "--ticks", "60")
    found = ended(start, unchanged, *same, flow="forward", expected=Expected((0,), ticks=60))
    alone = start.run(*same)
    alone.ends(Expected((0,), ticks=60))
    assert first_difference(alone.recorded(), found) is None
    assert found.intact_links() == 6


def test_a_finite_number_changed_on_the_way_is_found_in_the_recording(start: Start) -> None:
    """A flipped bit of the payload is no error that a tick could see: the ends' checksums tell afterwards."""

    def change(name: str, tick: int, raw: bytes) -> Passed:
        if name == "forward" and tick == 30:
            raw = raw[:32] + bytes([raw[32] ^ 1]) + raw[33:]
        return ((0.0, raw),)

    same = (*SHORT, "--ticks", "60")
    found = ended(start, change, *same, flow="forward", expected=Expected((0, 3), ticks=60))
    assert found.intact_links() == 5
