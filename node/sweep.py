"""The mathematics of one node in the two sweeps: pure, preallocated, the same in run and replay.

Per tick the process around it builds the input from the estimate, the command and the measurement,
answers the sums that come from its two neighbours and computes the next estimate and command
(theory, section 5):
    x = sweep.input(measurement)
    c_next = sweep.forward(x, c)         to the tip's side, once c is there (empty at the root)
    d_previous = sweep.backward(x, d)    to the root's side, once d is there (empty at the tip)
    sweep.accept(sweep.output(x, c, d))  the state of the next tick

Matrices act on the deviation from the reference, out = M (in - in_ref(k)) + out_ref(k+1); which setpoint's
they are is decided by the tip node (`node.scheduling`). For that the sums are longer than the products: c ends
with turn and end of the arm so far, d with the setpoint of the next tick.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from node.scheduling import CLAMP, ArmEnd, Sectors
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


class _Products:
    """The factors of one setpoint as three contiguous matrices over one buffer [c, in, d]."""

    def __init__(self, factors: SweepFactors) -> None:
        rank_c, rank_d = factors.forward_received, factors.backward_received
        self.whole = np.zeros(rank_c + INPUTS + rank_d)
        self.c = self.whole[:rank_c]
        self.x = self.whole[rank_c : rank_c + INPUTS]
        self.d = self.whole[rank_c + INPUTS :]
        self.c_in = self.whole[: rank_c + INPUTS]
        self.in_d = self.whole[rank_c:]
        self.forward = np.ascontiguousarray(np.hstack([factors.W, factors.Q]))
        self.backward = np.ascontiguousarray(np.hstack([factors.R, factors.V]))
        self.output = np.ascontiguousarray(np.hstack([factors.P, factors.D, factors.U]))


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

    Arrays returned by the methods are buffers that the next call of the same method overwrites;
    sums may be arrays or lists. OctarmError if a sum has not as many numbers as the factors ask for.
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
        self._first = factors.index == 0
        self._last = factors.index == factors.nodes - 1
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
        self._now, self._then = self._reference.at(0), self._reference.at(1)
        if self._now.shape != (OUTPUTS + CHORD,):
            raise UsageError(
                f"node {self.index}: expected a reference of {OUTPUTS + CHORD} numbers, got "
                f"{self._now.size}; deploy the gains again"
            )
        self._offset = np.zeros(INPUTS)
        self._aimed = self._now
        self._aim()
        self._input = np.zeros(INPUTS)
        self._output = np.zeros(OUTPUTS)
        sums = factors.setpoints[0]
        self._c_next = np.zeros(0 if self._last else sums.forward_sent + FORWARD_EXTRA)
        self._c_sum = self._c_next[: sums.forward_sent]
        self._d_previous = np.zeros(0 if self._first else sums.backward_sent + BACKWARD_EXTRA)
        self._d_sum = self._d_previous[: sums.backward_sent]
        self._state = np.zeros(OUTPUTS)
        self.estimate = self._state[:STATES]
        self._state[:STATES] = factors.initial_estimate[setpoint]
        self._state[STATES] = factors.initial_command[setpoint]

    @property
    def command(self) -> float:
        """u_i of the current tick, N/m."""
        return float(self._state[STATES])

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

    def input(self, measurement: Numbers) -> Array:
        """The input (7,) of this tick: estimate, command and the measurement (v_y, k)."""
        self._input[:OUTPUTS] = self._state
        self._input[OUTPUTS:] = measurement
        return self._input

    def forward(self, x: Array, c: Numbers) -> Array:
        """W c + Q (x - in_ref) and the arm with this segment, for the tip's side; empty at the tip node."""
        if self._last:
            return self._c_next
        p = self._active
        np.subtract(x, self._offset, out=p.x)
        self._receive(p.c, c, self.forward_received, "forward")
        np.dot(p.forward, p.c_in, out=self._c_sum)
        self._c_next[-FORWARD_EXTRA:] = self._grown(x, c)
        return self._c_next

    def backward(self, x: Array, d: Numbers) -> Array:
        """V d + R (x - in_ref) and the next setpoint, for the root's side; empty at the root node."""
        if self._first:
            return self._d_previous
        p = self._active
        np.subtract(x, self._offset, out=p.x)
        self._receive(p.d, d, self.backward_received, "backward")
        np.dot(p.backward, p.in_d, out=self._d_sum)
        self._d_previous[-1] = self._decided if self._last else d[-1]
        return self._d_previous

    def output(self, x: Array, c: Numbers, d: Numbers) -> Array:
        """D (x - in_ref) + P c + U d + out_ref: estimate, command (5,) of the next tick.

        In the first tick after a change of gains the command's deviation from the reference stays what it
        was: what the new gains want differently is the bump, which is faded out.
        """
        p = self._active
        np.subtract(x, self._offset, out=p.x)
        self._receive(p.c, c, self.forward_received, "forward")
        self._receive(p.d, d, self.backward_received, "backward")
        np.dot(p.output, p.whole, out=self._output)
        if self._changed:
            self._next_bump = float(p.x[STATES] - self._output[STATES])
        else:
            self._next_bump = self.bump * self._fade
        self._output[STATES] += self._next_bump
        self._announced = self._decided if self._last else int(d[-1])
        if self._last:
            self._tip = self._grown(x, c)
        return np.add(self._output, self._then[:OUTPUTS], out=self._output)

    def accept(self, output: Numbers) -> None:
        """Make an output (5,) the state: estimate and command of the tick that begins."""
        self._state[:] = output
        self.tick += 1
        self.bump = self._next_bump
        self._now, self._then = self._then, self._reference.at(self.tick + 1)
        if self._aimed is not self._now:
            self._aim()
        self._changed = self._announced != self._setpoint
        if self._changed:
            self.select(self._announced)
        if self._last:
            self._decided = self._sectors.choose(self._decided, self._tip)

    def _aim(self) -> None:
        """The reference of this tick as an offset of the input: its measurement is part of its state."""
        self._offset[:OUTPUTS] = self._now[:OUTPUTS]
        self._offset[OUTPUTS:] = self._now[MEASURED]
        self._aimed = self._now
        _, _, self._strain, self._curvature, _, self._chord_x, self._chord_y = self._now.tolist()

    def _grown(self, x: Array, c: Numbers) -> ArmEnd:
        """The estimated arm up to this segment's outer face."""
        so_far = CLAMP if self._first else ArmEnd(*map(float, c[-FORWARD_EXTRA:]))
        turn = (float(x[3]) - self._curvature) * self._bend
        stretch = (1.0 + float(x[2])) / (1.0 + self._strain)
        return so_far.grown(turn, stretch, self._chord_x, self._chord_y)

    def _receive(self, buffer: Array, values: Numbers, expected: int, direction: str) -> None:
        if len(values) != expected:
            raise OctarmError(
                f"node {self.index}: {direction} sum of {len(values)} numbers, expected {expected}; all "
                "nodes must run one deployment"
            )
        buffer[:] = values[: len(buffer)]
