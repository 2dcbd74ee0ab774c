"""An intruder in a process of its own: floods a port until its standard input closes.

It prints "ready", reads a line of JSON, [LEAST, KIND, PORT] or [LEAST, "puts", PORT, KEYS, NAME, KEY], begins,
and prints "enough" when it has done LEAST times what it does.

`connections` opens and closes TCP connections, `handshakes` begins TLS without a certificate, `silence` opens
connections and says nothing, `puts` publishes on KEY with the certificate NAME of KEYS.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import ssl
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from bare_peer import BarePeer, client_context

MOST_OPEN = 200


def _open(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=1.0)


def connections(port: int) -> int:
    _open(port).close()
    return 1


def handshakes(port: int) -> int:
    context = client_context(None)
    with _open(port) as plain, contextlib.suppress(ssl.SSLError):
        context.wrap_socket(plain).recv(1)
    return 1


def silence(kept: list[socket.socket]) -> Callable[[int], int]:
    def one(port: int) -> int:
        kept.append(_open(port))
        if len(kept) > MOST_OPEN:
            kept.pop(0).close()
        return 1

    return one


def puts(peer: BarePeer, key: str) -> Callable[[int], int]:
    def some(_: int) -> int:
        peer.put(key, bytes(200), times=20)
        return 20

    return some


def main() -> None:
    os.nice(10)  # it is the flood that is tried, not who has the cores of one machine
    print("ready", flush=True)
    least, kind, number, *rest = json.loads(sys.stdin.readline())
    port = int(number)
    kept: list[socket.socket] = []
    kinds = {"connections": connections, "handshakes": handshakes, "silence": silence(kept)}
    if kind == "puts":
        kinds["puts"] = puts(BarePeer(port, client_context(Path(rest[0]), rest[1])), rest[2])
    act = kinds[kind]
    done: list[int] = []
    over = threading.Event()

    def go_on() -> None:
        while not over.is_set():
            with contextlib.suppress(OSError):
                done.append(act(port))

    # The other end answers a handshake when it likes: several are under way.
    threads = [threading.Thread(target=go_on) for _ in range(8 if kind == "handshakes" else 1)]
    for thread in threads:
        thread.start()
    while sum(done) < least and not select.select([sys.stdin], [], [], 0.02)[0]:
        pass
    print("enough" if sum(done) >= least else sum(done), flush=True)
    sys.stdin.read()
    over.set()
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    main()
