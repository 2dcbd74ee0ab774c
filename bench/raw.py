"""The chain over unix datagram sockets without Zenoh: what the machine itself allows.

A process has one bound socket, on which everything comes, and a connected one for each receiver. The
first byte of a datagram is its kind. A single thread waits in recv, answers, waits again.
"""

from __future__ import annotations

import contextlib
import gc
import signal
import socket
import struct
import time
from collections.abc import Sequence
from time import monotonic_ns

from bench.configs import DriverConfig, WorkerConfig
from bench.worker import Instants, Tally, counters, is_counters
from wire.child import Child, Deadline
from wire.errors import OctarmError
from wire.messages import encode_batch, encode_counters, run_tag
from wire.placement import place

MEASUREMENT, FORWARD, BACKWARD, COMMAND, STOP, REPORT, READY = b"MFBCSRA"
LARGEST = 200_000
"""Bytes of a datagram; the kernel's default limit is a little higher."""
POLL_S = 0.2
"""The driver looks this often whether it should stop."""
RETRY_S = 0.002


def path_of(endpoint: str) -> str:
    """The file of an endpoint of `supervise.endpoints`."""
    return endpoint.partition("/")[2]


def bound(path: str) -> socket.socket:
    """A datagram socket that receives at the path."""
    own = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    own.bind(path)
    return own


def dial(path: str, patience: Deadline) -> socket.socket:
    """A socket that sends to the path, as soon as somebody receives there; OctarmError if nobody does."""
    far = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * LARGEST)
    while not patience.passed:
        with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
            far.connect(path)
            return far
        time.sleep(RETRY_S)
    far.close()
    raise OctarmError(f"nobody receives at {path}")


def kind(number: int, raw: bytes) -> bytes:
    """The message with its first byte replaced by its kind: as many bytes as over Zenoh."""
    return bytes((number,)) + raw[1:]


def run_raw(config: WorkerConfig, child: Child) -> None:
    """The life of a raw worker; a signal ends it where it stands, the group removes its socket."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    links = config.links
    place(links.cpu, links.fifo, lambda text: child.status("note", text=text))
    index, last = config.index, config.nodes - 1
    own = bound(path_of(links.listen[0]))
    patience = Deadline(60.0)
    driver, *neighbours = (dial(path_of(endpoint), patience) for endpoint in links.connect)
    backward = neighbours[0] if index > 0 else None
    forward = neighbours[-1] if index < last else None
    driver.send(struct.pack("<BI", READY, index))
    _serve(config, own, driver, forward, backward)


def _serve(
    config: WorkerConfig,
    own: socket.socket,
    driver: socket.socket,
    forward: socket.socket | None,
    backward: socket.socket | None,
) -> None:
    command = kind(COMMAND, bytes(config.command_bytes))
    measurement, exchange, instants = Tally(), Tally(), Instants()
    if forward is None or backward is None:  # an end: which way its own sum goes
        start, to = (
            (kind(FORWARD, bytes(config.payload_bytes)), forward)
            if backward is None
            else (kind(BACKWARD, bytes(config.payload_bytes)), backward)
        )
    else:
        start, to = b"", None
    needed = 1 + (forward is not None) + (backward is not None)
    left = needed
    buffer = bytearray(LARGEST)
    view = memoryview(buffer)
    gc.collect()
    gc.freeze()
    gc.disable()
    while True:
        size = own.recv_into(buffer)
        at_ns = monotonic_ns()
        came = buffer[0]
        if came == MEASUREMENT:
            if to is not None:
                to.send(start)
                instants.measured.append(at_ns)
            measurement.messages += 1
            measurement.bytes += size
        elif came in (FORWARD, BACKWARD):
            put_on = forward if came == FORWARD else backward
            if put_on is not None:
                put_on.send(view[:size])
            else:
                instants.arrived.append(at_ns)
            exchange.messages += 1
            exchange.bytes += size
        elif came == STOP:
            _report(config, driver, instants, counters(measurement, exchange))
            continue
        else:
            continue
        left -= 1
        if not left:
            left = needed
            driver.send(command)


def _report(
    config: WorkerConfig, driver: socket.socket, instants: Instants, counted: dict[str, int]
) -> None:
    run, rows = run_tag(config.run_id), instants.rows(config.links.epoch_ns)
    step = (LARGEST - 1000) // 16
    for first in range(0, len(rows), step):
        batch = encode_batch(run, first, config.index, rows[first : first + step])
        driver.send(bytes((REPORT,)) + batch)
    driver.send(bytes((REPORT,)) + encode_counters(run, 0, config.index, counted))


class RawLinks:
    """The driver's side, with the surface of `bench.zenoh_links.ZenohLinks`."""

    def __init__(self, config: DriverConfig, child: Child) -> None:
        self._config = config
        self._child = child
        self.command = Tally()
        self._count = len(config.ports)
        self._own = bound(path_of(config.links.listen[0]))
        seconds = struct.pack("ll", 0, int(1e6 * POLL_S))
        self._own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, seconds)
        self._far: list[socket.socket] = []
        self._buffer = bytearray(LARGEST)

    def link(self) -> bool:
        """Wait until every worker is there; False if stopped before."""
        missing = set(self._config.members)
        while missing and not self._child.stopping:
            size = self._receive()
            if size and self._buffer[0] == READY:
                missing.discard(struct.unpack_from("<I", self._buffer, 1)[0])
        patience = Deadline(60.0)
        self._far = [dial(path_of(end), patience) for end in self._config.links.connect]
        return not missing

    def send(self, messages: Sequence[bytes]) -> int:
        """Send every port its measurement; returns the instant before the first, in ns."""
        started_ns = monotonic_ns()
        for far, raw in zip(self._far, messages, strict=True):
            far.send(raw)
        return started_ns

    def wrap(self, raw: bytes) -> bytes:
        """A measurement as it is sent."""
        return kind(MEASUREMENT, raw)

    def wait(self, limit_s: float) -> int:
        """Wait for every command; returns the instant of the last in ns, 0 if that does not happen."""
        left, limit = self._count, Deadline(limit_s)
        receive, buffer, tally = self._own.recv_into, self._buffer, self.command
        while left:
            try:
                size = receive(buffer)
            except BlockingIOError:
                if limit.passed or self._child.stopping:
                    return 0
                continue
            if buffer[0] == COMMAND:
                left -= 1
                tally.messages += 1
                tally.bytes += size
        complete_ns = monotonic_ns()
        return 0 if self._child.stopping else complete_ns

    def missing(self) -> str:
        """Who has not given its command, for a message."""
        return "some node"

    def drain(self) -> list[bytes]:
        """Records that have come: none before the end."""
        return []

    def finish(self, _stop: bytes, limit_s: float) -> list[bytes]:
        """Tell everybody to report; returns what came until all counters are there, or so long."""
        for far in self._far:
            far.send(bytes((STOP,)))
        out: list[bytes] = []
        limit = Deadline(limit_s)
        ends = 0
        while ends < self._count and not limit.passed and not self._child.stopping:
            size = self._receive()
            if size and self._buffer[0] == REPORT:
                raw = bytes(self._buffer[1:size])
                out.append(raw)
                ends += is_counters(raw)
        return out

    def _receive(self) -> int:
        try:
            return self._own.recv_into(self._buffer)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close every socket."""
        for one in (self._own, *self._far):
            one.close()
