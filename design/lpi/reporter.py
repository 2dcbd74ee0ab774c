"""What the engine says while it works: what it does, and the best certified answer so far.

The command line runs the engine in a process of its own and keeps the last of these answers, so that Ctrl-C, a
time limit or a crash within a solver loses nothing that was proven.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from design.lpi.result import Progress, Result, silent


def ignore(_: Result) -> None:
    """For those who want the final answer only."""


@dataclass(frozen=True)
class Reporter:
    """Serves wherever a `Progress` is expected."""

    text: Progress = silent
    best: Callable[[Result], None] = ignore
    """To be called with every certified result that is better than those before."""

    def __call__(self, text: str) -> None:
        """Say what is being done."""
        self.text(text)
