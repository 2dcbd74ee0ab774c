"""`octarm design`: every gain in a process of its own, several at once, and the artefact when all are there.

A crash, an overrun or Ctrl-C costs the gains that are being worked on; finished ones are kept as parts
(`supervise.gain_parts`) and taken by the next design.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path

from analysis.one_thread import one_thread
from design.arm_file import ArmFile, read_arm_file
from design.command import Job, assemble, check_options, jobs, longest_first
from design.gain import GainDesign, Options, design_gain
from design.gain_problem import Role
from supervise.engine import Engine, EngineDiedError, Say, failure, held_back
from supervise.gain_parts import GainParts
from wire.artefact import GainsArtefact, write_artefact
from wire.errors import GainsRefusedError, UsageError

PROGRAMS = 4
GRACE_S = 120.0
"""A gain may take `PROGRAMS` times the time limit of one program, and `GRACE_S` for the rest, before it is
stopped."""
Tell = Callable[[str], None]
Work = Callable[[ArmFile, int, Role, Options, Tell], GainDesign]


@dataclass(frozen=True)
class Request:
    """What `octarm design` was asked for."""

    arm: Path
    out: Path
    options: Options = field(default_factory=Options)
    jobs: int | None = None
    """Gains worked on at once; default: the processors that this process may use."""
    fresh: bool = False
    """Take no part of an earlier design."""
    force: bool = False
    """Write over an existing artefact."""
    only: tuple[str, ...] = ()
    """Gains, each as SETPOINT or SETPOINT:ROLE, that are designed and kept as parts; no artefact is written."""

    def __post_init__(self) -> None:
        limit = self.options.time_limit_s
        if not 0.0 < limit < math.inf:
            raise UsageError(f"--time-limit: expected a positive number of seconds, got {limit!r}")
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"--jobs: expected at least 1, got {self.jobs}")


@dataclass(frozen=True)
class Designed:
    """What came of it. `artefact` and `sha256` are None if only some gains were asked for."""

    gains: dict[Job, GainDesign]
    """In the order of the artefact."""
    artefact: GainsArtefact | None
    sha256: str | None
    parts: Path
    """Where the gains are kept until there is an artefact."""


def run_design(
    request: Request,
    progress: Tell = lambda _: None,
    work: Work = design_gain,
    grace_s: float = GRACE_S,
) -> Designed:
    """Design the gains of an arm file and write the artefact if all were asked for.

    Raises UsageError for a bad arm file, option or output path, before the work starts, and, when all other
    gains are finished and kept, GainsRefusedError if a gain is not certified (the message names setpoint and
    role), EngineDiedError if its process ended early, and RuntimeError for an error of the program.
    """
    file = read_arm_file(request.arm)
    _check_output(request)
    check_options(request.options)
    wanted = _wanted(jobs(file), request)
    parts = GainParts(request.out, file, request.options)
    with parts.locked():
        gains = {} if request.fresh else _kept(parts, wanted, jobs(file), progress)
        todo = longest_first(file, [job for job in wanted if job not in gains])

        def keep(job: Job, gain: GainDesign) -> None:
            gains[job] = gain
            _keep(parts, job, gain, progress)
            progress(f"{job}: finished, {len(gains)} of {len(wanted)} gains")

        pool = _Pool(file, request.options, work, grace_s, keep, progress)
        try:
            pool.run(todo, request.jobs or processors())
        except KeyboardInterrupt:
            progress(f"interrupted; {_balance(parts, gains, wanted)}")
            raise
        if pool.failures:
            raise _joined(pool.failures, _balance(parts, gains, wanted))
        gains = {job: gains[job] for job in wanted}
        if request.only:
            return Designed(gains, None, None, parts.directory)
        with one_thread():
            artefact = assemble(file, gains)
        _check_output(request)  # minutes have passed
        try:
            sha = write_artefact(artefact, request.out)
        except OSError as error:
            raise UsageError(f"--out {request.out}: {error.strerror or error}") from None
        parts.remove()
    return Designed(gains, artefact, sha, parts.directory)


def _wanted(everything: list[Job], request: Request) -> list[Job]:
    """The jobs that --only names, all without it. UsageError for a name that there is not."""
    names = {text: [job] for job in everything for text in [f"{job.setpoint}:{job.role}"]}
    for job in everything:
        names.setdefault(job.setpoint, []).append(job)
    for text in request.only:
        if text not in names:
            raise UsageError(
                f"--only {text}: expected SETPOINT or SETPOINT:ROLE, one of {', '.join(names)}"
            )
    chosen = {job for text in request.only for job in names[text]}
    return [job for job in everything if job in chosen or not request.only]


def processors() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))


def _check_output(request: Request) -> None:
    """UsageError, now and not after minutes of work, if nothing can be written there."""
    path = request.out
    existing = path.parent
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if path.is_dir():
        raise UsageError(f"--out {path}: is a directory; give the name of a file")
    if path.exists() and not (request.force or request.only):
        raise UsageError(f"--out {path}: it exists already; give another name or --force")
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise UsageError(f"--out {path}: {existing} is no directory that can be written to")


# Parts


def _kept(
    parts: GainParts, wanted: Sequence[Job], everything: Sequence[Job], progress: Tell
) -> dict[Job, GainDesign]:
    """The wanted gains that an earlier design has left."""
    found = {}
    for job in wanted:
        try:
            gain = parts.take(job)
        except ValueError as error:
            progress(f"{job}: {parts.path(job)}: {error}; designed again")
            continue
        if gain is not None:
            found[job] = gain
            progress(f"{job}: taken from {parts.path(job)}")
    if others := parts.others(everything):
        progress(
            f"{parts.directory}: {others} part{'s' * (others > 1)} of other data, options or versions, "
            "not used"
        )
    return found


def _keep(parts: GainParts, job: Job, gain: GainDesign, progress: Tell) -> None:
    """Nothing is lost but the chance to resume if the part cannot be written."""
    try:
        with held_back():
            parts.keep(job, gain)
    except OSError as error:
        progress(f"{job}: not kept, {parts.path(job)}: {error.strerror or error}")


def _balance(parts: GainParts, gains: Mapping[Job, GainDesign], wanted: Sequence[Job]) -> str:
    if not gains:
        return "no artefact was written"
    return (
        f"no artefact was written, {len(gains)} of {len(wanted)} gains are kept in {parts.directory}: "
        "the next `octarm design` with the same --out takes those whose data are still the same"
    )


def _joined(failures: Mapping[Job, Exception], balance: str) -> Exception:
    """One exception for all failures; what is wrong with the program comes before what is with the gains."""
    kinds: tuple[type[Exception], ...] = (
        RuntimeError,
        EngineDiedError,
        UsageError,
        GainsRefusedError,
    )
    kind = next(k for k in kinds if any(isinstance(error, k) for error in failures.values()))
    joined = kind("\n".join([*map(str, failures.values()), balance]))
    for error in failures.values():
        for note in getattr(error, "__notes__", []):
            joined.add_note(note)
    return joined


# Processes


@dataclass(frozen=True)
class _Worker:
    job: Job
    engine: Engine
    end: float
    """On the monotonic clock: when it is stopped."""


class _Pool:
    """Works through jobs, some at once; every gain goes to `keep`, what has none to `failures`."""

    def __init__(
        self,
        file: ArmFile,
        options: Options,
        work: Work,
        grace_s: float,
        keep: Callable[[Job, GainDesign], None],
        progress: Tell,
    ) -> None:
        self._file = file
        self._options = options
        self._work = work
        self._limit_s = PROGRAMS * options.time_limit_s + grace_s
        self._keep = keep
        self._progress = progress
        self._running: dict[Connection, _Worker] = {}
        self.failures: dict[Job, Exception] = {}

    def run(self, todo: Sequence[Job], at_once: int) -> None:
        """Returns when every job has ended, one way or the other; an interrupt ends all processes."""
        waiting = list(todo)
        at_once = min(at_once, len(todo))
        try:
            while waiting or self._running:
                while waiting and len(self._running) < at_once:
                    self._start(waiting.pop(0))
                next_end = min(worker.end for worker in self._running.values())
                for pipe in wait([*self._running], max(0.0, next_end - time.monotonic())):
                    self._hear(self._running[pipe])  # type: ignore[index]
                self._stop_late()
        finally:
            for worker in [*self._running.values()]:
                self._finish(worker)

    def _start(self, job: Job) -> None:
        self._progress(f"{job}: started")
        arguments = (self._file, job.index, job.role, self._options, self._work)
        engine = Engine(_design, arguments, name=f"octarm-{job.role}")
        self._running[engine.pipe] = _Worker(job, engine, time.monotonic() + self._limit_s)

    def _hear(self, worker: _Worker) -> None:
        job = worker.job
        try:
            kind, content = worker.engine.hear()
        except EOFError:
            how = f"{job}: {worker.engine.ended()}"
            self._fail(worker, EngineDiedError(f"{how}; if memory ran out, give --jobs 1"))
            return
        if kind == "text":
            self._progress(content)
        elif kind == "gain":
            self._keep(job, content)
            self._finish(worker)
        else:
            error = failure(kind, content)
            if isinstance(error, RuntimeError):
                error = _named(error, job)
            self._fail(worker, error)

    def _stop_late(self) -> None:
        for worker in [*self._running.values()]:
            if time.monotonic() >= worker.end:
                how = f"{worker.job}: stopped after {self._limit_s:.0f} s, far over its time limit"
                self._fail(worker, GainsRefusedError(f"{how}; give a longer --time-limit"))

    def _fail(self, worker: _Worker, error: Exception) -> None:
        self.failures[worker.job] = error
        self._progress(f"{worker.job}: failed")
        self._finish(worker)

    def _finish(self, worker: _Worker) -> None:
        del self._running[worker.engine.pipe]
        worker.engine.stop()


def _named(error: RuntimeError, job: Job) -> RuntimeError:
    named = RuntimeError(f"{job}: {error}")
    for note in getattr(error, "__notes__", []):
        named.add_note(note)
    return named


def _design(file: ArmFile, index: int, role: Role, options: Options, work: Work, say: Say) -> None:
    """What a gain's process does."""
    say("gain", work(file, index, role, options, lambda text: say("text", text)))
