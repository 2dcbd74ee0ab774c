"""Where the processes of a run meet: unix sockets in a private directory, or ports, loopback's unless a
hosts file names other addresses.

First step of a start: the endpoints are chosen and checked here, before any process exists, so that
a taken port or directory is one clear message.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import shutil
import socket
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from supervise.hosts import LOWEST_PORT, Host, Hosts
from wire.child import remove_sockets
from wire.errors import UsageError

LONGEST_SOCKET_PATH = 107
"""Bytes of a unix socket's path on Linux, without the closing zero."""
LOWEST_FREE_PORT = 10_000
HIGHEST_FREE_PORT = 32_768
"""From here on the kernel hands ports to outgoing connections."""
LOOPBACK = "127.0.0.1"
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
    _made: bool = False
    """Whether it is there."""
    _lock: int = -1
    _created: Path | None = field(default=None)

    def make(self) -> None:
        """Make the private directory, if that was left for later; UsageError if it cannot be made."""
        if self.private is None or self._made:
            return
        directory = Path(self.private)
        try:
            directory.mkdir(mode=0o700)
            lock = _lock(directory)
        except OSError as error:
            reason = error.strerror or str(error)
            raise UsageError(
                f"{directory} for the run's sockets: {reason}; set TMPDIR to a directory that can be written"
            ) from None
        self._made, self._lock = True, -1 if lock is None else lock

    def close(self) -> None:
        """Remove every socket, and the directory if this run made it."""
        remove_sockets([self.plant, *self.nodes])
        if self.private is not None and self._made:
            with contextlib.suppress(
                OSError
            ):  # needs no descriptor, of which there may be none left
                os.rmdir(self.private)
            shutil.rmtree(self.private, ignore_errors=True)
        elif self._created is not None:
            with contextlib.suppress(OSError):  # somebody else put something there
                self._created.rmdir()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


def choose(
    nodes: int,
    transport: str,
    base_port: int | None,
    socket_dir: Path | None,
    *,
    tls: bool = False,
    later: bool = False,
) -> Endpoints:
    """Choose and check the endpoints of a run; UsageError names what is taken or unusable.

    `tls`: over TCP, with TLS on it, whatever `transport` says. `later`: a private directory is only named, and
    made by `Endpoints.make`: when there is a process that outlives this one and removes it.
    """
    if tls or transport == "tcp":
        if socket_dir is not None:
            raise UsageError("--socket-dir is for --transport unix; leave it out with tcp")
        endpoints = _tcp(nodes, base_port)
        return _with_tls(endpoints) if tls else endpoints
    if transport != "unix":
        raise UsageError(f"transport {transport!r}: expected 'unix' or 'tcp'")
    if base_port is not None:
        raise UsageError("--base-port is for --transport tcp; add it or leave the port out")
    if socket_dir is not None:
        return _given_directory(nodes, socket_dir)
    endpoints = _own_directory(nodes)
    if not later:
        endpoints.make()
    return endpoints


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
    directory = base / (PREFIX + secrets.token_hex(4))
    plant, own = _in_directory(directory, nodes)
    return Endpoints(plant, own, private=str(directory))


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
            if any(not _is_ours(entry) for entry in directory.iterdir()):
                continue  # somebody's own, which only has a name like it
            if (handle := _lock(directory)) is not None:
                shutil.rmtree(directory, ignore_errors=True)
                os.close(handle)
        except OSError:
            continue


def _is_ours(entry: Path) -> bool:
    return entry.is_socket() or entry.name.endswith(".lock")


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


# -- ports --------------------------------------------------------------------------------------


def port_taken(port: int, address: str = LOOPBACK) -> str | None:
    """Why this process cannot listen on a port of an address (0: on any), None if it can."""
    try:
        family, kind, _, _, target = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(target)
            probe.listen(1)
    except OSError as error:
        return error.strerror or str(error)
    return None


def check_live_port(port: int | None) -> None:
    """Raise UsageError if the live page cannot have the port that is asked for; None and 0 ask for any."""
    if port is not None and not 0 <= port <= 65_535:
        raise UsageError(
            f"--live-port: expected 0 (any that is free) or a port up to 65535, got {port}"
        )
    if port and (reason := port_taken(port)):
        raise UsageError(
            f"--live-port {port}: port {port} of {LOOPBACK} cannot be used ({reason}); give another or "
            "leave it out"
        )


def _free_base(count: int, address: str = LOOPBACK) -> int | None:
    """The first of so many free ports in a row, None if none were found.

    Not from `random`: two programs that seed it alike, side by side, would choose the same ports.
    """
    for _ in range(100):
        base = LOWEST_FREE_PORT + secrets.randbelow(HIGHEST_FREE_PORT - count - LOWEST_FREE_PORT)
        if not any(port_taken(port, address) for port in range(base, base + count)):
            return base
    return None


def _tcp(nodes: int, base_port: int | None) -> Endpoints:
    count = nodes  # the plant and nodes 0 .. n - 2
    if base_port is None:
        base = _free_base(count)
        if base is None:
            raise UsageError(
                f"--transport tcp: no {count} free loopback ports in a row below "
                f"{HIGHEST_FREE_PORT}; give --base-port or use --transport unix"
            )
        return _ports(base, nodes)
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
        _endpoint(LOOPBACK, base), [_endpoint(LOOPBACK, base + 1 + i) for i in range(nodes - 1)]
    )


def _with_tls(endpoints: Endpoints) -> Endpoints:
    """The same ports, spoken to in TLS."""
    plant, *nodes = (one.replace("tcp/", "tls/", 1) for one in (endpoints.plant, *endpoints.nodes))
    return replace(endpoints, plant=plant, nodes=nodes)


def _endpoint(address: str, port: int) -> str:
    return f"tcp/[{address}]:{port}" if ":" in address else f"tcp/{address}:{port}"


# -- hosts --------------------------------------------------------------------------------------


def over_hosts(hosts: Hosts, *, tls: bool = False) -> Endpoints:
    """The endpoints of a run over several hosts; UsageError names the key of what cannot be used.

    Only this machine's ports can be tried here; a node elsewhere says itself that it cannot listen.
    """
    last = hosts.hosts[-1].indices[-1]  # the tip has no right neighbour to listen for
    plant = _own_base(hosts, "plant", hosts.plant_address, hosts.plant_port, 1)
    used = {_endpoint(hosts.plant_address, plant): "the plant"}
    for host in hosts.hosts:
        base = _host_base(hosts, host, min(host.nodes, last - host.first), used)
        for offset, index in enumerate(host.indices[: last - host.first]):
            endpoint = _endpoint(host.address, base + offset)
            if endpoint in used:
                raise UsageError(
                    f"hosts file {hosts.path}: node {index} of host {host.name} and {used[endpoint]} "
                    f"would both listen on {endpoint}; give the host another base_port"
                )
            used[endpoint] = f"node {index}"
    own, *nodes = used
    endpoints = Endpoints(own, nodes)
    return _with_tls(endpoints) if tls else endpoints


def _host_base(hosts: Hosts, host: Host, count: int, used: dict[str, str]) -> int:
    if not host.local:
        assert host.base_port is not None  # set when the file was read
        return host.base_port
    where = f"host {host.name}"
    while True:
        base = _own_base(hosts, where, host.address, host.base_port, count)
        taken = {_endpoint(host.address, base + offset) for offset in range(count)}
        if host.base_port is not None or not taken & used.keys():
            return base


def _own_base(hosts: Hosts, where: str, address: str, base: int | None, count: int) -> int:
    """The first of `count` ports of an address of this machine, checked."""
    if reason := port_taken(0, address):
        raise UsageError(
            f"hosts file {hosts.path}: {where}: nothing can listen on {address} here ({reason}); give "
            "an address of this machine"
        )
    if base is None:
        base = _free_base(count, address)
        if base is None:
            raise UsageError(
                f"hosts file {hosts.path}: {where}: no {count} free ports in a row on {address} below "
                f"{HIGHEST_FREE_PORT}; free some, or give the first one in the file"
            )
        return base
    for port in range(base, base + count):
        if reason := port_taken(port, address):
            raise UsageError(
                f"hosts file {hosts.path}: {where}: port {port} of {address} cannot be used ({reason}); "
                "give another one, or leave it out"
            )
    return base
