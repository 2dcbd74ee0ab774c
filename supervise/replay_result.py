"""What a real process gave in a replay: its answers, and what its telemetry says.

Made by `supervise.replay_node`, filled by `supervise.replay_peer`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.replay import Replayed
from wire.messages import Kind, Reason, RejectedError, decode_batch, decode_counters, kind_of

Array = npt.NDArray[np.float64]


@dataclass
class NodeReplay:
    """What a real process gave."""

    replayed: Replayed
    latencies_us: Array
    """Per tick, from the first message put to the command received."""
    counters: dict[int, dict[str, int]]
    """Its last word, per segment; of several lives the last one's."""
    refused: int = 0
    """Messages that the lives before the last refused."""

    @property
    def rejected(self) -> int:
        """Messages that the process refused."""
        return self.refused + sum(one.get("rejected_messages", 0) for one in self.counters.values())

    def take(self, raw: bytes, run: int) -> None:
        """Put a message of its telemetry where it belongs; RejectedError if it is none of this run tag's."""
        if kind_of(raw) is Kind.COUNTERS:
            sender, _, counters = decode_counters(raw, run)
            self.counters[sender] = counters
            return
        kept = self.replayed.rows
        batch = decode_batch(raw, run, {i: rows.shape[1] for i, rows in kept.items()})
        rows, end = kept[batch.sender], batch.tick + len(batch.rows)
        if end > len(rows):
            raise RejectedError(
                Reason.EARLY, f"expected ticks up to {len(rows) - 1}, got {end - 1}"
            )
        rows[batch.tick : end] = batch.rows
