"""What the processes of a run have open: unix sockets, or ports of this machine's loopback, nothing else."""

from __future__ import annotations

import signal
import socket
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from security_runs import keys_made
from sockets import Socket, sockets_of

if TYPE_CHECKING:
    from conftest import Start

ENDLESS = ("--nodes", "3", "--ticks", "1000000", "--no-plot")
OURS = {
    "octarm-plant",
    "octarm-recorder",
    "octarm-zygote",
    "octarm-node0",
    "octarm-node1",
    "octarm-node2",
}


def all_sockets(start: Start, *options: str | Path) -> dict[str, list[Socket]]:
    """Of every process of a run in the middle of it, by the process's name."""
    cli = start.run(*ENDLESS, *options)
    cli.wait_for("tick ")
    found = {name: sockets_of(pid) for name, pid in cli.processes().items()}
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert found.keys() > OURS
    return found


def test_the_list_of_sockets_has_every_kind(tmp_path: Path) -> None:
    """Or nothing could be told from what is not in it."""
    import os

    with (
        socket.create_server(("127.0.0.1", 0)) as tcp,
        socket.socket(socket.AF_INET6, socket.SOCK_STREAM) as tcp6,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.socket(socket.AF_UNIX) as unix,
        socket.socket(socket.AF_NETLINK, socket.SOCK_RAW) as other,
    ):
        tcp6.bind(("::", 0))
        tcp6.listen()
        udp.bind(("0.0.0.0", 0))
        unix.bind(str(tmp_path / "s"))
        unix.listen()
        found = sockets_of(os.getpid())
        assert Socket("tcp", f"127.0.0.1:{tcp.getsockname()[1]}", True) in found
        assert Socket("tcp", f":::{tcp6.getsockname()[1]}", True) in found
        assert Socket("udp", f"0.0.0.0:{udp.getsockname()[1]}") in found
        assert Socket("unix", str(tmp_path / "s"), True) in found
        assert Socket("other", os.readlink(f"/proc/self/fd/{other.fileno()}")) in found


def test_by_default_there_are_unix_sockets_only(start: Start) -> None:
    found = all_sockets(start)
    assert {one.kind for sockets in found.values() for one in sockets} == {"unix"}
    (private,) = {
        Path(one.local).parent for sockets in found.values() for one in sockets if one.listening
    }
    assert private.name.startswith("octarm-")
    listening = {name for name, sockets in found.items() if any(s.listening for s in sockets)}
    assert listening == {"octarm-plant", "octarm-node0", "octarm-node1"}


@pytest.mark.parametrize("secured", [False, True])
def test_over_tcp_only_the_loopback_is_used(start: Start, tmp_path: Path, secured: bool) -> None:
    keys = ["--keys", keys_made(tmp_path / "keys", 3)] if secured else ["--transport", "tcp"]
    found = all_sockets(start, *keys)
    everything = [one for sockets in found.values() for one in sockets]
    assert {one.kind for one in everything} == {"tcp"}  # no UDP: nobody is looked for
    assert {str(one.address) for one in everything} == {"127.0.0.1"}
    listening = {
        name: sum(one.listening for one in sockets)
        for name, sockets in found.items()
        if any(one.listening for one in sockets)
    }
    assert listening == {"octarm-plant": 1, "octarm-node0": 1, "octarm-node1": 1}
