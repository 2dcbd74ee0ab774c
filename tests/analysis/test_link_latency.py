"""Link latencies on small arrays, against the definition written out, and on recordings."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from simulated_run import Scenario, write_recording

from analysis.link_times import link_facts, own_clocks, percentiles_ms
from analysis.recording import Recording, read_recording
from wire.link_latency import (
    CLOCKS,
    IN_MEMORY,
    MESSAGES,
    link_kinds,
    link_latencies,
)


def test_a_hop_begins_when_the_sender_has_all_that_it_needs() -> None:
    nan = math.nan
    measured = np.array([[10.0, 12.0, 30.0], [100.0, 100.0, 100.0]])
    forward = np.array([[nan, 15.0, 21.0], [nan, 140.0, 145.0]])
    backward = np.array([[50.0, 44.0, nan], [180.0, 170.0, nan]])
    found = link_latencies(measured, forward, backward)
    # Root's measurement to node 1: 15 - 10. Node 1 had its measurement at 12 and the sum at 15: 21 - 15.
    assert found.forward_ns.tolist() == [[5.0, 6.0], [40.0, 5.0]]
    # Column 0 is from node 1 to the root: 50 - max(12, 44). Column 1 from the tip: 44 - 30.
    assert found.backward_ns.tolist() == [[6.0, 14.0], [10.0, 70.0]]


def test_against_the_definition_written_out() -> None:
    random = np.random.default_rng(2)
    measured, forward, backward = random.uniform(0.0, 1e6, (3, 40, 7))
    forward[:, 0] = backward[:, -1] = np.nan
    forward[3, 4] = measured[5, 2] = np.nan  # a row that was lost
    found = link_latencies(measured, forward, backward)
    for k in range(40):
        for i in range(1, 7):
            needed = [measured[k, i - 1]] + ([forward[k, i - 1]] if i > 1 else [])
            ready = math.nan if any(map(math.isnan, needed)) else max(needed)
            expected = forward[k, i] - ready
            assert np.array_equal(found.forward_ns[k, i - 1], expected, equal_nan=True)
        for i in range(6):
            needed = [measured[k, i + 1]] + ([backward[k, i + 1]] if i < 5 else [])
            ready = math.nan if any(map(math.isnan, needed)) else max(needed)
            expected = backward[k, i] - ready
            assert np.array_equal(found.backward_ns[k, i], expected, equal_nan=True)


def test_links_in_memory_and_between_clocks_have_no_latency() -> None:
    assert link_kinds(4, (0, 1, 2, 3), frozenset()) == [MESSAGES] * 3
    assert link_kinds(5, (0, 2, 4), frozenset()) == [IN_MEMORY, MESSAGES, IN_MEMORY, MESSAGES]
    own = frozenset({3, 4})  # also between the two: each counts from its own first measurement
    assert link_kinds(5, (0, 1, 2, 3, 4), own) == [MESSAGES, MESSAGES, CLOCKS, CLOCKS]


def test_percentiles_leave_out_what_is_missing() -> None:
    values = np.array([[1e6, math.nan], [3e6, 2e6]])
    found = percentiles_ms(values)
    assert found is not None
    assert (found["p50"], found["max"]) == (2.0, 3.0)
    assert percentiles_ms(np.full((3, 2), math.nan)) is None


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(path, Scenario(nodes=4, ticks=30), skip=frozenset({(7, 1), (8, 2)}))
    return read_recording(path)


def test_the_worst_link_of_a_recording_is_named(recording: Recording) -> None:
    notes: list[str] = []
    facts = link_facts(recording.tables, recording.configuration, {}, notes)
    assert (facts["measured"], facts["left_out"], facts["unrecorded"]) == (6, {}, 0)
    worst = {
        (row["way"], row["from"], row["to"]): row["latency_ms"]["p99"] for row in facts["links"]
    }
    name = max(worst, key=lambda key: worst[key])
    assert (facts["worst"]["way"], facts["worst"]["from"], facts["worst"]["to"]) == name
    assert {key[1:] for key in worst if key[0] == "backward"} == {(1, 0), (2, 1), (3, 2)}
    y = recording.of_nodes("timing", ("measurement_received_wall_ns",))[:, :, 0]
    c = [
        recording.table(f"/node/0{i}/timing").by_tick(("forward_received_wall_ns",), 30)[:, 0]
        for i in (1, 2)
    ]
    hop = c[1] - np.maximum(y[:, 1], c[0])
    assert np.count_nonzero(np.isnan(hop)) == 2
    (row,) = [row for row in facts["links"] if (row["way"], row["from"]) == ("forward", 1)]
    assert row["latency_ms"]["max"] == pytest.approx(1e-6 * np.nanmax(hop), rel=1e-12)
    assert notes == []


def test_nodes_with_a_clock_of_their_own_are_left_out_and_said_so(recording: Recording) -> None:
    hosts = [
        {"name": "here", "address": "::1", "nodes": 2, "own_clock": False},
        {"name": "there", "address": "::1", "nodes": 2, "own_clock": True},
    ]
    notes: list[str] = []
    run = recording.configuration
    facts = link_facts(recording.tables, run, {"hosts": json.dumps(hosts)}, notes)
    assert (facts["measured"], facts["left_out"]) == (2, {CLOCKS: 4})
    assert {row["to"] for row in facts["links"]} == {0, 1}
    facts = link_facts(recording.tables, run, {"hosts": "{"}, notes)
    assert (facts["measured"], facts["worst"], facts["forward_ms"]) == (0, None, None)
    assert "hosts in the metadata cannot be read" in notes[0]


def test_tables_that_are_not_there_are_unrecorded(recording: Recording) -> None:
    tables = {t: one for t, one in recording.tables.items() if t != "/node/02/timing"}
    facts = link_facts(tables, recording.configuration, {}, [])
    assert (facts["measured"], facts["unrecorded"]) == (2, 4)
    assert link_facts({}, recording.configuration, {}, [])["worst"] is None


def test_lost_ticks_do_not_shift_the_others(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, Scenario(nodes=3, ticks=20, late=frozenset({5, 6})))
    recording = read_recording(path)
    facts = link_facts(recording.tables, recording.configuration, {}, [])
    y = recording.table("/node/00/timing")
    c = recording.table("/node/01/timing")
    assert y.rows == c.rows == 18
    hop = c.numbers("forward_received_wall_ns") - y.numbers("measurement_received_wall_ns")
    (row,) = [row for row in facts["links"] if (row["way"], row["from"]) == ("forward", 0)]
    assert row["latency_ms"]["p50"] == pytest.approx(1e-6 * np.median(hop), rel=1e-12)


def test_hosts_of_more_nodes_than_there_are_cost_no_memory() -> None:
    hosts = json.dumps([{"nodes": 1, "own_clock": False}, {"nodes": 10**400, "own_clock": True}])
    assert own_clocks(hosts, 3, []) == {1, 2}
