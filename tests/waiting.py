"""Waiting for something to become true, and no longer than it may take."""

from __future__ import annotations

import time
from collections.abc import Callable


def until(
    true: Callable[[], object],
    seconds: float,
    what: str = "it did not happen in time",
    every_s: float = 0.01,
) -> None:
    """Look again and again; AssertionError says what is amiss after so many seconds."""
    limit = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < limit, what
        time.sleep(every_s)
