"""A run of a case while it goes on: started, hit by the faults of its plan, read until it has ended, or should.

Between `chaos.draw`, which says what and when, and `chaos.case`, which checks what is left. A single thread:
pipes of the launcher and the instants of the plan in one loop.
"""

from __future__ import annotations

import heapq
import itertools
import os
import secrets
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from chaos.draw import (
    DEADLINE_S,
    ENDING,
    LAUNCHER,
    RUN,
    SPAN_S,
    START,
    START_TIMEOUT_S,
    THE_RUN,
    Case,
    Fault,
)
from chaos.expect import END_S, Ended
from chaos.inject import inject
from chaos.prepare import Prepared, own_keys, prepare
from chaos.processes import end_all, marked
from chaos.scene import ROOT, Hit, Scene, dies_with_parent

BEGUN = "plant and recorder linked in"
"""What the launcher says at the first tick."""
CURTAIN_S = 0.3
"""An endless run that no fault has ended is interrupted so long after the last of them."""
CURTAIN = "curtain"
"""Variant of the interrupt with which an endless run is ended."""
PATIENCE_S = 40.0
"""A run that has not ended so long after it should have hangs."""
AGAIN_S = 0.02
TRY_S = 3.0
"""So long a fault of the start-up waits for its target."""
TURN_S = 0.05


class BrokenOffError(Exception):
    """The campaign ends; the case is given up."""


def command(case: Case, prepared: Prepared | None) -> list[str]:
    """The run's command line."""
    more = [] if prepared is None else prepared.arguments
    words = case.run.arguments()
    if "--hosts" in more:
        at = words.index("--transport")
        del words[at : at + 2]
    return [sys.executable, str(ROOT / "launcher.py"), "run", *words, *more]


class Trial:
    """A case while it is going on. A context manager: leaving it leaves nothing of the run alive."""

    def __init__(
        self, case: Case, work: Path, broken_off: Callable[[], bool] = lambda: False
    ) -> None:
        self.case = case
        self.work = work
        self._broken_off = broken_off
        self.mark = secrets.token_hex(8)
        self.sockets = Path(tempfile.mkdtemp(prefix="oc-"))
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._text = {"stdout": b"", "stderr": b""}
        self.hits: list[Hit] = []
        self.missed: list[Fault] = []
        self.begun_at: float | None = None
        self.prepared: Prepared | None = None
        self._open_plan = len(case.faults)

    def __enter__(self) -> Self:
        case = self.case
        if case.run.keys:
            own_keys(case.run, self.work / "keys")
        if case.prepared is not None:
            self.prepared = prepare(case, case.prepared, self.work)
        self.command = command(case, self.prepared)
        environment = {**os.environ, **marked(self.mark), "TMPDIR": str(self.sockets)}
        environment.pop("COLUMNS", None)
        self.began = time.monotonic()
        self._popen = subprocess.Popen(
            self.command,
            cwd=self.work,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=dies_with_parent(signal.SIGKILL),  # noqa: PLW1509 - no threads here
        )
        self.scene = Scene(
            case.run, self.mark, self._popen.pid, self.sockets, self.work, self._later
        )
        if self.prepared is not None and case.prepared is not None:
            self.hits.append(Hit(case.prepared, self.began, self.prepared.what, alone=True))
            self._open_plan -= 1
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.scene.close()
        end_all(self.mark)
        self._popen.wait()
        for pipe in (self._popen.stdout, self._popen.stderr):
            if pipe is not None:
                pipe.close()
        if self.prepared is not None:
            self.prepared.close()
        shutil.rmtree(self.sockets, ignore_errors=True)

    # -- the plan ---------------------------------------------------------------------------------

    def _later(self, seconds: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._due, (time.monotonic() + seconds, next(self._order), act))

    def _plan(self, phase: str) -> None:
        for fault in self.case.faults:
            if fault.phase == phase == RUN:
                self._later(fault.at_s, partial(self._hit, fault))
            elif fault.phase == phase == START:
                limit = time.monotonic() + fault.at_s + TRY_S
                self._later(0.0, partial(self._await, fault, limit))

    def _await(self, fault: Fault, limit: float) -> None:
        """A fault of the start-up: its instant counts from when its target is there."""
        there = fault.target == THE_RUN or self.scene.find(fault.target, fault.node)
        if there:
            self._later(fault.at_s, lambda: self._hit(fault, limit))
        elif time.monotonic() > limit:
            self._settle(fault, None)
        else:
            self._later(AGAIN_S, lambda: self._await(fault, limit))

    def _hit(self, fault: Fault, limit: float = 0.0) -> None:
        hit = inject(self.scene, fault, begun=self.begun_at is not None)
        if hit is None and time.monotonic() < limit:
            self._later(AGAIN_S, lambda: self._hit(fault, limit))
            return
        self._settle(fault, hit)

    def _settle(self, fault: Fault, hit: Hit | None) -> None:
        self._open_plan -= 1
        if hit is None:
            self.missed.append(fault)
        else:
            self.hits.append(hit)
        if self._open_plan == 0 and self.case.run.endless:
            self._later(self._curtain_s(), self._curtain)

    def _curtain_s(self) -> float:
        """When to end an endless run: at once, unless a fault has to do it."""
        now = time.monotonic()
        longest = max((hit.at + hit.fault.for_s - now for hit in self.hits), default=0.0)
        ending = [h.fault for h in self.hits if h.fault.kind in ENDING]
        decisive = [f for f in ending if f.target in ("node", "plant", "zygote")]
        if not decisive or (self.case.run.restart and all(f.target == "node" for f in decisive)):
            return longest + CURTAIN_S + (1.0 if decisive else 0.0)
        return longest + 4 * DEADLINE_S + 2 * END_S

    def _curtain(self) -> None:
        fault = Fault("interrupt", LAUNCHER, RUN, variant=CURTAIN)
        hit = inject(self.scene, fault, begun=self.begun_at is not None)
        if hit is not None:
            self.hits.append(hit)

    # -- the loop ---------------------------------------------------------------------------------

    def finish(self) -> Ended:
        """Do what the plan says until the launcher has ended, or must have."""
        if self.case.prepared is None:
            self._plan(START)
        pipes = {"stdout": self._popen.stdout, "stderr": self._popen.stderr}
        poll = select.poll()
        names: dict[int, str] = {}
        for name, pipe in pipes.items():
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
            poll.register(pipe, select.POLLIN)
            names[pipe.fileno()] = name
        ended = os.pidfd_open(self._popen.pid)
        poll.register(ended, select.POLLIN)
        try:
            while not self._over():
                for number, _ in poll.poll(1000 * self._patience()):
                    if number == ended:
                        self._popen.poll()
                    elif not self._read(number, names[number]):
                        poll.unregister(number)
                self._act()
            ended_at = time.monotonic()
            code = self._popen.poll()
            for number, name in names.items():
                while self._read(number, name):
                    continue
        finally:
            os.close(ended)
        self.scene.wake_all()
        self.hits = list(self._came())
        return Ended(code, self.text("stderr"), self.begun_at is not None, ended_at)

    def text(self, name: str) -> str:
        """What the launcher wrote on standard output or error so far."""
        return self._text[name].decode(errors="replace")

    def _over(self) -> bool:
        if self._broken_off():
            raise BrokenOffError
        since = self.began if self.begun_at is None else self.begun_at
        run = self.case.run
        own_s = 0.0 if run.endless else run.ticks * (run.period_s if run.realtime else 0.01)
        last = max([since + own_s + SPAN_S, *(hit.at + hit.fault.for_s for hit in self.hits)])
        hangs = time.monotonic() > last + START_TIMEOUT_S + PATIENCE_S
        return self._popen.returncode is not None or hangs

    def _patience(self) -> float:
        left = self._due[0][0] - time.monotonic() if self._due else TURN_S
        return min(TURN_S, max(0.0, left))

    def _act(self) -> None:
        while self._due and self._due[0][0] <= time.monotonic():
            heapq.heappop(self._due)[2]()

    def _read(self, number: int, name: str) -> bool:
        """Take what came; whether there may be more."""
        try:
            data = os.read(number, 1 << 16)
        except BlockingIOError:
            return False
        self._text[name] += data
        if self.begun_at is None and BEGUN.encode() in self._text["stderr"]:
            self.begun_at = time.monotonic()
            if self.case.prepared is None:
                self._plan(RUN)
        return bool(data)

    def _came(self) -> Iterator[Hit]:
        """Hits that are known to have come."""
        for hit in self.hits:
            at = hit.at if hit.confirm is None else hit.confirm()
            if at is None:
                self.missed.append(hit.fault)
                continue
            hit.at = at
            yield hit
