"""The processes of one group before they exist: who listens where, who dials whom, on which core.

From pattern and n to configurations; `bench.group` starts them.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace

from bench.configs import CHAINS, HUB, PATIENCE_S, DriverConfig, EndRows, WorkerConfig
from bench.real_nodes import RealNodes, node_configs
from supervise.endpoints import Endpoints
from supervise.plan import CORES
from wire.placement import FIFO_PRIORITY
from wire.run_config import LinkConfig, NodeConfig


@dataclass(frozen=True)
class Placement:
    """Where the processes of every group run."""

    cores: tuple[int, ...]
    """Empty: not pinned."""
    fifo: bool

    @property
    def priority(self) -> int | None:
        """Under SCHED_FIFO, None for the ordinary scheduler."""
        return FIFO_PRIORITY if self.fifo else None

    @property
    def driver(self) -> int | None:
        """The driver's core: as in a run it is not pinned, but real-time threads may not wander."""
        return self.cores[0] if self.fifo and self.cores else None

    def of(self, index: int, workers: int) -> int | None:
        """Neighbours share a core, as in a run."""
        return self.cores[index * len(self.cores) // workers] if self.cores else None


def choose_placement(*, pin: bool, fifo: bool) -> Placement:
    """The first cores that this process may use, as many as a run uses."""
    allowed = sorted(os.sched_getaffinity(0))
    return Placement(tuple(allowed[:CORES]) if pin else (), fifo)


@dataclass(frozen=True)
class Layout:
    """The configurations of a group's processes."""

    driver: DriverConfig
    workers: tuple[WorkerConfig, ...]
    nodes: tuple[NodeConfig, ...]
    """Of the real nodes; one of the two is empty."""


def lay_out(
    pattern: str, real: RealNodes, endpoints: Endpoints, placement: Placement, seed: int
) -> Layout:
    """Every process's configuration; `endpoints` are those of `endpoints_needed` nodes."""
    workers = real.processes
    run_id = f"bench-{pattern}-{workers}"
    epoch_ns = time.monotonic_ns()
    hub = (workers,) if pattern == "star" else ()

    def links(listen: list[str], connect: list[str], cpu: int | None) -> LinkConfig:
        return LinkConfig(
            listen=tuple(listen),
            connect=tuple(connect),
            directory=endpoints.private,
            deadline_s=PATIENCE_S,
            epoch_ns=epoch_ns,
            cpu=cpu,
            fifo=placement.priority,
        )

    def worker(index: int) -> WorkerConfig:
        listen, dial = _links_of(pattern, index, workers, endpoints)
        cpu = placement.of(min(index, workers - 1), workers)
        return WorkerConfig(
            run_id=run_id,
            role=HUB if index in hub else pattern,
            index=index,
            nodes=workers,
            payload_bytes=real.payload_bytes,
            command_bytes=real.command_bytes,
            links=links(listen, [endpoints.plant, *dial], cpu),
        )

    nodes: list[NodeConfig] = []
    if pattern == "neighbour":
        cores = [placement.of(i, workers) for i in range(workers)]
        nodes = node_configs(real, endpoints, run_id, cores, placement.priority, epoch_ns)
    ends = real.ends if pattern == "neighbour" else None
    if pattern in CHAINS and ends is None:
        ends = EndRows(2, 2, workers - 1, tip=workers - 1, measured=0, arrived=1)
    indices = tuple(range(workers))
    ports = real.ports
    if not nodes:
        ports = tuple(replace(port, index=i) for i, port in enumerate(real.ports))
    # A raw driver dials its workers; over Zenoh they dial it.
    dialled = [endpoints.nodes[i] for i in indices] if pattern == "raw" else []
    return Layout(
        driver=DriverConfig(
            run_id=run_id,
            pattern=pattern,
            ports=ports,
            members=(*(port.index for port in ports), *hub),
            centres=real.centres,
            setpoint=real.setpoint,
            seed=seed,
            ends=ends,
            links=links([endpoints.plant], dialled, placement.driver),
        ),
        workers=tuple(worker(i) for i in (*indices, *hub)) if not nodes else (),
        nodes=tuple(nodes),
    )


def endpoints_needed(pattern: str, real: RealNodes) -> int:
    """For how many nodes `supervise.endpoints.choose` must be asked, so that everybody has one."""
    return real.nodes if pattern == "neighbour" else real.processes + 2


def _links_of(
    pattern: str, index: int, workers: int, endpoints: Endpoints
) -> tuple[list[str], list[str]]:
    """Where a worker listens, and whom it dials besides the driver."""
    own, at = [endpoints.nodes[index]], endpoints.nodes
    if pattern == "star":
        return (own, []) if index == workers else ([], [at[workers]])
    if pattern == "all-to-all":
        return own, [at[i] for i in range(index)]
    left, right = at[max(0, index - 1) : index], at[index + 1 : min(workers, index + 2)]
    if pattern == "raw":
        return own, left + right
    return (own if right else []), left
