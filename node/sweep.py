"""The mathematics of one node in the two sweeps: pure, preallocated, the same in run and replay.

Per tick the process around it builds the input from the estimate, the command and the measurement,
answers the sums that come from its two neighbours and computes the next estimate and command
(theory, section 5):
    x = sweep.input(measurement)
    c_next = sweep.forward(x, c)         to the tip's side, once c is there (empty at the root)
    d_previous = sweep.backward(x, d)    to the root's side, once d is there (empty at the tip)
    sweep.accept(sweep.output(x, c, d))  the state of the next tick
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from wire.errors import OctarmError, UsageError
from wire.factors import INPUTS, OUTPUTS, STATES, NodeFactors, SweepFactors

Array = npt.NDArray[np.float64]
Numbers = Array | Sequence[float]


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
        self.c_next = np.zeros(factors.forward_sent)
        self.d_previous = np.zeros(factors.backward_sent)
        self.offset_in = factors.in_offset.copy()
        self.offset_out = factors.out_offset.copy()


class NodeSweep:
    """One node's sweep and its state: `estimate` (4,) (v_x, v_y, e, k) and `command`, absolute, SI.

    Arrays returned by the methods are buffers that the next call of the same method overwrites;
    sums may be arrays or lists. OctarmError if a sum has not as many numbers as the setpoint's
    factors ask for.
    """

    def __init__(self, factors: NodeFactors, setpoint: int = 0) -> None:
        self.index = factors.index
        self._products = [_Products(one) for one in factors.setpoints]
        self._input = np.zeros(INPUTS)
        self._output = np.zeros(OUTPUTS)
        self._state = np.zeros(OUTPUTS)
        self.estimate = self._state[:STATES]
        self.select(setpoint)
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
    def forward_received(self) -> int:
        """How many numbers c has at the setpoint in use."""
        return len(self._active.c)

    @property
    def backward_received(self) -> int:
        """How many numbers d has at the setpoint in use."""
        return len(self._active.d)

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
        """W c + Q (x - in_offset), for the neighbour on the tip's side; empty at the tip node."""
        p = self._active
        np.subtract(x, p.offset_in, out=p.x)
        self._receive(p.c, c, "forward")
        return np.dot(p.forward, p.c_in, out=p.c_next)

    def backward(self, x: Array, d: Numbers) -> Array:
        """V d + R (x - in_offset), for the neighbour on the root's side; empty at the root node."""
        p = self._active
        np.subtract(x, p.offset_in, out=p.x)
        self._receive(p.d, d, "backward")
        return np.dot(p.backward, p.in_d, out=p.d_previous)

    def output(self, x: Array, c: Numbers, d: Numbers) -> Array:
        """D (x - in_offset) + P c + U d + out_offset: estimate, command (5,) of the next tick."""
        p = self._active
        np.subtract(x, p.offset_in, out=p.x)
        self._receive(p.c, c, "forward")
        self._receive(p.d, d, "backward")
        np.dot(p.output, p.whole, out=self._output)
        return np.add(self._output, p.offset_out, out=self._output)

    def accept(self, output: Numbers) -> None:
        """Make an output (5,) the state: estimate and command of the tick that begins."""
        self._state[:] = output

    def _receive(self, buffer: Array, values: Numbers, direction: str) -> None:
        if len(values) != len(buffer):
            raise OctarmError(
                f"node {self.index}: {direction} sum of {len(values)} numbers, setpoint "
                f"{self._setpoint} needs {len(buffer)}; all nodes must run one deployment"
            )
        buffer[:] = values
