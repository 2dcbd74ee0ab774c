"""The node process of a replay: forked from a zygote as in a run, watched, and gone at the end.

Below `supervise.replay_peer`, which speaks to it over Zenoh; here is what goes through pipes and signals.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
from collections.abc import Callable
from typing import IO, Self

from supervise.children import Handle, Process, ending, module
from wire.child import Deadline
from wire.config_json import dumps
from wire.run_config import NodeConfig

GRACE_S = 1.0
"""The node ends when it is told; after so long it is made to."""


class Turns:
    """What one thread waits for: files, and a word from other threads."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self.watch(self._read, self._woken)

    def close(self) -> None:
        """Give the files back."""
        self._selector.close()
        os.close(self._read)
        os.close(self._write)

    def watch(self, file: int, act: Callable[[], None]) -> None:
        """Call this when the file can be read."""
        self._selector.register(file, selectors.EVENT_READ, act)

    def forget(self, file: int) -> None:
        """Do not watch it any more."""
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(file)

    def turn(self, seconds: float) -> None:
        """Wait for something to happen and handle it."""
        for key, _ in self._selector.select(seconds):
            act: Callable[[], None] = key.data
            act()

    def wake(self) -> None:
        """End the wait; from any thread, before `close`."""
        with contextlib.suppress(BlockingIOError):  # full of wake-ups already
            os.write(self._write, b"w")

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._read, 4096)


class StartedNode:
    """The node process, forked from a zygote as in a run. Leaving it leaves no process behind."""

    def __init__(self, config: NodeConfig, errors: IO[bytes], turns: Turns) -> None:
        self._config = config
        self._errors = errors
        directory = config.links.directory
        command = ["--zygote", "--parent", str(os.getpid())]
        command += ["--directory", directory] if directory is not None else []
        self._zygote = Process("zygote", module("node", *command), errors)
        self._turns = turns
        self.node: Handle | None = None
        self.ready = False
        self.waits_for: list[str] = []
        self.ended: str | None = None
        """How it ended, once it has."""
        self.failure: str | None = None
        """What it said to be wrong."""

    def __enter__(self) -> Self:
        self._turns.watch(self._zygote.status, self._hear)
        self._zygote.tell(dumps(self._config))
        return self

    def __exit__(self, *_: object) -> None:
        if self.node is not None:
            self._end(self.node)
            self.node.close()
        with contextlib.suppress(OSError):  # it is gone, and did not read what it was told
            self._zygote.control.close()  # its lifeline
        self._end(self._zygote)
        self._turns.forget(self._zygote.status)
        self._zygote.reap()
        self._zygote.close()

    def _end(self, handle: Handle) -> None:
        """Ask it to end, then make it."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            handle.signal(number)
            limit = Deadline(GRACE_S)
            while handle.alive and not limit.passed:
                self._turns.turn(0.02)

    def last_words(self) -> str:
        """The last line that it wrote to standard error, if any."""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return f"; it wrote: {said[-1]}" if said else ""

    def _hear(self) -> None:
        lines = self._zygote.lines()
        if lines is None:
            self._turns.forget(self._zygote.status)
            self.ended = self.ended or ending(self._zygote.reap())
            return
        for line in lines:
            match line["event"]:
                case "born":
                    self.node = Handle("node", line["pid"], parent=self._zygote.pid)
                case "ready":
                    self.ready = True
                case "waiting":
                    self.waits_for = line["missing"]
                case "failed":
                    self.failure = line["message"]
                case "died":
                    self.ended = ending(line["code"])
