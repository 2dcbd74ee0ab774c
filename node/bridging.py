"""What stands for a sum that does not come, and whose sums a node does not wait for.

For `node.block`, which says when. The last sum, faded, stands for the one that is missing, so that after some
ticks the arm on that side is taken to be where the reference has it.
"""

from __future__ import annotations

from node.sweep import NodeSweep
from wire.channels import Degraded

FORWARD_BRIDGED, BACKWARD_BRIDGED = int(Degraded.FORWARD_BRIDGED), int(Degraded.BACKWARD_BRIDGED)
BRIDGED = FORWARD_BRIDGED | BACKWARD_BRIDGED


class Bridging:
    """The two sides of a block: sums to its first segment, `forward`, and to its last, `backward`."""

    __slots__ = (
        "_root",
        "_tip",
        "cut_backward",
        "cut_forward",
        "setpoint",
        "since_ns",
        "sums",
    )

    def __init__(self, root: NodeSweep, tip: NodeSweep) -> None:
        self._root, self._tip = root, tip
        self.cut_forward = self.cut_backward = False
        """That neighbour is not waited for."""
        self.setpoint = root.setpoint
        """Whose gains the last sums were made with."""
        self.sums = 0
        """How many did not come in time."""
        self.since_ns = 0
        """Since when every tick has had a sum bridged; 0 if the last one had none."""

    def forward(self, setpoint: int) -> int:
        """Bridge the sum from the root's side, in a tick with this setpoint; returns the tick's flag for it."""
        self._root.fade_forward(self._fading(setpoint))
        self.sums += 1
        return FORWARD_BRIDGED

    def backward(self, setpoint: int) -> int:
        """The same of the sum from the tip's side."""
        self._tip.fade_backward(self._fading(setpoint))
        self.sums += 1
        return BACKWARD_BRIDGED

    def whose(self) -> list[str]:
        """Whose sums are not waited for, in words."""
        out = []
        if self.cut_forward:
            out.append(f"forward sum from node {self._root.index - 1}")
        if self.cut_backward:
            out.append(f"backward sum from node {self._tip.index + 1}")
        return out or ["sum of a neighbour in every tick"]

    def _fading(self, setpoint: int) -> float:
        """By what the last sum is multiplied; the numbers of another setpoint's gains mean something else."""
        return self._root.fade if self.setpoint == setpoint else 0.0
