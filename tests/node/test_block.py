"""One segment's tick: any arrival order gives the same numbers; what does not belong is refused."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from node.segment import NotFiniteError, Segment

from node.sweep import NodeSweep
from wire.factors import NodeFactors, SweepFactors
from wire.messages import Numbers, Reason, RejectedError

Sent = list[tuple[str, int, list[float]]]


def factors(index: int, nodes: int, seed: int = 0) -> NodeFactors:
    """Random factors with sums of three numbers forward and two backward; none at the ends."""
    rng = np.random.default_rng([seed, index])
    c, c_next = (3 if index > 0 else 0), (3 if index < nodes - 1 else 0)
    d, d_previous = (2 if index < nodes - 1 else 0), (2 if index > 0 else 0)
    shapes = {
        "D": (5, 7),
        "P": (5, c),
        "Q": (c_next, 7),
        "W": (c_next, c),
        "U": (5, d),
        "R": (d_previous, 7),
        "V": (d_previous, d),
        "in_offset": (7,),
        "out_offset": (5,),
    }
    made = {k: 3.0 * rng.normal(size=shape) for k, shape in shapes.items()}
    made["in_offset"] = np.concatenate([made["out_offset"], made["out_offset"][[1, 3]]])
    start = rng.normal(size=(1, 4)), rng.normal(size=1)
    return NodeFactors(index, nodes, 0.1, *start, (SweepFactors(**made),))


class Bench:
    """A segment whose messages go into a list."""

    def __init__(self, index: int, nodes: int) -> None:
        self.sent: Sent = []
        self.rows: list[list[float]] = []
        self.factors = factors(index, nodes)
        self.segment = Segment(
            NodeSweep(self.factors),
            nodes,
            send_forward=lambda k, _, v: self.sent.append(("forward", k, v)),
            send_backward=lambda k, _, v: self.sent.append(("backward", k, v)),
            send_command=lambda k, _, v: self.sent.append(("command", k, v)),
            record=lambda _, row: self.rows.append(row),
        )

    def give(self, what: str, tick: int, values: list[float], at_ns: int = 5) -> None:
        message = Numbers(tick, 0, 0, values)
        getattr(self.segment, f"on_{what}")(message, at_ns)


def inputs(index: int, nodes: int, tick: int) -> dict[str, list[float]]:
    rng = np.random.default_rng([7, tick])
    y, c, d = rng.normal(size=2), rng.normal(size=3), rng.normal(size=2)
    out = {"measurement": y.tolist()}
    if index > 0:
        out["forward"] = [*c.tolist(), 0.1, 0.5, 0.2]
    if index < nodes - 1:
        out["backward"] = [*d.tolist(), 0.0]
    return out


@pytest.mark.parametrize("index", [0, 1, 3])
def test_any_order_of_arrival_gives_the_same_messages(index: int) -> None:
    nodes, ticks = 4, 3
    results: list[tuple[Sent, list[list[float]]]] = []
    for order in permutations(inputs(index, nodes, 0)):
        bench = Bench(index, nodes)
        for k in range(ticks):
            given_now = inputs(index, nodes, k)
            for what in order:
                bench.give(what, k, given_now[what])
        results.append((sorted(bench.sent), [row[:-1] for row in bench.rows]))
    assert all(result == results[0] for result in results)
    kinds = {
        0: ["command", "forward"],
        1: ["backward", "command", "forward"],
        3: ["backward", "command"],
    }
    for k in range(ticks):
        assert sorted(kind for kind, tick, _ in results[0][0] if tick == k) == kinds[index]


def test_numbers_are_those_of_the_equations() -> None:
    bench = Bench(1, 3)
    now = inputs(1, 3, 0)
    f = bench.factors.setpoints[0]
    held = [*bench.factors.initial_estimate[0], *bench.factors.initial_command]
    x = np.array([*held, *now["measurement"]]) - f.in_offset
    c, d = np.array(now["forward"][:3]), np.array(now["backward"][:2])
    for what in ("backward", "forward", "measurement"):
        bench.give(what, 0, now[what])
    sent = {kind: values for kind, _, values in bench.sent}
    out = f.D @ x + f.P @ c + f.U @ d + f.out_offset
    np.testing.assert_allclose(sent["forward"][:3], f.W @ c + f.Q @ x, rtol=1e-13)
    np.testing.assert_allclose(sent["backward"], [*(f.V @ d + f.R @ x), 0.0], rtol=1e-13)
    turn = 0.1 + 0.1 * (held[3] - f.out_offset[3])
    end = [turn, 0.5, 0.2]  # a node that only rests knows no chord
    np.testing.assert_allclose(sent["forward"][3:], end, rtol=1e-13)
    np.testing.assert_allclose(sent["command"], out[4:], rtol=1e-13)
    row = bench.rows[0]
    assert row[:2] == now["measurement"]
    assert row[2:7] == held
    assert row[7:9] == [0.0, 0.0]
    assert row[9:18] == [*now["forward"], *now["backward"]]
    assert row[18:21] == [5, 5, 5]
    assert len(row) == 22
    # The next tick starts from this output.
    for what in ("measurement", "forward", "backward"):
        bench.give(what, 1, now[what])
    np.testing.assert_allclose(bench.rows[1][2:7], out, rtol=1e-13)


def test_sums_go_on_before_everything_is_there() -> None:
    bench = Bench(1, 3)
    now = inputs(1, 3, 0)
    bench.give("measurement", 0, now["measurement"])
    assert bench.sent == []
    assert bench.segment.missing() == ["forward sum from node 0", "backward sum from node 2"]
    bench.give("backward", 0, now["backward"])
    assert [kind for kind, _, _ in bench.sent] == ["backward"]
    assert bench.segment.missing() == ["forward sum from node 0"]
    bench.give("forward", 0, now["forward"])
    assert [kind for kind, _, _ in bench.sent] == ["backward", "forward", "command"]
    assert bench.segment.tick == 1


@given(st.sampled_from(["measurement", "forward", "backward"]), st.sampled_from([-1, 0, 1, 5]))
def test_wrong_ticks_and_repetitions_change_nothing(what: str, shift: int) -> None:
    bench = Bench(1, 3)
    for k in range(2):
        for name, values in inputs(1, 3, k).items():
            bench.give(name, k, values)
    now = inputs(1, 3, 2)
    bench.give(what, 2, now[what])
    before = list(bench.sent)
    with pytest.raises(RejectedError) as caught:
        bench.give(what, 2 + shift, [9.0] * len(now[what]))
    expected = {-1: Reason.STALE, 0: Reason.DUPLICATE, 1: Reason.EARLY, 5: Reason.EARLY}
    assert caught.value.reason is expected[shift]
    assert bench.sent == before
    for name, values in now.items():
        if name != what:
            bench.give(name, 2, values)
    clean = Bench(1, 3)
    for k in range(3):
        for name, values in inputs(1, 3, k).items():
            clean.give(name, k, values)
    assert sorted(bench.sent) == sorted(clean.sent)


def test_another_setpoint_is_refused() -> None:
    bench = Bench(0, 2)
    with pytest.raises(RejectedError) as caught:
        bench.segment.on_measurement(Numbers(0, -1, 1, [0.0, 0.0]), 1)
    assert caught.value.reason is Reason.SETPOINT
    assert bench.segment.began_ns == 0


@pytest.mark.parametrize("announced", [1.0, -1.0, 0.5, 1e300])
def test_an_announced_setpoint_that_does_not_exist_is_refused(announced: float) -> None:
    bench = Bench(1, 3)
    with pytest.raises(RejectedError) as caught:
        bench.give("backward", 0, [0.0, 0.0, announced])
    assert caught.value.reason is Reason.SETPOINT
    bench.give("backward", 0, [0.0, 0.0, 0.0])


def test_ends_have_no_neighbour_to_wait_for() -> None:
    first, last = Bench(0, 2), Bench(1, 2)
    assert first.segment.missing() == ["measurement from the plant", "backward sum from node 1"]
    assert last.segment.missing() == ["measurement from the plant", "forward sum from node 0"]
    for bench, what in ((first, "forward"), (last, "backward")):
        with pytest.raises(RejectedError) as caught:
            bench.give(what, 0, [])
        assert caught.value.reason is Reason.DUPLICATE


def test_overflow_is_named_by_tick_node_and_field() -> None:
    bench = Bench(1, 3)
    bench.give("measurement", 0, [0.0, 0.0])
    signs = np.sign(bench.factors.setpoints[0].W[0])
    with (
        np.errstate(all="ignore"),
        pytest.raises(NotFiniteError, match=r"tick 0: node 1 computed forward sum\[0\] = inf"),
    ):
        bench.give("forward", 0, [*(1e308 * np.sign(signs)).tolist(), 0.0, 0.0, 0.0])
    assert all(np.isfinite(values).all() for _, _, values in bench.sent)
