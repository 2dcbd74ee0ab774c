"""Messages that are not the ones that are due: of another tick or setpoint, or to a node that is still joining.

Beside `node.process`, which has the links and knows the messages that are due by their first bytes, and
`node.block`, which is told what such a message shows: that a tick is over, or that a neighbour is there.
"""

from __future__ import annotations

from node.block import SegmentBlock
from node.neighbours import Neighbours
from node.sweep import payload
from wire.child import Child
from wire.messages import Numbers, Reason, RejectedError
from wire.run_config import NodeConfig


class Others:
    """What a node makes of them. Not thread-safe: the process around it holds a lock."""

    def __init__(
        self, config: NodeConfig, block: SegmentBlock, neighbours: Neighbours, child: Child
    ) -> None:
        self._config, self._block, self._neighbours = config, block, neighbours
        self._child = child
        self._early: dict[str, Numbers] = {}
        """Sums that came before this node has joined."""

    def take(self, name: str, message: Numbers, at_ns: int) -> bytes:
        """A message that is not the one that is due: refused by name, unless it shows that this tick is
        over."""
        block, skips = self._block, self._config.skip_ticks
        ahead = message.tick - block.tick
        if not 0 <= ahead <= skips:
            if -skips <= ahead < 0:
                self._heard(name)
            reason = Reason.STALE if ahead < 0 else Reason.EARLY
            raise RejectedError(reason, f"expected tick {block.tick}, got {message.tick}")
        known = skips and message.setpoint in self._config.scheduling.setpoints
        if message.setpoint != block.setpoint and not known:
            raise self._other_setpoint(message)
        if ahead and block.begun:
            block.close(at_ns)
        if message.setpoint != block.setpoint and name != "measurement":
            self._disagreed(name, message, at_ns)
            raise self._other_setpoint(message)
        if message.tick != block.tick:
            block.skip_to(message.tick)
        if message.partial:
            block.partial()
        return payload(message.values)

    def _other_setpoint(self, message: Numbers) -> RejectedError:
        expected = self._block.setpoint
        return RejectedError(Reason.SETPOINT, f"expected {expected}, got {message.setpoint}")

    def _heard(self, name: str) -> None:
        """A sum of an earlier tick: whoever sent it is there."""
        if name == "forward":
            self._block.heard_forward()
        elif name == "backward":
            self._block.heard_backward()

    def _disagreed(self, name: str, message: Numbers, at_ns: int) -> None:
        """A sum made with another setpoint's gains cannot be used: after a gap in the chain, or a tick that was
        given up, neighbours may not have agreed. The root's side follows the tip's.

        (A measurement is the same for all gains.)
        """
        if message.tick != self._block.tick:
            self._block.skip_to(message.tick)
        if name == "forward":
            self._block.cut_forward(at_ns)
        elif name == "backward":
            self._block.cut_backward(at_ns, int(message.values[-1]))

    def begin(self, name: str, message: Numbers, at_ns: int) -> bool:
        """A message to a node that has not joined: whether it is the measurement with which it does."""
        neighbours, block = self._neighbours, self._block
        if name != "measurement":
            self._early[name] = message
            return False
        if neighbours.joining is None or not neighbours.joining.begin(message):
            return False
        neighbours.joining = None
        self._child.status("joined", tick=message.tick)
        block.on_measurement(payload(message.values), at_ns)
        for early, take in (("forward", block.on_forward), ("backward", block.on_backward)):
            sums = self._early.pop(early, None)
            if sums is not None and (sums.tick, sums.setpoint) == (block.tick, block.setpoint):
                if sums.partial:
                    block.partial()
                take(payload(sums.values), at_ns)
        self._child.wake()
        return True
