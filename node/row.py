"""Where a tick of one segment happens: one row of numbers, made beforehand and cut into named views.

What a node receives, holds and knows in a tick is what it multiplies and what it records, so the sweep works in
the row itself: all that a product needs stands side by side, and recording costs no copy a tick. Rows lie in
blocks, one block a batch for the recorder.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from wire.channels import COMMAND, MEASUREMENT, SCHEDULE, STATE
from wire.factors import BACKWARD_EXTRA, FORWARD_EXTRA, INPUTS

Array = npt.NDArray[np.float64]

Y = len(MEASUREMENT)
_X = Y + len(STATE) + len(COMMAND)
OWN = _X + len(SCHEDULE)
"""Numbers of a telemetry row before the sums."""


class TickRow:
    """Views into one row: c, deviation, d, y, estimate and command, schedule, instants.

    deviation (7,): of x from the reference; y (2,); state (5,) estimate and command; x (7,) both; schedule
    (2,); c and d as they came, c_extra (3,) what the scheduling added to c; of_forward, of_backward,
    of_output: what the three products multiply, c or d with the deviation.
    """

    __slots__ = (
        "c",
        "c_extra",
        "d",
        "deviation",
        "instants",
        "of_backward",
        "of_forward",
        "of_output",
        "schedule",
        "state",
        "x",
        "y",
    )

    def __init__(self, row: Array, forward: int, backward: int) -> None:
        middle, end = forward + INPUTS, forward + INPUTS + backward
        self.c, self.c_extra = row[:forward], row[max(0, forward - FORWARD_EXTRA) : forward]
        self.deviation, self.d = row[forward:middle], row[middle:end]
        self.of_forward, self.of_backward, self.of_output = (
            row[:middle],
            row[forward:end],
            row[:end],
        )
        own = row[end:]
        self.y, self.state, self.x = own[:Y], own[Y:_X], own[:_X]
        self.schedule, self.instants = own[_X:OWN], own[OWN:]

    @classmethod
    def alone(cls, forward: int, backward: int) -> TickRow:
        """A row of its own, without instants, for sums of so many numbers."""
        return cls(np.zeros(forward + INPUTS + backward + OWN), forward, backward)


class RowBlock:
    """As many rows as a batch has; `rows` are the views into them."""

    def __init__(self, rows: int, forward: int, backward: int, instants: int) -> None:
        self._array = np.zeros((rows, forward + INPUTS + backward + OWN + instants))
        self._c, self._d = slice(0, forward), slice(forward + INPUTS, forward + INPUTS + backward)
        self.rows = [TickRow(row, forward, backward) for row in self._array]

    def telemetry(self, rows: int) -> Array:
        """A copy of the first rows in the order of `wire.channels.node_channels`."""
        array, own = self._array[:rows], self._d.stop
        parts = (
            array[:, own : own + OWN],
            array[:, self._c],
            array[:, self._d],
            array[:, own + OWN :],
        )
        return np.concatenate(parts, axis=1)


def columns(c: Array | None, deviation: Array, d: Array | None) -> Array:
    """A matrix for the parts of a row side by side, from the factors' matrices of c, input and d.

    Nothing is multiplied with what the scheduling added to the sums; without a neighbour there is neither.
    """
    parts = [np.roll(deviation, Y, axis=1)]  # a row has the measurement first
    if c is not None:
        parts = [c, _nothing(c, FORWARD_EXTRA), *parts]
    if d is not None:
        parts = [*parts, d, _nothing(d, BACKWARD_EXTRA)]
    return np.ascontiguousarray(np.hstack(parts))


def _nothing(matrix: Array, extra: int) -> Array:
    return np.zeros((len(matrix), extra))
