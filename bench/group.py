"""One group from the launcher's side: started, linked, told to run bursts, read, ended whatever happens.

Between `bench.campaign`, which decides what is measured, and the group's processes. Interruption is
noticed only where a group waits, so that an end is never cut short.
"""

from __future__ import annotations

import json
import os
import select
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import IO, Any, Self

import numpy as np
import numpy.typing as npt

from bench.layout import Placement, endpoints_needed, lay_out
from bench.machine import Memory, cpu_ns, memory_of
from bench.real_nodes import RealNodes
from supervise.children import Handle, Process, ending, module
from supervise.endpoints import Endpoints, choose
from wire.child import Deadline
from wire.config_json import dumps
from wire.errors import OctarmError, StartUpTimeoutError

START_S = 60.0
WARM_TICKS = 50
WARM_S = 3.0
PACED_WARM_TICKS = 10
"""Fewer: at a low rate each takes a long period."""
GRACE_S = 6.0
"""A zygote ends its own children first, which takes up to two seconds."""
ANSWER_S = 30.0
"""For the driver to write what it has."""


class Signals:
    """SIGINT and SIGTERM while groups live: counted, and raised as KeyboardInterrupt by `check` only."""

    def __init__(self) -> None:
        self.count = 0

    def __enter__(self) -> Self:
        self.read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._old = {
            number: signal.signal(number, self._on_signal)
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._old.items():
            signal.signal(number, handler)
        os.close(self.read)
        os.close(self._write)

    def _on_signal(self, *_: object) -> None:
        self.count += 1

    def check(self) -> None:
        """KeyboardInterrupt if a signal came."""
        with suppress(BlockingIOError):
            os.read(self.read, 4096)
        if self.count:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Burst:
    """What a burst of ticks gave."""

    first: int
    """Its first tick, counted over the group's life."""
    times_ns: npt.NDArray[np.int64]
    """Of each tick: first measurement sent to last command received; paced: due instant to that."""
    all_ticks: int
    """With those that warmed up."""
    cpu_ns: int
    """Of driver and workers together, in all ticks."""


@dataclass(frozen=True)
class Totals:
    """What the receivers counted over a group's life."""

    ticks: int
    messages: dict[str, int]
    """By kind: exchange, measurement, command."""
    bytes: dict[str, int]
    rejected: int
    chain_ns: npt.NDArray[np.float64] | None
    """Of each tick; -1 where it is not known; None without a chain."""


@dataclass(frozen=True)
class GroupMemory:
    """Proportional and private memory of a group, kB."""

    workers: tuple[Memory, ...]
    total_pss_kb: int
    """Of driver, hub and zygotes too."""


class Group:
    """One living group. A context manager: leaving it leaves no process and no socket behind."""

    def __init__(
        self,
        pattern: str,
        real: RealNodes,
        placement: Placement,
        *,
        seed: int,
        log: IO[bytes],
        signals: Signals,
        note: Callable[[str], None],
    ) -> None:
        self.pattern = pattern
        self.nodes = real.processes
        self.start_s = 0.0
        self._real, self._placement, self._seed = real, placement, seed
        self._log, self._signals, self._note = log, signals, note
        self._endpoints: Endpoints | None = None
        self._processes: list[Process] = []
        self._zygote: Process | None = None
        self._driver: Process | None = None
        self._workers: dict[int, Handle] = {}
        self._heard: list[dict[str, Any]] = []
        self._failures: list[str] = []

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.pattern}, {self.nodes} nodes"

    # -- life -------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        """Start every process and wait until all links are up."""
        began = monotonic()
        try:
            self._start()
            self._await("ready", Deadline(START_S), StartUpTimeoutError)
        except BaseException:
            self.close()
            raise
        self.start_s = monotonic() - began
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        needed = endpoints_needed(self.pattern, self._real)
        self._endpoints = choose(needed, "unix", None, None)
        own = ["--parent", str(os.getpid())]
        mine = [*own, "--directory", str(self._endpoints.private)]
        if self.pattern == "neighbour":
            self._zygote = self._process("zygote", "node", ["--zygote", *own])
        else:
            self._zygote = self._process("zygote", "bench", ["--zygote", *mine])
        self._driver = self._process("driver", "bench", ["--driver", *mine])
        layout = lay_out(self.pattern, self._real, self._endpoints, self._placement, self._seed)
        self._driver.tell(dumps(layout.driver))
        for config in (*layout.nodes, *layout.workers):
            self._zygote.tell(dumps(config))

    def _process(self, name: str, room: str, arguments: list[str]) -> Process:
        process = Process(name, module(room, *arguments), self._log)
        self._processes.append(process)
        return process

    def close(self) -> None:
        """End every process, by request and then by force, and remove the sockets."""
        for process in self._processes:
            process.control.close()
            process.signal(signal.SIGTERM)
        self._wait_gone([*self._processes], GRACE_S)
        everybody: list[Handle] = [*self._processes, *self._workers.values()]
        for handle in everybody:
            handle.signal(signal.SIGKILL)
        self._wait_gone(everybody, 1.0)
        for process in self._processes:
            process.reap()
        for handle in everybody:
            handle.close()
        if self._endpoints is not None:
            self._endpoints.close()
        self._processes, self._workers = [], {}

    @staticmethod
    def _wait_gone(handles: list[Handle], seconds: float) -> None:
        limit = Deadline(seconds)
        poll = select.poll()
        for handle in handles:
            if handle.fileno() >= 0:
                poll.register(handle.fileno(), select.POLLIN)
        while any(handle.alive for handle in handles) and not limit.passed:
            for fd, _ in poll.poll(1000 * limit.left):
                poll.unregister(fd)

    # -- what is measured -------------------------------------------------------------------------

    def burst(self, ticks: int, *, limit_s: float, period_ns: int = 0, most_late: int = 0) -> Burst:
        """Run ticks: in lock-step for at most `limit_s` seconds, or paced, see `bench.pacing`.

        Some ticks before them warm up: a group that was idle is cold.
        """
        pids = self._pids()
        before = cpu_ns(pids)
        warm = PACED_WARM_TICKS if period_ns else WARM_TICKS
        patience = (ticks + warm) * period_ns * 2e-9 if period_ns else limit_s + WARM_S
        self._order(
            do="burst",
            ticks=ticks,
            limit_s=limit_s,
            period_ns=period_ns,
            most_late=most_late,
            warm=warm,
            warm_s=WARM_S,
        )
        all_ticks = self._await("ran", Deadline(patience + ANSWER_S))["ticks"]
        spent = cpu_ns(pids) - before
        path = self._file("burst.npy")
        self._order(do="report", path=str(path))
        first = self._await("reported", Deadline(ANSWER_S))["first"]
        times = np.load(path)
        path.unlink()
        return Burst(first, times, all_ticks, spent)

    def finish(self) -> Totals:
        """Stop the group's workers and collect what they counted; no burst can follow."""
        path = self._file("totals.json")
        self._order(do="finish", path=str(path))
        self._await("finished", Deadline(ANSWER_S))
        found = json.loads(path.read_text())
        path.unlink()
        if found["silent"]:
            raise OctarmError(
                f"{self.name}: no counters from {found['silent'][:12]}; see {self._log.name}"
            )
        chain = found["chain_ns"]
        return Totals(
            ticks=found["ticks"],
            messages={kind: pair[0] for kind, pair in found["totals"].items()},
            bytes={kind: pair[1] for kind, pair in found["totals"].items()},
            rejected=found["rejected"],
            chain_ns=None if chain is None else np.array(chain),
        )

    def memory(self) -> GroupMemory:
        """Of all processes now."""
        found = {index: memory_of(handle.pid) for index, handle in self._workers.items()}
        others = [memory_of(process.pid) for process in self._processes]
        total = sum(m.pss_kb for m in (*found.values(), *others) if m is not None)
        nodes = [m for index, m in found.items() if m is not None and index < self.nodes]
        return GroupMemory(tuple(nodes), total)

    def _pids(self) -> list[int]:
        """Driver and workers."""
        driver = [] if self._driver is None else [self._driver.pid]
        return driver + [handle.pid for handle in self._workers.values()]

    def _file(self, name: str) -> Path:
        if self._endpoints is None or self._endpoints.private is None:
            raise RuntimeError("the group has no directory")
        return Path(self._endpoints.private) / name

    # -- events -----------------------------------------------------------------------------------

    def _order(self, **message: Any) -> None:
        if self._driver is not None:
            self._driver.order(**message)

    def _await(
        self, event: str, limit: Deadline, late: type[OctarmError] = OctarmError
    ) -> dict[str, Any]:
        """Wait for the driver's line; OctarmError if a process fails or time is over."""
        while True:
            for line in self._heard:
                if line["from"] == "driver" and line["event"] == event:
                    self._heard.clear()
                    return line
            if self._failures:
                raise OctarmError(f"{self.name}: {self._failures[0]}; see {self._log.name}")
            if limit.passed:
                raise late(
                    f"{self.name}: the driver did not say {event!r} in time; see {self._log.name}"
                )
            self._turn(min(limit.left, 1.0))

    def _turn(self, seconds: float) -> None:
        poll = select.poll()
        poll.register(self._signals.read, select.POLLIN)
        for process in self._processes:
            poll.register(process.status, select.POLLIN)
        poll.poll(1000 * seconds)
        self._signals.check()
        for process in self._processes:
            lines = process.lines()
            if lines is None:
                if not process.alive:
                    self._failures.append(f"the {process.name} {ending(process.reap())}")
                continue
            for line in lines:
                self._hear(line)

    def _hear(self, line: dict[str, Any]) -> None:
        match line["event"]:
            case "born" if self._zygote is not None:
                index = line["node"]
                self._workers[index] = Handle(
                    f"worker {index}", line["pid"], parent=self._zygote.pid
                )
            case "died":
                kind = "node" if self.pattern == "neighbour" else self.pattern
                self._failures.append(f"{kind} {line['node']} {ending(line['code'])}")
            case "failed":
                self._failures.append(line["message"])
            case "note":
                self._note(f"{self.name}: {line['from']}: {line['text']}")
            case _:
                self._heard.append(line)
