"""The mathematics of one node in the two sweeps: pure, preallocated, the same in run and replay.

Per tick the process around it hands on what comes, in any order of the three, and takes the next estimate and
command (theory, section 5):
    sweep.input(measurement)         estimate, command and measurement
    c_next = sweep.forward(c)        to the tip's side, once c is there (empty at the root)
    d_previous = sweep.backward(d)   to the root's side, once d is there (empty at the tip)
    sweep.accept(sweep.output())     the state of the next tick

Each of the three results is one product of a matrix with numbers that stand side by side in the tick's row
(`node.row`), so it is the same bit for bit whatever comes first. Matrices act on the deviation from the
reference, out = M (in - in_ref(k)) + out_ref(k+1), and the deviation is what a row holds: the reference of what
comes out is that of what goes in a tick later. Which setpoint's matrices they are is decided by the tip node
(`node.scheduling`). For that the sums are longer than the products: c ends with turn and end of the arm so
far, d with the setpoint of the next tick.

`node.block` takes the same steps on the bytes of messages: `measured`, `take_forward`, `forward_sum`,
`take_backward`, `backward_sum`, `finish`, `advance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct

import numpy as np
import numpy.typing as npt

from node.row import KNOWN, Y_PAIR, TickRow, matrix
from node.scheduling import Sectors
from wire.errors import OctarmError, UsageError
from wire.factors import (
    BACKWARD_EXTRA,
    FORWARD_EXTRA,
    OUTPUTS,
    STATES,
    NodeFactors,
    SweepFactors,
)
from wire.joints import CLAMP, ArmEnd, grow
from wire.messages import F8
from wire.reference import TERMS, Leg, Reference

Array = npt.NDArray[np.float64]
Numbers = Array | Sequence[float]
Payload = bytes | memoryview
"""Doubles as a message carries them, little-endian."""

CHORD = 2
"""Numbers of a reference behind state and command: x and y from the inner to the outer face, m."""
MEASURED = [1, 3]
"""Which of the state's components are measured: v_y and k."""
_END = Struct("<3d")
_ONE = Struct("<d")


class _Products:
    """The factors of one setpoint as three matrices that multiply parts of a row, bound once."""

    def __init__(self, factors: SweepFactors, *, first: bool, last: bool) -> None:
        W, P = (None, None) if first else (factors.W, factors.P)
        V, U = (None, None) if last else (factors.V, factors.U)
        self.forward = matrix(W, factors.Q, None).dot
        self.backward = matrix(None, factors.R, V).dot
        self.output = matrix(P, factors.D, U).dot


def resting_at(factors: SweepFactors) -> Reference:
    """The reference of a run that rests at a setpoint: the setpoint as its commands hold it."""
    coefficients = np.zeros((TERMS, OUTPUTS + CHORD, 1))
    coefficients[0, :OUTPUTS, 0] = factors.out_offset
    return Reference(1.0, [Leg(0.0, 0.0, coefficients)])


class NodeSweep:
    """One node's sweep and its state: `estimate` (4,) (v_x, v_y, e, k) and `command`, absolute, SI.

    `reference` gives what is wanted at each tick, (7,): state, command and chord; None rests at the setpoint.
    `sectors` is what the tip node decides by; None keeps the setpoint. `fade` is the factor a tick of
    the command's bump, see `finish`.

    Ticks happen in a `row` (`node.row`). Arrays returned by the methods are buffers that the next call of the
    same method overwrites; sums may be arrays or lists. OctarmError if a sum has not as many numbers as the
    factors ask for.
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
        sums = factors.setpoints[0]
        self.forward_sent = 0 if self.last else sums.forward_sent + FORWARD_EXTRA
        """How many numbers the sum to the tip's side has."""
        self.backward_sent = 0 if self.first else sums.backward_sent + BACKWARD_EXTRA
        """How many numbers the sum to the root's side has."""
        self.next_command = 0.0
        """The command of the tick after this one, N/m, absolute; known after `finish`."""
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
        self.fade = fade
        """Factor a tick of the bump, and of a sum that does not come."""
        self.partial = False
        """Whether the forward sum of this tick is not of the whole arm: then the tip node decides nothing."""
        self._next_bump = 0.0
        self._so_far_at = 8 * (self.forward_received - FORWARD_EXTRA)
        self._announced_at = 8 * (self.backward_received - BACKWARD_EXTRA)
        self.send_from(np.zeros(self.forward_sent), np.zeros(self.backward_sent))
        instants = 2 + (not self.first) + (not self.last)
        self.row = TickRow(self.forward_received, self.backward_received, instants)
        """Where the ticks happen."""
        self._stays(setpoint)
        self._next = np.zeros(OUTPUTS)
        self._next_bytes = bytes_of(self._next)
        self._absolute = np.zeros(0)
        self._reference = reference or resting_at(factors.setpoints[setpoint])
        self.reference, self._then = self._reference.at(0), self._reference.at(1)
        """Of this tick, (7,)."""
        if self.reference.shape != (OUTPUTS + CHORD,):
            raise UsageError(
                f"node {self.index}: expected a reference of {OUTPUTS + CHORD} numbers, got "
                f"{self.reference.size}; deploy the gains again"
            )
        self._aim()
        self._measured_nothing()
        start = [*factors.initial_estimate[setpoint], factors.initial_command[setpoint]]
        self.row.state[:] = np.array(start) - self.reference[:OUTPUTS]
        self._own()

    @property
    def state(self) -> Array:
        """xh_i and u_i of the current tick, (5,), absolute."""
        return np.asarray(self.row.state + self.reference[:OUTPUTS])

    @property
    def estimate(self) -> Array:
        """xh_i of the current tick, (4,), absolute."""
        return self.state[:STATES]

    @property
    def command(self) -> float:
        """u_i of the current tick, N/m, absolute."""
        return float(self.state[STATES])

    @property
    def setpoint(self) -> int:
        """Index of the setpoint whose factors are in use."""
        return self._setpoint

    @property
    def next_setpoint(self) -> int:
        """Index of the setpoint whose factors are in use in the next tick; known after `finish`."""
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
        self.forward_out, self.backward_out = forward, backward
        self._c_sum = forward[: max(0, forward.size - FORWARD_EXTRA)]
        self._d_sum = backward[: max(0, backward.size - BACKWARD_EXTRA)]
        self._forward_bytes, self._backward_bytes = bytes_of(forward), bytes_of(backward)
        self._end_at = 8 * (forward.size - FORWARD_EXTRA)

    # -- a tick, on the bytes of messages ---------------------------------------------------------

    # These run in every tick of every node, mostly with cold caches: few calls, few objects, no spare names.

    def measured(self, velocity: float, curvature: float) -> None:
        """The measurement, m/s and 1/m."""
        row = self.row
        wanted_velocity, wanted_curvature = self._wanted
        Y_PAIR.pack_into(
            row.buffer, row.y_at, velocity - wanted_velocity, curvature - wanted_curvature
        )
        KNOWN.pack_into(row.buffer, row.known_at, velocity, curvature, self._setpoint, self.bump)

    def take_forward(self, c: Payload) -> None:
        """The sum from the root's side: as many numbers as `forward_received`."""
        self.row.c[:] = c

    def take_backward(self, d: Payload) -> None:
        """The sum from the tip's side: as many numbers as `backward_received`."""
        self.row.d[:] = d

    def forward_sum(self) -> memoryview:
        """W c + Q (in - in_ref) and the arm with this segment; also in `forward_out`."""
        out = self._forward_bytes
        self._active.forward(self.row.of_forward, self._c_sum)
        _END.pack_into(out, self._end_at, *self._end())
        return out

    def backward_sum(self) -> memoryview:
        """V d + R (in - in_ref) and the next setpoint; also in `backward_out`."""
        row, out = self.row, self._backward_bytes
        self._active.backward(row.of_backward, self._d_sum)
        if self.last:
            _ONE.pack_into(out, len(out) - 8, self._decided)
        else:
            out[-8:] = row.d[-8:]
        return out

    def finish(self) -> list[float]:
        """D (in - in_ref) + P c + U d: the deviation of the next state from its reference, (5,).

        In the first tick after a change of gains the command's deviation stays what it was: what the new gains
        want differently is the bump, which is faded out.
        """
        row, state = self.row, self._next
        self._active.output(row.of_output, state)
        out: list[float] = state.tolist()
        if self._changed:
            self._next_bump = float(row.state[STATES]) - out[STATES]
        else:
            self._next_bump = self.bump * self.fade
        if self._next_bump:
            out[STATES] += self._next_bump
            state[STATES] = out[STATES]
        if self.last:
            self._announced, self._tip = self._decided, ArmEnd(*self._end())
        else:
            self._announced = int(_ONE.unpack_from(row.d, self._announced_at)[0])
        self.next_command = out[STATES] + self._then_command
        self._next_state = out
        return out

    def advance(self) -> None:
        """The tick that `finish` prepared begins."""
        self.row.state_bytes[:] = self._next_bytes
        self.tick = tick = self.tick + 1
        self.bump = self._next_bump
        then = self._reference.at(tick + 1)
        if then is not self._then or then is not self.reference:  # the reference moves
            self.reference, self._then = self._then, then
            self._aim()
        _, _, strain, curvature, _ = self._next_state
        self._turn = curvature * self._bend
        self._stretch = (self._strain + strain) / self._strain
        self._changed = self._announced != self._setpoint
        if self._changed:
            self.select(self._announced)
        if self.last and not self.partial:
            self._decided = self._sectors.choose(self._decided, self._tip)

    # -- what did not come ------------------------------------------------------------------------

    def measure_again(self) -> None:
        """The measurement did not come: the last one stands for it."""
        row = self.row
        velocity, curvature, *_ = KNOWN.unpack_from(row.buffer, row.known_at)
        self.measured(velocity, curvature)

    def fade_forward(self, factor: float) -> None:
        """The sum from the root's side did not come: the last one, times a factor, stands for it.

        With zero the arm on that side is taken to be where the reference has it. What the scheduling added to
        the sum stays.
        """
        self.row.of_forward[: max(0, self.forward_received - FORWARD_EXTRA)] *= factor

    def fade_backward(self, factor: float) -> None:
        """The same of the sum from the tip's side."""
        row = self.row
        row.of_output[row.of_output.size - self.backward_received :][:-BACKWARD_EXTRA] *= factor

    def announce(self, setpoint: int) -> None:
        """Put the next setpoint where the sum from the tip's side has it."""
        _ONE.pack_into(self.row.d, self._announced_at, setpoint)

    def hold(self) -> None:
        """After `finish`: the command of this tick is that of the next as well."""
        held = float(self.row.state[STATES]) + float(self.reference[STATES] - self._then[STATES])
        self._next[STATES] = self._next_state[STATES] = held
        self._next_bump = self.bump
        self.next_command = held + self._then_command

    def guess(self, tick: int, deviation: Array) -> Array:
        """An absolute state (5,) near the reference of a tick plus a deviation (5,), from which `join` finds
        again exactly the deviation that it is recorded with."""
        wanted = self._reference.at(tick)[:OUTPUTS]
        state: Array = wanted + deviation
        for _ in range(4):
            again = (state - wanted) + wanted
            if np.array_equal(again, state):
                return state
            state = again
        return np.asarray(wanted.copy())

    def join(self, tick: int, setpoint: int, state: Array) -> None:
        """Begin anew at a tick, with this absolute state (5,) and the gains of this setpoint."""
        self.tick, self.bump = tick, 0.0
        self.select(setpoint)
        self._decided = self._announced = setpoint
        self._stays(setpoint)
        self._changed = False
        self.reference, self._then = self._reference.at(tick), self._reference.at(tick + 1)
        self._aim()
        self.row.state[:] = state - self.reference[:OUTPUTS]
        self._measured_nothing()
        self._own()

    def skip_to(self, tick: int) -> None:
        """Ticks have passed without a sweep: the estimate keeps its deviation from the reference, the command
        is the one that is held."""
        held = float(self.reference[STATES])
        self.tick = tick
        self.reference, self._then = self._reference.at(tick), self._reference.at(tick + 1)
        self._aim()
        self.row.state[STATES] += held - self.reference[STATES]
        self._own()

    # -- the same on numbers ----------------------------------------------------------------------

    def input(self, measurement: Numbers) -> Array:
        """Take the measurement (v_y, k). Returns the whole input of the factors, absolute, (7,)."""
        velocity, curvature = map(float, measurement)
        self.measured(velocity, curvature)
        return np.array([*self.state, velocity, curvature])

    def forward(self, c: Numbers) -> Array:
        """Take c; the sum for the tip's side, after `input`; empty at the tip node."""
        if len(c) != self.forward_received:
            raise self._wrong_length("forward", len(c), self.forward_received)
        self.take_forward(payload(c))
        if not self.last:
            self.forward_sum()
        return self.forward_out

    def backward(self, d: Numbers) -> Array:
        """Take d; the sum for the root's side, after `input`; empty at the root node."""
        if len(d) != self.backward_received:
            raise self._wrong_length("backward", len(d), self.backward_received)
        self.take_backward(payload(d))
        if not self.first:
            self.backward_sum()
        return self.backward_out

    def output(self) -> Array:
        """Estimate and command of the next tick (5,), absolute, once all is taken."""
        self.finish()
        self._absolute = np.asarray(self._next + self._then[:OUTPUTS])
        return self._absolute.copy()

    def accept(self, output: Numbers) -> None:
        """Make an output (5,) the state: estimate and command of the tick that begins."""
        if not np.array_equal(
            output, self._absolute
        ):  # else its deviation is known without rounding
            self._next[:] = np.asarray(output) - self._then[:OUTPUTS]
            self._next_state = self._next.tolist()
        self.advance()

    # -- parts ------------------------------------------------------------------------------------

    def _stays(self, setpoint: int) -> None:
        """Until the first sum from the tip's side comes, the next setpoint is the one in use."""
        if not self.last:
            self.announce(setpoint)

    def _measured_nothing(self) -> None:
        """Until the first measurement comes, the last one is what the reference says."""
        row = self.row
        KNOWN.pack_into(row.buffer, row.known_at, *self._wanted, self._setpoint, self.bump)
        if not self.last:  # and the setpoint is not about to change
            self.announce(self._setpoint)

    def _aim(self) -> None:
        """The references of this tick and the next, in pieces."""
        now = self.reference
        velocity, curvature = now[MEASURED].tolist()
        self._wanted = velocity, curvature
        self._then_command = float(self._then[STATES])
        self._strain = 1.0 + float(now[2])
        self._chord_x, self._chord_y = now[OUTPUTS:].tolist()

    def _own(self) -> None:
        """What this segment adds to the arm so far, from its state's deviation from the reference."""
        _, _, strain, curvature, _ = self.row.state.tolist()
        self._turn = curvature * self._bend
        self._stretch = (self._strain + strain) / self._strain

    def _end(self) -> tuple[float, float, float]:
        """Where the estimated arm ends at this segment's outer face, as `ArmEnd`."""
        so_far = CLAMP if self.first else _END.unpack_from(self.row.c, self._so_far_at)
        return grow(so_far, self._turn, self._stretch, self._chord_x, self._chord_y)

    def _wrong_length(self, direction: str, count: int, expected: int) -> OctarmError:
        return OctarmError(
            f"node {self.index}: {direction} sum of {count} numbers, expected {expected}; all "
            "nodes must run one deployment"
        )


def payload(values: Numbers) -> bytes:
    """Numbers as a message carries them."""
    return np.asarray(values, dtype=F8).tobytes()


def bytes_of(values: Array) -> memoryview:
    """The bytes of an array, to be read and written in place."""
    return memoryview(values.data).cast("B") if values.size else memoryview(bytearray())
