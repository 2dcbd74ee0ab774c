"""The frame of the command line: Ctrl-C at a bad moment."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_VERB = """
import time
from supervise.entry import serve

class Taken:
    def __del__(self):
        raise KeyboardInterrupt  # as if Ctrl-C came here

def work() -> int:
    Taken()
    time.sleep(20.0)
    return 0

def other() -> int:
    return 0

serve({"work": work, "other": other}, "octarm", "A test.")
"""


def test_an_interrupt_that_python_forgets_comes_again() -> None:
    """In a finaliser it is printed with a traceback, ignored, and lost."""
    done = subprocess.run(
        [sys.executable, "-c", _VERB, "work"],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=15,
    )
    assert (done.returncode, done.stderr) == (130, "octarm: interrupted\n")
