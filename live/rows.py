"""The newest telemetry rows of every process, to be found by their tick.

Between the batches that arrive, each process's at another time, and `live.frame`, which wants one tick of all.
A row of tick k stands at place k modulo `KEPT`, so nothing is searched and nothing grows.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic

import numpy as np
import numpy.typing as npt

from wire.channels import width
from wire.messages import PLANT, Batch
from wire.telemetry import telemetry_layout

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

KEPT = 128
"""Rows of each process: four full batches. Processes send theirs at different ticks, up to a batch apart."""
NEVER = -1


class RecentRows:
    """Rows of plant and nodes by tick.

    forward, backward: (n,) numbers in the sums that each node receives, as in `wire.channels.node_channels`.
    again_from: the tick with which a recording begins that may be published several times; None for a run,
    which begins once.
    """

    def __init__(
        self,
        nodes: int,
        forward: Sequence[int],
        backward: Sequence[int],
        again_from: int | None = None,
    ) -> None:
        self.nodes = nodes
        self._again_from = again_from
        self.layout = telemetry_layout(forward, backward)
        self.columns = {sender: width(channels) for sender, channels in self.layout.items()}
        """Numbers in the rows of each sender."""
        self._rows = {sender: np.zeros((KEPT, columns)) for sender, columns in self.columns.items()}
        self._ticks = np.full((KEPT, nodes + 1), NEVER, dtype=np.int64)
        """Whose rows are there, nodes and then the plant."""
        self.newest = np.full(nodes + 1, NEVER, dtype=np.int64)
        """The tick that each node, and last the plant, has reached; -1: nothing has come."""
        self.arrived_s = np.full(nodes + 1, -np.inf)
        """When the last rows came, monotonic clock."""

    def add(self, batch: Batch) -> bool:
        """Take a batch; False if its ticks are older than what is here."""
        column = self._column(batch.sender)
        if self.begins_again(batch):
            self._ticks[:, column] = self.newest[column] = NEVER
        last = batch.tick + len(batch.rows) - 1
        if last <= self.newest[column]:
            return False
        rows = batch.rows[-KEPT:]
        ticks = np.arange(last - len(rows) + 1, last + 1)
        places = ticks % KEPT
        self._rows[batch.sender][places] = rows
        self._ticks[places, column] = ticks
        self.newest[column] = last
        self.arrived_s[column] = monotonic()
        return True

    def begins_again(self, batch: Batch) -> bool:
        """Whether the sender is at the beginning of a recording again, before `add` has taken the batch."""
        newest = self.newest[self._column(batch.sender)]
        return batch.tick == self._again_from and bool(newest > batch.tick)

    def complete(self, after: int = NEVER) -> Ints:
        """Ticks beyond `after` of which everybody's row is there, in order."""
        ticks = self._ticks[:, -1]
        there = (self._ticks[:, :-1] == ticks[:, None]).all(axis=1) & (ticks > after)
        return np.sort(ticks[there])

    def of(self, sender: int, ticks: Ints | int) -> Array:
        """The sender's rows of these ticks, (ticks, columns) or (columns,); asked for what is complete."""
        return np.asarray(self._rows[sender][ticks % KEPT])

    def last(self, sender: int) -> Array | None:
        """The newest row of a sender, whatever the others have; None before there is one."""
        tick = int(self.newest[self._column(sender)])
        return None if tick == NEVER else self.of(sender, tick)

    def _column(self, sender: int) -> int:
        return self.nodes if sender == PLANT else sender
