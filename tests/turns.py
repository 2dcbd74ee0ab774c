"""Tests that take all cores for seconds run while no test of real processes does.

The workers of pytest-xdist know nothing of each other. A flood at real-time priority beside a run with a period
of 40 ms makes that run's ticks late, which is right and not what its test asks for.
"""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def turn(folder: Path, *, alone: bool) -> Iterator[None]:
    """Hold a turn in this folder, which the workers share: together with others, or alone.

    Whoever waits to be alone keeps the door, so that nobody new comes in before it; the kernel gives both locks
    back if the worker dies.
    """
    with (folder / "room.lock").open("w") as room:
        with (folder / "door.lock").open("w") as door:
            fcntl.flock(door, fcntl.LOCK_EX)
            fcntl.flock(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        yield
