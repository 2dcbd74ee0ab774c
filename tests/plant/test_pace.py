"""The clock of a run in real time: instants of ticks, how many may be late, when the emulation must begin."""

from __future__ import annotations

from time import monotonic_ns

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.pace import FORGET, LEAD_NS, MOST_OF_PERIOD, SLACK_NS, Pace
from wire.run_config import PaceConfig

PERIOD_NS = 20_000_000


def pace(hold_ticks: int = 2, period_s: float = 0.02) -> Pace:
    made = Pace(PaceConfig(period_s, hold_ticks))
    made.begin()
    return made


def test_the_first_tick_is_due_soon_after_the_order_to_start() -> None:
    before = monotonic_ns()
    made = pace()
    assert before + LEAD_NS <= made.due_ns(0) <= monotonic_ns() + LEAD_NS


@given(st.floats(1e-4, 10.0), st.integers(0, 10**6))
def test_ticks_are_whole_periods_apart_whatever_happened(period_s: float, tick: int) -> None:
    """Nothing adds up: a late tick does not move the others."""
    made = pace(period_s=period_s)
    made.worked(10**9)
    made.late()
    assert made.due_ns(tick) - made.due_ns(0) == tick * round(period_s * 1e9)


@given(st.integers(0, 5), st.lists(st.booleans(), max_size=40))
def test_so_many_ticks_in_a_row_may_be_late_and_no_more(hold: int, lates: list[bool]) -> None:
    made = pace(hold)
    in_a_row = 0
    for late in lates:
        if late:
            in_a_row += 1
            assert made.late() == (in_a_row <= hold)
        else:
            in_a_row = 0
            made.on_time()
        assert made.late_in_a_row == in_a_row


def reserve_ns(made: Pace, tick: int = 3) -> int:
    """How long before the next tick the emulation begins."""
    return made.due_ns(tick + 1) - made.work_at_ns(tick)


def test_the_emulation_begins_in_time_for_what_it_took_lately() -> None:
    made = pace()
    assert reserve_ns(made) == SLACK_NS
    made.worked(2_000_000)
    assert reserve_ns(made) == SLACK_NS + 2_000_000
    made.worked(3_000_000)
    assert reserve_ns(made) == SLACK_NS + 3_000_000
    for _ in range(200):
        before = reserve_ns(made)
        made.worked(1_000_000)
        after = reserve_ns(made)
        assert SLACK_NS + 1_000_000 <= after <= before
    assert after == SLACK_NS + 1_000_000


def test_the_longest_work_is_forgotten_slowly() -> None:
    made = pace()
    made.worked(5_000_000)
    for _ in range(10):
        made.worked(0)
    assert reserve_ns(made) == pytest.approx(SLACK_NS + 5_000_000 * FORGET**10, abs=2.0)


@given(st.lists(st.integers(0, 10**9), max_size=5), st.integers(0, 1000))
def test_a_sweep_always_has_its_part_of_the_period(works: list[int], tick: int) -> None:
    """However long the emulation takes: otherwise no tick would ever be on time again."""
    made = pace()
    for work in works:
        made.worked(work)
    begin = made.work_at_ns(tick)
    assert made.due_ns(tick) + (1 - MOST_OF_PERIOD) * PERIOD_NS <= begin <= made.due_ns(tick + 1)
