"""The segments of one process: any arrival order gives the same numbers, and so does any split of the chain;
what does not belong is refused."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from itertools import accumulate, combinations, pairwise, permutations

import numpy as np
import pytest
from chain_factors import (
    BEND,
    Array,
    factors,
    measurements,
    reference,
    sweep,
    tick_by_hand,
)
from hypothesis import given
from hypothesis import strategies as st

from node.block import SegmentBlock
from node.finite import NotFiniteError
from node.sweep import NodeSweep, Numbers, payload
from wire.channels import node_channels, width
from wire.errors import UsageError
from wire.messages import Reason, RejectedError

Sent = list[tuple[str, int, int, list[float]]]
EPOCH_NS = 1_000


@pytest.fixture(autouse=True)
def _never_by_age(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine is: rows wait until a batch is full."""
    monkeypatch.setattr("node.block.BATCH_NS", 10**18)


class Bench:
    """A block whose messages go into a list, rows without their last instant into another."""

    def __init__(
        self, sweeps: Sequence[NodeSweep], batch: int = 1, first_batch: int | None = None
    ) -> None:
        self.sweeps = sweeps
        self.forward = np.zeros(sweeps[-1].forward_sent)
        self.backward = np.zeros(sweeps[0].backward_sent)
        self.commands = np.zeros(len(sweeps))
        self.sent: Sent = []
        self.batches: list[tuple[int, list[Array], list[Array]]] = []
        """Tick, the rows of each segment as they were when they came, and as they are now."""
        self.begun: list[tuple[int, int]] = []
        self.pass_on: Callable[[str, list[float]], None] = lambda _, __: None
        self.block = SegmentBlock(
            sweeps, self, batch=batch, first_batch=first_batch, epoch_ns=EPOCH_NS
        )

    @classmethod
    def single(cls, index: int, nodes: int) -> Bench:
        """One segment that rests at its only setpoint."""
        return cls([NodeSweep(factors(index, nodes))])

    # -- the outlet

    def send_forward(self, tick: int, setpoint: int) -> None:
        self._send("forward", tick, setpoint, self.forward)

    def send_backward(self, tick: int, setpoint: int) -> None:
        self._send("backward", tick, setpoint, self.backward)

    def send_commands(self, tick: int, setpoint: int) -> None:
        self._send("command", tick, setpoint, self.commands)

    def _send(self, kind: str, tick: int, setpoint: int, values: Array) -> None:
        self.sent.append((kind, tick, setpoint, values.tolist()))
        self.pass_on(kind, values.tolist())

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        self.batches.append((tick, [one.copy() for one in rows], list(rows)))

    def begins(self, tick: int, setpoint: int) -> None:
        self.begun.append((tick, setpoint))

    # -- the other side

    def give(self, what: str, values: Numbers, at_ns: int = EPOCH_NS + 5) -> None:
        getattr(self.block, f"on_{what}")(payload(values), at_ns)

    def tick(self, given_now: dict[str, list[float]]) -> None:
        for what, values in given_now.items():
            self.give(what, values)

    def rows(self, segment: int = 0) -> Array:
        """All rows of a segment that were handed over, as they were then."""
        return np.vstack([then[segment] for _, then, _ in self.batches])


def inputs(index: int, nodes: int, tick: int) -> dict[str, list[float]]:
    rng = np.random.default_rng([7, tick])
    y, c, d = rng.normal(size=2), rng.normal(size=3), rng.normal(size=2)
    out = {"measurement": y.tolist()}
    if index > 0:
        out["forward"] = [*c.tolist(), 0.1, 0.5, 0.2]
    if index < nodes - 1:
        out["backward"] = [*d.tolist(), 0.0]
    return out


def without_wall(rows: Array, index: int, nodes: int) -> Array:
    """Rows without the instants."""
    return rows[:, : -(2 + (index > 0) + (index < nodes - 1))]


# -- one segment -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0, 1, 3])
def test_any_order_of_arrival_gives_the_same_messages(index: int) -> None:
    nodes, ticks = 4, 3
    results: list[tuple[Sent, bytes]] = []
    for order in permutations(inputs(index, nodes, 0)):
        bench = Bench.single(index, nodes)
        for k in range(ticks):
            given_now = inputs(index, nodes, k)
            for what in order:
                bench.give(what, given_now[what])
        results.append((sorted(bench.sent), without_wall(bench.rows(), index, nodes).tobytes()))
    assert all(result == results[0] for result in results)
    kinds = {
        0: ["command", "forward"],
        1: ["backward", "command", "forward"],
        3: ["backward", "command"],
    }
    for k in range(ticks):
        assert sorted(kind for kind, tick, _, _ in results[0][0] if tick == k) == kinds[index]


def test_numbers_are_those_of_the_equations() -> None:
    bench = Bench.single(1, 3)
    now = inputs(1, 3, 0)
    known = factors(1, 3)
    f = known.setpoints[0]
    held = [*known.initial_estimate[0], *known.initial_command]
    x = np.array([*held, *now["measurement"]]) - f.in_offset
    c, d = np.array(now["forward"][:3]), np.array(now["backward"][:2])
    for at_ns, what in ((2005, "backward"), (2007, "forward"), (2009, "measurement")):
        bench.give(what, now[what], at_ns)
    sent = {kind: values for kind, _, _, values in bench.sent}
    out = f.D @ x + f.P @ c + f.U @ d + f.out_offset
    np.testing.assert_allclose(sent["forward"][:3], f.W @ c + f.Q @ x, rtol=1e-13)
    np.testing.assert_allclose(sent["backward"], [*(f.V @ d + f.R @ x), 0.0], rtol=1e-13)
    turn = 0.1 + BEND * (held[3] - f.out_offset[3])
    end = [turn, 0.5, 0.2]  # a node that only rests knows no chord
    np.testing.assert_allclose(sent["forward"][3:], end, rtol=1e-13)
    np.testing.assert_allclose(sent["command"], out[4:], rtol=1e-13)
    (row,) = bench.rows().tolist()
    assert row[:2] == now["measurement"]
    np.testing.assert_allclose(row[2:7], held, rtol=1e-15, atol=1e-15)
    assert row[7:9] == [0.0, 0.0]
    assert row[9:18] == [*now["forward"], *now["backward"]]
    assert row[18:21] == [2009 - EPOCH_NS, 2007 - EPOCH_NS, 2005 - EPOCH_NS]
    assert row[22] == 0.0  # nothing was other than it should be
    assert len(row) == 23
    # The next tick starts from this output.
    bench.tick(now)
    np.testing.assert_allclose(bench.rows()[1, 2:7], out, rtol=1e-13)


def test_rows_are_as_long_as_their_channels_say() -> None:
    for index in range(3):
        bench = Bench.single(index, 3)
        bench.tick(inputs(index, 3, 0))
        sums = bench.sweeps[0].forward_received, bench.sweeps[0].backward_received
        assert bench.rows().shape[1] == width(node_channels(index, 3, *sums))


def test_sums_go_on_before_everything_is_there() -> None:
    bench = Bench.single(1, 3)
    now = inputs(1, 3, 0)
    assert not bench.block.begun
    bench.give("measurement", now["measurement"], 77)
    assert bench.sent == []
    assert bench.block.missing() == ["forward sum from node 0", "backward sum from node 2"]
    assert (bench.block.begun, bench.block.began_ns) == (True, 77)
    bench.give("backward", now["backward"], 78)
    assert [kind for kind, _, _, _ in bench.sent] == ["backward"]
    assert bench.block.missing() == ["forward sum from node 0"]
    assert bench.block.began_ns == 77
    assert (bench.block.tick, bench.block.ended_ns) == (0, 0)
    bench.give("forward", now["forward"])
    assert [kind for kind, _, _, _ in bench.sent] == ["backward", "forward", "command"]
    assert bench.block.tick == 1
    assert not bench.block.begun
    assert bench.block.ended_ns > 0
    assert bench.begun == [(0, 0), (1, 0)]


@given(st.sampled_from(["measurement", "forward", "backward"]))
def test_repetitions_are_refused_and_change_nothing(what: str) -> None:
    bench, clean = Bench.single(1, 3), Bench.single(1, 3)
    for k in range(2):
        bench.tick(inputs(1, 3, k))
    now = inputs(1, 3, 2)
    bench.give(what, now[what])
    before = list(bench.sent)
    with pytest.raises(RejectedError) as caught:
        bench.give(what, [9.0] * len(now[what]))
    assert caught.value.reason is Reason.DUPLICATE
    assert bench.sent == before
    bench.tick({name: values for name, values in now.items() if name != what})
    for k in range(3):
        clean.tick(inputs(1, 3, k))
    assert sorted(bench.sent) == sorted(clean.sent)
    np.testing.assert_array_equal(
        without_wall(bench.rows(), 1, 3), without_wall(clean.rows(), 1, 3)
    )


@pytest.mark.parametrize("segments", [1, 2])
@pytest.mark.parametrize("as_array", [True, False])
@pytest.mark.parametrize("what", ["measurement", "forward", "backward"])
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused_and_the_tick_goes_on(
    bad: float, first: bool, what: str, as_array: bool, segments: int
) -> None:
    """Whether they come before or after the rest, and wherever in the message."""
    nodes = 2 + segments
    clean = Bench([NodeSweep(factors(i, nodes)) for i in range(1, 1 + segments)])
    now = inputs(1, nodes, 0)
    now["measurement"] = measurements(0, segments).ravel().tolist()
    clean.tick(now)
    for at in range(len(now[what])):
        bench = Bench([NodeSweep(factors(i, nodes)) for i in range(1, 1 + segments)])
        rest = {name: values for name, values in now.items() if name != what}
        if not first:
            bench.tick(rest)
        before = bench.block.missing()
        wrong: Numbers = [bad if j == at else value for j, value in enumerate(now[what])]
        with np.errstate(all="ignore"), pytest.raises(RejectedError) as caught:
            bench.give(what, np.array(wrong) if as_array else wrong)
        announced = what == "backward" and at == len(now[what]) - 1
        expected = (Reason.NOT_FINITE, Reason.SETPOINT) if announced else (Reason.NOT_FINITE,)
        assert caught.value.reason in expected
        assert bench.block.missing() == before
        assert bench.block.begun != first
        bench.give(what, now[what])
        if first:
            bench.tick(rest)
        assert sorted(bench.sent) == sorted(clean.sent)
        assert bench.block.tick == 1


@pytest.mark.parametrize("announced", [1.0, -1.0, 0.5, 1e300, np.nan])
def test_an_announced_setpoint_that_does_not_exist_is_refused(announced: float) -> None:
    bench = Bench.single(1, 3)
    with pytest.raises(RejectedError) as caught:
        bench.give("backward", [0.0, 0.0, announced])
    assert caught.value.reason is Reason.SETPOINT
    bench.give("backward", [0.0, 0.0, 0.0])


def test_ends_have_no_neighbour_to_wait_for() -> None:
    first, last = Bench.single(0, 2), Bench.single(1, 2)
    assert first.block.missing() == ["measurement from the plant", "backward sum from node 1"]
    assert last.block.missing() == ["measurement from the plant", "forward sum from node 0"]
    for bench, what in ((first, "forward"), (last, "backward")):
        with pytest.raises(RejectedError) as caught:
            bench.give(what, [])
        assert caught.value.reason is Reason.DUPLICATE


@pytest.mark.parametrize("order", list(permutations(["measurement", "forward", "backward"])))
def test_overflow_is_named_by_tick_node_and_field(order: tuple[str, ...]) -> None:
    """Sums that are finite themselves; nothing that is not finite is sent."""
    f = factors(1, 3).setpoints[0]
    huge = (1.7e308 * np.sign(f.W[0])).tolist()
    now = inputs(1, 3, 2) | {"forward": [*huge, 0.0, 0.0, 0.0]}
    bench = Bench.single(1, 3)
    for k in range(2):
        bench.tick(inputs(1, 3, k))
    name = r"tick 2: node 1 computed (forward sum\[0\]|.*velocity_x|.*forward sum.*\[0\]) = -?(inf|nan)"
    with np.errstate(all="ignore"), pytest.raises(NotFiniteError, match=name):
        bench.tick({what: now[what] for what in order})
    assert all(np.isfinite(values).all() for _, _, _, values in bench.sent)


def test_an_estimate_that_overflows_is_named() -> None:
    f = factors(2, 3).setpoints[0]
    huge = (1.7e308 * np.sign(f.P[3])).tolist()
    bench = Bench.single(2, 3)
    bench.give("measurement", [0.0, 0.0])
    name = "tick 0: node 2 computed (velocity_x|velocity_y|strain|curvature) = (-?inf|nan)"
    with np.errstate(all="ignore"), pytest.raises(NotFiniteError, match=name):
        bench.give("forward", [*huge, 0.0, 0.0, 0.0])
    assert [kind for kind, _, _, _ in bench.sent] == ["backward"]
    assert bench.batches == []


def test_large_finite_numbers_are_not_mistaken_for_infinite_ones() -> None:
    """Their total is infinite, their products with these matrices are not."""
    bench = Bench.single(2, 3)
    signs = np.sign(factors(2, 3).setpoints[0].P[0])
    with np.errstate(all="ignore"):
        bench.give("forward", [*(1e300 * signs).tolist(), 1.7e308, 1.7e308, 0.0])
    assert bench.block.missing() == ["measurement from the plant"]


# -- several segments ------------------------------------------------------------------------------------------

CHAIN = 6
TICKS = 30
SPLITS = [
    (0, *cuts, CHAIN) for count in range(CHAIN) for cuts in combinations(range(1, CHAIN), count)
]
"""Where the blocks of a chain begin, and its end: all ways to cut it."""


class Chain:
    """A chain cut into blocks; messages are handed over in a random order."""

    def __init__(self, split: Sequence[int], seed: int = 0, batch: int = 1) -> None:
        self.split = split
        self.benches = [
            Bench([sweep(i, CHAIN) for i in range(a, b)], batch) for a, b in pairwise(split)
        ]
        self._waiting: list[tuple[Bench, str, list[float]]] = []
        self._random = random.Random(seed)
        for place, bench in enumerate(self.benches):
            bench.pass_on = self._passer(place)

    def _passer(self, place: int) -> Callable[[str, list[float]], None]:
        def pass_on(kind: str, values: list[float]) -> None:
            if kind != "command":
                to = place + 1 if kind == "forward" else place - 1
                self._waiting.append((self.benches[to], kind, values))

        return pass_on

    def tick(self, tick: int) -> Array:
        """One whole tick; the commands of the next."""
        y = measurements(tick, CHAIN)
        for (a, b), bench in zip(pairwise(self.split), self.benches, strict=True):
            self._waiting.append((bench, "measurement", y[a:b].ravel().tolist()))
        while self._waiting:
            bench, what, values = self._waiting.pop(self._random.randrange(len(self._waiting)))
            bench.give(what, values)
        return np.concatenate([bench.commands for bench in self.benches])

    def rows(self, index: int) -> Array:
        """All rows of a segment without the instants."""
        place = max(i for i, first in enumerate(self.split[:-1]) if first <= index)
        rows = self.benches[place].rows(index - self.split[place])
        return without_wall(rows, index, CHAIN)

    def sums(self) -> list[tuple[int, int, str, list[float]]]:
        """What was sent between blocks, by tick, receiver and direction."""
        return sorted(
            (tick, (self.split[p + 1] if kind == "forward" else self.split[p] - 1), kind, values)
            for p, bench in enumerate(self.benches)
            for kind, tick, _, values in bench.sent
            if kind != "command"
        )


SINGLES = tuple(range(CHAIN + 1))


@pytest.mark.parametrize("split", SPLITS, ids=str)
def test_any_split_of_a_chain_gives_the_same_bits(split: tuple[int, ...]) -> None:
    """Sums, commands and rows of six segments, while gains change and the reference moves."""
    by_hand = [sweep(i, CHAIN) for i in range(CHAIN)]
    cut, singles = Chain(split, seed=len(split)), Chain(SINGLES)
    for k in range(TICKS):
        expected = tick_by_hand(by_hand, measurements(k, CHAIN))
        assert cut.tick(k).tobytes() == expected.tobytes()
        assert singles.tick(k).tobytes() == expected.tobytes()
    for i in range(CHAIN):
        assert cut.rows(i).tobytes() == singles.rows(i).tobytes()
    sums = set(map(str, singles.sums()))
    assert set(map(str, cut.sums())) <= sums
    assert len(cut.sums()) == 2 * (len(split) - 2) * TICKS
    used = cut.rows(0)[:, 7]
    assert np.flatnonzero(np.diff(used)).size == 2  # from setpoint 0 to 1 and back


@pytest.mark.parametrize("split", SPLITS, ids=str)
def test_sums_in_memory_are_counted(split: tuple[int, ...]) -> None:
    cut = Chain(split)
    for k in range(5):
        cut.tick(k)
    for (a, b), bench in zip(pairwise(split), cut.benches, strict=True):
        assert bench.block.passed == 5 * 2 * (b - a - 1)
    on_the_wire = len(cut.sums())
    assert on_the_wire + sum(bench.block.passed for bench in cut.benches) == 5 * 2 * (CHAIN - 1)


def test_a_block_has_one_command_a_segment_and_says_what_it_waits_for() -> None:
    bench = Bench([NodeSweep(factors(i, 5)) for i in (1, 2, 3)])
    assert bench.block.missing() == [
        "measurement from the plant",
        "forward sum from node 0",
        "backward sum from node 4",
    ]
    bench.give("measurement", [0.0] * 6)
    bench.give("forward", [0.0] * 6)
    assert [kind for kind, _, _, _ in bench.sent] == ["forward"]
    bench.give("backward", [0.0] * 3)
    assert [(kind, len(values)) for kind, _, _, values in bench.sent] == [
        ("forward", 6),
        ("backward", 3),
        ("command", 3),
    ]
    assert bench.block.passed == 4


@pytest.mark.parametrize("indices", [(), (1, 3), (2, 1), (1, 1)])
def test_segments_that_are_no_neighbours_are_refused(indices: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match=r"at least one segment|are not neighbours"):
        SegmentBlock([NodeSweep(factors(i, 5)) for i in indices], Bench.single(0, 2))


# -- records ---------------------------------------------------------------------------------------------------


@given(
    batch=st.integers(1, 7),
    first=st.integers(1, 7),
    ticks=st.integers(0, 30),
    segments=st.sampled_from([1, 2]),
)
def test_rows_come_in_batches_of_the_asked_size(
    batch: int, first: int, ticks: int, segments: int
) -> None:
    first = min(first, batch)
    sweeps = [sweep(i, segments) for i in range(segments)] if segments > 1 else None
    bench = Bench(sweeps or [NodeSweep(factors(0, 2))], batch, first)
    for k in range(ticks):
        if sweeps:
            bench.give("measurement", measurements(k, 2).ravel())
        else:
            bench.give("measurement", [0.1, 0.2])
            bench.give("backward", [0.0, 0.0, 0.0])
    starts = [0, *range(first, ticks + 1, batch)] if ticks >= first else [0]
    sizes = list(np.diff(starts))
    assert [tick for tick, _, _ in bench.batches] == starts[:-1]
    for (_, rows, _), size in zip(bench.batches, sizes, strict=True):
        assert [len(one) for one in rows] == [size] * segments
    bench.block.flush()
    left = ticks - starts[-1]
    assert [(tick, len(rows[0])) for tick, rows, _ in bench.batches[len(sizes) :]] == (
        [(starts[-1], left)] if left else []
    )
    assert list(accumulate(len(rows[0]) for _, rows, _ in bench.batches))[-1:] == (
        [ticks] if ticks else []
    )


def test_a_batch_is_left_alone_while_the_next_one_fills() -> None:
    bench = Bench([sweep(i, 2) for i in range(2)], batch=3)
    for k in range(20):
        bench.give("measurement", measurements(k, 2).ravel())
        if bench.batches:
            _, then, now = bench.batches[-1]
            for a, b in zip(then, now, strict=True):
                np.testing.assert_array_equal(a, b)
    assert len(bench.batches) == 6


@given(st.sets(st.integers(0, 20)), st.integers(1, 5))
def test_flushing_between_ticks_changes_no_number(flushes: set[int], batch: int) -> None:
    bench, clean = (Bench([sweep(i, 2) for i in range(2)], one) for one in (batch, 1))
    for k in range(20):
        if k in flushes:
            bench.block.flush()
            assert sum(len(rows[0]) for _, rows, _ in bench.batches) == k
        for one in (bench, clean):
            one.give("measurement", measurements(k, 2).ravel())
    bench.block.flush()
    assert bench.sent == clean.sent
    for i in range(2):
        np.testing.assert_array_equal(
            without_wall(bench.rows(i), i, 2), without_wall(clean.rows(i), i, 2)
        )
    covered = [k for tick, rows, _ in bench.batches for k in range(tick, tick + len(rows[0]))]
    assert covered == list(range(20))


# -- ticks without a sweep -------------------------------------------------------------------------------------


@given(at=st.integers(0, 25), ahead=st.integers(1, 5), batch=st.integers(1, 4))
def test_over_late_ticks_the_deviation_is_kept_and_the_command_held(
    at: int, ahead: int, batch: int
) -> None:
    segments = [sweep(i, 2) for i in range(2)]
    bench = Bench(segments, batch)
    for k in range(at):
        bench.give("measurement", measurements(k, 2).ravel())
    wanted = [reference(i, 2) for i in range(2)]
    deviations = [s.estimate - r.at(at)[:4] for s, r in zip(segments, wanted, strict=True)]
    commands, setpoint = [s.command for s in segments], segments[0].setpoint
    sent, begun = list(bench.sent), list(bench.begun)

    then = at + ahead
    bench.block.skip_to(then)
    assert bench.begun == [*begun, (then, setpoint)]
    assert bench.sent == sent
    assert (bench.block.tick, bench.block.begun) == (then, False)
    assert sum(len(rows[0]) for _, rows, _ in bench.batches) == at
    np.testing.assert_allclose([s.command for s in segments], commands, rtol=0.0, atol=1e-14)
    for s, r, deviation in zip(segments, wanted, deviations, strict=True):
        np.testing.assert_allclose(s.estimate - r.at(then)[:4], deviation, rtol=0.0, atol=1e-13)

    bench.give("measurement", measurements(then, 2).ravel())
    assert bench.sent[len(sent) :][0][:2] == ("command", then)
    bench.block.flush()
    tick, rows, _ = bench.batches[-1]
    assert tick == then
    for i, r in enumerate(wanted):
        (row,) = rows[i]
        np.testing.assert_array_equal(row[:2], measurements(then, 2)[i])
        np.testing.assert_allclose(row[2:6] - r.at(then)[:4], deviations[i], rtol=0.0, atol=1e-13)
        assert row[6] == pytest.approx(commands[i], rel=0.0, abs=1e-14)
        assert row[7] == setpoint


def test_late_ticks_may_follow_each_other_without_a_row_between() -> None:
    bench = Bench([sweep(i, 2) for i in range(2)], batch=4)
    bench.give("measurement", measurements(0, 2).ravel())
    for then in (3, 5, 6):
        bench.block.skip_to(then)
    assert [(tick, len(rows[0])) for tick, rows, _ in bench.batches] == [(0, 1)]
    bench.give("measurement", measurements(6, 2).ravel())
    assert bench.sent[-1][:2] == ("command", 6)
    assert bench.begun[-1][0] == 7
