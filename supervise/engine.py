"""A process that computes: how it is started, what it says, how it is ended.

Shared by `supervise.solving` (one question to the LPI engine) and `supervise.designing` (many gains at once).
Solvers are native code: they do not hear Ctrl-C, may overrun a time limit and may die. So they work in
children, and the parent, which does nothing but wait, keeps what was finished.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from analysis.one_thread import one_thread_in_children
from supervise.children import ending
from wire.child import die_with_parent, name_process
from wire.errors import GainsRefusedError, OctarmError, UsageError

_ENDING_S = 2.0
_SIGNALS = {signal.SIGINT, signal.SIGTERM}
_REFUSALS: dict[str, type[OctarmError]] = {"usage": UsageError, "gains": GainsRefusedError}
Say = Callable[[str, object], None]


class EngineDiedError(OctarmError):
    """The engine's process ended without an answer, by no error of its own making."""


class Engine:
    """One child that calls `work(*arguments, say)`; whatever is said arrives as (kind, content).

    A UsageError or GainsRefusedError of the work arrives as the kind "refused", any other error as "error";
    `failure` makes exceptions of both. Linear algebra and solver keep to one thread: matrices this small take
    longer on several, and their rounding depends on the number.
    """

    def __init__(
        self,
        work: Callable[..., None],
        arguments: tuple[Any, ...],
        *,
        name: str = "octarm-engine",
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_child, args=(there, os.getpid(), name, work, arguments), daemon=True
        )
        try:
            with held_back(), one_thread_in_children():
                self._process.start()
            there.close()
        except BaseException:  # also an interrupt that was held back
            self.stop()
            raise

    def hear(self) -> tuple[str, Any]:
        """The next thing said, waited for. Raises EOFError if there will be none: see `ended`."""
        try:
            kind, content = self.pipe.recv()
        except OSError:
            raise EOFError from None
        return kind, content

    def ended(self) -> str:
        """How the process ended, in words; to be asked when it says nothing more."""
        self._process.join(_ENDING_S)
        return f"the engine's process {ending(self._process.exitcode)}"

    def stop(self) -> None:
        """End it at once: it has nothing to put in order, and native code would not hear a polite word."""
        if self._process.pid is not None:
            self._process.kill()
            self._process.join()
        self.pipe.close()


def failure(kind: str, content: Any) -> Exception:
    """The exception that a "refused" or "error" stands for; the child's traceback is a note of it."""
    if kind == "refused":
        sort, text = content
        return _REFUSALS[sort](text)
    what, trace = content
    error = RuntimeError(f"in the engine: {what}")
    error.add_note(trace)
    return error


@contextmanager
def held_back() -> Iterator[None]:
    """Signals wait, while a child starts or a file is written: neither is to be left half done."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _child(
    pipe: Connection,
    parent: int,
    name: str,
    work: Callable[..., None],
    arguments: tuple[Any, ...],
) -> None:
    """Ctrl-C is for the parent alone; standard output as well, whatever a solver prints."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    die_with_parent(parent)
    name_process(name)
    sys.stdout.flush()
    os.dup2(2, 1)

    def say(kind: str, content: object) -> None:
        pipe.send((kind, content))

    try:
        work(*arguments, say)
    except (UsageError, GainsRefusedError) as error:
        say("refused", ("usage" if isinstance(error, UsageError) else "gains", str(error)))
    except BaseException as error:  # a panic of native code is no Exception
        say("error", (repr(error), traceback.format_exc()))
