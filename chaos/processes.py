"""The processes of a run as seen from outside: whatever carries its mark in the environment.

Before and after a fault: who is there to be hit, and who is still there when nobody should be. Children inherit
the environment, so that a mark finds what pids and names would miss: orphans, and processes that were renamed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

MARK = "OCTARM_TEST_RUN"
"""Environment variable that tells the processes of one run from all others."""


@dataclass(frozen=True)
class Living:
    """A process that has not ended; a zombie has."""

    pid: int
    name: str
    """As `ps` shows it: "octarm-node3"."""
    stopped: bool
    """By SIGSTOP: it lives, but does nothing."""

    def __str__(self) -> str:
        return f"{self.name} (pid {self.pid}{', stopped' if self.stopped else ''})"


def marked(mark: str) -> dict[str, str]:
    """What to add to the environment of a run so that `living` finds it."""
    return {MARK: mark}


def living(mark: str) -> list[Living]:
    """Every living process whose environment has the mark, by number."""
    wanted = f"{MARK}={mark}".encode()
    found = []
    for directory in Path("/proc").iterdir():
        if not directory.name.isdigit():
            continue
        with contextlib.suppress(OSError):  # it ended while it was looked at, or is another user's
            if wanted not in (directory / "environ").read_bytes().split(b"\0"):
                continue
            state = (directory / "stat").read_text().rpartition(")")[2].split()[0]
            if state not in "ZX":
                name = (directory / "comm").read_text().strip()
                found.append(Living(int(directory.name), name, state in "Tt"))
    return sorted(found, key=lambda process: process.pid)


def outliving(mark: str, seconds: float) -> list[Living]:
    """Processes that are still there after so long; none as soon as none is."""
    limit = time.monotonic() + seconds
    while (left := living(mark)) and time.monotonic() < limit:
        time.sleep(0.01)
    return left


def end_all(mark: str) -> None:
    """End by force what is left of a run."""
    for process in living(mark):
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGKILL)
