"""Pipes and pidfds of all children of a run in one selector: what they say, and that they have ended.

Between the processes (`supervise.children`, `supervise.far`) and the conductor, which is told and decides. All
of it happens in `turn`, on the thread that calls it.
"""

from __future__ import annotations

import contextlib
import selectors
from collections.abc import Callable
from functools import partial
from typing import Any

from supervise.children import Process
from supervise.far import FarZygote


class Pipes:
    """What is followed: processes, and files that somebody else reads."""

    def __init__(
        self,
        said: Callable[[Process, dict[str, Any]], None],
        ended: Callable[[Process, int | None], None],
    ) -> None:
        """`said` is called with each status line, `ended` once with the exit code, after the last words."""
        self._said = said
        self._ended = ended
        self._selector = selectors.DefaultSelector()
        self._followed: list[Process] = []
        self._far: list[FarZygote] = []

    def watch(self, file: int, act: Callable[[], None]) -> None:
        """Call `act` whenever a file can be read."""
        self._selector.register(file, selectors.EVENT_READ, act)

    def follow(self, process: Process) -> None:
        """Read what a process says, see its end, and write what it is told as it has room."""
        process.queue()
        self._followed.append(process)
        self._selector.register(process.status, selectors.EVENT_READ, lambda: self._read(process))
        self._selector.register(process, selectors.EVENT_READ, lambda: self._gone(process))

    def follow_far(self, far: FarZygote) -> None:
        """The same of another host; its standard error is read as well, and it hears a beat."""
        self._far.append(far)
        self.follow(far)
        self.watch(far.errors, lambda: self._read_errors(far))

    def turn(self, seconds: float) -> None:
        """Wait for something to happen and handle it."""
        for process in self._followed:
            if process.owed:
                with contextlib.suppress(KeyError):  # it is waited for already
                    self._selector.register(
                        process.control, selectors.EVENT_WRITE, partial(self._push, process)
                    )
        for key, _ in self._selector.select(seconds):
            act: Callable[[], None] = key.data
            act()
        for far in self._far:
            far.beat()

    def forget(self, process: Process) -> None:
        """Follow a process no more."""
        if process in self._followed:
            self._followed.remove(process)
        for item in (process, process.status, process.control, getattr(process, "errors", -1)):
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(item)

    def let_go(self, far: FarZygote) -> None:
        """Close a host's control pipe: everything that was started there ends."""
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(far.control)
        far.let_go()

    def close(self) -> None:
        """Give the selector back."""
        self._selector.close()

    def _push(self, process: Process) -> None:
        if process.push():
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(process.control)

    def _read_errors(self, far: FarZygote) -> None:
        if not far.read_errors():
            self._selector.unregister(far.errors)

    def _gone(self, process: Process) -> None:
        """A direct child has ended: read its last words."""
        self._read(process)
        code = process.reap()
        try:
            self._selector.unregister(process)
        except KeyError:
            return
        self._ended(process, code)

    def _read(self, process: Process) -> None:
        lines = process.lines()
        if lines is None:
            with contextlib.suppress(KeyError):
                self._selector.unregister(process.status)
            return
        for line in lines:
            self._said(process, line)
