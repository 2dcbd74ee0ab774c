"""Sockets and ports that somebody else has, before and after the check, and what dead runs left."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from ports import free_ports
from waiting import until

from chaos.aftermath import Expected
from supervise.endpoints import STALE_AFTER_S, port_taken

if TYPE_CHECKING:
    from conftest import Start

FOUR = ("--nodes", "4", "--no-plot")


@pytest.mark.parametrize("offset", [0, 2])
def test_taken_port_is_refused_before_the_start(start: Start, offset: int) -> None:
    base = free_ports(4)
    with socket.create_server(("127.0.0.1", base + offset)):
        cli = start.run(*FOUR, "--ticks", "20", "--transport", "tcp", "--base-port", str(base))
        said = (
            rf"--base-port {base}: port {base + offset} of 127.0.0.1 cannot be used "
            r"\(Address already in use\); 4 ports in a row are needed, give another base",
        )
        cli.ends(Expected((2,), said=said, recording=False))


@pytest.mark.parametrize(("offset", "who"), [(0, "plant"), (2, "node 1")])
def test_port_taken_between_the_check_and_the_use(start: Start, offset: int, who: str) -> None:
    """The launcher is stopped when it has checked (its log is there) and before its processes listen."""
    base = free_ports(4)
    cli = start.run(
        *(*FOUR, "--ticks", "20", "--transport", "tcp", "--base-port", str(base), "--out", "out")
    )
    until((cli.work / "out" / "processes.log").exists, 30.0, every_s=0.0005)
    os.kill(cli.popen.pid, signal.SIGSTOP)  # it cannot have started who must load modules first
    port = base + offset
    with contextlib.ExitStack() as stack:
        assert port_taken(port) is None, "too late: it listens already"
        stack.enter_context(socket.create_server(("127.0.0.1", port)))
        os.kill(cli.popen.pid, signal.SIGCONT)
        said = (
            rf"start-up failed: {who}: cannot listen on tcp/127.0.0.1:{port} of .*: "
            r"Address already in use; free the port or choose another"
            if who != "plant"
            else rf"start-up failed: cannot listen on tcp/127.0.0.1:{port} of .*: Address already in",
        )
        cli.ends(Expected((5,), said=said, recording=False))


def test_page_port_taken_is_refused(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        cli = start.run(*FOUR, "--ticks", "20", "--live", "--live-port", str(port))
        said = (
            rf"--live-port {port}: port {port} of 127.0.0.1 cannot be used \(Address already in use",
        )
        cli.ends(Expected((2,), said=said, recording=False))


def test_socket_directory_in_use_by_a_run_is_refused(start: Start, tmp_path: Path) -> None:
    shared = tmp_path / "s"
    first = start.run(*FOUR, "--ticks", "1000000", "--socket-dir", shared)
    first.wait_for("tick ")
    second = start.run(*FOUR, "--ticks", "20", "--socket-dir", shared)
    said = (rf"--socket-dir {shared}: in use by another run; give another or leave it out",)
    second.ends(Expected((2,), said=said, recording=False))
    first.popen.send_signal(signal.SIGINT)
    first.ends(Expected((130,)))
    assert not shared.exists()


def test_socket_file_of_a_dead_run_is_refused_where_a_user_chose_the_place(
    start: Start, tmp_path: Path
) -> None:
    """Nothing that this program did not make itself is deleted."""
    shared = tmp_path / "s"
    shared.mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(shared / "plant"))
    cli = start.run(*FOUR, "--ticks", "20", "--socket-dir", shared)
    said = (rf"--socket-dir {shared}: not empty, there is 'plant'; give an empty directory or",)
    cli.ends(Expected((2,), said=said, recording=False))
    assert (shared / "plant").is_socket()


def test_directory_of_a_run_that_was_killed_at_once_goes_with_the_next(start: Start) -> None:
    first = start.run(*FOUR, "--ticks", "1000000")
    first.wait_for_records()
    for pid in sorted(first.processes().values(), key=first.popen.pid.__ne__):  # the launcher first
        os.kill(pid, signal.SIGSTOP)
    for pid in first.processes().values():
        os.kill(pid, signal.SIGKILL)
    first.finish()
    (left,) = first.sockets.iterdir()
    assert {path.name for path in left.iterdir()} >= {"plant", "node0"}
    old = time.time() - 2 * STALE_AFTER_S
    os.utime(left, (old, old))
    second = start.run(*FOUR, "--ticks", "20", within=("env", f"TMPDIR={first.sockets}"))
    second.ends(Expected(ticks=20))
    assert list(first.sockets.iterdir()) == []
