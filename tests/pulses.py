"""A process that is stopped again and again: for faults, and for runs that are not to be over soon."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time


class Pulses:
    """A process that is stopped again and again, as one that has too little of its core."""

    def __init__(
        self, pid: int, stopped_s: float, running_s: float, most: int | None = None
    ) -> None:
        """`most` stops, or as many as there are until `end`."""
        self.stops = 0
        self._pid, self._stopped_s, self._running_s, self._most = pid, stopped_s, running_s, most
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._pulse)
        self._thread.start()

    def _pulse(self) -> None:
        with contextlib.suppress(ProcessLookupError):  # it has ended: so be it
            while not self._over.is_set() and self.stops != self._most:
                os.kill(self._pid, signal.SIGSTOP)
                time.sleep(self._stopped_s)
                os.kill(self._pid, signal.SIGCONT)
                self.stops += 1
                time.sleep(self._running_s)

    def wait(self) -> None:
        """Until all stops have been."""
        self._thread.join()

    def end(self) -> None:
        """No more stops; the process runs."""
        self._over.set()
        self._thread.join()
