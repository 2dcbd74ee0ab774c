"""What each node process of a run is told: its segments' matrices and references, and how the run goes on.

Last step of deploying: used when a run is planned, and again for recordings that do not hold it.
"""

from __future__ import annotations

from collections.abc import Callable

from deploy.deployment import Deployment
from deploy.path import References
from wire.channels import BATCH_TICKS
from wire.run_config import LinkConfig, NodeConfig, RunConfig, SegmentConfig


def node_configs(
    run: RunConfig,
    deployment: Deployment,
    references: References,
    links: Callable[[range], LinkConfig],
) -> tuple[NodeConfig, ...]:
    """One configuration a node process, from the root on; `links` gives those of one with these segments."""

    def config(first: int) -> NodeConfig:
        own = range(first, min(first + run.segments_per_process, run.nodes))
        return NodeConfig(
            run_id=run.run_id,
            index=first,
            nodes=run.nodes,
            setpoint=run.setpoint_index,
            scheduling=run.scheduling,
            batch_ticks=BATCH_TICKS,
            skip_ticks=0 if run.pace is None else run.pace.hold_ticks + 1,
            links=links(own),
            segments=tuple(
                SegmentConfig(deployment.nodes[j].to_plain(), references.nodes[j].to_plain())
                for j in own
            ),
        )

    return tuple(map(config, run.firsts))
