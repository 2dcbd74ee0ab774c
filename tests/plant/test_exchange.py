"""The plant's messages of a tick: what is sent, which commands count, what is refused, what is counted."""

from __future__ import annotations

import random
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt
import pytest
from bus import Bus
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from plant.exchange import Exchange
from wire.keys import Keys
from wire.messages import PLANT, Kind, decode_numbers, encode_numbers, run_tag

Array = npt.NDArray[np.float64]
RUN = run_tag("a run")
KEYS = Keys(RUN)
SEGMENTS = 5
START = [0.5, -1.0, 2.0, 0.0, 3.5]
SETPOINTS = 3


@pytest.fixture(autouse=True)
def _no_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    Bus.install(monkeypatch)


class Bench:
    """An exchange with the nodes of these first segments."""

    def __init__(self, *firsts: int, setpoint: int = 0) -> None:
        self.bus = Bus()
        self.firsts = firsts or tuple(range(SEGMENTS))
        self.completed: list[int] = []
        self.exchange = Exchange(
            KEYS,
            self.firsts,
            START,
            SETPOINTS,
            setpoint,
            lambda: self.completed.append(self.exchange.tick),
        )
        self.exchange.declare(self.bus)

    def size(self, first: int) -> int:
        following = [one for one in (*self.firsts, SEGMENTS) if one > first]
        return following[0] - first

    def command(self, first: int, tick: int, setpoint: int = 0, **changes: Any) -> None:
        """A command as a node sends it: of segment i at tick k it is 10 k + i."""
        own = range(first, first + self.size(first))
        fields: dict[str, Any] = {"kind": Kind.COMMAND, "run": RUN, "tick": tick, "sender": first}
        values = [10.0 * tick + i for i in own]
        fields |= {"setpoint": setpoint, "values": values}
        self.bus.give(KEYS.command(first), encode_numbers(**(fields | changes)))

    def rejections(self) -> dict[str, int]:
        counters = self.exchange.counters()
        return {
            name.removeprefix("rejected_"): count
            for name, count in counters.items()
            if name.startswith("rejected_") and name != "rejected_messages"
        }


def measured(tick: int) -> Array:
    return np.random.default_rng(tick).standard_normal((SEGMENTS, 2))


splits = st.sets(st.integers(1, SEGMENTS - 1)).map(lambda cuts: (0, *sorted(cuts)))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(splits, st.integers(0, 2**40), st.integers(0, SETPOINTS - 1))
def test_every_process_gets_the_measurements_of_its_segments(
    firsts: tuple[int, ...], tick: int, setpoint: int
) -> None:
    bench = Bench(*firsts, setpoint=setpoint)
    y = measured(3)
    bench.exchange.send(tick, y)
    assert [key for key, _ in bench.bus.sent] == [KEYS.measurement(first) for first in firsts]
    for first in firsts:
        size = bench.size(first)
        (raw,) = bench.bus.of(KEYS.measurement(first))
        got = decode_numbers(raw, Kind.MEASUREMENT, RUN, PLANT, [2 * size] * SETPOINTS)
        assert (got.tick, got.setpoint) == (tick, setpoint)
        assert got.values == y[first : first + size].ravel().tolist()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(splits, st.integers(0, 100))
def test_commands_count_when_all_have_come_in_any_order(firsts: tuple[int, ...], seed: int) -> None:
    bench, order = Bench(*firsts), random.Random(seed)
    exchange = bench.exchange
    np.testing.assert_array_equal(exchange.commands, START)
    assert (exchange.left, exchange.missing()) == (0, [])
    before = list(START)
    for k in range(3):
        exchange.send(k, measured(k))
        missing = list(firsts)
        for first in order.sample(firsts, len(firsts)):
            assert (exchange.left, exchange.missing()) == (len(missing), missing)
            assert not exchange.complete_by(2**62)
            assert len(bench.completed) == k
            bench.command(first, k)
            missing.remove(first)
            assert exchange.commands.tolist() == before
        assert exchange.left == 0
        assert exchange.complete_by(exchange.complete_ns)
        assert not exchange.complete_by(exchange.complete_ns - 1)
        assert bench.completed == list(range(k + 1))
        assert exchange.take() is None
        before = [10.0 * k + i for i in range(SEGMENTS)]
        assert exchange.commands.tolist() == before
    assert bench.rejections() == {}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"tick": 6}, "stale"),
        ({"tick": 8}, "early"),
        ({"run": RUN + 1}, "run"),
        ({"sender": 3}, "sender"),
        ({"sender": PLANT}, "sender"),
        ({"kind": Kind.MEASUREMENT}, "kind"),
        ({"setpoint": SETPOINTS}, "setpoint"),
        ({"values": [1.0]}, "length"),
        ({"values": []}, "length"),
        ({"values": [1.0, np.nan]}, "not_finite"),
        ({"values": [np.inf, 1.0]}, "not_finite"),
        ({"values": [np.nan, 1.0], "setpoint": 1}, "not_finite"),
    ],
)
def test_a_command_that_does_not_belong_is_refused_by_its_reason(
    changes: dict[str, Any], reason: str
) -> None:
    bench = Bench(0, 2, 4)
    bench.exchange.send(7, measured(7))
    bench.command(2, **{"tick": 7, **changes})
    assert bench.rejections() == {reason: 1}
    assert bench.exchange.missing() == [0, 2, 4]
    for first in (0, 2, 4):
        bench.command(first, 7)
    assert bench.completed == [7]
    assert bench.exchange.take() is None
    assert bench.exchange.commands.tolist() == [70.0, 71.0, 72.0, 73.0, 74.0]
    assert bench.exchange.setpoint == 0


@pytest.mark.parametrize("setpoint", [0, 1])
def test_a_second_command_of_a_node_is_refused(setpoint: int) -> None:
    bench = Bench(0, 3)
    bench.exchange.send(0, measured(0))
    bench.command(0, 0)
    bench.command(0, 0, setpoint, values=[9.0, 9.0, 9.0])
    assert bench.rejections() == {"duplicate": 1}
    assert bench.exchange.missing() == [3]
    bench.command(3, 0)
    bench.command(3, 0)
    assert bench.rejections() == {"duplicate": 2}
    assert bench.completed == [0]
    assert bench.exchange.take() is None
    assert bench.exchange.commands.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_commands_before_the_first_tick_are_refused() -> None:
    bench = Bench()
    for first in range(SEGMENTS):
        bench.command(first, 0)
    assert bench.rejections() == {"early": SEGMENTS}
    assert bench.completed == []
    bench.exchange.send(0, measured(0))
    assert bench.exchange.left == SEGMENTS


def test_rubbish_is_refused() -> None:
    bench = Bench()
    bench.exchange.send(0, measured(0))
    for raw in (b"", bytes(48), b"\x97" * 48):
        bench.bus.give(KEYS.command(1), raw)
    assert bench.rejections() == {"malformed": 3}
    assert bench.exchange.left == SEGMENTS


def test_a_change_of_gains_that_all_nodes_name_is_taken_over() -> None:
    bench = Bench(0, 2, 4)
    exchange = bench.exchange
    announced = [0, 0, 1, 1, 2, 0]
    for k, setpoint in enumerate(announced):
        exchange.send(k, measured(k))
        for first in (4, 0, 2):
            bench.command(first, k, setpoint)
        assert exchange.take() is None
        assert exchange.setpoint == setpoint
    assert bench.rejections() == {}
    sent = [
        decode_numbers(raw, Kind.MEASUREMENT, RUN, PLANT, [4] * SETPOINTS).setpoint
        for raw in bench.bus.of(KEYS.measurement(0))
    ]
    assert sent == [0, *announced[:-1]]  # of the tick in which they are measured


def test_nodes_that_name_different_setpoints_are_told_and_their_commands_do_not_count() -> None:
    bench = Bench()
    bench.exchange.send(0, measured(0))
    for first, setpoint in enumerate([1, 1, 0, 1, 2]):
        bench.command(first, 0, setpoint)
    assert bench.exchange.take() == ([2, 4], 0)
    assert bench.exchange.said_first == 1
    assert bench.exchange.commands.tolist() == START
    assert bench.exchange.setpoint == 0


def test_what_was_sent_and_received_is_counted() -> None:
    bench = Bench(0, 2, 4)
    for k in range(4):
        bench.exchange.send(k, measured(k))
        for first in (0, 2, 4):
            bench.command(first, k)
        assert bench.exchange.take() is None
    bench.command(0, 3)
    counters = bench.exchange.counters()
    raws = [raw for _, raw in bench.bus.sent]
    checksum = 0
    for raw in raws:
        checksum = crc32(raw, checksum)
    assert counters == {
        "command_received_messages": 12,
        "command_received_bytes": 4 * (3 * 32 + 8 * SEGMENTS),
        "measurement_sent_messages": 12,
        "measurement_sent_bytes": sum(map(len, raws)),
        "measurement_sent_crc32": checksum,
        "rejected_duplicate": 1,
        "rejected_messages": 1,
    }
    assert bench.exchange.counters() == counters


def test_who_is_not_there_and_who_is_not_linked() -> None:
    bench = Bench(0, 2, 4)
    assert bench.exchange.unlinked({0}) == ["node 2", "node 4", "link to node 0"]
    for first in (0, 4):
        bench.bus.declare_subscriber(KEYS.measurement(first), lambda _: None)
    assert bench.exchange.unlinked({0, 2}) == ["node 4", "link to node 2"]
    bench.bus.declare_subscriber(KEYS.measurement(2), lambda _: None)
    assert bench.exchange.unlinked({0, 2, 4}) == []
