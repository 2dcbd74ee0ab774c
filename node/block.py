"""The segments of one process in a tick: whatever arrives first, the sums go on as soon as they can, the
commands last.

Between the process around it (`node.process`: Zenoh in, Zenoh out) and the mathematics of each segment
(`node.sweep`). During tick k segment i holds xh_i(k) and u_i(k), takes y_i(k), c and d in any order, and gives
c_{i+1}, d_{i-1} and u_i(k+1) (theory, section 5). Usually a process has one segment; with several, the sums
between them are handed on in memory, by the same mathematics in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import isfinite
from struct import Struct
from time import monotonic_ns

import numpy as np

from node.bridging import BACKWARD_BRIDGED, BRIDGED, FORWARD_BRIDGED, Bridging
from node.finite import check_finite, explain, refuse_not_finite
from node.outlet import Outlet
from node.row import Batch, Y
from node.sweep import Array, NodeSweep, Payload, bytes_of
from wire.channels import BATCH_NS, Degraded
from wire.errors import UsageError
from wire.messages import PARTIAL, Reason, RejectedError

_ONE = Struct("<d")
_NOT_WHOLE = FORWARD_BRIDGED | int(Degraded.PARTIAL)


class SegmentBlock:
    """Consecutive segments within their tick. Not thread-safe: the process around it holds a lock.

    A segment's row is y (2), xh (4), u, setpoint, bump, c, d, then the instants on the monotonic clock, in
    ns after `epoch_ns` (None: after the first measurement), at which the measurement, c (unless it is the
    root's), d (unless the tip's) came and the command left, then the process's `wire.channels.Degraded`.
    `batch` rows are handed over at once, the first time `first_batch`.

    A sum that does not come can be bridged: the last one, faded, stands for it, so that after some ticks the
    arm on that side is taken to be where the reference has it. Whoever is around the block says when
    (`cut_forward`, `cut_backward`, `close`); from then on that neighbour is not waited for, until a sum of its
    comes again.
    """

    def __init__(
        self,
        sweeps: Sequence[NodeSweep],
        outlet: Outlet,
        *,
        batch: int = 1,
        first_batch: int | None = None,
        epoch_ns: int | None = 0,
    ) -> None:
        _check_chain(sweeps)
        self.tick = 0
        self.began_ns = 0
        """When the first message of this tick came; 0 between two ticks."""
        self.ended_ns = 0
        """When the last tick ended; 0 before the first has."""
        self.passed = 0
        """Sums that were handed on in memory."""
        self._root, self._tip = sweeps[0], sweeps[-1]
        self._outlet = outlet
        self._epoch_ns = epoch_ns
        inner = [(np.zeros(s.forward_sent), np.zeros(s.backward_sent)) for s in sweeps]
        for i, sweep in enumerate(sweeps):
            sweep.send_from(
                outlet.forward if i == len(sweeps) - 1 else inner[i][0],
                outlet.backward if i == 0 else inner[i][1],
            )
        self._inner = tuple(pairwise(sweeps))
        self._backward_inner = tuple((b, a) for a, b in reversed(self._inner))
        self._measuring = tuple((sweep, Y * i) for i, sweep in enumerate(sweeps))
        self._bridging = Bridging(self._root, self._tip)
        self._unpack_y = Struct(f"<{Y * len(sweeps)}d").unpack
        self._commands = bytes_of(outlet.commands)
        self._setpoints = frozenset(map(float, range(sweeps[0].setpoints)))
        self._finishing = tuple(
            (sweep, Batch(sweep.row, batch), 8 * i) for i, sweep in enumerate(sweeps)
        )
        # looked up once: these are called in every tick
        self._send_forward, self._send_backward = outlet.send_forward, outlet.send_backward
        self._send_commands, self._begins = outlet.send_commands, outlet.begins
        self._forward_out, self._backward_out = outlet.forward, outlet.backward
        self._batch, self._quota = batch, first_batch or batch
        self._total_forward = np.ones(outlet.forward.size).dot
        self._total_backward = np.ones(outlet.backward.size).dot
        self._filled = 0
        self._batch_began_ns = 0
        self._clear()
        outlet.begins(0, self.setpoint)

    def _clear(self) -> None:
        self._have_y = False
        self._have_c, self._have_d = self._root.first, self._tip.last
        self._y_ns = self._c_ns = self._d_ns = self.began_ns = 0
        self._flags = 0

    @property
    def setpoint(self) -> int:
        """Index of the setpoint whose factors are in use in this tick."""
        return self._root.setpoint

    @property
    def setpoints(self) -> int:
        """How many setpoints there are."""
        return self._root.setpoints

    @property
    def begun(self) -> bool:
        """Whether something of this tick has come."""
        return self.began_ns != 0

    def missing(self) -> list[str]:
        """What this tick still waits for, in words."""
        out = []
        if not self._have_y:
            out.append("measurement from the plant")
        if not self._have_c:
            out.append(f"forward sum from node {self._root.index - 1}")
        if not self._have_d:
            out.append(f"backward sum from node {self._tip.index + 1}")
        return out

    @property
    def bridged(self) -> int:
        """Sums that did not come in time."""
        return self._bridging.sums

    @property
    def bridging_ns(self) -> int:
        """Since when every tick has had a sum bridged; 0 if the last one had none."""
        return self._bridging.since_ns

    def bridged_from(self) -> list[str]:
        """Whose sums are not waited for, in words."""
        return self._bridging.whose()

    # -- what comes -------------------------------------------------------------------------------

    def on_measurement(self, values: Payload, at_ns: int) -> None:
        """Take y(k) of all segments, as bytes; RejectedError if it is here already or not finite."""
        if self._have_y:
            raise self._twice()
        y = self._unpack_y(values)
        if not isfinite(sum(y)):
            refuse_not_finite("measurement", y)
        for sweep, at in self._measuring:
            sweep.measured(y[at], y[at + 1])
        self._have_y, self._y_ns = True, at_ns
        self.began_ns = self.began_ns or at_ns
        if self._bridging.cut_forward and not self._have_c:
            self._bridge_forward(at_ns)
        if self._bridging.cut_backward and not self._have_d:
            self._bridge_backward(at_ns)
        if self._have_c:
            self._forward()
        if self._have_d:
            self._backward()
            if self._have_c:
                self._finish()

    def on_forward(self, values: Payload, at_ns: int) -> None:
        """Take c of the first segment from its neighbour; RejectedError as above."""
        if self._have_c:
            raise self._no_more("forward", FORWARD_BRIDGED)
        if not self._have_y or self._tip.last:  # else the sum that goes on tells
            check_finite("forward sum", values)
        row = self._root.row
        last = bytes(row.c)
        row.c[:] = values
        if self._have_y:
            try:
                self._forward()
            except RejectedError:
                row.c[:] = last  # it will be bridged by what came before, not by this
                raise
        self._have_c, self._c_ns = True, at_ns
        self._bridging.cut_forward = False
        self.began_ns = self.began_ns or at_ns
        if self._have_y and self._have_d:
            self._finish()

    def on_backward(self, values: Payload, at_ns: int) -> None:
        """Take d of the last segment from its neighbour; RejectedError as above, also for an announced setpoint
        that does not exist."""
        if self._have_d:
            raise self._no_more("backward", BACKWARD_BRIDGED)
        (announced,) = _ONE.unpack_from(values, len(values) - 8)
        if announced not in self._setpoints:
            raise RejectedError(
                Reason.SETPOINT,
                f"expected one of {len(self._setpoints)} setpoints, got {announced!r}",
            )
        if not self._have_y or self._root.first:
            check_finite("backward sum", values)
        row = self._tip.row
        last = bytes(row.d)
        row.d[:] = values
        if self._have_y:
            try:
                self._backward()
            except RejectedError:
                row.d[:] = last
                raise
        self._have_d, self._d_ns = True, at_ns
        self._bridging.cut_backward = False
        self.began_ns = self.began_ns or at_ns
        if self._have_y and self._have_c:
            self._finish()

    # -- what does not come -----------------------------------------------------------------------

    def cut_forward(self, at_ns: int) -> None:
        """The neighbour towards the root is not waited for, in this tick and until a sum of its comes again."""
        if self._root.first:
            return
        self._bridging.cut_forward = True
        if self._have_y and not self._have_c:
            self._bridge_forward(at_ns)
            self._forward()
            if self._have_d:
                self._finish()

    def cut_backward(self, at_ns: int, announced: int | None = None) -> None:
        """The same of the neighbour towards the tip; `announced`: the next setpoint, if that is known."""
        if self._tip.last:
            return
        self._bridging.cut_backward = True
        if not self._have_d and announced is not None:
            self._tip.announce(announced)
        if self._have_y and not self._have_d:
            self._bridge_backward(at_ns)
            self._backward()
            if self._have_c:
                self._finish()

    def heard_forward(self) -> None:
        """A sum of an earlier tick came: the neighbour towards the root is there, and waited for again."""
        self._bridging.cut_forward = False

    def heard_backward(self) -> None:
        """The same of the neighbour towards the tip."""
        self._bridging.cut_backward = False

    def partial(self) -> None:
        """The forward sum that comes now is not of the whole arm; of no matter if it was bridged before."""
        if not self._have_c:
            self._flags |= int(Degraded.PARTIAL)

    def close(self, at_ns: int) -> None:
        """Give the tick up: what has not come is bridged, nothing more is sent, the command is held."""
        self._flags |= int(Degraded.HELD)
        anew = not self._have_y
        if anew:
            self._flags |= int(Degraded.MEASUREMENT_HELD)
            for sweep, _ in self._measuring:
                sweep.measure_again()
            self._have_y, self._y_ns = True, at_ns
        if not self._have_c:
            self._bridging.cut_forward = True
            self._bridge_forward(at_ns)
            self._forward(send=False)
        elif anew:
            self._forward(send=False)
        if not self._have_d:
            self._bridging.cut_backward = True
            self._bridge_backward(at_ns)
            self._backward(send=False)
        elif anew:
            self._backward(send=False)
        self._finish(send=False)

    def join(self, tick: int, setpoint: int, states: Sequence[Array]) -> None:
        """Begin at a tick, in place of a process that is dead, with these absolute states (5,) of the
        segments."""
        for (sweep, _), state in zip(self._measuring, states, strict=True):
            sweep.join(tick, setpoint, state)
        self.tick = tick
        self._clear()
        self._bridging.setpoint = setpoint
        self._flags = int(Degraded.JOINED)
        self._outlet.begins(tick, setpoint)

    def deviations(self) -> tuple[Array, Array]:
        """State less reference, (5,), of the first and of the last segment, in the tick that has begun."""
        return self._root.row.state.copy(), self._tip.row.state.copy()

    def _bridge_forward(self, at_ns: int) -> None:
        self._flags |= self._bridging.forward(self.setpoint)
        self._have_c, self._c_ns = True, at_ns

    def _bridge_backward(self, at_ns: int) -> None:
        self._flags |= self._bridging.backward(self.setpoint)
        self._have_d, self._d_ns = True, at_ns

    def skip_to(self, tick: int) -> None:
        """Nothing of this tick will come, the next is `tick`: the ticks between had no sweep."""
        self._hand_over(self.tick)
        for sweep, _, _ in self._finishing:
            sweep.skip_to(tick)
        self.tick = tick
        self._clear()
        self._outlet.begins(tick, self.setpoint)

    # -- what goes --------------------------------------------------------------------------------

    def _forward(self, *, send: bool = True) -> None:
        """The sums to the tip's side, through all segments and on."""
        for sweep, following in self._inner:
            following.take_forward(sweep.forward_sum())
            self.passed += 1
        last = self._tip
        if not last.last:
            last.forward_sum()
            # a product with ones is the quickest sum of a short array; what is not finite stays so in products
            if not isfinite(self._total_forward(self._forward_out)):
                explain(self.tick, self._forward_out, "forward sum", self._root.row.c, last)
            if send:
                partial = PARTIAL if self._flags & _NOT_WHOLE else 0
                self._send_forward(self.tick, last.setpoint | partial)

    def _backward(self, *, send: bool = True) -> None:
        """The sums to the root's side, through all segments and on."""
        for sweep, following in self._backward_inner:
            following.take_backward(sweep.backward_sum())
            self.passed += 1
        first = self._root
        if not first.first:
            first.backward_sum()
            if not isfinite(self._total_backward(self._backward_out)):
                explain(self.tick, self._backward_out, "backward sum", self._tip.row.d, first)
            if send:
                self._send_backward(self.tick, first.setpoint)

    def _finish(self, *, send: bool = True) -> None:
        """Commands of the next tick, records of this one, and the next tick begins."""
        flags, setpoint = self._flags, self.setpoint
        self._tip.partial = bool(flags & _NOT_WHOLE)
        for sweep, _, at in self._finishing:
            deviation = sweep.finish()
            if not isfinite(sum(deviation)):
                explain(self.tick, np.array(deviation), "estimate or command", b"", sweep)
            if not send:
                sweep.hold()
            _ONE.pack_into(self._commands, at, sweep.next_command)
        if send:
            self._send_commands(self.tick, self._root.next_setpoint)
        self.ended_ns = sent_ns = monotonic_ns()
        epoch = self._epoch_ns
        if epoch is None:  # another machine's clock
            epoch = self._epoch_ns = self._y_ns
        y, c, d, sent = (
            self._y_ns - epoch,
            self._c_ns - epoch,
            self._d_ns - epoch,
            sent_ns - epoch,
        )
        for sweep, batch, _ in self._finishing:
            row = sweep.row
            if sweep.first:
                row.instants.pack_into(row.buffer, row.instants_at, y, d, sent, flags)
            elif sweep.last:
                row.instants.pack_into(row.buffer, row.instants_at, y, c, sent, flags)
            else:
                row.instants.pack_into(row.buffer, row.instants_at, y, c, d, sent, flags)
            batch.keep(sweep.reference)
            sweep.advance()
        bridging = self._bridging
        bridging.setpoint = setpoint
        if flags & BRIDGED:
            bridging.since_ns = bridging.since_ns or self._y_ns
        else:
            bridging.since_ns = 0
        if not self._filled:
            self._batch_began_ns = sent_ns
        self._filled += 1
        self.tick += 1
        self._clear()
        if self._filled >= self._quota or sent_ns - self._batch_began_ns > BATCH_NS:
            self._hand_over(self.tick)
        self._begins(self.tick, self._root.setpoint)

    def flush(self) -> None:
        """Hand over the rows of all ticks that are done."""
        if self._filled:
            self.skip_to(self.tick)

    def _hand_over(self, next_tick: int) -> None:
        """Give a copy of the filled rows away, and fill them anew."""
        if self._filled:
            rows = [batch.take() for _, batch, _ in self._finishing]
            self._outlet.recorded(next_tick - self._filled, rows)
            self._filled, self._quota = 0, self._batch

    # -- what is wrong ----------------------------------------------------------------------------

    def _twice(self) -> RejectedError:
        return RejectedError(Reason.DUPLICATE, f"tick {self.tick} has it already")

    def _no_more(self, which: str, bridged: int) -> RejectedError:
        """A sum of this tick is not wanted any more: it was bridged, or is here already."""
        if not self._flags & bridged:
            return self._twice()
        self.heard_forward() if bridged == FORWARD_BRIDGED else self.heard_backward()
        return RejectedError(Reason.LATE, f"the {which} sum of tick {self.tick} was bridged")


def _check_chain(sweeps: Sequence[NodeSweep]) -> None:
    if not sweeps:
        raise UsageError("a node process needs at least one segment")
    for a, b in pairwise(sweeps):
        if b.index != a.index + 1 or a.forward_sent != b.forward_received:
            raise UsageError(
                f"segments {a.index} and {b.index} of one process are not neighbours of one "
                "deployment; deploy the gains again"
            )
