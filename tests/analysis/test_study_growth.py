"""The study of growth: simulated ticks against closed forms and plain evaluation, its facts, its refusals."""

from __future__ import annotations

import json
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from analysis.study import growth
from analysis.study.growth_case import case
from analysis.study.hop import Hop, hop_of_file, measure_hop
from analysis.study.tick_cases import CORES, Costs, Hosts, crossing, draw, tick_times
from analysis.study.virtual_chain import (
    Durations,
    Member,
    Relay,
    TickTimes,
    run_tick,
    sequential_tick,
    split,
    states,
    virtual_nodes,
)
from analysis.study.workers import call_all
from deploy import deploy
from deploy.structured import structured_deploy
from node.sweep import NodeSweep
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import read_artefact
from wire.errors import OctarmError, UsageError
from wire.factors import BACKWARD_EXTRA, FORWARD_EXTRA

Array = npt.NDArray[np.float64]

GAINS = read_artefact(DEFAULT_GAINS)
N = 23
DEPLOYED = deploy(GAINS, N, 0.1)
FAST = Hop(np.array([20.0, 30.0]), np.array([25.0, 60.0]), 10.0, "made up")
ONE = Hosts("one host", 1)
APART = Hosts("apart", 0)


def test_hops_of_a_benchmark_are_those_of_its_longest_chain(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    chain = {"p50": 90.0, "p95": 180.0, "p99": 270.0, "p99_9": 360.0, "max": 450.0}
    rows = [
        {"pattern": "bare", "nodes": 50, "chain_us": chain, "cpu_us_per_tick": 1.0},
        {"pattern": "neighbour", "nodes": 5, "chain_us": chain, "cpu_us_per_tick": 1.0},
        {"pattern": "neighbour", "nodes": 10, "chain_us": chain, "cpu_us_per_tick": 760.0},
    ]
    file.write_text(json.dumps({"rows": rows}))
    hop = hop_of_file(file)
    assert hop.cpu_us == pytest.approx(760.0 / (18 + 20))
    assert np.median(hop.same_core_us) == pytest.approx(10.0)
    assert np.max(hop.same_core_us) == pytest.approx(50.0)
    assert np.percentile(hop.same_core_us, 95.0) == pytest.approx(20.0)
    file.write_text(json.dumps({"rows": rows[:1]}))
    with pytest.raises(UsageError, match="neighbour row with chain_us"):
        hop_of_file(file)


def constant(processes: int, service_ns: int, latency_ns: int) -> Durations:
    return Durations(np.full((processes, 3), service_ns), np.full((processes - 1, 2), latency_ns))


def simulated(processes: int, core: list[int], durations: Durations) -> TickTimes:
    members: list[Member] = [Relay(i, processes) for i in range(processes)]
    return run_tick(members, core, durations, [np.zeros(0)] * processes)


def measurements(ticks: int) -> Array:
    rest = np.stack([node.setpoints[0].in_offset[-2:] for node in DEPLOYED.nodes])
    return np.asarray(rest + 1e-3 * np.random.default_rng(5).standard_normal((ticks, N, 2)))


# Times


@pytest.mark.parametrize("n", [2, 3, 50])
def test_with_a_core_each_a_sweep_is_n_minus_1_hops(n: int) -> None:
    latency, service = 70_000, 9_000
    found = simulated(n, list(range(n)), constant(n, service, latency))
    # the first measurement, then a latency and a service a hop; forward and backward meet without waiting for
    # each other where they do not arrive at one instant (odd n: in the middle, where one of the two waits)
    longest = service + (n - 1) * (latency + service)
    assert longest <= found.sweep_ns <= longest + service
    assert found.messages == 2 * (n - 1)


def test_without_service_it_is_exactly_n_minus_1_latencies() -> None:
    assert simulated(50, list(range(50)), constant(50, 0, 70_000)).sweep_ns == 49 * 70_000


def test_with_an_even_number_it_is_exact_with_service() -> None:
    found = simulated(50, list(range(50)), constant(50, 9_000, 70_000))
    assert found.sweep_ns == 9_000 + 49 * 79_000


def test_on_one_core_the_services_add_up() -> None:
    n = 40
    found = simulated(n, [0] * n, constant(n, 9_000, 0))
    messages = n + 2 * (n - 1)  # the measurements too
    assert found.busy_ns.tolist() == [9_000 * messages]
    assert found.sweep_ns == 9_000 * messages


def test_two_cores_share_the_work() -> None:
    n = 40
    core = Hosts("one", 1).cores(n)
    found = simulated(n, core, constant(n, 9_000, 0))
    assert core == [0] * 20 + [1] * 20
    assert found.busy_ns.sum() == 9_000 * (n + 2 * (n - 1))
    assert found.sweep_ns >= found.busy_ns.max()


def test_durations_come_from_the_samples() -> None:
    handling = (np.array([1.0]), np.array([2.0]), np.array([3.0]))
    far = Hosts("far", 5, 400.0)
    found = draw(far, Costs(FAST, handling), 20, np.random.default_rng(1))
    core = np.array(far.cores(20))
    same, near = np.diff(core) == 0, np.diff(core // CORES) == 0
    hop = found.latency[:, 0] + found.service[1:, 1] - 2_000
    back = found.latency[:, 1] + found.service[:-1, 2] - 3_000
    for one in (hop, back):
        assert set(one[same].tolist()) <= {20_000, 30_000}
        assert set(one[near & ~same].tolist()) <= {25_000, 60_000}
        assert (one[~near] >= 0.9 * 400_000 + 10_000).all()
    assert found.service[:, 0].tolist() == [11_000] * 20
    again = draw(far, Costs(FAST, handling), 20, np.random.default_rng(1))
    assert np.array_equal(found.latency, again.latency)


def test_percentiles_are_deterministic_and_ordered() -> None:
    costs = Costs(FAST, (np.array([1.0]), np.array([2.0]), np.array([3.0])))
    one, again = (tick_times(ONE, costs, 12, 30, seed=3) for _ in range(2))
    assert one == again
    assert one["p50_ms"] <= one["p99_ms"]
    assert 0.0 < one["busiest_core"] <= 1.0


def test_where_a_time_reaches_a_limit() -> None:
    assert crossing([10, 100, 1000], [1.0, 10.0, 100.0], 50.0) == pytest.approx(500.0)
    assert crossing([10, 100], [1.0, 10.0], 100.0) == pytest.approx(1000.0)
    assert crossing([10, 100], [1.0, 10.0], 0.5) == pytest.approx(5.0)


# Sums


@pytest.mark.parametrize("segments", [1, 4, 12])
@pytest.mark.parametrize("hosts", [ONE, APART, Hosts("far", 3, 100.0)])
def test_the_order_of_events_does_not_change_a_bit(segments: int, hosts: Hosts) -> None:
    ticks = measurements(4)
    sweeps = [NodeSweep(node) for node in DEPLOYED.nodes]
    nodes = virtual_nodes(DEPLOYED.nodes, segments)
    nothing = np.zeros(1)
    random = np.random.default_rng(11)
    core = hosts.cores(len(nodes))
    for one in ticks:
        expected = sequential_tick(sweeps, one)
        durations = draw(hosts, Costs(FAST, (nothing,) * 3), len(nodes), random)
        order = random.permutation(len(nodes)).tolist()
        run_tick(nodes, core, durations, split(one, nodes), order)
        assert np.array_equal(states(nodes), expected)


def test_the_states_are_those_of_the_dense_step() -> None:
    nodes = virtual_nodes(DEPLOYED.nodes, 1)
    state = states(nodes)
    for one in measurements(5):
        state = DEPLOYED.dense[0](np.hstack([state, one]))
        run_tick(nodes, list(range(N)), constant(N, 5, 7), split(one, nodes))
        size = np.max(np.abs(state), axis=0)
        assert np.max(np.abs(states(nodes) - state) / size) < 1e-12


def test_relays_send_when_nodes_send() -> None:
    nodes = virtual_nodes(DEPLOYED.nodes, 2)
    relays = [Relay(i, len(nodes)) for i in range(len(nodes))]
    random = np.random.default_rng(2)
    for one in measurements(3):
        costs = Costs(FAST, (np.array([4.0]), np.array([5.0, 50.0]), np.array([6.0])))
        durations = draw(ONE, costs, len(nodes), random)
        core = ONE.cores(len(nodes))
        real = run_tick(nodes, core, durations, split(one, nodes))
        alone = run_tick(relays, core, durations, [np.zeros(0)] * len(nodes))
        assert real.sweep_ns == alone.sweep_ns
        assert real.messages == alone.messages == 2 * (len(nodes) - 1)


def test_a_process_that_says_nothing_is_noticed() -> None:
    class Mute(Relay):
        def take(self, what: Any, values: Array) -> list[Any]:
            super().take(what, values)
            return []

    members: list[Member] = [Relay(0, 3), Mute(1, 3), Relay(2, 3)]
    with pytest.raises(OctarmError, match="did not finish"):
        run_tick(members, [0, 1, 2], constant(3, 1, 1), [np.zeros(0)] * 3)


# The whole


def test_a_case_has_what_the_table_shows() -> None:
    found = [case(GAINS, n, 0.1, FAST, (ONE, APART)) for n in (40, 120)]
    for n, one in zip((40, 120), found, strict=True):
        assert one["difference"] < 1e-10
        assert one["messages_per_tick"] == 2 * (n - 1)
        assert one["forward_numbers"] == max(one["ranks_forward"]) + FORWARD_EXTRA
        assert one["backward_numbers"] == max(one["ranks_backward"]) + BACKWARD_EXTRA
        assert one["factor_bytes"] > 0 and one["object_bytes"] > 0
    for key in ("forward_numbers", "backward_numbers", "message_bytes_max"):
        assert found[0][key] == found[1][key]
    assert [c["segments"] for c in found[1]["cases"]] == [1, 1, 10, 10, 100, 100]


def test_the_study_from_a_file_of_hops(tmp_path: Path) -> None:
    hops = tmp_path / "hops.json"
    hops.write_text(json.dumps({"hop_us": [20.0, 25.0, 40.0], "cpu_us": 12.0}))
    said: list[str] = []
    facts = growth.run(GAINS, said.append, nodes=(4, 12), latency=hops, jobs=1)
    json.dumps(facts, allow_nan=False)
    assert facts["hop"]["source"] == str(hops)
    assert [row["nodes"] for row in facts["rows"]] == [4, 12]
    assert [row["nodes"] for row in facts["dense"]] == [4, 12]
    paper = facts["on_paper"][1]
    assert paper["chain_messages"] == 22
    assert paper["all_to_all_messages"] == 132
    text = growth.table(facts)
    assert "one host, 2 cores" in text
    assert all(len(line) < 160 for line in text.splitlines() if str(hops) not in line)
    growth.plot(facts, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").stat().st_size > 10_000


def test_a_hop_is_measured_between_two_processes() -> None:
    hop = measure_hop(samples=50)
    for samples in (hop.same_core_us, hop.other_core_us):
        assert samples.shape == (50,)
        assert (samples > 0.0).all()
    assert hop.cpu_us > 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected JSON"),
        ("[1, 2]", "expected JSON"),
        ('{"hop": [1]}', "expected JSON"),
        ('{"hop_us": []}', "positive numbers"),
        ('{"hop_us": [1, -2]}', "positive numbers"),
        ('{"hop_us": [1, 2], "cpu_us": 0}', "cpu_us"),
    ],
)
def test_files_that_hold_no_hops_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "hops.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=message):
        hop_of_file(path)


def test_hops_without_processor_time_are_all_of_it(tmp_path: Path) -> None:
    path = tmp_path / "hops.json"
    path.write_text('{"hop_us": [10, 20, 30]}')
    assert hop_of_file(path).cpu_us == 20.0
    with pytest.raises(UsageError, match="No such file"):
        hop_of_file(tmp_path / "none.json")


@pytest.mark.parametrize("nodes", [(), (1, 10), (10, 10**6)])
def test_numbers_of_nodes_out_of_range_are_refused(nodes: tuple[int, ...]) -> None:
    with pytest.raises(UsageError, match="nodes: expected"):
        growth.run(GAINS, lambda _: None, nodes=nodes)


def test_fresh_calls_have_processes_of_their_own() -> None:
    pids = call_all(os.getpid, [(), ()], 1, fresh=True)
    assert len({*pids, os.getpid()}) == 3


def test_structured_chain_is_connected() -> None:
    for a, b in pairwise(structured_deploy(GAINS, 30, 0.1).nodes):
        assert a.setpoints[0].forward_sent == b.setpoints[0].forward_received
        assert a.setpoints[0].backward_received == b.setpoints[0].backward_sent
