"""What a node does when a neighbour dies, and for the one that replaces it.

Between `node.process`, which has the session and the lock, and `node.block`. A neighbour that dies is known by
its liveliness token, milliseconds later: its sums are not waited for. One that replaces it subscribes to
states, which is how it asks for them.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from time import monotonic_ns
from typing import Any

from node.block import SegmentBlock
from node.joining import Joining
from node.sweep import NodeSweep
from wire import session as zsession
from wire.keys import Keys
from wire.messages import Incoming, Kind, Numbers, Outgoing, RejectedError
from wire.run_config import NodeConfig

STATE = 5
"""Numbers of a state: deviation of estimate and command."""


class Neighbours:
    """The two sides of one node, "left" towards the root and "right" towards the tip."""

    def __init__(
        self,
        config: NodeConfig,
        keys: Keys,
        sweeps: list[NodeSweep],
        block: SegmentBlock,
        lock: Lock,
    ) -> None:
        first, last = sweeps[0], sweeps[-1]
        self._config, self._keys, self._block, self._lock = config, keys, block, lock
        self._process: dict[str, int] = {}
        """The neighbours' processes, by their first segments."""
        self._own: dict[str, int] = {}
        """What this process is to them: the segment next to them."""
        self._segment: dict[str, int] = {}
        """Theirs, next to this process."""
        if not first.first and config.left >= 0:
            self._process["left"] = config.left
            self._own["left"], self._segment["left"] = first.index, first.index - 1
        if not last.last:
            self._process["right"] = self._segment["right"] = last.index + 1
            self._own["right"] = last.index
        self._outgoing = {
            side: Outgoing(Kind.STATE, keys.run, own, STATE) for side, own in self._own.items()
        }
        self._publishers: dict[str, Any] = {}
        self.asking: tuple[str, ...] = ()
        """Sides on which somebody wants to know the state."""
        self.joining = Joining(sweeps, block) if config.joins else None
        """None once this node is part of the chain."""
        self._states: list[Any] = []

    def declare(
        self,
        session: Any,
        running: Callable[[], bool],
        refused: Callable[[RejectedError], None],
        setpoints: int,
    ) -> list[Any]:
        """Watch the neighbours; returns what must be kept alive.

        `running`: whether it still matters that a neighbour is gone.
        """
        if not self._config.skip_ticks:  # in lock-step a tick waits, whatever happens
            return []
        keep: list[Any] = []
        for side, process in self._process.items():
            key = self._keys.ready(process)
            keep.append(zsession.watch_token(session, key, self._goer(side, running)))
            own = self._own[side]
            publisher = zsession.control_publisher(session, self._keys.state(process, own))
            self._publishers[side] = publisher
            keep.append(
                publisher.declare_matching_listener(zsession.observe(lambda _: self._look()))
            )
            if self.joining is not None:
                key = self._keys.state(self._config.index, self._segment[side])
                incoming = Incoming(
                    Kind.STATE, self._keys.run, self._segment[side], [STATE] * setpoints
                )
                handler = zsession.direct(self._listener(side, incoming, refused))
                self._states.append(session.declare_subscriber(key, handler))
        self._look()
        return keep

    def joined(self) -> None:
        """This node is part of the chain: it needs no states any more."""
        for subscriber in self._states:
            subscriber.undeclare()
        self._states.clear()

    def close(self) -> None:
        """Let go of everything that belongs to the session."""
        self._publishers.clear()
        self._states.clear()

    def tell(self, tick: int, setpoint: int) -> None:
        """Send the state of the tick that begins to whoever asks for it."""
        for side, deviation in zip(("left", "right"), self._block.deviations(), strict=True):
            if side in self.asking:
                outgoing = self._outgoing[side]
                outgoing.values[:] = deviation
                self._publishers[side].put(outgoing.stamped(tick, setpoint))

    # -- Zenoh's thread ---------------------------------------------------------------------------

    def _look(self) -> None:
        # Meanwhile the main thread may add the other side's publisher, or at the end let go of both.
        publishers = list(self._publishers.items())
        self.asking = tuple(side for side, one in publishers if zsession.matched(one))

    def _goer(self, side: str, running: Callable[[], bool]) -> Callable[[bool], None]:
        cut = self._block.cut_forward if side == "left" else self._block.cut_backward

        def notice(present: bool) -> None:
            with self._lock:
                if not present and running():
                    cut(monotonic_ns())

        return notice

    def _listener(
        self, side: str, incoming: Incoming, refused: Callable[[RejectedError], None]
    ) -> Callable[[bytes], None]:
        def listen(raw: bytes) -> None:
            try:
                state: Numbers = incoming.decode(raw)
            except RejectedError as error:
                refused(error)
                return
            with self._lock:
                if self.joining is not None:
                    self.joining.heard(side, state)

        return listen
