"""Every socket of a process, as the kernel has it, and the ports on which the processes of a run listen."""

from __future__ import annotations

import contextlib
import ipaddress
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LISTEN = "0A"


@dataclass(frozen=True)
class Socket:
    """One socket."""

    kind: str
    """tcp, udp, unix, or a name of the kernel for anything else."""
    local: str
    """Address and port, or path."""
    listening: bool = False

    @property
    def address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
        return ipaddress.ip_address(self.local.rpartition(":")[0])

    @property
    def port(self) -> int:
        return int(self.local.rpartition(":")[2])


def sockets_of(pid: int) -> list[Socket]:
    """All of them: a socket in none of the kernel's lists is of kind "other"."""
    known = _known(pid)
    found = []
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            target = os.readlink(descriptor)
            if target.startswith("socket:["):
                found.append(known.get(target[8:-1], Socket("other", target)))
    return found


def port_of(pid: int) -> int:
    """The one TCP port that a process listens on."""
    (port,) = {one.port for one in sockets_of(pid) if one.kind == "tcp" and one.listening}
    return port


def _known(pid: int) -> dict[str, Socket]:
    """By inode: everything in the lists of the process's network namespace."""
    found = {}
    for name in (
        "tcp",
        "tcp6",
        "udp",
        "udp6",
        "udplite",
        "udplite6",
        "raw",
        "raw6",
        "icmp",
        "icmp6",
    ):
        for words in _lines(pid, name):
            found[words[9]] = Socket(name.removesuffix("6"), _decoded(words[1]), words[3] == LISTEN)
    for words in _lines(pid, "unix"):
        path = words[7] if len(words) > 7 else ""
        found[words[6]] = Socket("unix", path, words[3] == "00010000")
    return found


def _lines(pid: int, name: str) -> Iterator[list[str]]:
    path = Path(f"/proc/{pid}/net/{name}")
    if path.exists():
        for line in path.read_text().splitlines()[1:]:
            yield line.split()


def _decoded(text: str) -> str:
    """The kernel writes addresses as 32-bit words in the machine's order."""
    number, _, port = text.partition(":")
    words = [bytes.fromhex(number[i : i + 8])[::-1] for i in range(0, len(number), 8)]
    return f"{ipaddress.ip_address(b''.join(words))}:{int(port, 16)}"
