"""How a node that replaces a dead one becomes part of the chain: pure, without links.

Beside `node.process`, which has the links. While a node is joining, either neighbour sends it in every tick its
own state's deviation from the reference; the new node takes what lies between the two for its segments' and
begins in the first tick of which it has the measurement and both states. Nobody else has to know that tick: the
neighbours expect its sums, and the plant its commands, once the first have come.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from node.block import SegmentBlock
from node.sweep import Array, NodeSweep
from wire.messages import Numbers

PATIENCE = 10
"""So many measurements a node waits for its neighbours' states; then it begins with those that have come."""
NEAR_TICKS = 2
"""A state of so many ticks before or after is good enough: it is a guess in any case."""


class Joining:
    """What a new node has heard so far. Not thread-safe: the process around it holds a lock."""

    def __init__(self, sweeps: Sequence[NodeSweep], block: SegmentBlock) -> None:
        self._sweeps = sweeps
        self._block = block
        self._states: dict[str, Numbers] = {}
        self._needed = {
            side
            for side, there in (("left", not sweeps[0].first), ("right", not sweeps[-1].last))
            if there
        }
        self._measurements = 0

    def heard(self, side: str, state: Numbers) -> None:
        """A neighbour, "left" (towards the root) or "right", has told its state."""
        self._states[side] = state

    def begin(self, measurement: Numbers) -> bool:
        """A measurement has come: begin in its tick if what else is needed is here; whether that is so."""
        self._measurements += 1
        near = {
            side: state
            for side, state in self._states.items()
            if abs(state.tick - measurement.tick) <= NEAR_TICKS
        }
        if near.keys() != self._needed and self._measurements <= PATIENCE:
            return False
        # The setpoint is decided at the tip and announced towards the root.
        said = near.get("right") or near.get("left")
        setpoint = measurement.setpoint if said is None else said.setpoint
        deviations = between(
            None if "left" not in near else np.asarray(near["left"].values),
            None if "right" not in near else np.asarray(near["right"].values),
            len(self._sweeps),
        )
        states = [
            sweep.guess(measurement.tick, deviation)
            for sweep, deviation in zip(self._sweeps, deviations, strict=True)
        ]
        self._block.join(measurement.tick, setpoint, states)
        return True


def between(left: Array | None, right: Array | None, segments: int) -> list[Array]:
    """Deviations (5,) of so many segments between two neighbours': on a straight line, or the one that is
    known, or zero. Commands are zero: the segment has been passive."""
    if left is None or right is None:
        one = right if left is None else left
        found = [np.zeros(5) if one is None else one.copy() for _ in range(segments)]
    else:
        shares = np.arange(1, segments + 1) / (segments + 1)
        found = [left + share * (right - left) for share in shares]
    for deviation in found:
        deviation[4] = 0.0
    return found
