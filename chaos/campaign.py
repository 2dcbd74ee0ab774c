"""A campaign: cases handed to two workers at a time until the time is over or enough faults were injected.

Between the command line and `chaos.worker`, whose processes do the cases; results go to `chaos.report`. It
decides nothing about a case, and whatever ends it, its workers and their runs end as well.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from chaos.report import facts_of, table
from supervise.children import Process, ending, module
from supervise.own_directory import claim, tidy
from wire.child import Deadline
from wire.errors import ExitCode, OctarmError, UsageError

SIDE_BY_SIDE = 2
"""Runs at a time: that two stand side by side is part of what is tried."""
MOST_MINUTES = 24 * 60.0
LOG = "workers.log"
END_S = 8.0
"""A worker that is told to stop ends its run first."""
FINISH_S = 180.0
"""For the cases that are going on when the time is over."""


@dataclass(frozen=True)
class ChaosOptions:
    """Checked when made; the command line explains each."""

    seed: int = 1
    minutes: float = 5.0
    faults: int | None = None
    only: int | None = None
    out: Path | None = None

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise UsageError(f"--seed: expected a whole number from 0 on, got {self.seed}")
        if not 0.0 < self.minutes <= MOST_MINUTES:
            raise UsageError(
                f"--minutes: expected more than 0 and at most {MOST_MINUTES:g}, got {self.minutes!r}"
            )
        if self.faults is not None and self.faults < 1:
            raise UsageError(f"--faults: expected at least 1, got {self.faults}")
        if self.only is not None and self.only < 0:
            raise UsageError(f"--only: expected the number of a case, 0 or more, got {self.only}")


@dataclass(frozen=True)
class Done:
    """A campaign that came to its end, or as far as it came."""

    facts: dict[str, Any]
    table: str
    exit_code: ExitCode
    message: str
    """What is wrong, or why it ended early; empty if it is well."""


class Campaign:
    """The cases of one campaign; `results` grow as they are done."""

    def __init__(
        self, options: ChaosOptions, out: Path, log: IO[bytes], progress: Callable[[str], None]
    ) -> None:
        self.results: list[dict[str, Any]] = []
        self._options = options
        self._out = out
        self._log = log
        self._progress = progress
        self._selector = selectors.DefaultSelector()
        self._workers: dict[Process, dict[str, list[Any]]] = {}
        """With the parts of the result that is coming."""
        self._busy: set[Process] = set()
        self._next = 0 if options.only is None else options.only
        self._until = Deadline(60.0 * options.minutes)
        self._began = time.monotonic()
        self._told = 0.0

    def run(self) -> None:
        """Do the cases; OctarmError if a worker fails. Leaves no process behind."""
        count = SIDE_BY_SIDE if self._options.only is None else 1
        try:
            for number in range(count):
                self._start(number)
            last = Deadline(60.0 * self._options.minutes + FINISH_S)
            while self._wants_more() or self._busy:
                if last.passed:
                    raise OctarmError("a case did not end: see the directory of the campaign")
                for key, _ in self._selector.select(1.0):
                    self._hear(key.data)
        finally:
            self._end()

    def _start(self, number: int) -> None:
        command = module("chaos.worker", str(os.getpid()))
        worker = Process(f"worker {number}", command, self._log)
        self._workers[worker] = {"hits": [], "wrong": []}
        self._selector.register(worker.status, selectors.EVENT_READ, worker)

    def _wants_more(self) -> bool:
        options = self._options
        if options.only is not None:
            return self._next == options.only
        enough = options.faults is not None and self.faults >= options.faults
        return not (enough or self._until.passed)

    @property
    def faults(self) -> int:
        """Injected so far."""
        return sum(1 for result in self.results for hit in result["hits"] if not hit["curtain"])

    def _hear(self, worker: Process) -> None:
        lines = worker.lines()
        if lines is None:
            code = None if not worker.wait(END_S) else worker.reap()
            raise OctarmError(f"{worker.name} {ending(code)}; see {self._out / LOG}")
        for line in lines:
            match line["event"]:
                case "part":
                    self._workers[worker][line["of"]].append(line["item"])
                case "done":
                    parts = self._workers[worker]
                    self._workers[worker] = {"hits": [], "wrong": []}
                    self._busy.discard(worker)
                    self._take({**line["result"], **parts})
                    self._order(worker)
                case "up":
                    self._order(worker)
                case "failed":
                    raise OctarmError(f"{worker.name}: {line['message']}; see {self._out / LOG}")

    def _order(self, worker: Process) -> None:
        if not self._wants_more():
            return
        worker.order(
            seed=self._options.seed,
            number=self._next,
            out=str(self._out),
            keep=self._options.only is not None,
        )
        self._next += 1
        self._busy.add(worker)

    def _take(self, result: dict[str, Any]) -> None:
        self.results.append(result)
        for text in result["wrong"]:
            self._progress(f"case {result['number']}: {text}")
        if result["wrong"]:
            self._progress(
                f"case {result['number']}: kept in {result['directory']}; again: octarm chaos --seed "
                f"{self._options.seed} --only {result['number']}"
            )
        now = time.monotonic()
        if now - self._told > 1.0:
            self._told = now
            wrong = sum(bool(one["wrong"]) for one in self.results)
            self._progress(
                f"{now - self._began:.0f} s: {len(self.results)} runs, {self.faults} faults, "
                f"{wrong} violations"
            )

    def _end(self) -> None:
        """Nothing of the campaign lives after this."""
        for worker in self._workers:
            with contextlib.suppress(OSError):
                worker.control.close()
        limit = Deadline(END_S)
        for worker in self._workers:
            if not worker.wait(limit.left):
                worker.signal(signal.SIGKILL)
                worker.wait()
            worker.reap()
            worker.close()
        self._selector.close()


def run_chaos(options: ChaosOptions, progress: Callable[[str], None]) -> Done:
    """Run a campaign; directories of cases with violations stay below its own.

    Raises UsageError before anything is started, OctarmError if the campaign itself cannot go on.
    """
    out = options.out or Path("runs") / time.strftime(f"chaos-{options.seed}-%Y%m%d-%H%M%S")
    made = claim(out, LOG)
    out = out.absolute()
    began = time.monotonic()
    interrupted = False
    with (out / LOG).open("wb") as log, _deaf_at_the_end():
        campaign = Campaign(options, out, log, progress)
        try:
            campaign.run()
        except KeyboardInterrupt:
            interrupted = True
        finally:
            _tidy(out, made)
    facts = facts_of(options.seed, campaign.results, time.monotonic() - began)
    facts["ended"] = "interrupted" if interrupted else "finished"
    wrong = len(facts["violations"])
    if wrong:
        code, message = ExitCode.DEGRADED, f"{wrong} cases with violations, kept in {out}"
        message += "; interrupted" if interrupted else ""
    elif interrupted:
        code, message = ExitCode.INTERRUPTED, "interrupted; this is what was done by then"
    else:
        code, message = ExitCode.OK, ""
    return Done(facts, table(facts), code, message)


@contextlib.contextmanager
def _deaf_at_the_end() -> Iterator[None]:
    """SIGINT and SIGTERM raise KeyboardInterrupt once; a second one does not disturb the clearing up."""

    def once(*_: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    numbers = (signal.SIGINT, signal.SIGTERM)
    old = {number: signal.signal(number, once) for number in numbers}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def _tidy(out: Path, made: bool) -> None:
    """Leave nothing of cases that were broken off, no empty log, and no empty directory that was made here."""
    for case in out.glob("case-*"):
        if not (case / "case.json").exists():
            shutil.rmtree(case, ignore_errors=True)
    tidy(out, LOG, made=made)
