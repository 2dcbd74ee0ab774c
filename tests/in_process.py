"""The command line in the test's own process, for speed: what is refused before a process would start."""

from __future__ import annotations

import signal
from pathlib import Path
from unittest import mock

import pytest

import launcher


def octarm(*arguments: str | Path) -> object:
    """The exit code of `octarm` with these arguments; the test's own handler of SIGTERM is put back."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        with (
            mock.patch("sys.argv", ["octarm", *map(str, arguments)]),
            pytest.raises(SystemExit) as end,
        ):
            launcher.main()
    finally:
        signal.signal(signal.SIGTERM, before)
    return end.value.code
