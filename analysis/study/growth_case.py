"""What one number of segments costs: deployed, measured and simulated in a process of its own.

Called by `analysis.study.growth` for each n; gives facts ready for JSON.
"""

from __future__ import annotations

import gc
import resource
import tracemalloc
from collections.abc import Sequence
from dataclasses import fields
from time import perf_counter, process_time
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.study.hop import Hop
from analysis.study.tick_cases import Costs, Hosts, draw, tick_times
from analysis.study.virtual_chain import (
    VirtualNode,
    run_tick,
    sequential_tick,
    split,
    states,
    virtual_nodes,
)
from deploy.deployment import deploy
from deploy.direct_tick import direct_tick
from deploy.grid import make_grid
from deploy.semiseparable import NodeMatrices, multiply
from deploy.structured import StructuredDeployment, structured_deploy, structured_step
from node.sweep import NodeSweep
from wire.artefact import GainsArtefact
from wire.errors import OctarmError
from wire.factors import BACKWARD_EXTRA, FORWARD_EXTRA, INPUTS, NodeFactors, SweepFactors
from wire.messages import HEADER_BYTES

Array = npt.NDArray[np.float64]

MIB = 2.0**20
SEGMENTS = (1, 10, 100)
"""Segments a process."""
HANDLED = 1000
"""About so many real handlings of each kind are timed; with many nodes two ticks give more."""
MOST_TICKS = 100
FEWEST_TICKS = 20
EVENTS = 300_000
"""About so many simulated messages a case."""
SAMPLE = 50
"""Nodes whose objects are weighed."""
NOISE = (1e-3, 1e-2)
"""Deviation of the measurements (m/s, 1/m) that the checked ticks are fed with."""


def dense_case(artefact: GainsArtefact, nodes: int, tick_s: float) -> dict[str, Any]:
    """Seconds, wall clock and processor, and peak memory of `deploy`."""
    before, began, cpu = _peak_mib(), perf_counter(), process_time()
    deploy(artefact, nodes, tick_s)
    return {
        "nodes": nodes,
        "seconds": perf_counter() - began,
        "cpu_seconds": process_time() - cpu,
        "peak_mib": _peak_mib() - before,
    }


def case(
    artefact: GainsArtefact, nodes: int, tick_s: float, hop: Hop, hosts: Sequence[Hosts]
) -> dict[str, Any]:
    """All about n segments. OctarmError if the simulated chain does not give the sums."""
    before, began, cpu = _peak_mib(), perf_counter(), process_time()
    deployed = structured_deploy(artefact, nodes, tick_s)
    out: dict[str, Any] = {
        "nodes": nodes,
        "deploy_seconds": perf_counter() - began,
        "deploy_cpu_seconds": process_time() - cpu,
        "deploy_peak_mib": _peak_mib() - before,
        "difference": _difference(artefact, deployed),
        **_messages(deployed),
        **_memory(deployed.nodes),
        "cases": [],
    }
    measured = _measurements(deployed.nodes, max(2, -(-HANDLED // nodes)))
    expected = _sequential(deployed.nodes, measured)
    for segments in SEGMENTS:
        processes = -(-nodes // segments)
        if processes < 2:
            continue
        chain = virtual_nodes(deployed.nodes, segments)
        gc.disable()  # going through the objects of thousands of nodes is no node's work
        try:
            _check(chain, measured, expected, hosts[0], hop)
        finally:
            gc.enable()
        handling = tuple(_handled_us(chain, what) for what in range(3))
        costs = Costs(hop, (handling[0], handling[1], handling[2]))
        ticks = int(np.clip(EVENTS // (3 * processes), FEWEST_TICKS, MOST_TICKS))
        for one in hosts:
            found = tick_times(one, costs, processes, ticks, seed=nodes)
            handled = [float(np.median(h)) for h in handling]
            out["cases"].append({"segments": segments, "handling_us": handled, **found})
    return out


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _difference(artefact: GainsArtefact, deployed: StructuredDeployment) -> float:
    """Sweeps against `direct_tick`: largest difference, random inputs, relative per component."""
    grid = make_grid(artefact.arm.length_m, len(deployed.nodes), deployed.faces_m.tolist())
    random = np.random.default_rng(20090101)
    worst = 0.0
    for k, setpoint in enumerate(artefact.setpoints):
        step = structured_step(artefact.arm, setpoint, grid, deployed.tick_s)
        scaled = random.standard_normal((grid.nodes, INPUTS))
        expected = direct_tick(step, scaled)
        matrices = [_matrices(node.setpoints[k]) for node in deployed.nodes]
        got = multiply(matrices, scaled / step.scale_in.reshape(scaled.shape))
        got *= step.scale_out.reshape(got.shape)
        size = np.max(np.abs(expected), axis=0)
        error = np.max(np.abs(got - expected), axis=0) / np.where(size > 0.0, size, 1.0)
        worst = max(worst, float(error.max()))
    return worst


def _matrices(one: SweepFactors) -> NodeMatrices:
    return NodeMatrices(D=one.D, P=one.P, Q=one.Q, W=one.W, U=one.U, R=one.R, V=one.V)


def _messages(deployed: StructuredDeployment) -> dict[str, Any]:
    """Numbers and bytes of the messages between nodes, and the ranks without padding."""
    forward = [node.forward_received for node in deployed.nodes[1:]]
    backward = [node.backward_received for node in deployed.nodes[:-1]]
    numbers = np.array(forward + backward)
    return {
        "forward_numbers": max(forward),
        "backward_numbers": max(backward),
        "extra_numbers": [FORWARD_EXTRA, BACKWARD_EXTRA],
        "message_bytes_mean": float(HEADER_BYTES + 8.0 * numbers.mean()),
        "message_bytes_max": int(HEADER_BYTES + 8 * numbers.max()),
        "ranks_forward": [max(one) for one in deployed.ranks_forward],
        "ranks_backward": [max(one) for one in deployed.ranks_backward],
        "messages_per_tick": len(numbers),
    }


def _memory(nodes: Sequence[NodeFactors]) -> dict[str, float]:
    """Bytes of a node: factors of all setpoints, and the objects that run them (mean of some in the middle)."""
    start = max(0, (len(nodes) - SAMPLE) // 2)
    some = nodes[start : start + SAMPLE]
    factors = [
        sum(getattr(one, field.name).nbytes for field in fields(one))
        for node in some
        for one in node.setpoints
    ]
    tracemalloc.start()
    try:
        kept = [VirtualNode([node]) for node in some]
        size = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    return {
        "factor_bytes": sum(factors) / len(some),
        "object_bytes": size / len(kept),
    }


def _measurements(nodes: Sequence[NodeFactors], ticks: int) -> Array:
    """(ticks, n, 2): the first setpoint's, with a seeded deviation."""
    rest = np.stack([node.setpoints[0].in_offset[-2:] for node in nodes])
    random = np.random.default_rng(7)
    return np.asarray(rest + np.array(NOISE) * random.standard_normal((ticks, len(nodes), 2)))


def _sequential(nodes: Sequence[NodeFactors], measured: Array) -> Array:
    sweeps = [NodeSweep(node) for node in nodes]
    for one in measured:
        out = sequential_tick(sweeps, one)
    return out


def _check(
    chain: list[VirtualNode], measured: Array, expected: Array, hosts: Hosts, hop: Hop
) -> None:
    """Run the real nodes through simulated ticks; bit for bit what one pass after the other gives."""
    nothing = np.zeros(1)
    random = np.random.default_rng(len(chain))
    costs = Costs(hop, (nothing, nothing, nothing))
    core = hosts.cores(len(chain))
    for one in measured:
        run_tick(chain, core, draw(hosts, costs, len(chain), random), split(one, chain))
    found = states(chain)
    if not np.array_equal(found, expected):
        raise OctarmError(
            f"{len(found)} simulated nodes in {len(chain)} processes differ from the plain evaluation by "
            f"{np.max(np.abs(found - expected)):.1e}, expected the same bits"
        )


def _handled_us(chain: Sequence[VirtualNode], what: int) -> Array:
    return 1e-3 * np.array(
        [ns for node in chain for ns in node.handling_ns[what]], dtype=np.float64
    )
