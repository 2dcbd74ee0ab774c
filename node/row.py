"""Where the ticks of one segment happen: one row of numbers, cut into named views, and the batch of its copies.

What a node receives, holds and knows in a tick is what it multiplies and what it records: all that a product
needs stands side by side, what comes is copied to its place in one piece, and a finished tick is copied into
the batch for the recorder as it is. The row is always the same memory, so that it stays in the cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct

import numpy as np
import numpy.typing as npt

from wire.channels import DEGRADED, MEASUREMENT, SCHEDULE
from wire.factors import BACKWARD_EXTRA, FORWARD_EXTRA, INPUTS, OUTPUTS

Array = npt.NDArray[np.float64]

Y = len(MEASUREMENT)
Y_PAIR = Struct("<2d")
KNOWN = Struct("<4d")
"""The measurement as it came, and the schedule."""
_INSTANTS = {count: Struct(f"<{count + 1}d") for count in (0, 3, 4)}
"""So many instants, then the tick's `wire.channels.Degraded`."""


class TickRow:
    """One row: c, deviation of the input from the reference (y, estimate, command), d, y as it came, schedule,
    instants.

    state (5,): deviation of estimate and command; c, d: bytes of the sums' places; buffer: all of it.
    of_forward, of_backward, of_output: what the three products multiply, c or d with the deviation.
    """

    __slots__ = (
        "_array",
        "_backward",
        "_forward",
        "buffer",
        "c",
        "d",
        "instants",
        "instants_at",
        "known_at",
        "of_backward",
        "of_forward",
        "of_output",
        "state",
        "state_bytes",
        "y_at",
    )

    def __init__(self, forward: int, backward: int, instants: int = 0) -> None:
        middle, end = forward + INPUTS, forward + INPUTS + backward
        row = self._array = np.zeros(end + Y + len(SCHEDULE) + instants + len(DEGRADED))
        self._forward, self._backward = forward, backward
        self.of_forward, self.of_backward, self.of_output = (
            row[:middle],
            row[forward:end],
            row[:end],
        )
        self.state = row[forward + Y : middle]
        self.buffer = memoryview(row.data).cast("B")
        self.state_bytes = self.buffer[8 * (forward + Y) : 8 * middle]
        self.c, self.d = self.buffer[: 8 * forward], self.buffer[8 * middle : 8 * end]
        self.y_at, self.known_at = 8 * forward, 8 * end
        self.instants_at = self.known_at + KNOWN.size
        self.instants = _INSTANTS[instants]

    def telemetry(self, rows: Array, references: Array) -> Array:
        """Copies of this row (ticks, numbers) in the order of `wire.channels.node_channels`, states absolute.

        references: (ticks, 5) or (5,), of estimate and command.
        """
        middle = self._forward + INPUTS
        end = middle + self._backward
        parts = (
            rows[:, end : end + Y],
            rows[:, self._forward + Y : middle] + references,
            rows[:, end + Y : end + Y + len(SCHEDULE)],
            rows[:, : self._forward],
            rows[:, middle:end],
            rows[:, end + Y + len(SCHEDULE) :],
        )
        return np.concatenate(parts, axis=1)

    def now(self, reference: Array) -> Array:
        """This row as it is, as telemetry."""
        return np.asarray(self.telemetry(self._array[None, :], reference[:OUTPUTS])[0])


class Batch:
    """Copies of a row, one a tick, until they are handed over."""

    def __init__(self, row: TickRow, ticks: int) -> None:
        self._row = row
        self._size = len(row.buffer)
        self._rows = np.zeros((ticks, self._size // 8))
        self._bytes = memoryview(self._rows.data).cast("B")
        self._references: list[Array] = []

    def keep(self, reference: Array) -> None:
        """Copy the row as it is now; `reference` is that of its state."""
        at = len(self._references) * self._size
        self._bytes[at : at + self._size] = self._row.buffer
        self._references.append(reference)

    def take(self) -> Array:
        """What was kept, as telemetry (ticks, columns); the batch is empty again."""
        references, self._references = self._references, []
        same = all(reference is references[0] for reference in references)
        wanted = references[0][:OUTPUTS] if same else _states(references)
        return self._row.telemetry(self._rows[: len(references)], wanted)


def _states(references: Sequence[Array]) -> Array:
    return np.stack([reference[:OUTPUTS] for reference in references])


def matrix(c: Array | None, deviation: Array, d: Array | None) -> Array:
    """A matrix for the parts of a row side by side, from the factors' matrices of c, input and d.

    Nothing is multiplied with what the scheduling added to the sums; without a neighbour there is neither.
    """
    parts = [np.roll(deviation, Y, axis=1)]  # a row has the measurement first
    if c is not None:
        parts = [c, _nothing(c, FORWARD_EXTRA), *parts]
    if d is not None:
        parts = [*parts, d, _nothing(d, BACKWARD_EXTRA)]
    return np.ascontiguousarray(np.hstack(parts))


def _nothing(rows: Array, extra: int) -> Array:
    return np.zeros((len(rows), extra))
