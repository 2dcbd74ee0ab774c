"""Ctrl-C and SIGTERM while a run is going on: counted, and seen at once by whoever waits for file descriptors.

For `supervise.conductor`, which decides what the first, the second and the third of them mean.
"""

from __future__ import annotations

import os
import signal
from typing import Any


class Interrupts:
    """The signals of the user from `begin` to `end`; `close` it when nobody waits any more."""

    def __init__(self) -> None:
        self.count = 0
        self.wakes, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        """A file descriptor that can be read when a signal has come; see `woken`."""
        self._old_wakeup = -1
        self._old_handlers: dict[signal.Signals, Any] = {}

    def begin(self) -> None:
        """Count from now on; only in a process's main thread."""
        self._old_wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._old_handlers = {
            number: signal.signal(number, self._on_signal)
            for number in (signal.SIGINT, signal.SIGTERM)
        }

    def woken(self) -> None:
        """Take from `wakes` what a signal has left there."""
        try:
            os.read(self.wakes, 4096)
        except BlockingIOError:
            return

    def end(self) -> None:
        """Whoever heard the signals before hears them again."""
        signal.set_wakeup_fd(self._old_wakeup)
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)

    def close(self) -> None:
        """Close both ends."""
        os.close(self.wakes)
        os.close(self._write)

    def _on_signal(self, *_: object) -> None:
        self.count += 1
