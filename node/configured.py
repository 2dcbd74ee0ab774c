"""The sweeps of a node process, made from its configuration: the same in a run and in a replay.

Between the configuration that the launcher sends or a recording holds (`wire.run_config`) and `node.sweep`.
"""

from __future__ import annotations

import math

from node.scheduling import Sectors
from node.sweep import NodeSweep
from wire.factors import NodeFactors
from wire.reference import Reference
from wire.run_config import NodeConfig


def sweeps_of(config: NodeConfig) -> list[NodeSweep]:
    """One sweep a segment, at tick 0; UsageError names what is missing or damaged."""
    sectors = Sectors.of(config.scheduling)
    sweeps = []
    for segment in config.segments:
        reference = Reference.from_plain(segment.reference)
        sweeps.append(
            NodeSweep(
                NodeFactors.from_plain(segment.factors),
                config.setpoint,
                reference=reference,
                sectors=sectors,
                fade=math.exp(-reference.tick_s / config.scheduling.bump_s),
            )
        )
    return sweeps
