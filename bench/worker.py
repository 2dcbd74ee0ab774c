"""One worker of the patterns over Zenoh that do no mathematics: chain, star, hub, all-to-all.

It links up, answers on Zenoh's thread, and reports as `node.process` does: a token when its links are
up, counters when the driver says stop. What it does within a tick is one small function a role.
"""

from __future__ import annotations

import gc
from array import array
from collections.abc import Callable
from time import monotonic_ns
from typing import Any

import numpy as np

from bench.configs import HUB, LEASE_MS, WorkerConfig
from wire import session as zsession
from wire.child import Child
from wire.errors import ExitCode
from wire.keys import Keys
from wire.messages import Kind, encode_batch, encode_counters, kind_of, run_tag
from wire.placement import place

Handler = Callable[[bytes], None]
Put = Callable[[bytes], None]


class Tally:
    """Messages and bytes of one kind that this process received."""

    __slots__ = ("bytes", "messages")

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0


class Instants:
    """At an end of the chain: when the measurement came, when the sum from the other end came."""

    def __init__(self) -> None:
        self.measured = array("q")
        self.arrived = array("q")

    def rows(self, epoch_ns: int | None) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Shape (ticks, 2), ns after the epoch; only ticks that have both."""
        ticks = min(len(self.measured), len(self.arrived))
        pairs = (self.measured[:ticks], self.arrived[:ticks])
        return np.array(pairs, dtype=np.float64).reshape(2, -1).T - (epoch_ns or 0)


class Worker:
    """One worker from its configuration to its exit code; `run` does everything."""

    def __init__(self, config: WorkerConfig, child: Child) -> None:
        self.config = config
        self.keys = Keys(run_tag(config.run_id))
        self.payload = bytes(config.payload_bytes)
        self.command = bytes(config.command_bytes)
        self.measurement, self.exchange = Tally(), Tally()
        self.instants = Instants()
        self._child = child
        self._session: Any = None
        self._publishers: list[Any] = []
        self._keep: list[Any] = []
        self._stopped = False

    def run(self) -> ExitCode:
        """Link up, take part in every tick, report, leave; returns the exit code."""
        links = self.config.links
        place(links.cpu, links.fifo, lambda text: self._child.status("note", text=text))
        self._session = zsession.open_session(
            "peer", links.listen, links.connect, lease_ms=LEASE_MS
        )
        try:
            report = self.publisher(self.keys.telemetry(self.config.index))
            self.subscribe(self.keys.stop, self._stop)
            ROLES[self.config.role](self)
            token = self._link()
            while not (token is None or self._stopped or self._child.stopping):
                self._child.wait(None)
            if self._stopped:
                self._report(report)
            while not self._child.stopping:
                self._child.wait(None)
        finally:
            self._publishers.clear()
            self._keep.clear()
            self._session.close()
        return ExitCode.OK

    def publisher(self, key: str) -> Put:
        """What puts on the key; the worker is ready when the other end is there."""
        publisher = zsession.control_publisher(self._session, key)
        wake = zsession.observe(lambda _: self._child.wake())
        self._keep.append(publisher.declare_matching_listener(wake))
        self._publishers.append(publisher)
        put: Put = publisher.put
        return put

    def subscribe(self, key: str, handler: Handler) -> None:
        """Call the handler on Zenoh's thread with each message of the key."""
        self._keep.append(self._session.declare_subscriber(key, zsession.direct(handler)))

    def _stop(self, _raw: bytes) -> None:
        self._stopped = True
        self._child.wake()

    def _link(self) -> Any | None:
        """Wait until every publisher has its subscriber; returns the token, None if stopped."""
        while not self._child.stopping:
            if all(map(zsession.matched, self._publishers)):
                token = self._session.liveliness().declare_token(self.keys.ready(self.config.index))
                gc.collect()
                gc.freeze()
                gc.disable()
                return token
            self._child.wait(1.0)
        return None

    def _report(self, put: Put) -> None:
        run, index = self.keys.run, self.config.index
        rows = self.instants.rows(self.config.links.epoch_ns)
        if len(rows):
            put(encode_batch(run, 0, index, rows))
        put(encode_counters(run, 0, index, counters(self.measurement, self.exchange)))


def counters(measurement: Tally, exchange: Tally) -> dict[str, int]:
    """Under the names that the nodes use."""
    kinds = {"measurement": measurement, "exchange": exchange}
    messages = {f"{name}_received_messages": tally.messages for name, tally in kinds.items()}
    return messages | {f"{name}_received_bytes": tally.bytes for name, tally in kinds.items()}


def is_counters(raw: bytes) -> bool:
    """Whether a record is a process's last word."""
    return kind_of(raw) is Kind.COUNTERS


def _bare(worker: Worker) -> None:
    """The chain: a sum is put on as it comes; the command leaves when measurement and sums are there."""
    index, keys, payload = worker.config.index, worker.keys, worker.payload
    first, last = index == 0, index == worker.config.nodes - 1
    put_command = worker.publisher(keys.command(index))
    forward = None if last else worker.publisher(keys.forward(index + 1))
    backward = None if first else worker.publisher(keys.backward(index - 1))
    own, sums, instants = worker.measurement, worker.exchange, worker.instants
    needed = 3 - first - last
    left = needed

    def came() -> None:
        nonlocal left
        left -= 1
        if not left:
            left = needed
            put_command(worker.command)

    def on_measurement(raw: bytes) -> None:
        at_ns = monotonic_ns()
        own.messages += 1
        own.bytes += len(raw)
        if first and forward is not None:
            instants.measured.append(at_ns)
            forward(payload)
        elif last and backward is not None:
            instants.measured.append(at_ns)
            backward(payload)
        came()

    def sum_handler(put_on: Put | None) -> Handler:
        def on_sum(raw: bytes) -> None:
            at_ns = monotonic_ns()
            if put_on is not None:
                put_on(raw)
            else:
                instants.arrived.append(at_ns)
            sums.messages += 1
            sums.bytes += len(raw)
            came()

        return on_sum

    worker.subscribe(keys.measurement(index), on_measurement)
    if not first:
        worker.subscribe(keys.forward(index), sum_handler(forward))
    if not last:
        worker.subscribe(keys.backward(index), sum_handler(backward))


def _to_hub(keys: Keys, index: int) -> str:
    return f"{keys.root}/hub/{index}"


def _to_node(keys: Keys, index: int) -> str:
    return f"{keys.root}/node/{index}/exchange"


def _star(worker: Worker) -> None:
    """A node of the star: measurement to the hub, its answer to the driver."""
    index, keys = worker.config.index, worker.keys
    put_command = worker.publisher(keys.command(index))
    put_hub = worker.publisher(_to_hub(keys, index))
    own, answers = worker.measurement, worker.exchange

    def on_measurement(raw: bytes) -> None:
        own.messages += 1
        own.bytes += len(raw)
        put_hub(worker.payload)

    def on_answer(raw: bytes) -> None:
        put_command(worker.command)
        answers.messages += 1
        answers.bytes += len(raw)

    worker.subscribe(keys.measurement(index), on_measurement)
    worker.subscribe(_to_node(keys, index), on_answer)


def _hub(worker: Worker) -> None:
    """The hub: when all n messages are there, an answer to each node."""
    keys, nodes = worker.keys, worker.config.nodes
    answers = [worker.publisher(_to_node(keys, i)) for i in range(nodes)]
    tally = worker.exchange
    left = nodes

    def on_message(raw: bytes) -> None:
        nonlocal left
        tally.messages += 1
        tally.bytes += len(raw)
        left -= 1
        if not left:
            left = nodes
            for answer in answers:
                answer(worker.payload)

    for i in range(nodes):
        worker.subscribe(_to_hub(keys, i), on_message)


def _all_to_all(worker: Worker) -> None:
    """Every node to every other: the command leaves when measurement and n - 1 messages are there."""
    index, keys, nodes = worker.config.index, worker.keys, worker.config.nodes
    put_command = worker.publisher(keys.command(index))
    others = [worker.publisher(_to_node(keys, i)) for i in range(nodes) if i != index]
    own, exchange = worker.measurement, worker.exchange
    left = nodes

    def came() -> None:
        nonlocal left
        left -= 1
        if not left:
            left = nodes
            put_command(worker.command)

    def on_measurement(raw: bytes) -> None:
        own.messages += 1
        own.bytes += len(raw)
        for put in others:
            put(worker.payload)
        came()

    def on_message(raw: bytes) -> None:
        exchange.messages += 1
        exchange.bytes += len(raw)
        came()

    worker.subscribe(keys.measurement(index), on_measurement)
    worker.subscribe(_to_node(keys, index), on_message)


ROLES: dict[str, Callable[[Worker], None]] = {
    "bare": _bare,
    "star": _star,
    HUB: _hub,
    "all-to-all": _all_to_all,
}
