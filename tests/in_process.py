"""The command line in the test's own process, for speed: what is refused before a process would start."""

from __future__ import annotations

import signal
from pathlib import Path
from unittest import mock

import pytest

import launcher


def octarm(*arguments: str | Path) -> object:
    """The exit code of `octarm` with these arguments; the test's own handlers of signals are put back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with (
            mock.patch("sys.argv", ["octarm", *map(str, arguments)]),
            pytest.raises(SystemExit) as end,
        ):
            launcher.main()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return end.value.code
