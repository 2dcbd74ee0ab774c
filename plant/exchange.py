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
from wire.channels import MEASUREMENT, WELL, Health
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
DISAGREE_TICKS = 20
"""After a gap in the chain its two sides may use different setpoints' gains for some ticks; not for longer."""
_LATE = (Reason.STALE, Reason.EARLY)
"""Refused for their time alone: what they say is valid."""


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
        *,
        lenient: bool = False,
    ) -> None:
        """`commands` are u(0) of all segments; `complete` is called (on Zenoh's thread) when all have come.

        lenient: nodes that do not agree about the next setpoint are given time to.
        """
        self._lenient = lenient
        self._patience = DISAGREE_TICKS if lenient else 0
        self.disagreeing = 0
        """Ticks in a row in which the nodes did not agree about the next setpoint."""
        self.vanished: set[int] = set()
        """Nodes whose token was there and is not any more; filled by whoever watches the tokens."""
        self._out: set[int] = set()
        self._back: set[int] = set()
        """Places in the order of `firsts`: not waited for, and waited for again from the next tick on."""
        self._refused: set[int] = set()
        self._missed: set[int] = set()
        """Places that were waited for in the tick before and whose command did not come."""
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
        for outgoing, own, said in zip(self._outgoing, self._slices, self._said, strict=True):
            outgoing.values[:] = measured[own].ravel()
            messages.append(outgoing.stamped(tick, said))
        with self._lock:
            self._missed = {p for p, have in enumerate(self._have) if not have} - self._out
            self._out -= self._back
            self._back.clear()
            self._refused.clear()
            self.tick = tick
            self._have = [False] * len(self._firsts)
            self.left = len(self._firsts) - len(self._out)
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
        """The next setpoint according to the first node that is waited for."""
        return self._said[next((p for p in range(len(self._said)) if p not in self._out), 0)]

    def missing(self) -> list[int]:
        """Nodes that are waited for and whose command of this tick has not come."""
        return [
            node
            for place, node in enumerate(self._firsts)
            if not self._have[place] and place not in self._out
        ]

    def stuck(self) -> list[int]:
        """Those that are missing again: in this tick and in the one before; if there are none, those that are
        missing. Who was late once is not stuck, and has not to be replaced because somebody else is."""
        missing = self.missing()
        return [node for node in missing if self._firsts.index(node) in self._missed] or missing

    @property
    def out(self) -> list[int]:
        """Nodes that are not waited for."""
        return [self._firsts[place] for place in sorted(self._out)]

    def give_up(self, node: int) -> None:
        """Do not wait for a node, in this tick and until a command of its comes again."""
        place = self._firsts.index(node)
        with self._lock:
            if place in self._out:
                return
            self._out.add(place)
            self._back.discard(place)
            if not self._have[place] and self.left:
                self.left -= 1
                if not self.left:
                    self.complete_ns = monotonic_ns()

    def health(self) -> list[int]:
        """Per segment wire.channels.Health as it is now."""
        out = []
        for place, (node, own) in enumerate(zip(self._firsts, self._slices, strict=True)):
            health = WELL
            if node in self.vanished:
                health &= ~int(Health.ALIVE)
            if not self._have[place]:
                health &= ~int(Health.ON_TIME)
            if place in self._refused:
                health &= ~int(Health.VALID)
            out += [health] * (own.stop - own.start)
        return out

    def take(self, rest: Array | None = None, fade: float = 0.0) -> tuple[list[int], int] | None:
        """Make what has come the commands that count; or tell who disagrees with the first node about the next
        setpoint, and what they say.

        Of a node that is late the last command is held; that of one that is not waited for goes to `rest`
        (segments,), N/m: its difference from that is multiplied by `fade`.
        """
        said = self.said_first
        other = [
            node
            for place, node in enumerate(self._firsts)
            if place not in self._out and self._said[place] != said
        ]
        self.disagreeing = self.disagreeing + 1 if other else 0
        if other and self.disagreeing > self._patience:
            return other, self._said[self._firsts.index(other[0])]
        self.setpoint = said
        with self._lock:
            for place in self._out:
                if not self._have[place] and rest is not None:
                    own = self._slices[place]
                    self._coming[own] = rest[own] + fade * (self._coming[own] - rest[own])
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
                    _check_finite(values)
                    self._coming[own] = values
                    self._have[place] = True
                    flow.add(raw)
                    if place in self._out:
                        self._back.add(place)
                        self.vanished.discard(self._firsts[place])
                        return
                    done = self.left == 1
                    if done:
                        self.complete_ns = monotonic_ns()
                    self.left -= 1
            except RejectedError as error:
                self._rejections.add(error.reason)
                if error.reason not in _LATE:
                    self._refused.add(place)
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
            if self._lenient and place in self._out and message.tick == self.tick - 1:
                self._back.add(place)  # not far behind: in the next tick it is there
                self.vanished.discard(self._firsts[place])
            reason = Reason.STALE if message.tick < self.tick else Reason.EARLY
            raise RejectedError(reason, f"expected tick {self.tick}, got {message.tick}")
        if self._have[place]:
            node = self._firsts[place]
            raise RejectedError(
                Reason.DUPLICATE, f"tick {self.tick} has the command of node {node}"
            )
        self._said[place] = message.setpoint
        return message.values


def _check_finite(values: Array | list[float]) -> None:
    if not np.isfinite(values).all():
        raise RejectedError(Reason.NOT_FINITE, f"got {list(values)}")
