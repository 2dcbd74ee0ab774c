"""A TCP link to somebody who reads nothing any more is closed without anybody waiting for it."""

from __future__ import annotations

import signal
import socket
import struct
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

from supervise.endpoints import choose
from wire import session as zsession

ROOT = Path(__file__).resolve().parents[2]
LEASE_MS = 1000
_READER = f"""
import sys, time
from wire import session as zsession
session = zsession.open_session("client", (), (sys.argv[1],), lease_ms={LEASE_MS})
heard = session.declare_subscriber("records", zsession.direct(lambda raw: None))
print("up", flush=True)
time.sleep(60)
"""

_EXHAUSTED = """
import os, resource, socket, struct
from wire.linger import end_lingering
one = socket.socket()
one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
resource.setrlimit(resource.RLIMIT_NOFILE, (one.fileno() + 1, one.fileno() + 1))
try:
    os.listdir("/proc/self/fd")
except OSError:
    print(end_lingering(), struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0])
"""


def _lingers() -> list[bool]:
    """Of every TCP connection of this process, whether closing it may take time."""
    found = []
    for name in Path("/proc/self/fd").iterdir():
        try:
            one = socket.socket(fileno=int(name.name))
        except OSError:
            continue
        try:
            if one.family == socket.AF_INET and one.type == socket.SOCK_STREAM:
                value = one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)
                found.append(struct.unpack("ii", value)[0] != 0)
        finally:
            one.detach()
    return found


def test_a_frozen_peer_whose_lease_is_over_stops_nobody_else() -> None:
    """The library would stand still for ten seconds."""
    endpoint = choose(2, "tcp", None, None).plant
    router = zsession.open_session("router", (endpoint,), ())
    other = zsession.open_session("client", (), (endpoint,))
    came: list[float] = []
    heard = other.declare_subscriber(
        "ticks", zsession.direct(lambda _: came.append(time.monotonic()))
    )
    records, ticks = (
        zsession.telemetry_publisher(router, "records"),
        zsession.control_publisher(router, "ticks"),
    )
    command = [sys.executable, "-c", _READER, endpoint]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as reader:
        try:
            assert reader.stdout is not None
            reader.stdout.readline()
            limit = time.monotonic() + 20.0
            while not (zsession.matched(records) and zsession.matched(ticks)):
                assert time.monotonic() < limit
                time.sleep(0.01)
            links = _lingers()
            assert len(links) >= 3 and not any(links)  # two at the router, one at the client
            reader.send_signal(signal.SIGSTOP)
            end = time.monotonic() + 4.0 * LEASE_MS * 1e-3
            while time.monotonic() < end:
                records.put(bytes(30_000))  # more than socket and queue take
                ticks.put(b"tick")
                time.sleep(0.005)
            assert not zsession.matched(records), "its lease is not over yet"
            limit = time.monotonic() + 20.0
            while came[-1] < end - 0.1 and time.monotonic() < limit:
                time.sleep(0.01)
        finally:
            reader.kill()
            del heard
            other.close()
            router.close()
    gaps = [after - before for before, after in pairwise(came)]
    assert max(gaps) < 2.0


def test_without_a_descriptor_left_it_is_done_all_the_same() -> None:
    """In a process of its own, whose limit is lowered."""
    done = subprocess.run(
        [sys.executable, "-c", _EXHAUSTED], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "1 0\n")
