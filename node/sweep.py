"""The mathematics of one node in the two sweeps: pure, preallocated, the same in run and replay.

Per tick the process around it hands on what comes, in any order of the three, and takes the next estimate and
command (theory, section 5):
    sweep.input(measurement)         the products of estimate, command and measurement
    c_next = sweep.forward(c)        to the tip's side, once c is there (empty at the root)
    d_previous = sweep.backward(d)   to the root's side, once d is there (empty at the tip)
    sweep.accept(sweep.output())     the state of the next tick

What depends on the input alone is multiplied when the measurement comes, so that a sum that arrives waits for
one small product only; the order of the additions is the same whatever comes first, and so are the bits.
Matrices act on the deviation from the reference, out = M (in - in_ref(k)) + out_ref(k+1); which setpoint's
they are is decided by the tip node (`node.scheduling`). For that the sums are longer than the products: c ends
with turn and end of the arm so far, d with the setpoint of the next tick.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from node.row import TickRow
from node.scheduling import CLAMP, ArmEnd, Sectors, grow
from wire.errors import OctarmError, UsageError
from wire.factors import (
    BACKWARD_EXTRA,
    FORWARD_EXTRA,
    INPUTS,
    OUTPUTS,
    STATES,
    NodeFactors,
    SweepFactors,
)
from wire.reference import TERMS, Leg, Reference

Array = npt.NDArray[np.float64]
Numbers = Array | Sequence[float]
add, subtract = np.add, np.subtract

CHORD = 2
"""Numbers of a reference behind state and command: x and y from the inner to the outer face, m."""
MEASURED = [1, 3]
"""Which of the state's components are measured: v_y and k."""
_AS_ROWS_HAVE_IT = [5, 6, 0, 1, 2, 3, 4]
"""The factors' input (estimate, command, measurement) in the order of a row: measurement first."""
_COMMAND = INPUTS - 1
"""Where a row's input has the command."""


class _Products:
    """The factors of one setpoint, stacked by what they are multiplied with, and where the products go."""

    def __init__(self, factors: SweepFactors) -> None:
        of_input = np.vstack([factors.Q, factors.R, factors.D])[:, _AS_ROWS_HAVE_IT]
        self.of_input = np.ascontiguousarray(of_input)
        self.of_c = np.ascontiguousarray(np.vstack([factors.W, factors.P]))
        self.of_d = np.ascontiguousarray(np.vstack([factors.V, factors.U]))
        c, d = factors.forward_sent, factors.backward_sent
        # bound once: these are the products of every tick
        self.multiply_input = self.of_input.dot
        self.multiply_c, self.multiply_d = self.of_c.dot, self.of_d.dot
        self.from_input = np.zeros(c + d + OUTPUTS)
        self.from_c, self.from_d = np.zeros(c + OUTPUTS), np.zeros(d + OUTPUTS)
        self.c_of_input, self.c_of_c = self.from_input[:c], self.from_c[:c]
        self.d_of_input, self.d_of_d = self.from_input[c : c + d], self.from_d[:d]
        self.out_of_input = self.from_input[c + d :]
        self.out_of_c, self.out_of_d = self.from_c[c:], self.from_d[d:]


def resting_at(factors: SweepFactors) -> Reference:
    """The reference of a run that rests at a setpoint: the setpoint as its commands hold it."""
    coefficients = np.zeros((TERMS, OUTPUTS + CHORD, 1))
    coefficients[0, :OUTPUTS, 0] = factors.out_offset
    return Reference(1.0, [Leg(0.0, 0.0, coefficients)])


class NodeSweep:
    """One node's sweep and its state: `estimate` (4,) (v_x, v_y, e, k) and `command`, absolute, SI.

    `reference` gives what is wanted at each tick, (7,): state, command and chord; None rests at the setpoint.
    `sectors` is what the tip node decides by; None keeps the setpoint. `fade` is the factor a tick of
    the command's bump, see `output`.

    A tick happens in a `row` (`node.row`), which `accept` changes for the next tick's. Arrays returned by
    the methods are buffers that the next call of the same method overwrites; sums may be arrays or lists.
    OctarmError if a sum has not as many numbers as the factors ask for.
    """

    def __init__(
        self,
        factors: NodeFactors,
        setpoint: int = 0,
        *,
        reference: Reference | None = None,
        sectors: Sectors | None = None,
        fade: float = 0.0,
    ) -> None:
        self.index = factors.index
        self.tick = 0
        self.bump = 0.0
        """Part of the command, N/m, that hides a change of gains."""
        self.forward_received = factors.forward_received
        """How many numbers c has."""
        self.backward_received = factors.backward_received
        """How many numbers d has."""
        self.first = factors.index == 0
        """Whether this is the root's node."""
        self.last = factors.index == factors.nodes - 1
        """Whether this is the tip's node."""
        self._bend = factors.bend_m
        self._products = [_Products(one) for one in factors.setpoints]
        self.select(setpoint)
        self._decided = setpoint
        self._announced = setpoint
        self._sectors = sectors or Sectors.only(setpoint)
        self._tip = CLAMP
        self._changed = False
        self._fade = fade
        self._next_bump = 0.0
        self._reference = reference or resting_at(factors.setpoints[setpoint])
        self._now = self._reference.at(0)
        self._expect(self._reference.at(1))
        if self._now.shape != (OUTPUTS + CHORD,):
            raise UsageError(
                f"node {self.index}: expected a reference of {OUTPUTS + CHORD} numbers, got "
                f"{self._now.size}; deploy the gains again"
            )
        self._offset = np.zeros(INPUTS)
        self._deviation = np.zeros(INPUTS)
        self._aimed = self._now
        self._aim()
        self._output = np.zeros(OUTPUTS)
        # a product with ones is the quickest sum of a short array
        self._total_c = np.ones(self.forward_received).dot
        self._total_d = np.ones(self.backward_received).dot
        sums = factors.setpoints[0]
        self.forward_sent = 0 if self.last else sums.forward_sent + FORWARD_EXTRA
        """How many numbers the sum to the tip's side has."""
        self.backward_sent = 0 if self.first else sums.backward_sent + BACKWARD_EXTRA
        """How many numbers the sum to the root's side has."""
        self.send_from(np.zeros(self.forward_sent), np.zeros(self.backward_sent))
        self.row = TickRow.alone(self.forward_received, self.backward_received)
        """Where this tick happens."""
        self._spare = TickRow.alone(self.forward_received, self.backward_received)
        self.row.state[:STATES] = factors.initial_estimate[setpoint]
        self.row.state[STATES] = factors.initial_command[setpoint]
        self._label_row()

    @property
    def estimate(self) -> Array:
        """xh_i of the current tick, (4,)."""
        return self.row.state[:STATES]

    @property
    def command(self) -> float:
        """u_i of the current tick, N/m."""
        return float(self.row.state[STATES])

    @property
    def last_output(self) -> Array:
        """What `output` gave last, (5,)."""
        return self._output

    @property
    def setpoint(self) -> int:
        """Index of the setpoint whose factors are in use."""
        return self._setpoint

    @property
    def next_setpoint(self) -> int:
        """Index of the setpoint whose factors are in use in the next tick; known after `output`."""
        return self._announced

    @property
    def setpoints(self) -> int:
        """How many setpoints there are."""
        return len(self._products)

    def select(self, setpoint: int) -> None:
        """Use another setpoint's factors from the next product on; all nodes at the same tick."""
        if not 0 <= setpoint < len(self._products):
            raise UsageError(
                f"node {self.index}: setpoint {setpoint} does not exist, the factors have "
                f"{len(self._products)} (0 .. {len(self._products) - 1})"
            )
        self._setpoint = setpoint
        self._active = self._products[setpoint]

    def send_from(self, forward: Array, backward: Array) -> None:
        """Write the sums that go on into these arrays from now on: the payloads of messages, say."""
        self._c_next, self._d_previous = forward, backward
        self._c_sum = forward[: max(0, forward.size - FORWARD_EXTRA)]
        self._d_sum = backward[: max(0, backward.size - BACKWARD_EXTRA)]

    def start_in(self, row: TickRow) -> None:
        """Let the tick that begins happen in another row."""
        row.state[:] = self.row.state
        self.row = row
        self._label_row()

    # -- a tick -----------------------------------------------------------------------------------

    def input(self, measurement: Numbers) -> Array:
        """Take the measurement (v_y, k): all that depends on this node alone. Returns the input, as a row has
        it: measurement, estimate, command (7,)."""
        row, p = self.row, self._active
        row.y[:] = measurement
        subtract(row.x, self._offset, self._deviation)
        p.multiply_input(self._deviation, p.from_input)
        return row.x

    def take_forward(self, c: Numbers) -> float:
        """Take the sum from the root's side and multiply it; returns its total, finite only if all of it is."""
        row, p = self.row, self._active
        if len(c) != self.forward_received:
            raise self._wrong_length("forward", len(c), self.forward_received)
        row.c[:] = c
        p.multiply_c(row.c_sum, p.from_c)
        total: float = self._total_c(row.c)
        return total

    def take_backward(self, d: Numbers) -> float:
        """Take the sum from the tip's side and multiply it; returns its total, finite only if all of it is."""
        row, p = self.row, self._active
        if len(d) != self.backward_received:
            raise self._wrong_length("backward", len(d), self.backward_received)
        row.d[:] = d
        p.multiply_d(row.d_sum, p.from_d)
        total: float = self._total_d(row.d)
        return total

    def forward_sum(self) -> Array:
        """W c + Q (in - in_ref) and the arm with this segment, after `input` and `take_forward`."""
        p = self._active
        if self.first:
            self._c_sum[:] = p.c_of_input
        else:
            add(p.c_of_c, p.c_of_input, self._c_sum)
        out = self._c_next
        out[-3], out[-2], out[-1] = self._grown()
        return out

    def backward_sum(self) -> Array:
        """V d + R (in - in_ref) and the next setpoint, after `input` and `take_backward`."""
        p = self._active
        if self.last:
            self._d_sum[:] = p.d_of_input
            self._d_previous[-1] = self._decided
        else:
            add(p.d_of_d, p.d_of_input, self._d_sum)
            self._d_previous[-1] = self.row.d[-1]
        return self._d_previous

    def forward(self, c: Numbers) -> Array:
        """Take c; the sum for the tip's side, after `input`; empty at the tip node."""
        if not self.first:
            self.take_forward(c)
        return self._c_next if self.last else self.forward_sum()

    def backward(self, d: Numbers) -> Array:
        """Take d; the sum for the root's side, after `input`; empty at the root node."""
        if not self.last:
            self.take_backward(d)
        return self._d_previous if self.first else self.backward_sum()

    def output(self) -> Array:
        """D (in - in_ref) + P c + U d + out_ref: estimate, command (5,) of the next tick, once all is taken.

        In the first tick after a change of gains the command's deviation from the reference stays what it
        was: what the new gains want differently is the bump, which is faded out.
        """
        p, out = self._active, self._output
        if self.first:
            add(p.out_of_input, p.out_of_d, out)
        else:
            add(p.out_of_input, p.out_of_c, out)
            if not self.last:
                add(out, p.out_of_d, out)
        if self._changed:
            self._next_bump = float(self._deviation[_COMMAND] - out[STATES])
        else:
            self._next_bump = self.bump * self._fade
        if self._next_bump:
            out[STATES] += self._next_bump
        if self.last:
            self._announced, self._tip = self._decided, ArmEnd(*self._grown())
        else:
            self._announced = int(self.row.d[-1])
        return add(out, self._then_output, out)

    def accept(self, output: Numbers, row: TickRow | None = None) -> None:
        """Make an output (5,) the state: estimate and command of the tick that begins, in another row."""
        if row is None:
            row, self._spare = self._spare, self.row
        row.state[:] = output
        self.row = row
        self.tick += 1
        self.bump = self._next_bump
        self._now = self._then
        then = self._reference.at(self.tick + 1)
        if then is not self._then:
            self._expect(then)
        if self._aimed is not self._now:
            self._aim()
        self._changed = self._announced != self._setpoint
        if self._changed:
            self.select(self._announced)
        if self.last:
            self._decided = self._sectors.choose(self._decided, self._tip)
        self._label_row()

    def skip_to(self, tick: int) -> None:
        """Ticks have passed without a sweep: the estimate keeps its deviation from the reference, the command
        is the one that is held."""
        before = self._now
        self.tick = tick
        self._now = self._reference.at(tick)
        self._expect(self._reference.at(tick + 1))
        if self._now is not before:
            self.estimate[:] += self._now[:STATES] - before[:STATES]
        if self._aimed is not self._now:
            self._aim()

    # -- parts ------------------------------------------------------------------------------------

    def _label_row(self) -> None:
        self.row.schedule[0], self.row.schedule[1] = self._setpoint, self.bump

    def _expect(self, then: Array) -> None:
        """The reference of the next tick."""
        self._then, self._then_output = then, then[:OUTPUTS]

    def _aim(self) -> None:
        """The reference of this tick as an offset of the input: its measurement is part of its state."""
        self._offset[:2] = self._now[MEASURED]
        self._offset[2:] = self._now[:OUTPUTS]
        self._aimed = self._now
        _, _, self._strain, self._curvature, _, self._chord_x, self._chord_y = self._now.tolist()

    def _grown(self) -> tuple[float, float, float]:
        """Where the estimated arm ends at this segment's outer face, as `ArmEnd`."""
        row = self.row
        so_far = CLAMP if self.first else row.c_extra.tolist()
        _, _, strain, curvature, _ = row.state.tolist()
        turn = (curvature - self._curvature) * self._bend
        stretch = (1.0 + strain) / (1.0 + self._strain)
        return grow(so_far, turn, stretch, self._chord_x, self._chord_y)

    def _wrong_length(self, direction: str, count: int, expected: int) -> OctarmError:
        return OctarmError(
            f"node {self.index}: {direction} sum of {count} numbers, expected {expected}; all "
            "nodes must run one deployment"
        )
