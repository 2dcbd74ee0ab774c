"""Percentiles, the search for a rate, targets and ratios: pure functions on made-up figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.pacing import next_due
from bench.statistics import (
    LADDER_HZ,
    first_rate,
    highest_rate,
    most_late,
    percentile,
    ratios,
    spread,
    targets,
    trial_facts,
)


def test_percentiles_are_nearest_ranks() -> None:
    values = np.arange(1000, 0, -1)
    found = {q: percentile(values, q) for q in (0.001, 0.5, 0.95, 0.99, 0.999, 1.0)}
    assert found == {0.001: 1, 0.5: 500, 0.95: 950, 0.99: 990, 0.999: 999, 1.0: 1000}
    assert percentile(np.array([7]), 0.999) == 7


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=50), st.floats(0.01, 1.0))
def test_a_percentile_is_the_least_value_that_covers_its_share(
    values: list[int], quantile: float
) -> None:
    found = percentile(np.array(values), quantile)
    below = sum(value <= found for value in values)
    assert found in values
    assert below >= quantile * len(values) - 1e-6
    assert sum(value < found for value in values) < quantile * len(values) + 1e-6


def test_spread_is_in_the_unit_asked_for() -> None:
    found = spread(np.array([1000, 2000, 3000]), 1e3)
    assert found["count"] == 3
    assert (found["mean"], found["p50"], found["max"]) == (2.0, 2.0, 3.0)


@pytest.mark.parametrize(("ticks", "late"), [(200, 0), (1000, 1), (2000, 2), (2999, 2)])
def test_so_many_late_ticks_and_not_one_more(ticks: int, late: int) -> None:
    assert most_late(ticks) == late
    times = np.full(ticks, 5e6)
    times[:late] = 50e6
    assert trial_facts(100, ticks, times)["held"]
    times[late] = 10e6  # at the next due instant is late
    facts = trial_facts(100, ticks, times)
    assert not facts["held"]
    assert facts["late"] == late + 1


def test_a_trial_that_was_given_up_is_not_held() -> None:
    facts = trial_facts(100, 200, np.full(30, 1e6))
    assert (facts["held"], facts["ticks"], facts["asked"]) == (False, 30, 200)


@pytest.mark.parametrize(("limit", "expected"), [(5000, 1000), (160, 150), (10, 10), (9, None)])
@pytest.mark.parametrize("start", [10, 67, 1000])
def test_the_search_finds_the_limit_from_wherever_it_begins(
    limit: int, expected: int | None, start: int
) -> None:
    tried: list[int] = []

    def trial(hz: int) -> bool:
        tried.append(hz)
        return hz <= limit

    assert highest_rate(trial, start) == expected
    assert tried[0] == start
    assert expected is None or tried.count(expected) == 2


def test_a_rate_that_is_not_held_again_gives_way_to_the_next_lower() -> None:
    answers = {100: [True, False], 80: [True, True], 125: [False]}

    def trial(hz: int) -> bool:
        return answers[hz].pop(0)

    assert highest_rate(trial, 100) == 80
    assert answers == {100: [], 80: [], 125: []}


@given(st.dictionaries(st.sampled_from(LADDER_HZ), st.lists(st.booleans(), min_size=4)))
def test_the_search_ends_and_what_it_finds_was_held_twice(
    answers: dict[int, list[bool]],
) -> None:
    said: list[tuple[int, bool]] = []

    def trial(hz: int) -> bool:
        answer = answers[hz].pop() if answers.get(hz) else False
        said.append((hz, answer))
        return answer

    found = highest_rate(trial, 100)
    assert len(said) <= 3 * len(LADDER_HZ)
    assert found is None or said.count((found, True)) >= 2


def test_the_search_begins_below_what_one_tick_takes() -> None:
    assert first_rate(0.0009) == 1000
    assert first_rate(0.0041) == 200
    assert first_rate(10.0) == 10


@pytest.mark.parametrize(
    ("took", "due"), [(0, 10), (1, 10), (10, 10), (11, 20), (20, 20), (95, 100)]
)
def test_the_next_tick_is_due_at_the_first_instant_after_the_end(took: int, due: int) -> None:
    assert next_due(0, 10, took) == due
    assert next_due(1000, 10, 1000 + took) == 1000 + due


def row(pattern: str, nodes: int, p50: float, **changes: Any) -> dict[str, Any]:
    figures = {"p50": p50, "p99": 2 * p50, "p99_9": 3 * p50}
    return {
        "pattern": pattern,
        "nodes": nodes,
        "messages_per_tick": {"exchange": 2.0 * (nodes - 1)},
        "expected_messages_per_tick": 2 * (nodes - 1),
        "sweep_us": figures,
        "chain_us": None,
        "cpu_us_per_tick": 10.0,
        "memory_mb": {"pss_per_node": 9.0},
        "start_s": 1.0,
    } | changes


def rate(nodes: int, held: int | None) -> dict[str, Any]:
    return {"pattern": "neighbour", "nodes": nodes, "held_hz": held}


def test_targets_are_met_or_missed() -> None:
    rows = [
        row("neighbour", 10, 125.0),
        row("bare", 10, 100.0, messages_per_tick={"exchange": 17.5}),
        row("neighbour", 50, 126.0, start_s=3.0),
        row("bare", 50, 100.0, messages_per_tick={"exchange": None}),
    ]
    found = {(t.name, t.nodes): t.met for t in targets(rows, [rate(10, 250), rate(20, None)])}
    assert found == {
        ("messages a tick, neighbour", 10): True,
        ("messages a tick, bare", 10): False,
        ("messages a tick, neighbour", 50): True,
        ("sweep p50, neighbour over bare", 10): True,
        ("sweep p50, neighbour over bare", 50): False,
        ("start-up", 50): False,
        ("memory a node, PSS", 50): True,
        ("rate held", 10): True,
        ("rate held", 20): False,
    }


def test_no_figures_no_targets() -> None:
    assert targets([], []) == []


def test_ratios_are_new_over_old_of_what_both_have() -> None:
    new = {"rows": [row("bare", 5, 50.0), row("raw", 5, 1.0)], "rates": [rate(5, 500)]}
    old = {
        "rows": [row("bare", 5, 100.0, start_s=None), row("bare", 6, 1.0)],
        "rates": [rate(5, 250)],
    }
    (found,) = ratios(new, old)
    assert (found["pattern"], found["nodes"]) == ("bare", 5)
    assert (found["sweep_p50"], found["cpu"], found["pss_per_node"]) == (0.5, 1.0, 1.0)
    assert found["chain_p50"] is None
    assert found["start"] is None
    assert "rate" not in found


def test_the_ratio_of_the_rates_stands_with_its_pattern() -> None:
    new = {"rows": [row("neighbour", 5, 50.0)], "rates": [rate(5, 500)]}
    old = {"rows": [row("neighbour", 5, 50.0)], "rates": [rate(5, 250)]}
    assert ratios(new, old)[0]["rate"] == 2.0
    assert ratios(new, old | {"rates": [rate(5, None)]})[0]["rate"] is None
