"""Batches of many senders in any order become one sequence by tick."""

from __future__ import annotations

import random

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recorder.merge import Gap, TickMerge
from wire.messages import Batch


def batch(sender: int, first: int, count: int) -> Batch:
    rows = [[float(100 * sender + first + j)] for j in range(count)]
    return Batch(first, sender, np.array(rows))


@given(
    sizes=st.lists(st.lists(st.integers(1, 7), min_size=1, max_size=8), min_size=1, max_size=5),
    seed=st.integers(0, 1000),
)
def test_order_of_arrival_does_not_matter(sizes: list[list[int]], seed: int) -> None:
    shortest = min(sum(own) for own in sizes)
    queues = []
    for sender, own in enumerate(sizes):
        starts = np.cumsum([0, *own])
        queues.append([batch(sender, int(a), n) for a, n in zip(starts, own, strict=False)])
    merge = TickMerge(range(len(sizes)))
    rng = random.Random(seed)
    seen: list[tuple[int, dict[int, list[float]]]] = []
    while any(queues):
        queue = rng.choice([q for q in queues if q])
        assert merge.add(queue.pop(0))
        seen += merge.complete()
    assert [tick for tick, _ in seen] == list(range(shortest))
    assert all(
        rows == {s: [float(100 * s + tick)] for s in range(len(sizes))} for tick, rows in seen
    )
    rest = list(merge.rest())
    ticks = [tick for tick, _ in rest]
    assert ticks == list(range(shortest, max(sum(own) for own in sizes)))
    assert merge.gaps == []


def test_a_repeated_batch_is_told() -> None:
    merge = TickMerge([0])
    assert merge.add(batch(0, 0, 4))
    assert not merge.add(batch(0, 0, 4))
    assert len(list(merge.complete())) == 4
    assert not merge.add(batch(0, 2, 4))


def test_a_gap_is_kept_and_the_others_go_on() -> None:
    merge = TickMerge([0, 1])
    merge.add(batch(0, 0, 6))
    merge.add(batch(1, 0, 2))
    merge.add(batch(1, 4, 2))
    seen = dict(merge.complete())
    assert list(seen) == [0, 1, 2, 3, 4, 5]
    assert set(seen[2]) == {0}
    assert set(seen[4]) == {0, 1}
    assert merge.gaps == [Gap(1, 2, 4)]


def test_the_others_rows_wait_for_a_sender_that_is_out() -> None:
    """A second at 100 Hz: nothing is handed out before its next row, and then everything at once, in order."""
    merge = TickMerge([0, 1])
    merge.add(batch(1, 0, 10))
    for tick in range(0, 110, 10):
        merge.add(batch(0, tick, 10))
        assert len(list(merge.complete())) == (10 if tick == 0 else 0)
    merge.add(batch(1, 110, 5))  # the replacement's first
    merge.add(batch(0, 110, 5))
    rows = list(merge.complete())
    assert [tick for tick, _ in rows] == list(range(10, 115))
    assert all(set(own) == ({0} if tick < 110 else {0, 1}) for tick, own in rows)
    assert merge.gaps == [Gap(1, 10, 110)]


def test_a_sender_that_ended_holds_nobody_up() -> None:
    merge = TickMerge([0, 1, 2])
    merge.add(batch(0, 0, 3))
    merge.add(batch(1, 0, 5))
    assert list(merge.complete()) == []
    assert merge.waiting_for() == [0, 1, 2]
    merge.end(2, 0)
    assert [tick for tick, _ in merge.complete()] == [0, 1, 2]
    merge.end(0, 3)
    assert [tick for tick, _ in merge.complete()] == [3, 4]
    assert merge.waiting_for() == [1]
    merge.end(1, 7)
    assert merge.gaps == [Gap(1, 5, 7)]
    assert merge.waiting_for() == []
    assert list(merge.complete()) == []
