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
from collections.abc import Callable
from threading import Lock
from time import monotonic_ns
from typing import Any

import numpy as np

from node.scheduling import Sectors
from node.segment import NotFiniteError, Segment
from node.sweep import NodeSweep
from wire import session as zsession
from wire.channels import COMMAND, MEASUREMENT, SCHEDULE, STATE
from wire.child import Child, Deadline
from wire.counters import Flow, Rejections
from wire.errors import ExitCode
from wire.factors import NodeFactors
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Kind,
    Numbers,
    RejectedError,
    Stop,
    decode_numbers,
    decode_stop,
    encode_batch,
    encode_counters,
    encode_numbers,
    run_tag,
)
from wire.placement import place
from wire.reference import Reference
from wire.run_config import NodeConfig

BATCH_NS = 250_000_000
"""Telemetry does not wait longer than this for a batch to fill, while ticks go on."""
PLANT_PATIENCE = 3.0
"""Between two ticks a node waits this many deadlines: the plant, which has its own, should speak
first."""
OWN = len(MEASUREMENT) + len(STATE) + len(COMMAND) + len(SCHEDULE)
"""Numbers of a telemetry row before the sums."""
FAREWELL_S = 5.0
"""A node started by hand stays this long after the end, so that its last batch gets through."""


class NodeProcess:
    """One node from its configuration to its exit code; `run` does everything."""

    def __init__(self, config: NodeConfig, child: Child, *, supervised: bool) -> None:
        self._config = config
        self._child = child
        self._supervised = supervised
        self._keys = Keys(run_tag(config.run_id))
        factors = NodeFactors.from_plain(config.factors)
        reference = Reference.from_plain(config.reference)
        sweep = NodeSweep(
            factors,
            config.setpoint,
            reference=reference,
            sectors=Sectors.of(config.scheduling),
            fade=math.exp(-reference.tick_s / config.scheduling.bump_s),
        )
        self._lock = Lock()
        self._stop: Stop | None = None
        self._failure: tuple[str, str] | None = None
        names = ("measurement", "command", "forward", "backward")
        self._received = {name: Flow() for name in names}
        self._sent = {name: Flow() for name in names}
        self._telemetry = Flow()
        self._rejections = Rejections()
        self._lengths = {
            "measurement": [2] * len(factors.setpoints),
            "forward": [factors.forward_received] * len(factors.setpoints),
            "backward": [factors.backward_received] * len(factors.setpoints),
        }
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []
        self._segment = Segment(
            sweep,
            config.nodes,
            send_forward=self._sender("forward", Kind.FORWARD_SUM),
            send_backward=self._sender("backward", Kind.BACKWARD_SUM),
            send_command=self._sender("command", Kind.COMMAND),
            record=self._record,
        )
        sums = sweep.forward_received + sweep.backward_received
        instants = 2 + (config.index > 0) + (config.index < config.nodes - 1)
        self._rows = np.empty((config.batch_ticks, OWN + sums + instants))
        self._instants = instants
        self._filled = 0
        self._batch_began_ns = 0
        # Nodes send their batches at different ticks, so that the recorder's link sees no bursts.
        self._quota = 1 + (config.index * config.batch_ticks) // config.nodes

    def run(self) -> ExitCode:
        """Link up, take part in every tick, report, and leave; returns the exit code."""
        config = self._config
        place(config.links.cpu, config.links.fifo, lambda t: self._child.status("note", text=t))
        session = zsession.open_session("peer", config.links.listen, config.links.connect)
        try:
            self._declare(session)
            token = self._link(session)
            if token is not None:
                self._attend()
        finally:
            self._publishers.clear()
            self._subscribers.clear()
            session.close()
        return ExitCode.SAFETY_STOP if self._failure else ExitCode.OK

    # -- links ------------------------------------------------------------------------------------

    def _declare(self, session: Any) -> None:
        index, nodes, keys = self._config.index, self._config.nodes, self._keys
        control: dict[str, str] = {"command": keys.command(index)}
        receive = {"measurement": (keys.measurement(index), Kind.MEASUREMENT, PLANT)}
        if index > 0:
            control["backward"] = keys.backward(index - 1)
            receive["forward"] = (keys.forward(index), Kind.FORWARD_SUM, index - 1)
        if index < nodes - 1:
            control["forward"] = keys.forward(index + 1)
            receive["backward"] = (keys.backward(index), Kind.BACKWARD_SUM, index + 1)
        handlers = {
            "measurement": self._segment.on_measurement,
            "forward": self._segment.on_forward,
            "backward": self._segment.on_backward,
        }
        for name, (key, kind, sender) in receive.items():
            handler = self._receiver(name, kind, sender, handlers[name])
            self._subscribers.append(session.declare_subscriber(key, zsession.direct(handler)))
        self._subscribers.append(
            session.declare_subscriber(keys.stop, zsession.direct(self._on_stop))
        )
        for name, key in control.items():
            self._publishers[name] = zsession.control_publisher(session, key)
        self._publishers["telemetry"] = zsession.telemetry_publisher(session, keys.telemetry(index))
        for publisher in self._publishers.values():
            listener = publisher.declare_matching_listener(
                zsession.observe(lambda _: self._child.wake())
            )
            self._subscribers.append(listener)

    def _link(self, session: Any) -> Any | None:
        """Wait until every publisher has its subscriber; returns the liveliness token, None if
        stopped."""
        index = self._config.index
        far = {
            "command": "the plant",
            "telemetry": "the recorder",
            "forward": f"node {index + 1}",
            "backward": f"node {index - 1}",
        }
        told: list[str] | None = None
        while not self._child.stopping:
            missing = [far[n] for n, p in self._publishers.items() if not zsession.matched(p)]
            if missing != told:
                self._child.status("waiting", missing=missing)
                told = missing
            if not missing:
                token = session.liveliness().declare_token(self._keys.ready(index))
                self._child.status("ready")
                gc.collect()
                gc.freeze()
                gc.disable()
                return token
            self._child.wait(1.0)
        return None

    # -- the run ----------------------------------------------------------------------------------

    def _attend(self) -> None:
        """Main thread: until stopped, see that no tick takes longer than its deadline."""
        limit_s = self._config.links.deadline_s
        while not (self._stop or self._failure or self._child.stopping):
            began, ended = self._segment.began_ns, self._segment.ended_ns
            if began:
                left = limit_s - (monotonic_ns() - began) * 1e-9
            elif ended:
                left = PLANT_PATIENCE * limit_s - (monotonic_ns() - ended) * 1e-9
            else:
                left = limit_s  # the first measurement comes when the launcher says so
            if left <= 0.0:
                self._late(began)
            else:
                self._child.wait(left)
        if self._failure:
            code, text = self._failure
            self._child.status("failed", code=code, message=text, tick=self._segment.tick)
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
            if self._segment.began_ns != began_ns:
                return  # finished in the meantime
            missing = self._segment.missing() if began_ns else ["the measurement of the plant"]
            tick = self._segment.tick
        limit_s = self._config.links.deadline_s * (1.0 if began_ns else PLANT_PATIENCE)
        self._failure = (
            "deadline",
            f"tick {tick}: node {self._config.index} waited {limit_s:g} s "
            f"for {' and '.join(missing)}",
        )

    def _report(self) -> None:
        """Send the rest of the telemetry and the counters; tell the launcher where the tick
        stood."""
        with self._lock:
            tick = self._segment.tick
            missing = self._segment.missing() if self._segment.began_ns else []
            self._flush()
            counters = self._counters()
            run, index = self._keys.run, self._config.index
            self._publishers["telemetry"].put(encode_counters(run, tick, index, counters))
        self._child.status("stopped", tick=tick, missing=missing)

    def _counters(self) -> dict[str, int]:
        out: dict[str, int] = {}
        for name, flow in self._received.items():
            out |= flow.report(f"{name}_received")
        for name, flow in self._sent.items():
            out |= flow.report(f"{name}_sent")
        return out | self._telemetry.report("telemetry_sent") | self._rejections.report()

    # -- Zenoh's thread ---------------------------------------------------------------------------

    def _receiver(
        self, name: str, kind: Kind, sender: int, handler: Callable[[Numbers, int], None]
    ) -> Callable[[bytes], None]:
        flow, lengths, run = self._received[name], self._lengths[name], self._keys.run

        def receive(raw: bytes) -> None:
            at_ns = monotonic_ns()
            try:
                message = decode_numbers(raw, kind, run, sender, lengths)
                with self._lock:
                    handler(message, at_ns)
                    flow.add(raw)
            except RejectedError as error:
                self._rejections.add(error.reason)
            except NotFiniteError as error:
                self._fail("not finite", str(error))
            except Exception as error:
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

    def _sender(self, name: str, kind: Kind) -> Callable[[int, int, list[float]], None]:
        flow, publishers = self._sent[name], self._publishers
        run, index = self._keys.run, self._config.index

        def send(tick: int, setpoint: int, values: list[float]) -> None:
            raw = encode_numbers(kind, run, tick, index, setpoint, values)
            publishers[name].put(raw)
            flow.add(raw)

        return send

    def _record(self, tick: int, row: list[float]) -> None:
        rows, filled = self._rows, self._filled
        rows[filled] = row
        rows[filled, -self._instants :] -= self._config.links.epoch_ns
        sent_ns = int(row[-1])
        if filled == 0:
            self._batch_began_ns = sent_ns
        self._filled = filled + 1
        full = self._filled >= self._quota or tick == self._config.ticks - 1
        if full or sent_ns - self._batch_began_ns > BATCH_NS:
            self._flush(next_tick=tick + 1)
            self._quota = self._config.batch_ticks

    def _flush(self, next_tick: int | None = None) -> None:
        if self._filled:
            first = (self._segment.tick if next_tick is None else next_tick) - self._filled
            rows = self._rows[: self._filled]
            raw = encode_batch(self._keys.run, first, self._config.index, rows)
            self._publishers["telemetry"].put(raw)
            self._telemetry.add(raw)
            self._filled = 0
