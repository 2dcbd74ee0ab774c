"""Sums that do not come are bridged, ticks that do not end are given up, and a new process begins in between:
the same numbers as of a block that is told them outright."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
import pytest
from chain_factors import FADE, Array, factors, measurements, sweep, tick_by_hand
from hypothesis import given
from hypothesis import strategies as st

from node.block import SegmentBlock
from node.joining import NEAR_TICKS, PATIENCE, Joining, between
from node.sweep import NodeSweep, payload
from wire.messages import PARTIAL, Numbers, Reason, RejectedError

NODES = 4
FORWARD_BRIDGED, BACKWARD_BRIDGED, HELD, PART, MEASUREMENT_HELD, JOINED = (2**i for i in range(6))
Y, C, D = [0.3, -0.2], [0.5, -1.5, 0.25, 0.1, 0.5, 0.2], [0.75, -0.125, 0.0]


class Outlet:
    """A block whose results go into lists."""

    def __init__(self, sweeps: Sequence[NodeSweep]) -> None:
        self.sweeps = sweeps
        self.forward = np.zeros(sweeps[-1].forward_sent)
        self.backward = np.zeros(sweeps[0].backward_sent)
        self.commands = np.zeros(len(sweeps))
        self.sent: list[tuple[str, int, int, list[float]]] = []
        self.rows: list[Array] = []
        self.begun: list[tuple[int, int]] = []
        self.block = SegmentBlock(sweeps, self)

    def send_forward(self, tick: int, setpoint: int) -> None:
        self.sent.append(("forward", tick, setpoint, self.forward.tolist()))

    def send_backward(self, tick: int, setpoint: int) -> None:
        self.sent.append(("backward", tick, setpoint, self.backward.tolist()))

    def send_commands(self, tick: int, setpoint: int) -> None:
        self.sent.append(("command", tick, setpoint, self.commands.tolist()))

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        self.rows.append(rows[0].copy())

    def begins(self, tick: int, setpoint: int) -> None:
        self.begun.append((tick, setpoint))

    # -- the other side

    def give(self, what: str, values: Sequence[float]) -> None:
        if what == "measurement":
            values = [*values] * len(self.sweeps)
        getattr(self.block, f"on_{what}")(payload(np.asarray(values)), 5)

    def whole_tick(self) -> None:
        self.give("measurement", Y)
        if not self.sweeps[0].first:
            self.give("forward", C)
        if not self.sweeps[-1].last:
            self.give("backward", D)

    @property
    def flags(self) -> list[int]:
        return [int(row[0, -1]) for row in self.rows]

    @property
    def state(self) -> list[Array]:
        return [one.state for one in self.sweeps]


def inner(*indices: int, setpoints: int = 1) -> Outlet:
    return Outlet([NodeSweep(factors(i, NODES, setpoints, size=0.4), fade=FADE) for i in indices])


# -- bridging --------------------------------------------------------------------------------------


@pytest.mark.parametrize("indices", [(1,), (2,), (1, 2)])
@pytest.mark.parametrize("order", list(permutations(("y", "c", "d"))))
@pytest.mark.parametrize("missing", ["c", "d", "cd"])
def test_a_sum_that_does_not_come_is_the_last_one_faded(
    indices: tuple[int, ...], order: tuple[str, ...], missing: str
) -> None:
    """In whatever order the rest comes and is given up."""
    one, other = inner(*indices), inner(*indices)
    for bench in (one, other):
        bench.whole_tick()
    faded = {
        "c": [*(FADE * np.array(C[:3])).tolist(), *C[3:]],
        "d": [*(FADE * np.array(D[:2])).tolist(), *D[2:]],
    }
    for what in order:
        if what == "y":
            one.give("measurement", Y)
        elif what in missing:
            one.block.cut_forward(7) if what == "c" else one.block.cut_backward(7)
        else:
            one.give("forward" if what == "c" else "backward", C if what == "c" else D)
    other.give("measurement", Y)
    other.give("forward", faded["c"] if "c" in missing else C)
    other.give("backward", faded["d"] if "d" in missing else D)
    assert one.block.tick == other.block.tick == 2
    for a, b in zip(one.state, other.state, strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.flags == [
        0,
        FORWARD_BRIDGED * ("c" in missing) | BACKWARD_BRIDGED * ("d" in missing),
    ]
    assert one.block.bridged == len(missing)
    sent = {(kind, tick): (said, values) for kind, tick, said, values in one.sent}
    for kind, tick, said, values in other.sent:
        part = PARTIAL if kind == "forward" and tick == 1 and "c" in missing else 0
        assert sent[kind, tick] == (said | part, values)


def test_who_was_bridged_is_not_waited_for_until_it_is_heard_again() -> None:
    bench = inner(1)
    bench.whole_tick()
    bench.give("measurement", Y)
    assert bench.block.missing() == ["forward sum from node 0", "backward sum from node 2"]
    bench.block.cut_forward(7)
    bench.give("backward", D)
    for _ in range(3):  # at once, as soon as there is a measurement
        bench.give("measurement", Y)
        assert bench.block.missing() == ["backward sum from node 2"]
        with pytest.raises(RejectedError) as late:
            bench.give("forward", C)
        assert late.value.reason is Reason.LATE
        bench.give("backward", D)
        bench.block.cut_forward(7)
    bench.block.heard_forward()
    bench.give("measurement", Y)
    assert bench.block.missing() == ["forward sum from node 0", "backward sum from node 2"]
    assert bench.flags == [0, 1, 1, 1, 1]


def test_since_when_every_tick_was_bridged() -> None:
    bench = inner(1)
    assert bench.block.bridging_ns == 0
    bench.block.cut_backward(7)
    for at_ns in (10, 20, 30):
        bench.block.on_measurement(payload(np.array(Y)), at_ns)
        bench.give("forward", C)
    assert bench.block.bridging_ns == 10
    assert bench.block.bridged_from() == ["backward sum from node 2"]
    bench.give("backward", D)
    bench.give("measurement", Y)
    bench.give("forward", C)
    assert bench.block.bridging_ns == 0
    assert bench.block.bridged_from() == ["sum of a neighbour in every tick"]


@pytest.mark.parametrize("what", ["forward", "backward"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@given(at=st.integers(0, 4))
def test_a_sum_that_was_refused_is_not_what_it_is_bridged_by(
    what: str, bad: float, at: int
) -> None:
    one, other = inner(1), inner(1)
    for bench in (one, other):
        bench.whole_tick()
        bench.give("measurement", Y)
    values = list(C if what == "forward" else D)
    values[at % (len(values) - 1)] = bad
    with pytest.raises(RejectedError), np.errstate(invalid="ignore"):
        one.give(what, values)
    for bench in (one, other):
        bench.block.close(9)
    np.testing.assert_array_equal(one.state[0], other.state[0])
    assert np.isfinite(one.state[0]).all()


# -- giving a tick up ------------------------------------------------------------------------------


@given(came=st.sets(st.sampled_from(["measurement", "forward", "backward"]), max_size=2))
def test_a_tick_that_is_given_up_sends_nothing_more_and_holds_its_command(came: set[str]) -> None:
    one, other = inner(1), inner(1)
    for bench in (one, other):
        bench.whole_tick()
    numbers = {"measurement": Y, "forward": C, "backward": D}
    for what in sorted(came):
        one.give(what, numbers[what])
    before, held = len(one.sent), one.sweeps[0].command
    one.block.close(9)
    assert len(one.sent) == before
    assert one.block.tick == 2
    assert one.begun[-1] == (2, 0)
    assert one.sweeps[0].command == held
    assert one.flags[1] == (
        HELD
        | MEASUREMENT_HELD * ("measurement" not in came)
        | FORWARD_BRIDGED * ("forward" not in came)
        | BACKWARD_BRIDGED * ("backward" not in came)
    )
    # the estimate is that of a tick with the last measurement and faded sums
    other.give("measurement", Y)
    other.give("forward", C if "forward" in came else [*(FADE * np.array(C[:3])).tolist(), *C[3:]])
    other.give(
        "backward", D if "backward" in came else [*(FADE * np.array(D[:2])).tolist(), *D[2:]]
    )
    np.testing.assert_allclose(one.sweeps[0].estimate, other.sweeps[0].estimate, rtol=1e-12)


def test_the_last_measurement_stands_for_one_that_does_not_come_while_the_reference_moves() -> None:
    """Absolute: what was measured, not its deviation from a reference that has gone on."""
    one, other = Outlet([sweep(1, NODES)]), Outlet([sweep(1, NODES)])
    for tick in range(8):  # the reference rests for three ticks, then it moves
        y = measurements(tick, NODES)[1]
        for bench in (one, other):
            bench.give("measurement", y)
            bench.give("forward", C)
            bench.give("backward", D)
    one.give("forward", C)
    one.give("backward", D)
    one.block.close(9)
    other.give("measurement", measurements(7, NODES)[1])
    other.give("forward", C)
    other.give("backward", D)
    np.testing.assert_allclose(one.sweeps[0].estimate, other.sweeps[0].estimate, rtol=1e-12)


def test_the_tip_decides_nothing_by_an_arm_that_is_not_whole() -> None:
    """A chain whose gains change: with every forward sum partial they never do."""

    def run(*, partial: bool) -> list[int]:
        sweeps = [sweep(i, NODES) for i in range(NODES)]
        used = []
        for tick in range(20):
            sweeps[-1].partial = partial
            tick_by_hand(sweeps, measurements(tick, NODES))
            used.append(sweeps[-1].next_setpoint)
        return used

    assert set(run(partial=False)) == {0, 1}
    assert set(run(partial=True)) == {0}


# -- beginning in place of a dead process ----------------------------------------------------------


@given(
    tick=st.integers(0, 60),
    deviation=st.lists(st.floats(-1.0, 1.0, width=32), min_size=5, max_size=5),
    setpoint=st.integers(0, 1),
)
def test_it_begins_at_the_tick_with_the_state_it_was_given(
    tick: int, deviation: list[float], setpoint: int
) -> None:
    one = Outlet([sweep(1, NODES)])
    (new,) = one.sweeps
    state = new.guess(tick, np.array(deviation))
    one.block.join(tick, setpoint, [state])
    assert one.begun[-1] == (tick, setpoint)
    assert (one.block.tick, new.tick, new.setpoint) == (tick, tick, setpoint)
    np.testing.assert_array_equal(new.state, state)  # exactly what is recorded
    wanted = new.reference[:5] + deviation
    np.testing.assert_allclose(state, wanted, atol=1e-12)
    one.give("measurement", Y)
    one.give("forward", C)
    one.give("backward", [*D[:2], float(setpoint)])
    assert one.flags == [JOINED]
    assert [tick for _, tick, _, _ in one.sent] == [tick] * 3


@pytest.mark.parametrize("setpoint", [0, 1])
@pytest.mark.parametrize("joins", [False, True])
def test_the_setpoint_stays_if_the_first_announcement_does_not_come(
    joins: bool, setpoint: int
) -> None:
    new = NodeSweep(factors(1, NODES, 2, size=0.4), setpoint=setpoint, fade=FADE)
    one = Outlet([new])
    if joins:
        one.block.join(7, setpoint, [new.guess(7, np.zeros(5))])
    one.give("measurement", Y)
    one.block.close(9)
    assert one.block.setpoint == setpoint


VECTORS = st.lists(st.floats(-1e3, 1e3), min_size=5, max_size=5).map(np.array)


@given(left=st.none() | VECTORS, right=st.none() | VECTORS, segments=st.integers(1, 5))
def test_between_is_a_straight_line(left: Array | None, right: Array | None, segments: int) -> None:
    found = between(left, right, segments)
    assert len(found) == segments
    a = right if left is None else left
    b = left if right is None else right
    for j, one in enumerate(found, 1):
        if a is None or b is None:
            np.testing.assert_array_equal(one, np.zeros(5))
            continue
        share = j / (segments + 1)
        np.testing.assert_allclose(one[:4], ((1 - share) * a + share * b)[:4], atol=1e-9)
        assert one[4] == 0.0
    assert len({id(one) for one in found}) == segments


class TestJoining:
    """When a new node begins."""

    @staticmethod
    def state(tick: int, setpoint: int = 0, value: float = 0.1) -> Numbers:
        return Numbers(tick, 0, setpoint, [value] * 5)

    @staticmethod
    def measurement(tick: int) -> Numbers:
        return Numbers(tick, -1, 0, Y)

    @pytest.mark.parametrize(
        ("index", "sides"), [(0, ("right",)), (1, ("left", "right")), (3, ("left",))]
    )
    def test_with_the_first_measurement_after_both_neighbours_spoke(
        self, index: int, sides: tuple[str, ...]
    ) -> None:
        bench = inner(index)
        joining = Joining(bench.sweeps, bench.block)
        for side in sides:
            assert not joining.begin(self.measurement(8))
            joining.heard(side, self.state(9))
        assert joining.begin(self.measurement(10))
        assert bench.block.tick == 10

    def test_an_old_state_is_not_good_enough(self) -> None:
        bench = inner(1)
        joining = Joining(bench.sweeps, bench.block)
        joining.heard("left", self.state(9 - NEAR_TICKS))
        joining.heard("right", self.state(10))
        assert not joining.begin(self.measurement(10))
        joining.heard("left", self.state(10))
        assert joining.begin(self.measurement(11))

    def test_it_does_not_wait_for_ever(self) -> None:
        """Its neighbour may be dead as well."""
        bench = inner(1)
        joining = Joining(bench.sweeps, bench.block)
        assert not any(joining.begin(self.measurement(k)) for k in range(PATIENCE))
        joining.heard("right", self.state(PATIENCE, value=0.5))
        assert joining.begin(self.measurement(PATIENCE))
        np.testing.assert_allclose(
            bench.sweeps[0].state[:4] - bench.sweeps[0].reference[:4], [0.5] * 4, rtol=1e-12
        )

    def test_the_setpoint_is_that_of_the_tips_side(self) -> None:
        bench = inner(1, setpoints=2)
        joining = Joining(bench.sweeps, bench.block)
        joining.heard("left", self.state(5, setpoint=0))
        joining.heard("right", self.state(5, setpoint=1))
        assert joining.begin(self.measurement(5))
        assert bench.block.setpoint == 1
