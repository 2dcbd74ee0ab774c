"""The driver's end of a group over Zenoh: the plant's session, publishers and callbacks, without a plant.

Between the loops of `bench.pacing` and the workers. Like the plant, it is the router of its group, and
takes commands on Zenoh's thread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import monotonic_ns, sleep
from typing import Any

from bench.configs import LEASE_MS, DriverConfig
from bench.worker import Tally, is_counters
from wire import session as zsession
from wire.child import Child, Deadline
from wire.keys import Keys
from wire.messages import run_tag

END_QUEUE = 1 << 16
"""Batches of an end node that may wait for `drain`: those of a burst."""
OTHER_QUEUE = 4
"""Of every other node only its last words are wanted; older batches are dropped inside Zenoh."""
COLLECT_S = 0.005


class ZenohLinks:
    """Session and links of the driver; `send` and `wait` are a tick."""

    def __init__(self, config: DriverConfig, child: Child) -> None:
        self._config = config
        self._child = child
        self._keys = Keys(run_tag(config.run_id))
        self.command = Tally()
        self._count = len(config.ports)
        # A real node gives counters of each of its segments.
        several = config.pattern == "neighbour"
        self._segments = {port.index: port.commanded for port in config.ports if several}
        self._ends = () if config.ends is None else (0, config.ends.last)
        self._left = 0
        self._complete_ns = 0
        self._have = [0] * self._count
        self._present: set[int] = set()
        self._publishers: list[Any] = []
        self._keep: list[Any] = []
        self._records: dict[int, Any] = {}
        links = config.links
        self._session = zsession.open_session(
            "router", links.listen, links.connect, lease_ms=LEASE_MS
        )
        self._declare()

    def _declare(self) -> None:
        keys, session, config = self._keys, self._session, self._config
        for position, port in enumerate(config.ports):
            handler = zsession.direct(self._receiver(position))
            self._keep.append(session.declare_subscriber(keys.command(port.index), handler))
            self._publishers.append(
                zsession.control_publisher(session, keys.measurement(port.index))
            )
        for member in config.members:
            last_words = OTHER_QUEUE + self._segments.get(member, 1)
            queue = (
                zsession.queue(END_QUEUE) if member in self._ends else zsession.newest(last_words)
            )
            self._records[member] = session.declare_subscriber(keys.telemetry(member), queue)
        self._stop = zsession.control_publisher(session, keys.stop)
        for publisher in self._publishers:
            wake = zsession.observe(lambda _: self._child.wake())
            self._keep.append(publisher.declare_matching_listener(wake))
        self._keep.append(
            zsession.watch_tokens(session, keys.all_ready, self._present, self._child.wake)
        )

    def link(self) -> bool:
        """Wait until every member's token and every link is there; False if stopped before."""
        members = set(self._config.members)
        while not self._child.stopping:
            if members <= self._present and all(map(zsession.matched, self._publishers)):
                return True
            self._child.wait(1.0)
        return False

    def _receiver(self, position: int) -> Callable[[bytes], None]:
        have, tally = self._have, self.command

        def receive(raw: bytes) -> None:
            have[position] += 1
            tally.messages += 1
            tally.bytes += len(raw)
            self._left -= 1
            if not self._left:
                self._complete_ns = monotonic_ns()
                self._child.wake()

        return receive

    def wrap(self, raw: bytes) -> bytes:
        """A measurement as it is sent."""
        return raw

    def send(self, messages: Sequence[bytes]) -> int:
        """Put every port's measurement; returns the instant before the first, in ns."""
        self._left = self._count
        started_ns = monotonic_ns()
        for publisher, raw in zip(self._publishers, messages, strict=True):
            publisher.put(raw)
        return started_ns

    def wait(self, limit_s: float) -> int:
        """Wait for every command; returns the instant of the last in ns, 0 if that does not happen."""
        limit = Deadline(limit_s)
        while self._left:
            if limit.passed or self._child.stopping:
                return 0
            self._child.wait(limit.left)
        return 0 if self._child.stopping else self._complete_ns

    def missing(self) -> str:
        """Who has not given its command, for a message."""
        most = max(self._have)
        late = [
            p.index for p, got in zip(self._config.ports, self._have, strict=True) if got < most
        ]
        return f"nodes {late[:12]}" if late else "every node"

    def drain(self) -> list[bytes]:
        """Records of the end nodes that have come."""
        out: list[bytes] = []
        for end in self._ends:
            while (sample := self._records[end].try_recv()) is not None:
                out.append(bytes(sample.payload))
        return out

    def finish(self, stop: bytes, limit_s: float) -> list[bytes]:
        """Tell everybody to stop; returns what came until all counters are there, or so long."""
        self._stop.put(stop)
        out: list[bytes] = []
        limit = Deadline(limit_s)
        missing = {member: self._segments.get(member, 1) for member in self._config.members}
        while missing and not limit.passed and not self._child.stopping:
            for member in tuple(missing):
                while (sample := self._records[member].try_recv()) is not None:
                    raw = bytes(sample.payload)
                    last = is_counters(raw)
                    if last or member in self._ends:
                        out.append(raw)
                    if last:
                        missing[member] -= 1
                if not missing[member]:
                    del missing[member]
            sleep(COLLECT_S)
        return out

    def close(self) -> None:
        """Undeclare everything and close the session."""
        self._publishers.clear()
        self._keep.clear()
        self._records.clear()
        self._session.close()
