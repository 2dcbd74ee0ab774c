"""One question to the LPI engine, answered in a process of its own.

Solvers are native code: they do not hear Ctrl-C, may overrun a time limit and may die. So the engine works in a
child, this process waits, and the best certified answer so far survives whatever happens to the child.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from design.lpi.reporter import Reporter
from design.lpi.result import Progress, Result, Status, silent
from design.solve_command import Request, answer, facts
from supervise.engine import Engine, EngineDiedError, Say, failure

GRACE_S = 10.0
"""The engine may be late by so much, or by a quarter of its time limit, before it is stopped."""
Work = Callable[[Request, Reporter], Result]


@dataclass(frozen=True)
class Answer:
    """facts: see `design.solve_command.facts`."""

    facts: dict[str, Any]
    interrupted: bool = False


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
    best: dict[str, Any] | None = None
    engine: Engine | None = None

    def early(reason: str) -> dict[str, Any]:
        if best is not None:
            return {**best, "message": f"{best['message']}; {reason}"}
        seconds = time.monotonic() - began
        result = Result(request.task, Status.UNRELIABLE, reason, seconds=seconds)
        return facts(request, result)

    try:
        engine = Engine(_answer, (request, work))
        while True:
            if not engine.pipe.poll(max(0.0, end - time.monotonic())):
                return Answer(
                    early(f"stopped after {time.monotonic() - began:.0f} s, over its time limit")
                )
            try:
                kind, content = engine.hear()
            except EOFError:
                how = engine.ended()
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
            else:
                raise failure(kind, content)
    except KeyboardInterrupt:
        return Answer(early("interrupted"), interrupted=True)
    finally:
        if engine is not None:
            engine.stop()


def _answer(request: Request, work: Work, say: Say) -> None:
    """What the engine's process does."""

    def stated(result: Result) -> dict[str, Any]:
        return facts(request, result, peak_memory_mb())

    reporter = Reporter(lambda text: say("text", text), lambda result: say("best", stated(result)))
    say("answer", stated(work(request, reporter)))


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, in MB of 2^20 bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
