"""The process of one segment: its Zenoh session, links to two neighbours and its segment of the
plant only.

Messages come on Zenoh's thread and are answered there; the main thread watches the time, the
launcher and the end of the run. Telemetry goes to the recorder in batches, after the command of the
tick has left.
"""

from __future__ import annotations

import gc
import math
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from threading import Lock
from time import monotonic_ns
from typing import Any

from node.block import SegmentBlock
from node.configured import sweeps_of
from node.finite import NotFiniteError
from node.neighbours import Neighbours
from node.receiving import Others
from node.row import Y
from node.sweep import Array
from wire import session as zsession
from wire.child import Child, Deadline, remove_sockets
from wire.counters import Flow, Rejections
from wire.errors import ExitCode
from wire.gate import Gate
from wire.keys import Keys
from wire.limits import check_files
from wire.messages import (
    HEADER_BYTES,
    PLANT,
    Incoming,
    Kind,
    Outgoing,
    RejectedError,
    Stop,
    decode_stop,
    encode_batch,
    encode_counters,
    run_tag,
)
from wire.placement import place, step_back
from wire.run_config import NodeConfig

PLANT_PATIENCE = 3.0
"""Between two ticks a node waits this many deadlines: the plant, which has its own, should speak
first."""
FAREWELL_S = 5.0
"""A node started by hand stays this long after the end, so that its last batch gets through."""


class NodeProcess:
    """One node from its configuration to its exit code; `run` does everything. It is the block's outlet."""

    def __init__(self, config: NodeConfig, child: Child, *, supervised: bool) -> None:
        self._config = config
        self._child = child
        self._supervised = supervised
        self._keys = Keys(run_tag(config.run_id))
        sweeps = sweeps_of(config)
        first, last = sweeps[0], sweeps[-1]
        self._lock = Lock()
        self._stop: Stop | None = None
        self._failure: tuple[str, str] | None = None
        self._leaving = False
        names = ("measurement", "command", "forward", "backward")
        self._received = {name: Flow() for name in names}
        self._sent = {name: Flow() for name in names}
        self._telemetry = Flow()
        self._rejections = Rejections()
        run = self._keys.run
        self._outgoing = {
            "forward": Outgoing(Kind.FORWARD_SUM, run, last.index, last.forward_sent),
            "backward": Outgoing(Kind.BACKWARD_SUM, run, first.index, first.backward_sent),
            "command": Outgoing(Kind.COMMAND, run, first.index, len(sweeps)),
        }
        self.forward = self._outgoing["forward"].values
        self.backward = self._outgoing["backward"].values
        self.commands = self._outgoing["command"].values

        def incoming(kind: Kind, sender: int, numbers: int) -> Incoming:
            return Incoming(kind, run, sender, [numbers] * first.setpoints)

        self._incoming = {
            "measurement": incoming(Kind.MEASUREMENT, PLANT, Y * len(sweeps)),
            "forward": incoming(Kind.FORWARD_SUM, first.index - 1, first.forward_received),
            "backward": incoming(Kind.BACKWARD_SUM, last.index + 1, last.backward_received),
        }
        self._all_incoming = tuple(self._incoming.values())
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        self._batches: deque[tuple[int, Sequence[Array]]] = deque()
        self.send_forward = self._sender("forward")
        self.send_backward = self._sender("backward")
        self.send_commands = self._sender("command")
        self._linked = False
        self._block = SegmentBlock(
            sweeps,
            self,
            batch=config.batch_ticks,
            # Nodes send their batches at different ticks, so that the recorder's link sees no bursts.
            first_batch=1 + (config.index * (config.batch_ticks - 1)) // config.nodes,
            epoch_ns=config.links.epoch_ns,
        )
        self._neighbours = Neighbours(config, self._keys, sweeps, self._block, self._lock)
        self._linked = True
        self._others = Others(config, self._block, self._neighbours, child)

    def run(self) -> ExitCode:
        """Link up, take part in every tick, report, and leave; returns the exit code."""
        config = self._config
        place(config.links.cpu, config.links.fifo, self._note)
        if config.joins:
            remove_sockets(list(config.links.listen))  # the dead process's
        gate = Gate("peer", config.links, self._child)
        session = gate.session
        try:
            self._declare(session)
            if self._link():
                step_back(config.links.fifo)
                token = self._present(session)
                self._attend(token)
                del token
        finally:
            with self._lock:  # nobody is in the middle of sending
                self._leaving = True
            self._neighbours.close()
            self._publishers.clear()
            self._subscribers.clear()
            gate.close()
        return ExitCode.SAFETY_STOP if self._failure else ExitCode.OK

    # -- links ------------------------------------------------------------------------------------

    def _note(self, text: str) -> None:
        self._child.status("note", text=text)

    def _declare(self, session: Any) -> None:
        first, last, keys = self._config.index, self._config.last, self._keys
        control: dict[str, str] = {"command": keys.command(first)}
        receive = {"measurement": (keys.measurement(first), self._block.on_measurement)}
        if first > 0:
            control["backward"] = keys.backward(first - 1)
            receive["forward"] = (keys.forward(first), self._block.on_forward)
        if last < self._config.nodes - 1:
            control["forward"] = keys.forward(last + 1)
            receive["backward"] = (keys.backward(last), self._block.on_backward)
        for name, (key, take) in receive.items():
            handler = zsession.direct(self._receiver(name, take))
            self._subscribers.append(session.declare_subscriber(key, handler))
        self._subscribers.append(
            session.declare_subscriber(keys.stop, zsession.direct(self._on_stop))
        )
        for name, key in control.items():
            self._publishers[name] = zsession.control_publisher(session, key)
        self._subscribers += self._neighbours.declare(
            session,
            lambda: not (self._stop or self._failure or self._leaving),
            lambda error: self._rejections.add(error.reason),
            self._block.setpoints,
        )
        self._publishers["telemetry"] = zsession.telemetry_publisher(session, keys.telemetry(first))
        for publisher in self._publishers.values():
            listener = publisher.declare_matching_listener(
                zsession.observe(lambda _: self._child.wake())
            )
            self._subscribers.append(listener)

    def _link(self) -> bool:
        """Wait until every publisher has its subscriber; False if stopped before."""
        index = self._config.index
        far = {
            "command": "the plant",
            "telemetry": "the recorder",
            "forward": f"node {self._config.last + 1}",
            "backward": f"node {index - 1}",
        }
        told: list[str] | None = None
        while not self._child.stopping:
            check_files()
            missing = [far[n] for n, p in self._publishers.items() if not zsession.matched(p)]
            if missing != told:
                self._child.status("waiting", missing=missing)
                told = missing
            if not missing:
                self._child.status("ready")
                gc.collect()
                gc.freeze()
                gc.disable()
                return True
            self._child.wait(1.0)
        return False

    def _present(self, session: Any) -> Any | None:
        """Say that this node is part of the chain, by a token to be kept; one that replaces a dead node waits
        until it is, None if it is stopped before."""
        while self._neighbours.joining is not None:
            if self._stop or self._failure or self._child.stopping:
                return None
            self._child.wait(1.0)
        self._neighbours.joined()
        return session.liveliness().declare_token(self._keys.ready(self._config.index))

    # -- the run ----------------------------------------------------------------------------------

    def _attend(self, token: Any | None) -> None:
        """Main thread: until stopped, send the records on and see that no tick exceeds its deadline."""
        limit_s = self._config.links.deadline_s
        while not (self._stop or self._failure or self._child.stopping):
            began, ended = self._block.began_ns, self._block.ended_ns
            if began:
                left = limit_s - (monotonic_ns() - began) * 1e-9
            elif ended:
                left = PLANT_PATIENCE * limit_s - (monotonic_ns() - ended) * 1e-9
            else:
                left = limit_s  # the first measurement comes when the launcher says so
            bridge_left = self._bridge_left_s()
            if left <= 0.0:
                self._late(began)
            elif bridge_left <= 0.0:
                self._unheard()
            else:
                self._child.wait(min(left, bridge_left))
            self._send_batches()
        if self._failure:
            code, text = self._failure
            self._child.status("failed", code=code, message=text, tick=self._block.tick)
            if (
                token is not None and not self._supervised
            ):  # nobody reads that line: this the plant sees
                token.undeclare()
            # The plant answers with its order to stop; without one the launcher's signal comes.
            patience = Deadline(limit_s)
            while not (self._stop or self._child.stopping or patience.passed):
                self._child.wait(patience.left)
        self._report()
        farewell = Deadline(FAREWELL_S)
        while not (self._child.stopping or (not self._supervised and farewell.passed)):
            self._child.wait(None if self._supervised else farewell.left)

    def _late(self, began_ns: int) -> None:
        with self._lock:
            if self._block.began_ns != began_ns:
                return  # finished in the meantime
            missing = self._block.missing() if began_ns else ["the measurement of the plant"]
            tick = self._block.tick
        limit_s = self._config.links.deadline_s * (1.0 if began_ns else PLANT_PATIENCE)
        self._failure = (
            "deadline",
            f"tick {tick}: node {self._config.index} waited {limit_s:g} s "
            f"for {' and '.join(missing)}",
        )

    def _bridge_left_s(self) -> float:
        """How long a neighbour's sums may still be bridged."""
        since, limit_s = self._block.bridging_ns, self._config.bridge_s
        return limit_s - (monotonic_ns() - since) * 1e-9 if since and limit_s else math.inf

    def _unheard(self) -> None:
        """A link is broken though everybody lives, or a dead neighbour is not replaced: the arm must not be
        controlled in two halves for long."""
        ways = self._block.bridged_from()
        self._failure = (
            "bridged",
            f"tick {self._block.tick}: node {self._config.index} has had no {' and no '.join(ways)} for "
            f"{self._config.bridge_s:g} s",
        )

    def _report(self) -> None:
        """Send the rest of the telemetry and the counters; tell the launcher where the tick
        stood."""
        with self._lock:
            tick = self._block.tick
            missing = self._block.missing() if self._block.begun else []
            self._block.flush()
        self._send_batches()
        for index, counters in self._counters().items():
            raw = encode_counters(self._keys.run, tick, index, counters)
            self._publishers["telemetry"].put(raw)
        self._child.status("stopped", tick=tick, missing=missing)

    def _counters(self) -> dict[int, dict[str, int]]:
        """Per segment: what it had on the wire at either end, and sums that it got in memory."""
        indices = range(self._config.index, self._config.last + 1)
        inner = self._block.passed // max(1, 2 * (len(indices) - 1))
        ends = {i: (i > indices[0]) + (i < indices[-1]) for i in indices}
        out = {i: {"passed_messages": ends[i] * inner} for i in indices}
        first, last = out[indices[0]], out[indices[-1]]
        received, sent = self._received, self._sent
        first |= received["measurement"].report("measurement_received")
        first |= sent["command"].report("command_sent")
        first |= received["forward"].report("forward_received")
        first |= sent["backward"].report("backward_sent")
        last |= received["backward"].report("backward_received")
        last |= sent["forward"].report("forward_sent")
        first["bridged_sums"] = self._block.bridged
        first |= self._telemetry.report("telemetry_sent") | self._rejections.report()
        return out

    def _send_batches(self) -> None:
        """What could wait: records to the recorder, and the sums over what was sent and received."""
        for flow in (*self._received.values(), *self._sent.values(), self._telemetry):
            flow.settle()
        while self._batches:
            tick, segments = self._batches.popleft()
            for index, rows in enumerate(segments, self._config.index):
                raw = encode_batch(self._keys.run, tick, index, rows)
                self._publishers["telemetry"].put(raw)
                self._telemetry.add(raw)

    # -- Zenoh's thread ---------------------------------------------------------------------------

    def _receiver(self, name: str, take: Callable[[bytes, int], None]) -> Callable[[bytes], None]:
        incoming, lock, note = self._incoming[name], self._lock, self._received[name].add

        def receive(raw: bytes) -> None:
            at_ns = monotonic_ns()
            try:
                with lock:
                    if self._neighbours.joining is not None:
                        if not self._others.begin(name, incoming.decode(raw), at_ns):
                            return
                    elif raw.startswith(incoming.header) and len(raw) == incoming.size:
                        take(raw[HEADER_BYTES:], at_ns)
                    else:
                        take(self._others.take(name, incoming.decode(raw), at_ns), at_ns)
                note(raw)
            except RejectedError as error:
                self._rejections.add(error.reason)
            except NotFiniteError as error:
                self._fail("not finite", str(error))
            except Exception as error:
                if self._leaving:  # a last message, and nothing to answer it with any more
                    return
                traceback.print_exc()
                self._fail("internal", f"node {self._config.index}: {error!r}")

        return receive

    def _fail(self, code: str, text: str) -> None:
        self._failure = self._failure or (code, text)
        self._child.wake()

    def _on_stop(self, raw: bytes) -> None:
        try:
            self._stop = decode_stop(raw, self._keys.run)
        except RejectedError as error:
            self._rejections.add(error.reason)
            return
        self._child.wake()

    def _sender(self, name: str) -> Callable[[int, int], None]:
        publishers, stamped = self._publishers, self._outgoing[name].stamped
        note = self._sent[name].add

        def send(tick: int, setpoint: int) -> None:
            raw = stamped(tick, setpoint)
            publishers[name].put(raw)
            note(raw)

        return send

    def begins(self, tick: int, setpoint: int) -> None:
        """Know the messages of this tick beforehand."""
        Incoming.expect_all(self._all_incoming, tick, setpoint)
        if self._linked and self._neighbours.asking:
            self._neighbours.tell(tick, setpoint)

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        """Leave a batch to the main thread: nothing on the way of a tick waits for it."""
        self._batches.append((tick, rows))
        self._child.wake()
