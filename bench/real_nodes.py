"""The real nodes in a group: their configurations as in a run, and what the driver must know of them.

The only place of the benchmark that knows how a run's processes are made (`supervise.plan`,
`node.process`): how many there are, how many numbers their messages have, where their telemetry keeps
its instants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bench.configs import PATIENCE_S, EndRows, Port
from node.row import Y
from supervise.endpoints import Endpoints
from supervise.options import RunOptions
from supervise.plan import Prepared, make_plan, prepare
from wire.channels import DEGRADED, SUMS_AT
from wire.factors import NodeFactors
from wire.messages import message_bytes
from wire.run_config import MOST_TICKS, NodeConfig


@dataclass(frozen=True)
class RealNodes:
    """The gains on n nodes, and the sizes of what they send."""

    prepared: Prepared
    setpoint: int
    """Index of the setpoint whose gains are in use."""
    nodes: int
    """Segments."""
    ports: tuple[Port, ...]
    """Of the real nodes, called by their first segments."""
    centres: tuple[tuple[float, ...], ...]
    """What each process measures at the setpoint: velocity m/s, curvature 1/m of each segment."""
    ends: EndRows
    payload_bytes: int
    """Mean size of a sum's message."""
    command_bytes: int

    @property
    def processes(self) -> int:
        """Node processes."""
        return len(self.ports)


def deploy_nodes(gains: Path, nodes: int, per_process: int = 1) -> RealNodes:
    """Deploy the gains on n nodes; raises what `supervise.plan.prepare` does for gains and nodes."""
    prepared = prepare(
        RunOptions(gains=gains, nodes=nodes, ticks=MOST_TICKS, segments_per_process=per_process)
    )
    setpoint = prepared.artefact.setpoint_index(prepared.course.setpoint)
    factors = prepared.deployment.nodes
    groups = [range(i, min(i + per_process, nodes)) for i in range(0, nodes, per_process)]
    sums = [message_bytes(factors[own[0]].forward_received) for own in groups[1:]]
    sums += [message_bytes(factors[own[-1]].backward_received) for own in groups[:-1]]
    measured = [f.setpoints[setpoint].in_offset[-Y:].tolist() for f in factors]
    return RealNodes(
        prepared=prepared,
        setpoint=setpoint,
        nodes=nodes,
        ports=tuple(Port(own[0], Y * len(own), len(own)) for own in groups),
        centres=tuple(tuple(value for i in own for value in measured[i]) for own in groups),
        ends=EndRows(
            _row(factors[0]),
            _row(factors[-1]),
            groups[-1][0],
            tip=nodes - 1,
            measured=-3 - len(DEGRADED),
            arrived=-2 - len(DEGRADED),
        ),
        payload_bytes=round(sum(sums) / len(sums)),
        command_bytes=message_bytes(per_process),
    )


def _row(factors: NodeFactors) -> int:
    """Columns of an end node's telemetry row: its numbers, the sums, three instants, and how the tick went."""
    return SUMS_AT + factors.forward_received + factors.backward_received + 3 + len(DEGRADED)


def node_configs(
    real: RealNodes,
    endpoints: Endpoints,
    run_id: str,
    cores: list[int | None],
    fifo: int | None,
    epoch_ns: int,
) -> list[NodeConfig]:
    """Every node's configuration as a run makes it; the deadline is so long that a node can wait."""
    plan = make_plan(real.prepared, endpoints, run_id, Path(endpoints.private or "."))
    return [
        replace(
            node,
            links=replace(
                node.links, deadline_s=PATIENCE_S, cpu=core, fifo=fifo, epoch_ns=epoch_ns
            ),
        )
        for node, core in zip(plan.nodes, cores, strict=True)
    ]
