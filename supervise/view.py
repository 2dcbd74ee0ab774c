"""What the user sees while a run goes on: a progress bar on a terminal, an occasional line
elsewhere.

Fed by the conductor; writes to standard error only, so that standard output stays free for the
result.
"""

from __future__ import annotations

import sys
from time import monotonic
from types import TracebackType
from typing import Self

PLAIN_EVERY_S = 5.0


class View:
    """Shows nothing: the view of `--quiet`, and the base of the others."""

    def __init__(self, ticks: int) -> None:
        self._ticks = ticks
        self._tick = 0
        self._figures = ""
        self._first: tuple[float, int] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def note(self, text: str) -> None:
        """Say one thing."""

    def say(self, text: str) -> None:
        """Say one thing that is asked for even where progress is not."""
        print(text, file=sys.stderr, flush=True)

    def progress(self, tick: int) -> None:
        """The plant has done this many ticks."""
        now = monotonic()
        if self._first is None:
            self._first = (now, tick)
        self._tick = tick
        self.draw(now)

    def errors(self, tip_error_m: float, estimation_error: float | None) -> None:
        """Latest figures: the tip's error, and the estimate's in the energy norm, share of the first."""
        self._figures = f"tip error {tip_error_m * 1e3:.3g} mm"
        if estimation_error is not None:
            self._figures += f", estimation error {estimation_error:.2%}"

    def rate(self, now: float) -> float:
        """Ticks a second since the first report."""
        if self._first is None or now <= self._first[0]:
            return 0.0
        return (self._tick - self._first[1]) / (now - self._first[0])

    def draw(self, now: float) -> None:
        """Show the state."""

    def close(self) -> None:
        """Nothing more will come."""


class PlainView(View):
    """A line now and then, for logs and pipes."""

    _shown_at = 0.0

    def note(self, text: str) -> None:
        """Say one thing."""
        print(text, file=sys.stderr, flush=True)

    def draw(self, now: float) -> None:
        """Print the state, not too often."""
        if now - self._shown_at >= PLAIN_EVERY_S and self._figures:
            self._shown_at = now
            self.note(
                f"tick {self._tick} of {self._ticks}, {self.rate(now):.0f} ticks/s, {self._figures}"
            )


class TerminalView(View):
    """A progress bar with live rate and errors."""

    def __init__(self, ticks: int) -> None:
        super().__init__(ticks)
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[state]}"),
            console=Console(stderr=True),
            auto_refresh=False,  # no thread: the conductor's loop draws
        )
        self._task = self._progress.add_task("run", total=ticks, state="")
        self._progress.start()

    def say(self, text: str) -> None:
        """Say one thing above the bar."""
        self.note(text)

    def note(self, text: str) -> None:
        """Say one thing above the bar."""
        self._progress.console.print(text, highlight=False, markup=False)

    def draw(self, now: float) -> None:
        """Draw the bar."""
        state = f"{self.rate(now):.0f} ticks/s, {self._figures}" if self._figures else ""
        self._progress.update(self._task, completed=self._tick, state=state)
        self._progress.refresh()

    def close(self) -> None:
        """Leave the bar as it is."""
        self._progress.stop()


def choose_view(ticks: int, *, quiet: bool) -> View:
    """The view that fits where standard error goes."""
    if quiet:
        return View(ticks)
    return TerminalView(ticks) if sys.stderr.isatty() else PlainView(ticks)
