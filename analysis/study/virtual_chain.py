"""One tick of a chain of node processes, event by event, in one process: when messages arrive, what they say.

Between the factors of a deployment and `analysis.study.growth`. The nodes are the real ones (`node.block`),
only what carries their messages is simulated: every message arrives after a latency and keeps the core of its
receiver busy for a service time; a core serves what arrives one after the other. What a handling sends leaves
at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from heapq import heappop, heappush
from time import thread_time_ns
from typing import Protocol

import numpy as np
import numpy.typing as npt

from node.block import SegmentBlock
from node.sweep import NodeSweep, Payload, payload
from wire.channels import MEASUREMENT
from wire.errors import OctarmError
from wire.factors import OUTPUTS, NodeFactors

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

Y = len(MEASUREMENT)


class What(IntEnum):
    """What a message to a node carries."""

    MEASUREMENT = 0
    FORWARD = 1
    BACKWARD = 2


class Member(Protocol):
    """A node process as the simulation sees it."""

    def take(self, what: What, values: Array) -> list[tuple[What, Array]]:
        """Handle a message; what is sent on, FORWARD to the tip's side and BACKWARD to the root's."""

    def done(self) -> bool:
        """Whether the tick that began with the last measurement has ended."""


@dataclass(frozen=True, eq=False)
class Durations:
    """Of one tick, ns. Drawn beforehand, so that they do not depend on the order of the events."""

    service: Ints
    """(processes, 3): how long a message of each `What` keeps the core busy."""
    latency: Ints
    """(processes - 1, 2): of the link behind each process, to the tip's side and to the root's."""


@dataclass(frozen=True, eq=False)
class TickTimes:
    """One simulated tick; all measurements arrive at 0."""

    sweep_ns: int
    """When the last process had its commands."""
    busy_ns: Ints
    """(cores,): how long each core worked."""
    messages: int
    """Between processes."""


def run_tick(
    members: Sequence[Member],
    core: Sequence[int],
    durations: Durations,
    measurements: Sequence[Array],
    first: Iterable[int] | None = None,
) -> TickTimes:
    """Let all measurements arrive and follow the messages until nothing happens any more.

    core: the one that each process runs on. first: order in which simultaneous measurements are served, default
    root to tip. OctarmError if a process has not finished its tick then.
    """
    service, latency = durations.service.tolist(), durations.latency.tolist()
    free = [0] * (max(core) + 1)
    busy = [0] * len(free)
    serial = messages = end = 0
    events: list[tuple[int, int, int, What, Array]] = []
    for i in range(len(members)) if first is None else first:
        heappush(events, (0, serial, i, What.MEASUREMENT, measurements[i]))
        serial += 1
    while events:
        arrived, _, i, what, values = heappop(events)
        c = core[i]
        needed = service[i][what]
        now = max(arrived, free[c]) + needed
        free[c] = now
        busy[c] += needed
        end = max(end, now)
        for to, sums in members[i].take(what, values):
            there, delay = (
                (i + 1, latency[i][0]) if to is What.FORWARD else (i - 1, latency[i - 1][1])
            )
            heappush(events, (now + delay, serial, there, to, sums))
            serial += 1
            messages += 1
    for i, one in enumerate(members):
        if not one.done():
            raise OctarmError(f"simulated process {i} of {len(members)} did not finish its tick")
    return TickTimes(end, np.array(busy, dtype=np.int64), messages)


_NOTHING: Array = np.zeros(0)


class Relay:
    """A node process without mathematics: sends what a `SegmentBlock` sends, when it sends it."""

    def __init__(self, index: int, processes: int) -> None:
        self._first, self._last = index == 0, index == processes - 1
        self._clear()

    def _clear(self) -> None:
        self._y = False
        self._c, self._d = self._first, self._last

    def take(self, what: What, values: Array) -> list[tuple[What, Array]]:  # noqa: ARG002
        """See `Member`."""
        out: list[tuple[What, Array]] = []
        if what is What.MEASUREMENT:
            self._y = True
        elif what is What.FORWARD:
            self._c = True
        else:
            self._d = True
        if self._y:
            if self._c and what is not What.BACKWARD and not self._last:
                out.append((What.FORWARD, _NOTHING))
            if self._d and what is not What.FORWARD and not self._first:
                out.append((What.BACKWARD, _NOTHING))
            if self._c and self._d:
                self._clear()
        return out

    def done(self) -> bool:
        """See `Member`."""
        return not self._y


class VirtualNode:
    """A node process in memory: a `SegmentBlock`, and the outlet that it writes to."""

    def __init__(self, factors: Sequence[NodeFactors]) -> None:
        self.sweeps = [NodeSweep(one) for one in factors]
        self.forward: Array = np.zeros(self.sweeps[-1].forward_sent)
        self.backward: Array = np.zeros(self.sweeps[0].backward_sent)
        self.commands: Array = np.zeros(len(factors))
        self.handling_ns: tuple[list[int], list[int], list[int]] = ([], [], [])
        """Processor time of the node's own code, by `What`."""
        self._sent: list[tuple[What, Array]] = []
        self._began = False
        self._block = SegmentBlock(self.sweeps, self)
        self._handlers: tuple[Callable[[Payload, int], None], ...] = (
            self._block.on_measurement,
            self._block.on_forward,
            self._block.on_backward,
        )

    def take(self, what: What, values: Array) -> list[tuple[What, Array]]:
        """See `Member`."""
        self._sent = []
        raw = payload(values)
        before = thread_time_ns()  # others' work on the machine does not count
        self._handlers[what](raw, 1)
        self.handling_ns[what].append(thread_time_ns() - before)
        return self._sent

    def done(self) -> bool:
        """See `Member`."""
        return not self._block.begun

    # -- the outlet ---------------------------------------------------------------------------------

    def send_forward(self, tick: int, setpoint: int) -> None:  # noqa: ARG002
        """See `node.outlet.Outlet`."""
        self._sent.append((What.FORWARD, self.forward.copy()))

    def send_backward(self, tick: int, setpoint: int) -> None:  # noqa: ARG002
        """See `node.outlet.Outlet`."""
        self._sent.append((What.BACKWARD, self.backward.copy()))

    def send_commands(self, tick: int, setpoint: int) -> None:
        """Nobody is there to take them."""

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        """Nobody records."""

    def begins(self, tick: int, setpoint: int) -> None:
        """Messages come when they come."""


def virtual_nodes(factors: Sequence[NodeFactors], segments: int) -> list[VirtualNode]:
    """Processes of so many consecutive segments each, the last of what is left."""
    return [VirtualNode(factors[i : i + segments]) for i in range(0, len(factors), segments)]


def states(nodes: Sequence[VirtualNode]) -> Array:
    """Estimates and commands (n, 5) of the tick that begins."""
    return np.stack([sweep.state for node in nodes for sweep in node.sweeps])


def split(measurements: Array, nodes: Sequence[VirtualNode]) -> list[Array]:
    """Measurements (n, 2) as each process gets them."""
    ends = np.cumsum([len(node.sweeps) for node in nodes])[:-1]
    return [one.ravel() for one in np.split(measurements, ends)]


def sequential_tick(sweeps: Sequence[NodeSweep], measurements: Array) -> Array:
    """The same tick without events: one pass to the tip, one to the root. Returns states (n, 5)."""
    for sweep, y in zip(sweeps, measurements, strict=True):
        sweep.input(y)
    sums: Array = _NOTHING
    for sweep in sweeps:
        sums = sweep.forward(sums).copy()
    for sweep in reversed(sweeps):
        sums = sweep.backward(_NOTHING if sweep.last else sums).copy()
    out = np.empty((len(sweeps), OUTPUTS))
    for i, sweep in enumerate(sweeps):
        out[i] = sweep.output()
        sweep.accept(out[i])
    return out
