"""One question to the LPI engine, answered in a process of its own.

Solvers are native code: they do not hear Ctrl-C, may overrun a time limit and may die. So the engine works in a
child, this process waits, and the best certified answer so far survives whatever happens to the child.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from design.lpi.reporter import Reporter
from design.lpi.result import Progress, Result, Status, silent
from design.solve_command import Request, answer, facts
from supervise.children import ending
from wire.child import die_with_parent, name_process
from wire.errors import OctarmError, UsageError

GRACE_S = 10.0
"""The engine may be late by so much, or by a quarter of its time limit, before it is stopped."""
_ENDING_S = 2.0
_SIGNALS = {signal.SIGINT, signal.SIGTERM}
Work = Callable[[Request, Reporter], Result]


@dataclass(frozen=True)
class Answer:
    """facts: see `design.solve_command.facts`."""

    facts: dict[str, Any]
    interrupted: bool = False


class EngineDiedError(OctarmError):
    """The engine's process ended without an answer, by no error of its own making."""


def solve_in_child(
    request: Request, progress: Progress = silent, work: Work = answer, grace_s: float = GRACE_S
) -> Answer:
    """The engine's answer; after Ctrl-C, an overrun time limit or a crash the best certified one so far.

    Raises UsageError as the engine does, EngineDiedError if it dies before anything is certified and
    RuntimeError, with the child's traceback as a note, for an error within it.
    """
    began = time.monotonic()
    limit = request.options.time_limit_s
    end = began + limit + max(grace_s, 0.25 * limit)
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(there, os.getpid(), request, work), daemon=True)
    best: dict[str, Any] | None = None

    def early(reason: str) -> dict[str, Any]:
        if best is not None:
            return {**best, "message": f"{best['message']}; {reason}"}
        seconds = time.monotonic() - began
        result = Result(request.task, Status.UNRELIABLE, reason, seconds=seconds)
        return facts(request, result)

    try:
        with _held_back():
            process.start()
        there.close()
        while True:
            if not here.poll(max(0.0, end - time.monotonic())):
                return Answer(
                    early(f"stopped after {time.monotonic() - began:.0f} s, over its time limit")
                )
            try:
                kind, content = here.recv()
            except (EOFError, OSError):
                process.join(_ENDING_S)
                how = f"the engine's process {ending(process.exitcode)}"
                if best is not None:
                    return Answer(early(how))
                raise EngineDiedError(
                    f"{how} before anything was certified; if memory ran out, give a lower --degree"
                ) from None
            if kind == "text":
                progress(content)
            elif kind == "best":
                best = content
            elif kind == "answer":
                return Answer(content)
            elif kind == "refused":
                raise UsageError(content)
            else:
                raise _engine_error(*content)
    except KeyboardInterrupt:
        return Answer(early("interrupted"), interrupted=True)
    finally:
        _stop(process)
        here.close()


def _engine_error(what: str, trace: str) -> RuntimeError:
    error = RuntimeError(f"in the engine: {what}")
    error.add_note(trace)
    return error


@contextmanager
def _held_back() -> Iterator[None]:
    """Signals wait while a child starts: it is not yet known here, nor deaf to Ctrl-C there."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _stop(process: multiprocessing.process.BaseProcess) -> None:
    """At once: the engine has nothing to put in order, and native code would not hear a polite word."""
    if process.pid is not None:
        process.kill()
        process.join()


def _child(pipe: Connection, parent: int, request: Request, work: Work) -> None:
    """Ctrl-C is for the parent alone; standard output as well, whatever a solver prints."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    die_with_parent(parent)
    name_process("octarm-engine")
    sys.stdout.flush()
    os.dup2(2, 1)

    def say(kind: str, content: object) -> None:
        pipe.send((kind, content))

    def stated(result: Result) -> dict[str, Any]:
        return facts(request, result, peak_memory_mb())

    reporter = Reporter(lambda text: say("text", text), lambda result: say("best", stated(result)))
    try:
        say("answer", stated(work(request, reporter)))
    except UsageError as error:
        say("refused", str(error))
    except BaseException as error:  # a panic of native code is no Exception
        say("error", (repr(error), traceback.format_exc()))


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in MB of 2^20 bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
