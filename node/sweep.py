"""The mathematics of one node in the two sweeps: pure, preallocated, the same in run and replay.

Per tick the process around it hands on what comes, in any order of the three, and takes the next estimate and
command (theory, section 5):
    sweep.input(measurement)         the products of estimate, command and measurement
    c_next = sweep.forward(c)        to the tip's side, once c is there (empty at the root)
    d_previous = sweep.backward(d)   to the root's side, once d is there (empty at the tip)
    sweep.accept(sweep.output())     the state of the next tick

Each of the three results is one product of a matrix with numbers that stand side by side in the tick's row
(`node.row`), so it is the same bit for bit whatever comes first.
Matrices act on the deviation from the reference, out = M (in - in_ref(k)) + out_ref(k+1); which setpoint's
they are is decided by the tip node (`node.scheduling`). For that the sums are longer than the products: c ends
with turn and end of the arm so far, d with the setpoint of the next tick.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from node.row import TickRow, Y, columns
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

CHORD = 2
"""Numbers of a reference behind state and command: x and y from the inner to the outer face, m."""
MEASURED = [1, 3]
"""Which of the state's components are measured: v_y and k."""
_COMMAND = INPUTS - 1
"""Where a row's deviation has the command."""
add, subtract = np.add, np.subtract


class _Products:
    """The factors of one setpoint as three matrices that multiply parts of a row, bound once."""

    def __init__(self, factors: SweepFactors, *, first: bool, last: bool) -> None:
        W, P = (None, None) if first else (factors.W, factors.P)
        V, U = (None, None) if last else (factors.V, factors.U)
        self.forward = columns(W, factors.Q, None).dot
        self.backward = columns(None, factors.R, V).dot
        self.output = columns(P, factors.D, U).dot


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
        self._products = [
            _Products(one, first=self.first, last=self.last) for one in factors.setpoints
        ]
        self.select(setpoint)
        self._decided = setpoint
        self._announced = setpoint
        self._sectors = sectors or Sectors.only(setpoint)
        self._tip = CLAMP
        self._changed = False
        self._fade = fade
        self._next_bump = 0.0
        self._reference = reference or resting_at(factors.setpoints[setpoint])
        self._now, self._then = self._reference.at(0), self._reference.at(1)
        if self._now.shape != (OUTPUTS + CHORD,):
            raise UsageError(
                f"node {self.index}: expected a reference of {OUTPUTS + CHORD} numbers, got "
                f"{self._now.size}; deploy the gains again"
            )
        self._output = np.zeros(OUTPUTS)
        self._offset = np.zeros(INPUTS)
        self._aim()
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
        """Take the measurement (v_y, k).

        Returns the input as a row has it: measurement, estimate, command (7,).
        """
        row = self.row
        row.y[:] = measurement
        subtract(row.x, self._offset, row.deviation)
        return row.x

    def take_forward(self, c: Numbers) -> None:
        """Take the sum from the root's side."""
        if len(c) != self.forward_received:
            raise self._wrong_length("forward", len(c), self.forward_received)
        self.row.c[:] = c

    def take_backward(self, d: Numbers) -> None:
        """Take the sum from the tip's side."""
        if len(d) != self.backward_received:
            raise self._wrong_length("backward", len(d), self.backward_received)
        self.row.d[:] = d

    def forward_sum(self) -> Array:
        """W c + Q (in - in_ref) and the arm with this segment, after `input` and `take_forward`."""
        row, out = self.row, self._c_next
        self._active.forward(row.of_forward, self._c_sum)
        out[-3], out[-2], out[-1] = self._grown()
        return out

    def backward_sum(self) -> Array:
        """V d + R (in - in_ref) and the next setpoint, after `input` and `take_backward`."""
        row, out = self.row, self._d_previous
        self._active.backward(row.of_backward, self._d_sum)
        out[-1] = self._decided if self.last else row.d[-1]
        return out

    def forward(self, c: Numbers) -> Array:
        """Take c; the sum for the tip's side, after `input`; empty at the tip node."""
        self.take_forward(c)
        return self._c_next if self.last else self.forward_sum()

    def backward(self, d: Numbers) -> Array:
        """Take d; the sum for the root's side, after `input`; empty at the root node."""
        self.take_backward(d)
        return self._d_previous if self.first else self.backward_sum()

    def output(self) -> Array:
        """D (in - in_ref) + P c + U d + out_ref: estimate, command (5,) of the next tick, once all is taken.

        In the first tick after a change of gains the command's deviation from the reference stays what it
        was: what the new gains want differently is the bump, which is faded out.
        """
        out = self._output
        self._active.output(self.row.of_output, out)
        if self._changed:
            self._next_bump = float(self.row.deviation[_COMMAND] - out[STATES])
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
        self.tick = tick = self.tick + 1
        self.bump = self._next_bump
        then = self._reference.at(tick + 1)
        if then is not self._then or then is not self._now:  # the reference moves
            self._now, self._then = self._then, then
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
        self._now, self._then = self._reference.at(tick), self._reference.at(tick + 1)
        if self._now is not before:
            self.estimate[:] += self._now[:STATES] - before[:STATES]
        self._aim()

    # -- parts ------------------------------------------------------------------------------------

    def _label_row(self) -> None:
        schedule = self.row.schedule
        schedule[0], schedule[1] = self._setpoint, self.bump

    def _aim(self) -> None:
        """The reference of this tick as an offset of the input, that of the next as one of the output; the
        measurement's reference is part of the state's."""
        now = self._now
        self._offset[:Y], self._offset[Y:] = now[MEASURED], now[:OUTPUTS]
        self._then_output = self._then[:OUTPUTS]
        _, _, self._strain, self._curvature, _, self._chord_x, self._chord_y = now.tolist()

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
