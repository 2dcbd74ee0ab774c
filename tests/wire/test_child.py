"""Status lines, control lines and waiting of a child process, over real pipes."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import pytest

from wire.child import LINE_LIMIT, ORPHAN_S, Child, Deadline, remove_sockets


@dataclass
class Pipes:
    child: Child
    control: int
    status: int

    def said(self) -> dict[str, object]:
        value = json.loads(os.read(self.status, 1 << 16))
        assert isinstance(value, dict)
        return value


@pytest.fixture
def pipes(tmp_path: Path) -> Iterator[Pipes]:
    control_read, control_write = os.pipe()
    status_read, status_write = os.pipe()
    child = Child("node 1", control=control_read, status=status_write, directory=str(tmp_path))
    child.watch(reads_control=True)
    yield Pipes(child, control_write, status_read)
    for fd in (control_read, control_write, status_read, status_write):
        try:
            os.close(fd)
        except OSError:
            continue
    child.close()


def test_control_lines_come_whole_and_in_order(pipes: Pipes) -> None:
    os.write(pipes.control, b'{"do":"start"}\n{"do":')
    assert pipes.child.wait(1.0) == [{"do": "start"}]
    os.write(pipes.control, b'"stop"}\n')
    assert pipes.child.wait(1.0) == [{"do": "stop"}]


def test_lines_behind_the_configuration_are_not_lost(pipes: Pipes) -> None:
    os.write(pipes.control, b'{"a":1}\n{"do":"start"}\n{"do":"stop"}\n')
    assert json.loads(pipes.child.configuration()) == {"a": 1}
    assert pipes.child.wait(1.0) == [{"do": "start"}, {"do": "stop"}]


def test_the_end_of_the_lifeline_is_noticed(pipes: Pipes, tmp_path: Path) -> None:
    (tmp_path / "socket").touch()
    os.close(pipes.control)
    assert pipes.child.wait(1.0) == []
    assert pipes.child.orphaned
    assert pipes.child.stopping
    pipes.child.leave([])
    assert not tmp_path.exists()
    assert 0 < signal.alarm(0) <= ORPHAN_S


def test_the_end_of_a_lifeline_that_is_a_socket_is_noticed_by_who_never_reads() -> None:
    """As behind sshd, whose socket carries both ways: only one of them ends."""
    near, far = socket.socketpair()
    with near, far:
        child = Child("node 1", control=near.fileno(), status=-1, directory=None)
        child.watch(reads_control=False)
        assert child.wait(0.0) == []
        assert not child.orphaned
        far.shutdown(socket.SHUT_WR)
        assert child.wait(1.0) == []
        assert child.orphaned
        child.close()
    signal.alarm(0)


def test_a_wake_up_from_another_thread_ends_the_wait(pipes: Pipes) -> None:
    thread = Thread(target=pipes.child.wake)
    deadline = Deadline(20.0)
    thread.start()
    assert pipes.child.wait(deadline.left) == []
    assert not deadline.passed
    thread.join()


def test_a_precise_wait_ends_for_the_same_reasons(pipes: Pipes) -> None:
    ever_ns = 20 * 10**9
    os.write(pipes.control, b'{"do":"start"}\n{"do":')
    assert pipes.child.wait_precisely(ever_ns) == [{"do": "start"}]
    assert pipes.child.wait_precisely(0) == []
    assert pipes.child.wait_precisely(-5) == []
    os.write(pipes.control, b'"stop"}\n')
    assert pipes.child.wait_precisely(ever_ns) == [{"do": "stop"}]
    pipes.child.wake()
    assert pipes.child.wait_precisely(ever_ns) == []
    assert not pipes.child.stopping


def test_a_precise_wait_takes_its_time(pipes: Pipes) -> None:
    began_ns = time.monotonic_ns()
    assert pipes.child.wait_precisely(3_200_000) == []
    assert time.monotonic_ns() - began_ns >= 3_200_000


def test_a_precise_wait_gives_lines_that_were_read_before(pipes: Pipes) -> None:
    os.write(pipes.control, b'{"a":1}\n{"do":"start"}\n{"do":"stop"}\n')
    assert json.loads(pipes.child.configuration()) == {"a": 1}
    assert pipes.child.wait_precisely(20 * 10**9) == [{"do": "start"}, {"do": "stop"}]


def test_the_end_of_the_lifeline_ends_a_precise_wait_once(pipes: Pipes) -> None:
    """After it, waiting takes its time again: the process still has things to end."""
    os.close(pipes.control)
    assert pipes.child.wait_precisely(20 * 10**9) == []
    assert pipes.child.orphaned
    assert pipes.child.stopping
    began_ns = time.monotonic_ns()
    assert pipes.child.wait_precisely(2_000_000) == []
    assert time.monotonic_ns() - began_ns >= 2_000_000
    assert 0 < signal.alarm(0) <= ORPHAN_S


def test_a_child_without_a_lifeline_waits_precisely_for_wake_ups_only() -> None:
    """A standard input that has something to read is not its lifeline."""
    read, write = os.pipe()
    os.write(write, b"not for the child")
    standard_input = os.dup(0)
    os.dup2(read, 0)
    child = Child("node 1", control=-1, status=-1, directory=None)
    try:
        began_ns = time.monotonic_ns()
        assert child.wait_precisely(2_000_000) == []
        assert time.monotonic_ns() - began_ns >= 2_000_000
        child.wake()
        assert child.wait_precisely(20 * 10**9) == []
    finally:
        os.dup2(standard_input, 0)
        for fd in (read, write, standard_input):
            os.close(fd)
        child.close()


def test_status_lines_fit_into_one_write(pipes: Pipes) -> None:
    pipes.child.status("failed", message="x" * 100_000, tick=3)
    line = os.read(pipes.status, 1 << 20)
    assert len(line) <= LINE_LIMIT + 1
    said = json.loads(line)
    assert (said["from"], said["event"], said["tick"]) == ("node 1", "failed", 3)
    pipes.child.status("waiting", missing=["y" * 100] * 1000)
    assert pipes.said() == {"from": "node 1", "event": "waiting", "missing": ["y" * 100] * 25}


def test_sockets_and_their_locks_are_removed(tmp_path: Path) -> None:
    for name in ("node0", "node0.lock", "other"):
        (tmp_path / name).touch()
    remove_sockets([f"unixsock-stream/{tmp_path}/node0", "tcp/127.0.0.1:9"])
    assert [p.name for p in tmp_path.iterdir()] == ["other"]


def test_a_launcher_that_does_not_read_holds_nobody_up(pipes: Pipes) -> None:
    for tick in range(5000):  # four times what the pipe takes
        pipes.child.status("progress", tick=tick)
    said = b""
    while not said.endswith(b"}\n") or b"4999" not in said:
        piece = os.read(pipes.status, 1 << 16)
        said += piece
        pipes.child.status("progress", tick=4999)
    ticks = [json.loads(line)["tick"] for line in said.splitlines()]
    assert ticks[:100] == [*range(100)]
    assert len(ticks) < 5000


_CHILD = """
import os, sys
from wire.child import Child, die_with_parent
die_with_parent(int(sys.argv[1]))
child = Child("node 1", control=0, status=1, directory=sys.argv[2])
child.install(reads_control=True)
child.status("up")
while not child.stopping:
    child.wait(None)
assert os.getppid() == int(sys.argv[1])
child.leave([])
"""
_DYING_PARENT = """
import ctypes, os, subprocess, sys, threading
pipe = subprocess.PIPE
command = [sys.executable, "-c", sys.argv[1], str(os.getpid()), sys.argv[2]]
child = subprocess.Popen(command, stdin=pipe, stdout=pipe)
child.stdout.readline()
def last():
    os.write(1, b"ended %d" % child.wait(20))
    os._exit(0)
threading.Thread(target=last).start()
ctypes.CDLL(None).syscall(60 if os.uname().machine == "x86_64" else 93, 0)  # exit, of one thread
"""


def test_a_launcher_whose_last_thread_still_lives_is_dead(tmp_path: Path) -> None:
    """Its first thread can be gone before the others: it is still the parent, the lifeline open."""
    private = tmp_path / "private"
    private.mkdir()
    (private / "plant").touch()
    done = subprocess.run(
        [sys.executable, "-c", _DYING_PARENT, _CHILD, str(private)],
        capture_output=True,
        timeout=30,
        check=False,
    )
    assert (done.stdout, done.stderr) == (b"ended 0", b"")
    assert not private.exists()
