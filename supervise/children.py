"""One child process of a run: started in a session of its own, spoken to in JSON lines, watched by
its pidfd.

Between the conductor, which decides, and the operating system. Signals go through pidfds, so that a
number that the system has given to somebody else is never hit.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from supervise.status_line import LONGEST, status_of
from wire.child import HELD_BACK

PYTHON_ROOT = Path(__file__).resolve().parent.parent


class Handle:
    """A process that this run started, directly or through the zygote, by pidfd."""

    def __init__(self, name: str, pid: int, parent: int) -> None:
        self.name = name
        self.pid = pid
        self._fd = -1
        with contextlib.suppress(OSError):
            self._fd = os.pidfd_open(pid)
        # The number may have passed to a stranger before it was opened: then it has another parent.
        if _parent_of(pid) != parent:
            self.close()

    def fileno(self) -> int:
        """The pidfd: readable when the process has ended; -1 if it is gone."""
        return self._fd

    @property
    def alive(self) -> bool:
        """Whether the process still runs."""
        return not self.wait(0.0)

    @property
    def has_ended(self) -> bool:
        """Whether the process was seen to end: not so if the pidfd was given back, or there never was one."""
        return self._fd >= 0 and self.wait(0.0)

    def wait(self, seconds: float | None = None) -> bool:
        """Wait for the end, None: as long as it takes; whether it has come."""
        if self._fd < 0:
            return True
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        return bool(poll.poll(None if seconds is None else 1e3 * seconds))

    def signal(self, number: signal.Signals) -> None:
        """Send a signal; nothing happens if the process has ended."""
        if self._fd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._fd, number)

    def close(self) -> None:
        """Give the pidfd back."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class FarNode:
    """A node on another host, known by hearsay: no signal reaches it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.alive = True

    def close(self) -> None:
        """It is gone, or nobody knows any more."""
        self.alive = False


class Process(Handle):
    """A direct child with pipes for control and status, usually a Python module of this project."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        errors: IO[bytes] | int,
        directory: Path | None = PYTHON_ROOT,
    ) -> None:
        environment = dict(os.environ)
        environment["OPENBLAS_NUM_THREADS"] = "1"
        environment["PYTHONUNBUFFERED"] = "1"
        # They wait until the child has its handlers: no half-loaded module is interrupted.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, HELD_BACK)
        try:
            self._popen = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                cwd=directory,
                env=environment,
                start_new_session=True,  # Ctrl-C is for the launcher alone
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        super().__init__(name, self._popen.pid, os.getpid())
        if self._popen.stdin is None or self._popen.stdout is None:
            raise RuntimeError("a pipe to a child is missing")
        self.control = self._popen.stdin
        self.status = self._popen.stdout.fileno()
        self._partial = b""
        self._unsent = b""
        self._queues = False
        self._log = None if isinstance(errors, int) else errors
        os.set_blocking(self.status, False)

    def queue(self) -> None:
        """From now on nobody waits for a child that does not read: what its pipe has no room for is owed."""
        self._queues = True
        os.set_blocking(self.control.fileno(), False)

    @property
    def owed(self) -> bool:
        """Whether something that the child was told waits for `push`."""
        return bool(self._unsent) and not self.control.closed

    def push(self) -> bool:
        """Write what has room, without waiting; whether all of it went."""
        try:
            written = os.write(self.control.fileno(), self._unsent)
            self._unsent = self._unsent[written:]
        except BlockingIOError:
            pass
        except (BrokenPipeError, ValueError):  # its end is noticed elsewhere
            self._unsent = b""
        return not self._unsent

    def tell(self, line: str) -> None:
        """Write one line to the child; a child that is gone is noticed elsewhere."""
        if self._queues:
            self._unsent += line.encode() + b"\n"
            self.push()
            return
        try:
            self.control.write(line.encode() + b"\n")
            self.control.flush()
        except (BrokenPipeError, ValueError):
            return

    def order(self, **message: Any) -> None:
        """Write one control message to the child."""
        self.tell(json.dumps(message))

    def lines(self) -> list[dict[str, Any]] | None:
        """Status lines that have come; None at the end of the pipe."""
        try:
            data = os.read(self.status, 1 << 20)
        except BlockingIOError:
            return []
        if not data:
            return None
        return list(self._said(data))

    def _said(self, data: bytes) -> Iterator[dict[str, Any]]:
        """The status lines that are complete with these bytes; anything else that was written is logged."""
        *whole, self._partial = (self._partial + data).split(b"\n")
        if len(self._partial) > LONGEST:  # and so is what never ends
            whole.append(self._partial)
            self._partial = b""
        for line in whole:
            status = self._status(line)
            if status is None:
                self._note(line)
            else:
                yield status

    def _status(self, line: bytes) -> dict[str, Any] | None:
        """The status in a line; None if it is none."""
        return status_of(line)

    def _note(self, line: bytes) -> None:
        if self._log is not None:
            self._log.write(f"{self.name}: ".encode() + line[:LONGEST] + b"\n")
            self._log.flush()

    def adopt(self, name: str, pid: int, /) -> Handle | FarNode:
        """The handle of a process that this one has forked."""
        return Handle(name, pid, parent=self.pid)

    def reap(self) -> int | None:
        """The exit code once the process has ended (minus the signal's number), else None."""
        return self._popen.poll()

    def close(self) -> None:
        """Close pipes and pidfd of a process that has ended."""
        for pipe in (self._popen.stdin, self._popen.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        super().close()


def module(name: str, *arguments: str) -> list[str]:
    """The command that runs a module of this project."""
    return [sys.executable, "-m", name, *arguments]


def _parent_of(pid: int) -> int | None:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    return int(stat.rpartition(")")[2].split()[1])


def ending(code: int | None) -> str:
    """How a process ended, in words."""
    if code is None:
        return "is gone"
    if code < 0:
        with contextlib.suppress(ValueError):  # a real-time signal has no name
            return f"was ended by {signal.Signals(-code).name}"
        return f"was ended by signal {-code}"
    return f"exited with code {code}"
