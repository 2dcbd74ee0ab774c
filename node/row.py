"""Where a tick of one segment happens: one row of its telemetry, made beforehand and cut into named views.

What a node receives, holds and knows in a tick is what it records (`wire.channels.node_channels` names the
numbers), so the sweep works in the row itself and recording costs no copy. Rows lie in blocks, one block a
batch for the recorder.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from wire.channels import COMMAND, MEASUREMENT, SCHEDULE, STATE
from wire.factors import BACKWARD_EXTRA, FORWARD_EXTRA

Array = npt.NDArray[np.float64]

_Y = len(MEASUREMENT)
_X = _Y + len(STATE) + len(COMMAND)
OWN = _X + len(SCHEDULE)
"""Numbers of a row before the sums."""


class TickRow:
    """Views into one row: y (2,), state (5,) estimate and command, x (7,) both; schedule (2,); c and d as they
    came, c_sum and d_sum without what the scheduling added, c_extra what it added; instants: the rest."""

    __slots__ = ("c", "c_extra", "c_sum", "d", "d_sum", "instants", "schedule", "state", "x", "y")

    def __init__(self, row: Array, forward: int, backward: int) -> None:
        self.y, self.state, self.x = row[:_Y], row[_Y:_X], row[:_X]
        self.schedule = row[_X:OWN]
        end = OWN + forward
        self.c, self.c_sum = row[OWN:end], row[OWN : max(OWN, end - FORWARD_EXTRA)]
        self.c_extra = row[max(OWN, end - FORWARD_EXTRA) : end]
        self.d = row[end : end + backward]
        self.d_sum = row[end : max(end, end + backward - BACKWARD_EXTRA)]
        self.instants = row[end + backward :]

    @classmethod
    def alone(cls, forward: int, backward: int) -> TickRow:
        """A row of its own, without instants, for sums of so many numbers."""
        return cls(np.zeros(OWN + forward + backward), forward, backward)


class RowBlock:
    """As many rows as a batch has: `array` (rows, columns) is what is sent, `rows` the views into it."""

    def __init__(self, rows: int, forward: int, backward: int, instants: int) -> None:
        self.array = np.zeros((rows, OWN + forward + backward + instants))
        self.rows = [TickRow(row, forward, backward) for row in self.array]
