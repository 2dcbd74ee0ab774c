"""The instants in the nodes' telemetry, each at its own place, for `wire.link_latency`.

Beside `live.frame`.
"""

from __future__ import annotations

import numpy as np

from live.rows import Array, Ints, RecentRows
from wire.channels import DEGRADED, timing_fields

INSTANTS = (
    "measurement_received_wall_ns",
    "forward_received_wall_ns",
    "backward_received_wall_ns",
    "command_sent_wall_ns",
)
Y, C, D, _ = range(len(INSTANTS))


class Instants:
    """The instants of ticks at all nodes, each at its own place."""

    def __init__(self, rows: RecentRows) -> None:
        self._rows = rows
        self._places: list[tuple[list[int], slice]] = []
        for i in range(rows.nodes):
            fields = timing_fields(i, rows.nodes)
            columns = slice(-len(fields) - len(DEGRADED), -len(DEGRADED))
            self._places.append(([INSTANTS.index(f) for f in fields], columns))

    def came(self, ticks: Ints) -> Ints:
        """Of these ticks those in which all messages came; in others some instants are those of giving up."""
        flags = [self._rows.of(i, ticks)[:, -len(DEGRADED)] for i in range(self._rows.nodes)]
        return np.asarray(ticks[~np.any(flags, axis=0)])

    def at(self, ticks: Ints) -> Array:
        """(ticks, n, 4) in ns in the order of `INSTANTS`; -inf where a node has no such neighbour."""
        out = np.full((len(ticks), self._rows.nodes, len(INSTANTS)), -np.inf)
        for i, (places, columns) in enumerate(self._places):
            out[:, i, places] = self._rows.of(i, ticks)[:, columns]
        return out
