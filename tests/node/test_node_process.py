"""The process around a block without its transport: which messages it takes, how it refuses the others; the
whole chain with the plant's exchange, for any split into processes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np
import pytest
from bus import Bus
from chain_factors import FADE, factors, measurements, reference, sweep, tick_by_hand
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from node.process import NodeProcess
from plant.exchange import Exchange
from wire.child import Child
from wire.keys import Keys
from wire.messages import PLANT, Kind, decode_batch, decode_counters, encode_numbers, run_tag
from wire.run_config import LinkConfig, NodeConfig, SchedulingConfig, SegmentConfig

RUN = run_tag("r")
KEYS = Keys(RUN)
TICK_S = 0.1
SCHEDULING = SchedulingConfig(
    (0, 1), (float(np.degrees(0.9)),), float(np.degrees(0.05)), -TICK_S / float(np.log(FADE))
)


class Quiet(Child):
    """A launcher that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__("node", control=-1, status=-1, directory=None)
        self.said: list[tuple[str, dict[str, Any]]] = []

    def status(self, event: str, **fields: Any) -> None:
        self.said.append((event, fields))


def config(
    first: int, segments: int, nodes: int, *, skip_ticks: int = 0, size: float = 0.2
) -> NodeConfig:
    return NodeConfig(
        run_id="r",
        index=first,
        nodes=nodes,
        setpoint=0,
        scheduling=SCHEDULING,
        batch_ticks=4,
        skip_ticks=skip_ticks,
        links=LinkConfig((), (), None, 2.0, 0, None, None),
        segments=tuple(
            SegmentConfig(
                factors(i, nodes, setpoints=2, size=size).to_plain(),
                reference(i, nodes).to_plain(),
            )
            for i in range(first, first + segments)
        ),
    )


class Bench:
    """A process on a bus."""

    def __init__(self, bus: Bus, settings: NodeConfig) -> None:
        self.bus = bus
        self.index = settings.index
        self.child = Quiet()
        self.process = NodeProcess(settings, self.child, supervised=True)
        self.process._declare(bus)

    def close(self) -> None:
        self.child.close()

    def counters(self) -> dict[int, dict[str, int]]:
        return self.process._counters()

    @property
    def rejections(self) -> dict[str, int]:
        return {
            name.removeprefix("rejected_"): count
            for name, count in self.counters()[self.index].items()
            if name.startswith("rejected_") and name != "rejected_messages"
        }


@pytest.fixture(autouse=True)
def _no_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    Bus.install(monkeypatch)
    monkeypatch.setattr("node.block.BATCH_NS", 10**18)


NODES = 3
Y, C, D = [0.1, -0.2], [0.01, 0.02, 0.03, 0.1, 0.5, 0.2], [0.04, 0.05, 0.0]


@pytest.fixture
def bench() -> Iterator[Bench]:
    """Node 1 of 3, in lock-step."""
    made = Bench(Bus(), config(1, 1, NODES))
    yield made
    made.close()


@pytest.fixture
def paced() -> Iterator[Bench]:
    """Node 1 of 3, where up to three ticks may be left out."""
    made = Bench(Bus(), config(1, 1, NODES, skip_ticks=3))
    yield made
    made.close()


INCOMING = {
    "measurement": (KEYS.measurement(1), Kind.MEASUREMENT, PLANT, Y),
    "forward": (KEYS.forward(1), Kind.FORWARD_SUM, 0, C),
    "backward": (KEYS.backward(1), Kind.BACKWARD_SUM, 2, D),
}


def give(bench: Bench, what: str, tick: int, setpoint: int = 0, **changes: Any) -> None:
    key, kind, sender, values = INCOMING[what]
    fields: dict[str, Any] = {"kind": kind, "run": RUN, "tick": tick, "sender": sender}
    fields |= {"setpoint": setpoint, "values": values} | changes
    bench.bus.give(key, encode_numbers(**fields))


def give_all(bench: Bench, tick: int) -> None:
    for what in INCOMING:
        give(bench, what, tick)


def state(bench: Bench) -> list[Any]:
    block = bench.process._block
    sums = [(key, raw) for key, raw in bench.bus.sent if "telemetry" not in key]
    return [block.tick, block.begun, block.missing(), block._root.row.state.tolist(), sums]


def test_a_tick_is_answered_to_both_neighbours_and_the_plant(bench: Bench) -> None:
    for k in range(3):
        give_all(bench, k)
    keys = [KEYS.forward(2), KEYS.backward(0), KEYS.command(1)]
    assert [len(bench.bus.of(key)) for key in keys] == [3, 3, 3]
    assert {key for key, _ in bench.bus.sent} == set(keys)
    assert bench.rejections == {}
    counted = bench.counters()[1]
    for name in ("measurement_received", "forward_received", "backward_received"):
        assert counted[f"{name}_messages"] == 3
    for name in ("command_sent", "forward_sent", "backward_sent"):
        assert counted[f"{name}_messages"] == 3


@pytest.mark.parametrize("what", list(INCOMING))
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"tick": 1}, "stale"),
        ({"tick": 3}, "early"),
        ({"tick": 50}, "early"),
        ({"setpoint": 1}, "setpoint"),
        ({"setpoint": 2}, "setpoint"),
        ({"run": RUN + 1}, "run"),
        ({"sender": 7}, "sender"),
        ({"kind": Kind.COMMAND}, "kind"),
        ({"values": [0.0]}, "length"),
        ({"values": []}, "length"),
    ],
)
def test_what_does_not_belong_is_refused_by_its_reason_and_changes_nothing(
    bench: Bench, what: str, changes: dict[str, Any], reason: str
) -> None:
    give_all(bench, 0)
    give_all(bench, 1)
    before = state(bench)
    give(bench, what, **{"tick": 2, **changes})
    assert bench.rejections == {reason: 1}
    assert state(bench) == before
    give_all(bench, 2)
    assert bench.process._block.tick == 3
    assert bench.counters()[1][f"{what}_received_messages"] == 3


@pytest.mark.parametrize("what", list(INCOMING))
def test_a_repeated_message_is_refused(bench: Bench, what: str) -> None:
    give(bench, what, 0)
    before = state(bench)
    give(bench, what, 0)
    assert bench.rejections == {"duplicate": 1}
    assert state(bench) == before


@pytest.mark.parametrize("what", list(INCOMING))
def test_a_message_that_is_not_finite_is_refused_and_the_good_one_taken(
    bench: Bench, what: str
) -> None:
    bad = [np.nan, *INCOMING[what][3][1:]]
    with np.errstate(all="ignore"):
        give(bench, what, 0, values=bad)
    assert bench.rejections == {"not_finite": 1}
    give_all(bench, 0)
    assert bench.process._block.tick == 1
    assert bench.process._failure is None


def test_rubbish_is_refused(bench: Bench) -> None:
    for key, _, _, _ in INCOMING.values():
        bench.bus.give(key, b"")
        bench.bus.give(key, bytes(64))
    bench.bus.give(KEYS.stop, b"\xff" * 9)
    assert bench.rejections == {"malformed": 7}
    give_all(bench, 0)
    assert bench.process._block.tick == 1


def test_a_message_of_a_later_tick_leaves_out_those_between(paced: Bench) -> None:
    give_all(paced, 0)
    for then in (1, 3, 4, 8):  # none, one, none, three left out
        give_all(paced, then)
        assert paced.process._block.tick == then + 1
    assert paced.rejections == {}
    commands = paced.bus.of(KEYS.command(1))
    assert len(commands) == 5
    paced.process._report()
    batches = [
        decode_batch(raw, RUN, {1: raw_width(paced)})
        for raw in paced.bus.of(KEYS.telemetry(1))[:-1]
    ]
    recorded = [k for batch in batches for k in range(batch.tick, batch.tick + len(batch.rows))]
    assert recorded == [0, 1, 3, 4, 8]
    sender, tick, _ = decode_counters(paced.bus.of(KEYS.telemetry(1))[-1], RUN)
    assert (sender, tick) == (1, 9)


def raw_width(bench: Bench) -> int:
    """Numbers of a telemetry row of the one segment."""
    (sweep, _, _), *_ = bench.process._block._finishing
    return len(sweep.row.now(sweep.reference))


@pytest.mark.parametrize("what", list(INCOMING))
def test_any_of_the_three_may_be_the_first_after_a_gap(paced: Bench, what: str) -> None:
    give_all(paced, 0)
    give(paced, what, 2)
    for other in INCOMING:
        if other != what:
            give(paced, other, 2)
    assert paced.process._block.tick == 3
    assert paced.rejections == {}


def test_no_more_ticks_are_left_out_than_may_be(paced: Bench) -> None:
    give_all(paced, 0)
    before = state(paced)
    give(paced, "measurement", 5)
    assert paced.rejections == {"early": 1}
    assert state(paced) == before


def test_a_neighbour_that_is_gone_is_not_waited_for_unless_this_node_leaves_too(
    paced: Bench,
) -> None:
    give(paced, "measurement", 0)
    give(paced, "forward", 0)
    paced.bus.vanish(KEYS.ready(2))
    assert [len(paced.bus.of(key)) for key in (KEYS.backward(0), KEYS.command(1))] == [1, 1]
    give_all(paced, 1)  # it is there again
    give(paced, "measurement", 2)
    sent = list(paced.bus.sent)
    paced.process._leaving = True
    paced.process._publishers.clear()
    paced.bus.vanish(KEYS.ready(2))  # nothing is left to send it with
    assert paced.bus.sent == sent


def test_in_lock_step_a_tick_that_has_begun_is_not_given_up(bench: Bench) -> None:
    give_all(bench, 0)
    give(bench, "forward", 1)
    before = state(bench)
    give(bench, "measurement", 2)
    assert bench.rejections == {"early": 1}
    assert state(bench) == before


@pytest.mark.parametrize("what", ["forward", "backward"])
def test_a_sum_of_other_gains_leaves_nobody_waiting_for_the_right_one(
    paced: Bench, what: str
) -> None:
    """It cannot be used; the one before stands for it, and the root's side follows the tip's."""
    give_all(paced, 0)
    give(paced, "measurement", 1)
    announced = {"values": [*D[:-1], 1.0]} if what == "backward" else {}
    give(paced, what, 1, setpoint=1, **announced)
    assert paced.rejections == {"setpoint": 1}
    give(paced, "backward" if what == "forward" else "forward", 1)
    assert paced.process._block.tick == 2
    assert paced.process._block.bridged == 1
    assert paced.process._block.setpoint == (1 if what == "backward" else 0)


def test_a_sum_of_gains_that_the_run_does_not_use_changes_nothing(bench: Bench) -> None:
    give_all(bench, 0)
    give(bench, "measurement", 1)
    before = state(bench)
    give(bench, "forward", 1, setpoint=1)
    assert bench.rejections == {"setpoint": 1}
    assert state(bench) == before


def test_batches_that_wait_for_the_main_thread_are_not_written_over() -> None:
    """It may be late by more than a batch: Zenoh's thread goes on."""
    bus = Bus()
    bench, clean = Bench(bus, config(1, 1, NODES)), Bench(Bus(), config(1, 1, NODES))
    for k in range(24):
        for one in (bench, clean):
            give_all(one, k)
        clean.process._send_batches()
    bench.process._send_batches()
    wall = raw_width(bench) - 5
    for late, timely in zip(
        bus.of(KEYS.telemetry(1)), clean.bus.of(KEYS.telemetry(1)), strict=True
    ):
        a, b = (decode_batch(raw, RUN, {1: raw_width(bench)}) for raw in (late, timely))
        assert a.tick == b.tick
        np.testing.assert_array_equal(a.rows[:, :wall], b.rows[:, :wall])
    for one in (bench, clean):
        one.close()


def test_what_was_sent_and_received_is_not_kept_for_the_whole_run(bench: Bench) -> None:
    """The sums over it are made when the main thread has time, not only at the end."""
    for k in range(40):
        give_all(bench, k)
        bench.process._send_batches()
    process = bench.process
    flows = (*process._received.values(), *process._sent.values(), process._telemetry)
    assert sum(len(flow._waiting) for flow in flows) <= 1


def test_a_number_that_overflows_ends_the_run_and_names_itself() -> None:
    bench = Bench(Bus(), config(1, 1, NODES, size=3.0))
    f = factors(1, NODES, setpoints=2, size=3.0).setpoints[0]
    huge = (1.7e308 * np.sign(f.W[0])).tolist()
    give(bench, "measurement", 0)
    with np.errstate(all="ignore"):
        give(bench, "forward", 0, values=[*huge, 0.0, 0.0, 0.0])
        give(bench, "backward", 0)
    assert bench.process._failure is not None
    code, text = bench.process._failure
    assert code == "not finite"
    assert text.startswith("tick 0: node 1 computed ")
    bench.close()


# -- the whole chain -------------------------------------------------------------------------------------------

CHAIN = 6
TICKS = 30


class Whole:
    """Node processes of one chain and the plant's exchange on one bus."""

    def __init__(self, per_process: int, *, skip_ticks: int = 0) -> None:
        firsts = list(range(0, CHAIN, per_process))
        self.bus = Bus()
        self.benches = [
            Bench(self.bus, config(a, b - a, CHAIN, skip_ticks=skip_ticks))
            for a, b in pairwise([*firsts, CHAIN])
        ]
        start = [float(factors(i, CHAIN, 2, 0.2).initial_command[0]) for i in range(CHAIN)]
        self.completed = 0
        self.exchange = Exchange(KEYS, firsts, start, 2, 0, self._complete)
        self.exchange.declare(self.bus)

    def _complete(self) -> None:
        self.completed += 1

    def tick(self, tick: int, order: Random | None) -> bytes:
        self.exchange.send(tick, measurements(tick, CHAIN))
        self.bus.deliver(order)
        assert self.exchange.left == 0
        assert self.exchange.take() is None
        return self.exchange.commands.tobytes()

    def close(self) -> None:
        for bench in self.benches:
            bench.close()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(per_process=st.integers(1, CHAIN), seed=st.integers(0, 1000))
def test_the_plant_gets_the_same_bits_for_any_split_and_order_of_messages(
    per_process: int, seed: int
) -> None:
    by_hand = [sweep(i, CHAIN) for i in range(CHAIN)]
    whole, order = Whole(per_process), Random(seed)
    setpoints = []
    for k in range(TICKS):
        expected = tick_by_hand(by_hand, measurements(k, CHAIN))
        assert whole.tick(k, order) == expected.tobytes()
        assert whole.exchange.setpoint == by_hand[0].setpoint
        setpoints.append(whole.exchange.setpoint)
    assert set(setpoints) == {0, 1}
    assert whole.completed == TICKS
    counted = [one for bench in whole.benches for one in bench.counters().values()]

    def total(*names: str) -> int:
        return sum(one.get(name, 0) for one in counted for name in names)

    received = total("forward_received_messages", "backward_received_messages")
    assert received == total("forward_sent_messages", "backward_sent_messages")
    assert received + total("passed_messages") == 2 * (CHAIN - 1) * TICKS
    assert received == 2 * (len(whole.benches) - 1) * TICKS
    assert total("rejected_messages") == 0
    whole.close()


@pytest.mark.parametrize("per_process", [1, 2, 4])
def test_late_ticks_are_left_out_by_all_processes_alike(per_process: int) -> None:
    """The plant holds the commands in ticks 4, 9, 10, 11: nobody else needs to be told."""
    by_hand = [sweep(i, CHAIN) for i in range(CHAIN)]
    whole, order = Whole(per_process, skip_ticks=3), Random(1)
    for k in range(TICKS):
        if k in (4, 9, 10, 11):
            continue
        if k in (5, 12):
            for one in by_hand:
                one.skip_to(k)
        expected = tick_by_hand(by_hand, measurements(k, CHAIN))
        assert whole.tick(k, order) == expected.tobytes()
    assert all(bench.rejections == {} for bench in whole.benches)
    whole.close()
