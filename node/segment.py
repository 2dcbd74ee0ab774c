"""One segment's part of a tick: whatever arrives first, the sums go on as soon as they can, the
command last.

Between the process around it (`node.process`: Zenoh in, Zenoh out) and the mathematics
(`node.sweep`). During tick k it holds xh_i(k) and u_i(k), takes y_i(k), c and d in any order, and
gives c_{i+1}, d_{i-1} and u_i(k+1) (theory, section 5).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic_ns

from node.sweep import Array, NodeSweep
from wire.messages import Numbers, Reason, RejectedError

Send = Callable[[int, int, list[float]], None]
"""Called with the tick, the setpoint that the numbers belong to, and the numbers to send."""


class NotFiniteError(Exception):
    """A number that this node computed is not finite; the text names node, tick and field."""


class Segment:
    """The state of one node within its tick. Not thread-safe: the process around it holds a lock.

    `record` gets one row a tick: y (2), xh (4), u, setpoint, bump, c, d, then the instants on the
    monotonic clock, in ns, at which the measurement, c (unless first), d (unless last) came and the
    command left.
    """

    def __init__(
        self,
        sweep: NodeSweep,
        nodes: int,
        *,
        send_forward: Send,
        send_backward: Send,
        send_command: Send,
        record: Callable[[int, list[float]], None],
    ) -> None:
        self.tick = 0
        self.began_ns = 0
        """When the first message of this tick came; 0 between two ticks."""
        self.ended_ns = 0
        """When the last tick ended; 0 before the first has."""
        self._sweep = sweep
        self._index = sweep.index
        self._first = sweep.index == 0
        self._last = sweep.index == nodes - 1
        self._setpoints = frozenset(map(float, range(sweep.setpoints)))
        self._send_forward = send_forward
        self._send_backward = send_backward
        self._send_command = send_command
        self._record = record
        self._reset()

    def _reset(self) -> None:
        self._x: Array | None = None
        self._y: list[float] = []
        self._c: list[float] | None = [] if self._first else None
        self._d: list[float] | None = [] if self._last else None
        self._at = [0, 0, 0]
        self.began_ns = 0

    def missing(self) -> list[str]:
        """What this tick still waits for, in words."""
        out = []
        if self._x is None:
            out.append("measurement from the plant")
        if self._c is None:
            out.append(f"forward sum from node {self._index - 1}")
        if self._d is None:
            out.append(f"backward sum from node {self._index + 1}")
        return out

    def on_measurement(self, message: Numbers, at_ns: int) -> None:
        """Take y_i(k); RejectedError if it is not this tick's first."""
        self._check(message, self._x is not None)
        self._y = message.values
        self._x = self._sweep.input(message.values)
        self._came(0, at_ns)
        if self._c is not None:
            self._forward(self._x, self._c)
        if self._d is not None:
            self._backward(self._x, self._d)
        self._finish()

    def on_forward(self, message: Numbers, at_ns: int) -> None:
        """Take c_i from the neighbour on the root's side."""
        self._check(message, self._c is not None)
        self._c = message.values
        self._came(1, at_ns)
        if self._x is not None:
            self._forward(self._x, self._c)
            self._finish()

    def on_backward(self, message: Numbers, at_ns: int) -> None:
        """Take d_i from the neighbour on the tip's side."""
        self._check(message, self._d is not None)
        if message.values[-1] not in self._setpoints:
            raise RejectedError(
                Reason.SETPOINT,
                f"expected one of {self._sweep.setpoints} setpoints, got {message.values[-1]!r}",
            )
        self._d = message.values
        self._came(2, at_ns)
        if self._x is not None:
            self._backward(self._x, self._d)
            self._finish()

    def _check(self, message: Numbers, have: bool) -> None:
        if message.tick != self.tick:
            reason = Reason.STALE if message.tick < self.tick else Reason.EARLY
            raise RejectedError(reason, f"expected tick {self.tick}, got {message.tick}")
        if have:
            raise RejectedError(Reason.DUPLICATE, f"tick {self.tick} has it already")
        if message.setpoint != self._sweep.setpoint:
            raise RejectedError(
                Reason.SETPOINT, f"expected {self._sweep.setpoint}, got {message.setpoint}"
            )

    def _came(self, which: int, at_ns: int) -> None:
        self._at[which] = at_ns
        if not self.began_ns:
            self.began_ns = at_ns

    def _forward(self, x: Array, c: list[float]) -> None:
        if not self._last:
            numbers = self._finite(self._sweep.forward(x, c), "forward sum")
            self._send_forward(self.tick, self._sweep.setpoint, numbers)

    def _backward(self, x: Array, d: list[float]) -> None:
        if not self._first:
            numbers = self._finite(self._sweep.backward(x, d), "backward sum")
            self._send_backward(self.tick, self._sweep.setpoint, numbers)

    def _finish(self) -> None:
        if self._x is None or self._c is None or self._d is None:
            return
        output = self._sweep.output(self._x, self._c, self._d)
        numbers = self._finite(output, "estimate or command")
        self._send_command(self.tick, self._sweep.next_setpoint, numbers[4:])
        sent_ns = monotonic_ns()
        held = self._x.tolist()  # xh (4), u, y (2) of this tick
        schedule = (float(self._sweep.setpoint), self._sweep.bump)
        row = [*self._y, *held[:5], *schedule, *self._c, *self._d, self._at[0]]
        if not self._first:
            row.append(self._at[1])
        if not self._last:
            row.append(self._at[2])
        row.append(sent_ns)
        self._record(self.tick, row)
        self._sweep.accept(output)
        self.tick += 1
        self.ended_ns = sent_ns
        self._reset()

    def _finite(self, array: Array, field: str) -> list[float]:
        values: list[float] = array.tolist()
        if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
            wrong = next(i for i, v in enumerate(values) if not math.isfinite(v))
            names = ("velocity_x", "velocity_y", "strain", "curvature", "command")
            name = names[wrong] if field.startswith("estimate") else f"{field}[{wrong}]"
            raise NotFiniteError(
                f"tick {self.tick}: node {self._index} computed {name} = {values[wrong]}"
            )
        return values
