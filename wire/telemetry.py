"""Whose telemetry rows have which channels: what senders, recorder, live page and replay agree on.

Apart from `wire.channels`, which the design reads too and which knows nothing of messages.
"""

from __future__ import annotations

from collections.abc import Sequence

from wire.channels import Channel, node_channels, plant_channels
from wire.messages import PLANT


def telemetry_layout(forward: Sequence[int], backward: Sequence[int]) -> dict[int, list[Channel]]:
    """The channels of each sender's telemetry rows: nodes by their index, then the plant (wire.messages.PLANT).

    forward, backward: (n,) numbers in the sums that each node receives, as in `node_channels`.
    """
    nodes = len(forward)
    layout = {
        i: node_channels(i, nodes, *sums)
        for i, sums in enumerate(zip(forward, backward, strict=True))
    }
    return {**layout, PLANT: plant_channels(nodes)}
