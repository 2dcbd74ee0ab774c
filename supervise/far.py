"""Hosts that nodes run on besides this machine: the start command of each, and what is known of its nodes.

Between the conductor and the zygote there (node.zygote). Its pipes go through the start command, ssh for
example; a process number there means nothing here, so its nodes are known by what the zygote says and end
with it.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections import deque
from time import monotonic
from typing import IO, Any

from supervise.children import FarNode, Process
from supervise.hosts import Host
from supervise.status_line import status_of
from wire.errors import UsageError

BEAT_S = 5.0
"""A zygote that has not heard from here for much longer takes the launcher for lost (node.zygote)."""
SHOWN_LINES = 3
"""Last words of a host that a message repeats."""


class FarZygote(Process):
    """The start command of one host, and so the zygote at its other end."""

    def __init__(self, host: Host, log: IO[bytes]) -> None:
        self.host = host
        try:
            super().__init__(
                f"host {host.name}", host.zygote_command(), subprocess.PIPE, directory=None
            )
        except OSError as error:
            raise UsageError(
                f"host {host.name}: start: {host.start[0]!r} cannot be run ({error.strerror})"
            ) from None
        if self._popen.stderr is None:
            raise RuntimeError("the pipe of a start command's errors is missing")
        self.errors = self._popen.stderr.fileno()
        self._log: IO[bytes] | None = log
        self._last_words: deque[str] = deque(maxlen=SHOWN_LINES)
        self._sent_at = monotonic()
        self._known = {"zygote", *(f"node {index}" for index in host.indices)}
        self.nodes: list[FarNode] = []
        self.up = False
        """Whether the zygote there has answered."""
        for descriptor in (self.errors, self.control.fileno()):
            os.set_blocking(descriptor, False)

    # -- to the host --------------------------------------------------------------------------------

    def tell(self, line: str) -> None:
        """Take one line for the host; `push` writes it, as far as the way there has room."""
        self._unsent += line.encode() + b"\n"

    def push(self) -> bool:
        """Write what has room, without waiting; whether all of it went."""
        before = len(self._unsent)
        done = super().push()
        if len(self._unsent) < before:
            self._sent_at = monotonic()
        return done

    @property
    def owed(self) -> bool:
        """Nothing is sent before somebody reads there."""
        return self.up and super().owed

    def beat(self) -> None:
        """Say from time to time that the launcher lives."""
        if not (self._unsent or self.control.closed) and monotonic() - self._sent_at > BEAT_S:
            self._unsent = b"\n"
            self.push()
            self._unsent = b""  # without room now: another beat comes

    def let_go(self) -> None:
        """Close the control pipe: everything that was started there ends."""
        self._unsent = b""
        with contextlib.suppress(OSError):
            self.control.close()

    # -- from the host ------------------------------------------------------------------------------

    def _status(self, line: bytes) -> dict[str, Any] | None:
        """That of the zygote or one of its nodes; anything else, a greeting for example, is logged."""
        status = status_of(line)
        if status is None or status["from"] not in self._known:
            return None
        if status["from"] == "zygote":
            status["from"] = self.name
        return status

    def read_errors(self) -> bool:
        """Log what the start command and the processes there wrote to standard error; False at the end."""
        try:
            data = os.read(self.errors, 1 << 16)
        except BlockingIOError:
            return True
        for line in data.splitlines():
            self._note(line)
        return bool(data)

    def _note(self, line: bytes) -> None:
        if text := line.decode(errors="replace").strip():
            self._last_words.append(text)
        super()._note(line)

    @property
    def last_words(self) -> str:
        """The end of what was said on standard error, for a message; empty if nothing was."""
        return f" (last said: {' | '.join(self._last_words)})"[:500] if self._last_words else ""

    # -- its nodes ----------------------------------------------------------------------------------

    def adopt(self, name: str, _pid: int, /) -> FarNode:
        """A node that the zygote there has forked."""
        node = FarNode(name)
        self.nodes.append(node)
        return node

    def close(self) -> None:
        """Close the pipes of a start command that has ended."""
        if self._popen.stderr is not None:
            self._popen.stderr.close()
        super().close()
