"""What each node process of a run is told: its segments' matrices and references, and how the run goes on.

Last step of deploying: used when a run is planned, and again for recordings that do not hold it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from deploy.deployment import Deployment
from deploy.path import References
from wire.channels import BATCH_TICKS
from wire.run_config import LinkConfig, NodeConfig, RunConfig, SegmentConfig

JOINING_SKIPS = 10_000
"""Ticks that may pass in lock-step, where they take less than a millisecond, while a process that nobody waits
for has something else to do: those of some seconds. One that falls behind by more is never heard again."""
REPLACED_S = 6.0
"""So long the neighbours of a dead node bridge its sums: longer than the plant waits for its replacement, which
speaks first."""


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
            skip_ticks=_skip_ticks(run),
            bridge_s=_bridge_s(run),
            left=first - run.segments_per_process if first else -1,
            links=links(own),
            segments=tuple(
                SegmentConfig(deployment.nodes[j].to_plain(), references.nodes[j].to_plain())
                for j in own
            ),
        )

    return tuple(map(config, run.firsts))


def _bridge_s(run: RunConfig) -> float:
    """In lock-step without replacement nothing is bridged. In real time as many ticks in a row as may be late,
    after the half of that which the plant waits for a sweep, and three for either side to hear of the other."""
    if run.restart:
        return REPLACED_S
    if run.pace is None:
        return 0.0
    return (run.pace.hold_ticks + (run.pace.hold_ticks + 1) // 2 + 3) * run.pace.period_s


def _skip_ticks(run: RunConfig) -> int:
    """In lock-step nobody is a tick ahead, but of a node that joins, which nobody waits for."""
    if run.pace is None:
        return JOINING_SKIPS if run.restart else 0
    joining = math.ceil(REPLACED_S / run.pace.period_s) if run.restart else 0
    return max(run.pace.hold_ticks + 1, min(joining, JOINING_SKIPS))
