"""Nodes that the plant does not wait for, commands of those that are late, and when a sweep is given up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from bus import Bus
from hypothesis import given
from hypothesis import strategies as st

from plant.exchange import DISAGREE_TICKS, Exchange
from plant.pace import Pace
from plant.presence import Presence
from wire.keys import Keys
from wire.messages import Kind, encode_numbers, run_tag
from wire.run_config import PaceConfig

RUN = run_tag("a run")
KEYS = Keys(RUN)
START = [0.5, -1.0, 2.0, 0.0, 3.5, 1.0]
REST = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
ALIVE, ON_TIME, VALID = 1, 2, 4


class Bench:
    """An exchange with nodes of two segments each."""

    def __init__(self, *, lenient: bool = True) -> None:
        self.bus = Bus()
        self.completed: list[int] = []
        self.exchange = Exchange(
            KEYS,
            (0, 2, 4),
            START,
            3,
            0,
            lambda: self.completed.append(self.exchange.tick),
            lenient=lenient,
        )
        self.exchange.declare(self.bus)

    def send(self, tick: int) -> None:
        self.exchange.send(tick, np.zeros((6, 2)))

    def command(self, first: int, tick: int, setpoint: int = 0, **changes: Any) -> None:
        """What a node sends at a tick: 100 tick + its segment."""
        fields: dict[str, Any] = {"kind": Kind.COMMAND, "run": RUN, "tick": tick, "sender": first}
        values = [100.0 * tick + i for i in (first, first + 1)]
        fields |= {"setpoint": setpoint, "values": values}
        self.bus.give(KEYS.command(first), encode_numbers(**(fields | changes)))


@pytest.fixture(autouse=True)
def _no_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    Bus.install(monkeypatch)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_who_is_left_out_is_not_waited_for_until_it_speaks_again(bench: Bench) -> None:
    exchange = bench.exchange
    bench.send(0)
    bench.command(0, 0)
    bench.command(4, 0)
    assert (exchange.left, exchange.missing(), exchange.out) == (1, [2], [])
    exchange.give_up(2)
    exchange.give_up(2)
    assert (exchange.left, exchange.missing(), exchange.out) == (0, [], [2])
    assert exchange.complete_ns > 0
    bench.send(1)
    assert exchange.left == 2
    bench.command(2, 1)  # a new process: from the next tick on it is waited for
    assert (exchange.left, exchange.out) == (2, [2])
    bench.command(0, 1)
    bench.command(4, 1)
    assert bench.completed == [1]
    bench.send(2)
    assert (exchange.left, exchange.out) == (3, [])


def test_left_out_before_its_command_came_or_after(bench: Bench) -> None:
    bench.send(0)
    bench.command(2, 0)
    bench.exchange.give_up(2)
    assert bench.exchange.left == 2
    bench.send(1)
    assert bench.exchange.left == 2


@given(
    fade=st.floats(0.0, 1.0),
    ticks=st.integers(1, 6),
    node=st.sampled_from([0, 2, 4]),
)
def test_the_load_of_a_node_that_is_left_out_goes_to_rest(
    fade: float, ticks: int, node: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        Bus.install(patch)
        bench = Bench()
    exchange = bench.exchange
    exchange.give_up(node)
    for tick in range(ticks):
        bench.send(tick)
        for other in {0, 2, 4} - {node}:
            bench.command(other, tick)
        assert exchange.take(REST, fade) is None
    for i in range(6):
        if i in (node, node + 1):
            wanted = REST[i] + fade**ticks * (START[i] - REST[i])
            assert exchange.commands[i] == pytest.approx(wanted, rel=1e-12, abs=1e-12)
        else:
            assert exchange.commands[i] == 100.0 * (ticks - 1) + i


def test_the_command_of_a_late_node_is_held(bench: Bench) -> None:
    bench.send(0)
    bench.command(0, 0)
    bench.command(4, 0)
    assert bench.exchange.take(REST, 0.5) is None
    np.testing.assert_array_equal(bench.exchange.commands, [0.0, 1.0, 2.0, 0.0, 4.0, 5.0])


def test_three_things_that_are_known_of_a_node(bench: Bench) -> None:
    exchange = bench.exchange
    bench.send(0)
    bench.command(0, 0, values=[np.nan, 0.0])
    bench.command(2, 0)
    exchange.vanished.add(4)
    assert exchange.health() == [
        *[ALIVE] * 2,
        *[ALIVE | ON_TIME | VALID] * 2,
        *[VALID] * 2,
    ]
    bench.command(0, 0)  # the good one after a bad one
    assert exchange.health()[:2] == [ALIVE | ON_TIME] * 2
    bench.send(1)
    bench.command(2, 0)  # late, and valid
    bench.command(0, 2)  # early, and valid
    assert [h & VALID for h in exchange.health()] == [VALID] * 6


def test_a_command_shows_that_its_node_is_alive_again(bench: Bench) -> None:
    bench.exchange.vanished.add(2)
    bench.exchange.give_up(2)
    bench.send(0)
    bench.command(2, 0)
    assert bench.exchange.vanished == set()


@pytest.mark.parametrize("lenient", [False, True])
def test_a_command_of_the_tick_before_brings_a_node_back_where_time_matters(lenient: bool) -> None:
    bench = Bench(lenient=lenient)
    bench.exchange.give_up(2)
    bench.send(0)
    bench.send(1)
    bench.command(2, 0)
    bench.send(2)
    assert bench.exchange.out == ([] if lenient else [2])


@pytest.mark.parametrize("lenient", [False, True])
def test_nodes_may_disagree_about_the_setpoint_only_so_long(lenient: bool) -> None:
    bench = Bench(lenient=lenient)
    for tick in range(DISAGREE_TICKS + 1 if lenient else 1):
        bench.send(tick)
        bench.command(0, tick)
        bench.command(2, tick, setpoint=1)
        bench.command(4, tick, setpoint=1)
        told = bench.exchange.take(REST, 0.5)
        if lenient and tick < DISAGREE_TICKS:
            assert told is None
    assert told == ([2, 4], 1)


def test_agreement_in_between_begins_the_patience_anew(bench: Bench) -> None:
    for tick in range(3 * DISAGREE_TICKS):
        bench.send(tick)
        other = 0 if tick % 10 == 9 else 1
        for node in (0, 2, 4):
            bench.command(node, tick, setpoint=0 if node == 0 else other)
        assert bench.exchange.take(REST, 0.5) is None


def test_who_is_left_out_has_no_say_about_the_setpoint(bench: Bench) -> None:
    bench.exchange.give_up(0)
    bench.send(0)
    bench.command(2, 0, setpoint=1)
    bench.command(4, 0, setpoint=1)
    assert bench.exchange.take(REST, 0.5) is None
    assert bench.exchange.setpoint == 1


@pytest.mark.parametrize("hold", [2, 3, 6])
@pytest.mark.parametrize("late_once", [(), (0,), (4,), (0, 4)])
def test_who_is_late_once_is_not_left_out_with_who_is_stuck(
    bench: Bench, hold: int, late_once: tuple[int, ...]
) -> None:
    """By the clock, node 2 of three does not answer; in the last tick that may be late others are slow as well.
    More than half would not be left out."""
    exchange, pace, told = bench.exchange, Pace(PaceConfig(0.01, hold)), []
    presence = Presence(exchange, 3, lambda what, **about: told.append((what, about)), restart=True)

    def sweep(tick: int, *slow: int) -> None:
        bench.send(tick)
        for node in {0, 4}.difference(slow):
            bench.command(node, tick)

    sweep(0)
    for tick in range(1, hold + 1):
        assert pace.late()
        if pace.gives_up:
            assert exchange.take(REST, 0.5) is None
            sweep(tick, *(late_once if tick == hold else ()))
    assert exchange.missing() == sorted([2, *late_once])
    assert not pace.late()
    assert presence.leave_stuck_out(pace, hold + 1)
    assert exchange.out == [2]
    assert told == [("out", {"node": 2, "tick": hold + 1, "why": "stuck"})]
    # Who is still late in the next sweep is late again.
    bench.send(hold + 1)
    bench.command(0, hold + 1)
    assert exchange.stuck() == [4]


def test_if_nobody_is_late_again_those_are_stuck_that_are_late(bench: Bench) -> None:
    bench.send(0)
    bench.command(0, 0)
    bench.command(2, 0)
    bench.send(1)
    bench.command(2, 1)
    bench.command(4, 1)
    assert bench.exchange.stuck() == [0]


@pytest.mark.parametrize("hold", range(8))
def test_half_of_the_late_ticks_are_waited_for_then_every_tick_has_a_sweep(hold: int) -> None:
    pace = Pace(PaceConfig(0.01, hold))
    for _ in range(2):
        done = []
        while pace.late():
            done.append(pace.gives_up)
        assert len(done) == hold
        assert done == [k >= (hold + 1) // 2 for k in range(hold)]
        pace.on_time()
        assert pace.late_in_a_row == 0
