"""The plant's side of a tick on the wire: measurements out to every node, commands of the next tick back.

Between the plant's process, which says when, and Zenoh. Messages are written into buffers made once; commands
come on Zenoh's threads and are only checked and noted there.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from itertools import pairwise
from threading import Lock
from time import monotonic_ns
from typing import Any

import numpy as np
import numpy.typing as npt

from wire import session as zsession
from wire.channels import MEASUREMENT
from wire.counters import Flow, Rejections
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Incoming,
    Kind,
    Numbers,
    Outgoing,
    Reason,
    RejectedError,
    numbers_of,
)

Array = npt.NDArray[np.float64]
Y = len(MEASUREMENT)


class Exchange:
    """Measurements and commands of one tick at a time, for node processes with these first segments."""

    def __init__(
        self,
        keys: Keys,
        firsts: Sequence[int],
        commands: Sequence[float],
        setpoints: int,
        setpoint: int,
        complete: Callable[[], None],
    ) -> None:
        """`commands` are u(0) of all segments; `complete` is called (on Zenoh's thread) when all have come."""
        self._firsts = tuple(firsts)
        self._slices = [slice(a, b) for a, b in pairwise([*firsts, len(commands)])]
        self._keys = keys
        sizes = [one.stop - one.start for one in self._slices]
        run = keys.run
        self._outgoing = [Outgoing(Kind.MEASUREMENT, run, PLANT, Y * size) for size in sizes]
        self._incoming = [
            Incoming(Kind.COMMAND, run, first, [size] * setpoints)
            for first, size in zip(firsts, sizes, strict=True)
        ]
        self.commands: Array = np.array(commands, dtype=np.float64)
        """The last complete set, N/m, one a segment."""
        self._coming = self.commands.copy()
        self._said = [setpoint] * len(self._firsts)
        self.setpoint = setpoint
        """Whose gains the nodes use, as their last complete set of commands says."""
        self._complete = complete
        self._lock = Lock()
        self.tick = -1
        """The tick whose commands are being collected."""
        self._have = [True] * len(self._firsts)
        self.left = 0
        """Commands that have not come yet."""
        self.complete_ns = 0
        """When the last command came."""
        self.publishers: list[Any] = []
        self._received = [Flow() for _ in self._firsts]
        self._sent = Flow()
        self._rejections = Rejections()

    def declare(self, session: Any) -> list[Any]:
        """Publishers and subscribers on the session; returns what must be kept alive."""
        keep = []
        for place, first in enumerate(self._firsts):
            handler = zsession.direct(self._receiver(place))
            keep.append(session.declare_subscriber(self._keys.command(first), handler))
            key = self._keys.measurement(first)
            self.publishers.append(zsession.control_publisher(session, key))
        return keep

    def unlinked(self, present: set[int]) -> list[str]:
        """Which nodes are not there yet, and which of those that are have no link for measurements."""
        missing = [f"node {i}" for i in self._firsts if i not in present]
        return missing + [
            f"link to node {i}"
            for i, publisher in zip(self._firsts, self.publishers, strict=True)
            if i in present and not zsession.matched(publisher)
        ]

    def send(self, tick: int, measured: Array) -> int:
        """Send y(tick), (segments, 2), and begin to collect; returns the instant of the first one, ns."""
        messages = []
        for outgoing, own in zip(self._outgoing, self._slices, strict=True):
            outgoing.values[:] = measured[own].ravel()
            messages.append(outgoing.stamped(tick, self.setpoint))
        with self._lock:
            self.tick = tick
            self._have = [False] * len(self._firsts)
            self.left = len(self._firsts)
            for incoming, said in zip(self._incoming, self._said, strict=True):
                incoming.expect(tick, said)
        started_ns = monotonic_ns()
        for publisher, raw in zip(self.publishers, messages, strict=True):
            publisher.put(raw)
        for raw in messages:
            self._sent.add(raw)
        return started_ns

    def complete_by(self, at_ns: int) -> bool:
        """Whether every command of the tick had come at that instant."""
        return not self.left and self.complete_ns <= at_ns

    @property
    def said_first(self) -> int:
        """The next setpoint according to the first node."""
        return self._said[0]

    def missing(self) -> list[int]:
        """Nodes whose command of this tick has not come."""
        return [i for i, have in zip(self._firsts, self._have, strict=True) if not have]

    def take(self) -> tuple[list[int], int] | None:
        """Make the set that has come the commands that count; or tell who disagrees with the first node about
        the next setpoint, and what they say."""
        said = self._said[0]
        other = [i for i, one in zip(self._firsts, self._said, strict=True) if one != said]
        if other:
            return other, self._said[self._firsts.index(other[0])]
        self.setpoint = said
        np.copyto(self.commands, self._coming)
        return None

    def settle(self) -> None:
        """Make the sums over what was sent and received, between two ticks."""
        for flow in (self._sent, *self._received):
            flow.settle()

    def counters(self) -> dict[str, int]:
        """What was sent, received and refused."""
        self.settle()
        return (
            {
                "command_received_messages": sum(flow.messages for flow in self._received),
                "command_received_bytes": sum(flow.bytes for flow in self._received),
            }
            | self._sent.report("measurement_sent")
            | self._rejections.report()
        )

    # -- Zenoh's threads --------------------------------------------------------------------------

    def _receiver(self, place: int) -> Callable[[bytes], None]:
        incoming, flow, own = self._incoming[place], self._received[place], self._slices[place]

        def receive(raw: bytes) -> None:
            try:
                with self._lock:
                    due = incoming.due(raw) and not self._have[place]
                    values = numbers_of(raw) if due else self._other(raw, place)
                    self._coming[own] = values
                    _check_finite(self._coming[own])
                    self._have[place] = True
                    flow.add(raw)
                    done = self.left == 1
                    if done:
                        self.complete_ns = monotonic_ns()
                    self.left -= 1
            except RejectedError as error:
                self._rejections.add(error.reason)
                return
            except Exception:
                traceback.print_exc()
                return
            if done:
                self._complete()

        return receive

    def _other(self, raw: bytes, place: int) -> list[float]:
        """A command that is not quite the expected one: of another setpoint, or refused by name."""
        message: Numbers = self._incoming[place].decode(raw)
        if message.tick != self.tick:
            reason = Reason.STALE if message.tick < self.tick else Reason.EARLY
            raise RejectedError(reason, f"expected tick {self.tick}, got {message.tick}")
        if self._have[place]:
            node = self._firsts[place]
            raise RejectedError(
                Reason.DUPLICATE, f"tick {self.tick} has the command of node {node}"
            )
        self._said[place] = message.setpoint
        return message.values


def _check_finite(values: Array) -> None:
    if not np.isfinite(values).all():
        raise RejectedError(Reason.NOT_FINITE, f"got {values.tolist()}")
