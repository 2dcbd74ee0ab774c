"""Where the processes of a run meet: unix sockets in a private directory, or loopback ports.

First step of a start: the endpoints are chosen and checked here, before any process exists, so that
a taken port or directory is one clear message.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import random
import shutil
import socket
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from wire.child import remove_sockets
from wire.errors import UsageError

LONGEST_SOCKET_PATH = 107
"""Bytes of a unix socket's path on Linux, without the closing zero."""
HIGHEST_FREE_PORT = 32_768
"""From here on the kernel hands ports to outgoing connections."""
LOWEST_PORT = 1024
PREFIX = "octarm-"
STALE_AFTER_S = 60.0
SPECIAL = "?#;,"
"""Characters that have a meaning in a Zenoh endpoint."""


@dataclass
class Endpoints:
    """The listening addresses of a run; `close` leaves nothing of them behind."""

    plant: str
    nodes: list[str]
    """Of nodes 0 .. n - 2; the tip node has no right neighbour to listen for."""
    private: str | None = None
    """Directory made for this run alone."""
    _lock: int = -1
    _created: Path | None = field(default=None)

    def close(self) -> None:
        """Remove every socket, and the directory if this run made it."""
        remove_sockets([self.plant, *self.nodes])
        if self.private is not None:
            shutil.rmtree(self.private, ignore_errors=True)
        elif self._created is not None:
            with contextlib.suppress(OSError):  # somebody else put something there
                self._created.rmdir()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def choose(nodes: int, transport: str, base_port: int | None, socket_dir: Path | None) -> Endpoints:
    """Choose and check the endpoints of a run; UsageError names what is taken or unusable."""
    if transport == "tcp":
        if socket_dir is not None:
            raise UsageError("--socket-dir is for --transport unix; leave it out with tcp")
        return _tcp(nodes, base_port)
    if transport != "unix":
        raise UsageError(f"transport {transport!r}: expected 'unix' or 'tcp'")
    if base_port is not None:
        raise UsageError("--base-port is for --transport tcp; add it or leave the port out")
    return _own_directory(nodes) if socket_dir is None else _given_directory(nodes, socket_dir)


# -- unix sockets -------------------------------------------------------------------------------


def _in_directory(directory: Path, nodes: int) -> tuple[str, list[str]]:
    return (
        f"unixsock-stream/{directory}/plant",
        [f"unixsock-stream/{directory}/node{i}" for i in range(nodes - 1)],
    )


def _longest(directory: Path, nodes: int) -> int:
    return len(os.fsencode(f"{directory}/node{nodes}.lock"))


def _own_directory(nodes: int) -> Endpoints:
    base = Path(tempfile.gettempdir())
    too_long = _longest(base / (PREFIX + "xxxxxxxx"), nodes) > LONGEST_SOCKET_PATH
    if too_long or any(character in str(base) for character in SPECIAL):
        base = Path("/tmp")
    _sweep(base)
    directory = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))  # mode 0700
    lock = _lock(directory)
    plant, own = _in_directory(directory, nodes)
    return Endpoints(plant, own, private=str(directory), _lock=-1 if lock is None else lock)


def _lock(directory: Path) -> int | None:
    """Hold the directory for this process's life; None if another process holds it."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        return None
    return handle


def _sweep(base: Path) -> None:
    """Remove what a run left whose processes were all killed at once: its directory is not
    locked."""
    for directory in base.glob(PREFIX + "*"):
        try:
            facts = directory.lstat()
            if facts.st_uid != os.getuid() or time.time() - facts.st_mtime < STALE_AFTER_S:
                continue
            if (handle := _lock(directory)) is not None:
                shutil.rmtree(directory, ignore_errors=True)
                os.close(handle)
        except OSError:
            continue


def _given_directory(nodes: int, directory: Path) -> Endpoints:
    directory = directory.absolute()
    if _longest(directory, nodes) > LONGEST_SOCKET_PATH:
        raise UsageError(
            f"--socket-dir {directory}: too long, a socket's path has at most "
            f"{LONGEST_SOCKET_PATH} bytes; give a shorter one or leave it out"
        )
    if any(character in str(directory) for character in SPECIAL):
        raise UsageError(
            f"--socket-dir {directory}: a socket's path may not contain any of {SPECIAL!r}; give "
            "another or leave it out"
        )
    created = not directory.exists()
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        lock = _lock(directory)
        entries = sorted(entry.name for entry in directory.iterdir())
        usable = os.access(directory, os.W_OK | os.X_OK)
    except OSError as error:
        reason = "not a directory" if error.errno == errno.EEXIST else error.strerror
        raise UsageError(
            f"--socket-dir {directory}: {reason}; give a directory that can be written"
        ) from None
    if lock is None:
        raise UsageError(
            f"--socket-dir {directory}: in use by another run; give another or leave it out"
        )
    if entries or not usable:
        os.close(lock)
        reason = f"not empty, there is {entries[0]!r}" if entries else "cannot be written"
        raise UsageError(
            f"--socket-dir {directory}: {reason}; give an empty directory or leave it out"
        )
    plant, own = _in_directory(directory, nodes)
    return Endpoints(plant, own, _lock=lock, _created=directory if created else None)


# -- loopback ports -----------------------------------------------------------------------------


def port_taken(port: int) -> str | None:
    """Why this process cannot listen on a loopback port, None if it can."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
            probe.listen(1)
        except OSError as error:
            return error.strerror or str(error)
    return None


def _tcp(nodes: int, base_port: int | None) -> Endpoints:
    count = nodes  # the plant and nodes 0 .. n - 2
    if base_port is None:
        for _ in range(100):
            base = random.randrange(10_000, HIGHEST_FREE_PORT - count)
            if not any(port_taken(port) for port in range(base, base + count)):
                return _ports(base, nodes)
        raise UsageError(
            f"--transport tcp: no {count} free loopback ports in a row below "
            f"{HIGHEST_FREE_PORT}; give --base-port or use --transport unix"
        )
    if not LOWEST_PORT <= base_port <= 65_536 - count:
        raise UsageError(
            f"--base-port {base_port}: expected {LOWEST_PORT}..{65_536 - count} for {nodes} nodes"
        )
    for port in range(base_port, base_port + count):
        if reason := port_taken(port):
            raise UsageError(
                f"--base-port {base_port}: port {port} of 127.0.0.1 cannot be used ({reason}); "
                f"{count} ports in a row are needed, give another base or leave it out"
            )
    return _ports(base_port, nodes)


def _ports(base: int, nodes: int) -> Endpoints:
    return Endpoints(
        f"tcp/127.0.0.1:{base}", [f"tcp/127.0.0.1:{base + 1 + i}" for i in range(nodes - 1)]
    )
