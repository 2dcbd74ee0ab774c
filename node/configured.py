"""The sweeps of a node process, made from its configuration: the same in a run and in a replay.

Between the configuration that the launcher sends or a recording holds (`wire.run_config`) and `node.sweep`.
"""

from __future__ import annotations

import math

from node.scheduling import Sectors
from node.sweep import NodeSweep
from wire.errors import UsageError, shown
from wire.factors import NodeFactors
from wire.reference import Reference
from wire.run_config import NodeConfig, SegmentConfig


def sweeps_of(config: NodeConfig) -> list[NodeSweep]:
    """One sweep a segment, at tick 0; UsageError names what is missing or damaged."""
    sectors = Sectors.of(config.scheduling)
    sweeps = []
    for index, segment in enumerate(config.segments, config.index):
        try:
            sweeps.append(_sweep(config, index, segment, sectors))
        except UsageError as error:
            raise UsageError(f"segment {index}: {error}") from None
    return sweeps


def _sweep(config: NodeConfig, index: int, segment: SegmentConfig, sectors: Sectors) -> NodeSweep:
    reference = Reference.from_plain(segment.reference)
    factors = NodeFactors.from_plain(segment.factors)
    if (factors.index, factors.nodes) != (index, config.nodes):
        raise UsageError(
            f"the configuration is for segment {index} of {config.nodes}, its factors are those of node "
            f"{shown(factors.index)} of {shown(factors.nodes)}: take the one that this run's launcher wrote"
        )
    wanted, count = config.scheduling.setpoints, len(factors.setpoints)
    if not all(0 <= one < count for one in wanted):
        raise UsageError(f"scheduling: setpoints {shown(wanted)} of {count}")
    return NodeSweep(
        factors,
        config.setpoint,
        reference=reference,
        sectors=sectors,
        fade=math.exp(-reference.tick_s / config.scheduling.bump_s),
    )
