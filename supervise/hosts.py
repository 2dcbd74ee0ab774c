"""Hosts files: which segments' nodes run on which machine, how they are started there, where they are reached.

Between the option --hosts and the plan. Without a file there is one host, this machine.
"""

from __future__ import annotations

import ipaddress
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import msgspec

from wire.errors import UsageError, shown
from wire.files import TEXT_BYTES, read_limited

REMOTE_BASE_PORT = 17_000
"""Of hosts whose ports cannot be tried from here."""
LOWEST_PORT = 1024
HIGHEST_PORT = 65_535
PRINT = "print"
"""In place of a start command: the user starts the nodes."""
DIRECTORY = "octarm"
PYTHON = ".venv/bin/python"
NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?")
WORD = re.compile(r"[A-Za-z0-9_@%+=:,./~-]+")
"""What a shell on the other host, which may see it, leaves as it is."""


class PlantTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """This machine: plant, recorder and launcher."""

    address: str
    port: int | None = None


class HostTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One host as the file describes it."""

    name: str
    address: str
    nodes: int
    start: str = ""
    directory: str | None = None
    python: str | None = None
    base_port: int | None = None
    same_clock: bool = False
    keys: str | None = None


class HostsFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of a hosts file."""

    plant: PlantTable
    hosts: tuple[HostTable, ...]


@dataclass(frozen=True)
class Host:
    """A machine with `nodes` consecutive segments from segment `first` on."""

    name: str
    address: str
    """Where its nodes listen, and where their neighbours dial them."""
    first: int
    nodes: int
    start: tuple[str, ...] = ()
    """Words before the command that starts the nodes; none: on this machine."""
    by_hand: bool = False
    directory: str = DIRECTORY
    python: str = PYTHON
    base_port: int | None = None
    """Of its first node; None: chosen among this machine's free ones."""
    same_clock: bool = False
    """Its monotonic clock is this machine's."""
    keys: str | None = None
    """Directory of its processes' keys there, from `directory` on; None: as on this machine."""

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise UsageError(
                f"name: expected letters, digits and . _ - between them, got {self.name!r}"
            )
        _check_address("address", self.address)
        if self.nodes < 1:
            raise UsageError(f"nodes: expected at least 1, got {shown(self.nodes)}")
        if self.nodes > HIGHEST_PORT:
            raise UsageError(f"nodes: expected at most {HIGHEST_PORT}, got {shown(self.nodes)}")
        for key, word in (("directory", self.directory), ("python", self.python)):
            if not WORD.fullmatch(word) or word.startswith("-"):
                raise UsageError(
                    f"{key}: a shell on the way must not change it; expected letters, digits and "
                    f"_@%+=:,./~- only, got {word!r}"
                )
        if self.base_port is not None:
            _check_port("base_port", self.base_port, self.nodes)

    @property
    def indices(self) -> range:
        """Its nodes."""
        return range(self.first, self.first + self.nodes)

    @property
    def local(self) -> bool:
        """Whether its nodes are this machine's own processes, forked by this launcher."""
        return not (self.start or self.by_hand)

    @property
    def own_clock(self) -> bool:
        """Whether nothing is known about its clock."""
        return not (self.local or self.same_clock)

    def zygote_command(self) -> list[str]:
        """What starts the zygote there: plain words, so that it is the same with and without a
        shell in between."""
        node = [self.python, "-m", "node", "--zygote", "--remote"]
        return [*self.start, "env", "-C", self.directory, *node]

    def hand_command(self, configuration: str) -> str:
        """What the user types there to start one node."""
        if self.local:
            return f"python -m node {configuration}"
        return f"cd {self.directory} && {self.python} -m node {configuration}"


@dataclass(frozen=True)
class Hosts:
    """All hosts of a run, in the order of their segments from the root on."""

    path: Path
    plant_address: str
    plant_port: int | None
    hosts: tuple[Host, ...]


def this_machine(nodes: int) -> Host:
    """The one host of a run without a hosts file."""
    return Host("this-machine", "127.0.0.1", 0, nodes)


def read_hosts(path: Path, nodes: int) -> Hosts:
    """The hosts in a file, for so many nodes.

    Raises UsageError naming the file, the key, what was expected and what was found.
    """
    try:
        table = msgspec.toml.decode(read_limited(path, TEXT_BYTES), type=HostsFile)
    except OSError as error:
        raise UsageError(
            f"--hosts {path}: {error.strerror or error}; give a hosts file, see examples/hosts.toml"
        ) from None
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError) as error:
        raise UsageError(f"hosts file {path}: {error}") from None
    try:
        return _hosts(path, table, nodes)
    except UsageError as error:
        raise UsageError(f"hosts file {path}: {error}") from None


def _hosts(path: Path, table: HostsFile, nodes: int) -> Hosts:
    _check_address("plant.address", table.plant.address)
    if table.plant.port is not None:
        _check_port("plant.port", table.plant.port, 1)
    hosts: list[Host] = []
    first = 0
    for number, entry in enumerate(table.hosts):
        try:
            host = _host(entry, first)
        except UsageError as error:
            raise UsageError(f"hosts[{number}].{error}") from None
        if any(host.name == other.name for other in hosts):
            raise UsageError(f"hosts[{number}].name: there is a host {host.name!r} already")
        hosts.append(host)
        first += host.nodes
    if first != nodes:
        counted = " + ".join(str(host.nodes) for host in hosts) or "0"
        raise UsageError(
            f"hosts: expected --nodes {nodes} nodes in all, got {counted} = {first}; change one of them"
        )
    return Hosts(path, table.plant.address, table.plant.port, tuple(hosts))


def _host(entry: HostTable, first: int) -> Host:
    try:
        start = tuple(shlex.split(entry.start))
    except ValueError as error:
        raise UsageError(f"start: {error} in {entry.start!r}") from None
    by_hand = start == (PRINT,)
    if not start:
        for key in ("directory", "python"):
            if getattr(entry, key) is not None:
                raise UsageError(
                    f"{key}: it is for a host that is started with words of its own; give start or "
                    "leave it out"
                )
    base_port = entry.base_port
    if base_port is None and start:
        base_port = REMOTE_BASE_PORT
    return Host(
        name=entry.name,
        address=entry.address,
        first=first,
        nodes=entry.nodes,
        start=() if by_hand else start,
        by_hand=by_hand,
        directory=DIRECTORY if entry.directory is None else entry.directory,
        python=PYTHON if entry.python is None else entry.python,
        base_port=base_port,
        same_clock=entry.same_clock,
        keys=entry.keys,
    )


def _check_address(key: str, address: str) -> None:
    try:
        number = ipaddress.ip_address(address)
    except ValueError:
        # A dotted number that is no address must not pass for a name.
        if NAME.fullmatch(address) and not re.fullmatch(r"[\d.]+", address):
            return
        raise UsageError(
            f"{key}: expected an IP address or a host's name without port, got {address!r}"
        ) from None
    if number.is_unspecified or number.is_multicast:
        raise UsageError(
            f"{key}: expected the address under which others reach this host, got {address!r}"
        )


def _check_port(key: str, port: int, count: int) -> None:
    highest = HIGHEST_PORT + 1 - count
    if not LOWEST_PORT <= port <= highest:
        raise UsageError(f"{key}: expected {LOWEST_PORT}..{highest}, got {shown(port)}")
