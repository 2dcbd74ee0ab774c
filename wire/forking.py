"""Processes forked from one that has its modules loaded: birth, death and end, of nodes and benchmark workers.

The process that forks (`node.zygote`, `bench.zygote`) reads configurations from the launcher, one a line;
births and deaths go back as status lines.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from typing import Protocol, TypeVar

from wire.child import Child, die_with_parent, name_process, send_status
from wire.config_json import loads
from wire.errors import ExitCode, OctarmError
from wire.limits import refusal

USAGE = int(ExitCode.USAGE)
GRACE_S = 1.0
"""Between the request to end and the end by force, when the forking process itself has to stop its children."""


class Numbered(Protocol):
    """A configuration of one of several children."""

    @property
    def index(self) -> int:
        """The child's number."""


Config = TypeVar("Config", bound=Numbered)


class Nursery:
    """The children of a forking process. To be made when everything that they share is loaded."""

    def __init__(self, child: Child) -> None:
        self._child = child
        self._alive: dict[int, int] = {}
        signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
        child.install(reads_control=True)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # What is loaded stays as it is: a collection in a child would touch, and so copy, every page of it.
        gc.collect()
        gc.freeze()
        child.status("up")

    def birth(
        self, line: bytes, kind: type[Config], what: str, live: Callable[[Config, int], int]
    ) -> None:
        """Fork the child that a line configures; `live` gets the configuration and this process's number.

        What is wrong with the line, a `what` in words, is told to the launcher.
        """
        try:
            config = loads(kind, line, what)
        except OctarmError as error:
            self._child.status("failed", code="configuration", message=str(error))
            return
        self.fork(config.index, lambda own: live(config, own))

    def fork(self, index: int, live: Callable[[int], int]) -> None:
        """Fork the child with this number; `live` gets this process's number and returns the exit code."""
        own = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            text = f"process {index} cannot be forked: {refusal(error) or error.strerror}"
            self._child.status("failed", code="limit", exit=USAGE, message=text)
            return
        if pid == 0:
            code = 1
            try:
                code = live(own)
            finally:
                os._exit(code)
        self._alive[pid] = index
        self._child.status("born", node=index, pid=pid)

    def reap(self) -> None:
        """Tell of children that have ended."""
        while self._alive:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            index, code = self._alive.pop(pid), os.waitstatus_to_exitcode(status)
            self._child.status("died", node=index, pid=pid, code=code)

    def end(self) -> None:
        """Ask the children to end, then make them."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            for pid in list(self._alive):
                os.kill(
                    pid, number
                )  # own children, not yet waited for: the number cannot be another's
            limit = time.monotonic() + GRACE_S
            while self._alive and time.monotonic() < limit:
                self._child.wait_lines(0.05)
                self.reap()


def life(name: str, short: str, parent: int, run: Callable[[], int]) -> int:
    """The life of a forked process: never returns into the loop of the one that it was forked from.

    `short` is its name in the process list. What goes wrong is told to the launcher. Returns the exit code.
    """
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        die_with_parent(parent)
        name_process(short)
        return run()
    except OctarmError as error:
        exit_code = int(error.exit_code)
        send_status(
            1, name, "failed", code="configuration", exit=exit_code, message=f"{name}: {error}"
        )
        return int(error.exit_code)
    except SystemExit:
        raise
    except BaseException as error:  # a panic of native code is no Exception
        if reason := refusal(error):
            send_status(1, name, "failed", code="limit", exit=USAGE, message=f"{name}: {reason}")
            return USAGE
        traceback.print_exc()
        send_status(1, name, "failed", code="internal", message=f"{name}: {error!r}")
        return int(ExitCode.INTERNAL)
    finally:
        sys.stderr.flush()
