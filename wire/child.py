"""The manners of a child process: status lines to the launcher, stop signals, and no life after the
launcher.

A child writes one JSON object a line to its standard output; the launcher holds the other end. Its
standard input is the lifeline: when it is closed, the launcher is gone and the child ends. Linux's
parent-death signal does the same for a parent that dies without a word; it is SIGHUP, which nobody
else sends, so that it cannot be taken for the launcher's own request to end.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import shutil
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

ORPHANED = signal.SIGHUP
"""What the kernel sends when the parent dies. By then `getppid` may still name it: a parent of many
threads is not gone before its last one is."""
HELD_BACK = frozenset({signal.SIGINT, ORPHANED})
"""Blocked by the launcher in every child, until the child can handle them."""
_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_SELECT_FILES = 1024
"""`select` knows no file beyond this number."""
PASSING = ("progress", "writing")
"""Status lines that the next one replaces: left out while nobody reads, rather than waited with."""
LINE_LIMIT = 4000
"""Bytes of a status line: writes up to 4096 bytes (PIPE_BUF) by many processes never mix."""


_parent: int | None = None
"""Who started this process, where that matters."""


def die_with_parent(parent: int, directory: str | None = None) -> None:
    """Ask the kernel for `ORPHANED` when the parent dies; if it is dead already, end at once and leave no
    private directory."""
    global _parent  # noqa: PLW0603 - of this process, as the kernel has it
    _parent = parent
    signal.signal(ORPHANED, signal.SIG_DFL)  # `nohup` would have it ignored
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, ORPHANED, 0, 0, 0)
    if os.getppid() != parent:
        if directory is not None:
            shutil.rmtree(directory, ignore_errors=True)
        raise SystemExit(0)


def name_process(name: str) -> None:
    """Name shown by `ps` and `top` (15 characters)."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def send_status(fd: int, name: str, event: str, **fields: Any) -> None:
    """Write one status line; a launcher that is gone is not an error here (the lifeline tells)."""
    line = json.dumps({"from": name, "event": event, **fields}, allow_nan=False).encode()
    for most in (1500, 250, 40):  # a character has up to twelve bytes in JSON
        if len(line) <= LINE_LIMIT:
            break
        short = {k: _shortened(v, most) for k, v in fields.items()}
        line = json.dumps({"from": name, "event": event, **short}).encode()
    try:
        os.write(fd, line + b"\n")
    except OSError:
        return


def _shortened(value: Any, most: int) -> Any:
    """The beginning of a text or of a list of texts: no field is missing in a line that must be short."""
    if isinstance(value, list):
        return [_shortened(one, most) for one in value[: most // 10]]
    return value[:most] if isinstance(value, str) else value


def _orders(lines: list[bytes]) -> list[dict[str, Any]]:
    """The orders in control lines; what is none is said on standard error, which the launcher keeps."""
    out = []
    for line in lines:
        try:
            order = json.loads(line)
        except (ValueError, RecursionError):
            order = None
        if isinstance(order, dict) and isinstance(order.get("do"), str):
            out.append(order)
        else:
            print(f"not an order: {line[:200]!r}", file=sys.stderr, flush=True)
    return out


ORPHAN_S = 8
"""A child that finds the launcher dead ends within so many seconds."""


class Child:
    """What the main thread of a node, plant or recorder waits on: lifeline, signals, wake-ups,
    time.

    `name` is how the launcher calls the process ("node 3"); `directory` the run's private
    directory, which a child that finds the launcher dead removes (whoever is last succeeds).
    """

    def __init__(self, name: str, *, control: int, status: int, directory: str | None) -> None:
        self.name = name
        self.stopping = False
        """Set by SIGINT, SIGTERM or the end of the lifeline."""
        self.orphaned = False
        """Set when the launcher is gone."""
        self.directory = directory
        self._status = status
        self._control = control
        self._buffer = b""
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._poll = select.poll()
        self._poll.register(self._read, select.POLLIN)

    def install(self, *, reads_control: bool) -> None:
        """Install signal handlers and watch the lifeline; `reads_control`: lines come on it too."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        if _parent is not None:
            signal.signal(ORPHANED, self._on_orphaned)
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, HELD_BACK)  # the launcher blocked them
        self.watch(reads_control=reads_control)

    def watch(self, *, reads_control: bool) -> None:
        """Watch the lifeline without touching the process's signals."""
        if self._control >= 0:
            # A lifeline that is a socket (sshd's) ends half first: only POLLRDHUP tells who never reads.
            self._poll.register(self._control, select.POLLIN if reads_control else select.POLLRDHUP)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.stopping = True

    def _on_orphaned(self, _number: int, _frame: FrameType | None) -> None:
        self._end_alone()

    def wake(self) -> None:
        """End the main thread's wait; callable from any thread."""
        try:
            os.write(self._write, b"w")
        except BlockingIOError:
            return  # the pipe is full of wake-ups already

    def wait(self, seconds: float | None) -> list[dict[str, Any]]:
        """Wait for a wake-up, a signal, the lifeline or the time; returns the control messages that
        came."""
        return _orders(self.wait_lines(seconds))

    def wait_precisely(self, nanoseconds: int) -> list[dict[str, Any]]:
        """The same as `wait` with a time that is not rounded up to milliseconds."""
        *lines, self._buffer = self._buffer.split(b"\n")
        if not lines:
            watched = [self._read]
            if self._control >= 0 and not self.orphaned:
                watched.append(self._control)
            seconds = max(0, nanoseconds) * 1e-9
            if max(watched) >= _SELECT_FILES:  # then milliseconds must do
                lines = self.wait_lines(seconds)
            elif select.select(watched, (), (), seconds)[0]:
                lines = self.wait_lines(0.0)
        return _orders(lines)

    def wait_lines(self, seconds: float | None) -> list[bytes]:
        """The same with the control lines as they came."""
        timeout = None if seconds is None else max(0, int(seconds * 1000 + 0.999))
        *out, self._buffer = self._buffer.split(b"\n")
        if out:
            timeout = 0
        for fd, event in self._poll.poll(timeout):
            if fd == self._read:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._read, 4096)
            elif event & select.POLLIN:
                out += self._control_lines()
            elif event & (select.POLLHUP | select.POLLRDHUP | select.POLLERR | select.POLLNVAL):
                self._lost()
        return out

    def _control_lines(self) -> list[bytes]:
        data = os.read(self._control, 1 << 20)
        if not data:
            self._lost()
            return []
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return lines

    def _lost(self) -> None:
        self._poll.unregister(self._control)
        self._end_alone()

    def _end_alone(self) -> None:
        signal.alarm(ORPHAN_S)  # whatever the end may hang on
        self.orphaned = True
        self.stopping = True

    def configuration(self) -> bytes:
        """The first line of the control pipe, waited for; SystemExit if the launcher goes before it
        came."""
        while b"\n" not in self._buffer:
            piece = os.read(self._control, 1 << 20)
            if not piece:
                raise SystemExit(0)
            self._buffer += piece
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line

    def status(self, event: str, **fields: Any) -> None:
        """Tell the launcher. One that is stopped lets the pipe run full: no tick may wait for it."""
        if event in PASSING and not self._heard():
            return
        send_status(self._status, self.name, event, **fields)

    def _heard(self) -> bool:
        """Whether a status line can be written without waiting."""
        poll = select.poll()
        poll.register(self._status, select.POLLOUT)
        return bool(poll.poll(0))

    def move_status(self) -> int:
        """Give standard output to somebody else; returns where status lines go from now on."""
        self._status = os.dup(self._status)
        return self._status

    def status_on(self, descriptor: int) -> None:
        """Send status lines there."""
        self._status = descriptor

    def close(self) -> None:
        """Give the wake-up pipe back."""
        os.close(self._read)
        os.close(self._write)

    def leave(self, endpoints: list[str]) -> None:
        """Remove this process's sockets, and the whole private directory if the launcher is
        dead."""
        self.orphaned = self.orphaned or (_parent is not None and os.getppid() != _parent)
        remove_sockets(endpoints)
        if self.orphaned and self.directory is not None:
            shutil.rmtree(self.directory, ignore_errors=True)


def remove_sockets(endpoints: list[str]) -> None:
    """Remove the files of unix socket endpoints: the socket and Zenoh's lock beside it."""
    for endpoint in endpoints:
        protocol, _, path = endpoint.partition("/")
        if protocol == "unixsock-stream":
            for file in (path, path + ".lock"):
                Path(file).unlink(missing_ok=True)


class Deadline:
    """A point on the monotonic clock."""

    def __init__(self, seconds: float) -> None:
        self.at = time.monotonic() + seconds

    @property
    def left(self) -> float:
        """Seconds until it, zero when passed."""
        return max(0.0, self.at - time.monotonic())

    @property
    def passed(self) -> bool:
        """Whether it is over."""
        return time.monotonic() >= self.at
