"""Who listens and who dials in a group, on which core: before a process exists."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.configs import PATTERNS, DriverConfig, WorkerConfig
from bench.layout import Layout, Placement, endpoints_needed, lay_out
from bench.real_nodes import RealNodes, deploy_nodes
from supervise.endpoints import Endpoints
from wire.config_json import dumps, loads
from wire.errors import UsageError
from wire.factors import NodeFactors
from wire.messages import Kind, encode_numbers
from wire.run_config import LinkConfig, NodeConfig

NODES = 4


@pytest.fixture(scope="module")
def real(gains: Path) -> RealNodes:
    return deploy_nodes(gains, NODES)


def layout(pattern: str, real: RealNodes, placement: Placement) -> Layout:
    count = endpoints_needed(pattern, real)
    names = [f"unixsock-stream/d/node{i}" for i in range(count - 1)]
    return lay_out(pattern, real, Endpoints("unixsock-stream/d/plant", names), placement, seed=3)


def all_links(made: Layout) -> list[LinkConfig]:
    return [node.links for node in made.nodes] + [worker.links for worker in made.workers]


@pytest.mark.parametrize(
    ("pattern", "count"),
    [("neighbour", 3), ("bare", 3), ("star", 4), ("all-to-all", 6), ("raw", 6)],
)
def test_every_link_is_dialled_once_and_somebody_listens(
    pattern: str, count: int, real: RealNodes
) -> None:
    made = layout(pattern, real, Placement((), fifo=False))
    everybody = all_links(made)
    listening = [end for links in everybody for end in links.listen]
    dialled = [end for links in everybody for end in links.connect]
    plant = made.driver.links.listen[0]
    assert len(set(listening)) == len(listening)
    assert dialled.count(plant) == len(everybody) == len(made.driver.members)
    others = [end for end in dialled if end != plant]
    assert len(others) == count  # raw sockets are one-way: a pair of neighbours has two
    assert set(others) <= set(listening)
    assert set(made.driver.links.connect) == (set(listening) if pattern == "raw" else set())


@pytest.mark.parametrize("pattern", PATTERNS)
def test_neighbours_share_a_core_and_configurations_survive_their_pipe(
    pattern: str, real: RealNodes
) -> None:
    made = layout(pattern, real, Placement((4, 7), fifo=True))
    cores = [links.cpu for links in all_links(made)]
    assert cores[:NODES] == [4, 4, 7, 7]
    assert {links.fifo for links in (made.driver.links, *all_links(made))} == {10}
    assert loads(DriverConfig, dumps(made.driver), "here") == made.driver
    for worker in made.workers:
        assert loads(WorkerConfig, dumps(worker), "here") == worker
    for node in made.nodes:
        assert loads(NodeConfig, dumps(node), "here") == node


def test_the_payload_is_the_mean_of_the_nodes_sums(real: RealNodes) -> None:
    made = layout("neighbour", real, Placement((), fifo=False))
    nodes = [NodeFactors.from_plain(config.segments[0].factors) for config in made.nodes]
    numbers = [f.forward_received for f in nodes[1:]] + [f.backward_received for f in nodes[:-1]]
    sizes = [
        len(encode_numbers(Kind.FORWARD_SUM, 1 << 62, 1000, 0, 0, [0.1] * count))
        for count in numbers
    ]
    assert real.payload_bytes == round(sum(sizes) / len(sizes))


def test_a_wrong_configuration_is_refused(real: RealNodes) -> None:
    (one, *_) = layout("bare", real, Placement((), fifo=False)).workers
    text = dumps(one)
    with pytest.raises(UsageError, match="role: expected one of bare"):
        loads(WorkerConfig, text.replace('"bare"', '"neighbour"'), "here")
    with pytest.raises(UsageError, match=r"index: expected 0\.\.4"):
        loads(WorkerConfig, text.replace('"index":0', '"index":5'), "here")
