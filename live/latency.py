"""How long a message between neighbours was on its way, from the instants in the nodes' telemetry.

Beside `live.frame`. Node i has forward_received(i); its neighbour i - 1 had all that it needed for that sum
when both its measurement and the sum from node i - 2 were there. What lies between the two is the link: the
neighbour's product, its sending, the transport, and node i's waking up. Backward alike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from live.rows import Array, Ints, RecentRows
from wire.channels import timing_fields

INSTANTS = (
    "measurement_received_wall_ns",
    "forward_received_wall_ns",
    "backward_received_wall_ns",
    "command_sent_wall_ns",
)
Y, C, D, SENT = range(len(INSTANTS))


class Instants:
    """The instants of ticks at all nodes, each at its own place."""

    def __init__(self, rows: RecentRows) -> None:
        self._rows = rows
        self._places: list[tuple[list[int], slice]] = []
        for i in range(rows.nodes):
            fields = timing_fields(i, rows.nodes)
            self._places.append(([INSTANTS.index(f) for f in fields], slice(-len(fields), None)))

    def at(self, ticks: Ints) -> Array:
        """(ticks, n, 4) in ns in the order of `INSTANTS`; -inf where a node has no such neighbour."""
        out = np.full((len(ticks), self._rows.nodes, len(INSTANTS)), -np.inf)
        for i, (places, columns) in enumerate(self._places):
            out[:, i, places] = self._rows.of(i, ticks)[:, columns]
        return out


def measurable(nodes: int, firsts: Sequence[int], elsewhere: Sequence[int]) -> list[bool]:
    """Whether link i -> i + 1 is one between two processes of one clock, for each of the n - 1."""
    begins, far = set(firsts), set(elsewhere)
    return [i + 1 in begins and i not in far and i + 1 not in far for i in range(nodes - 1)]


def link_latencies(instants: Array) -> tuple[Array, Array]:
    """Forward (link i -> i + 1) and backward (i + 1 -> i), each (ticks, n - 1) in ns, from (ticks, n, 4)."""
    could_forward = np.maximum(instants[:, :, Y], instants[:, :, C])
    could_backward = np.maximum(instants[:, :, Y], instants[:, :, D])
    forward = instants[:, 1:, C] - could_forward[:, :-1]
    backward = instants[:, :-1, D] - could_backward[:, 1:]
    return forward, backward
