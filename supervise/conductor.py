"""Starts the processes of a run, waits for their links, watches them, and ends them whatever
happens.

One loop, one thread: pipes and pidfds of all children in a selector. It decides nothing about the
arm; it only tells the plant to stop when a process fails, because only the plant can tell everybody
at one tick.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, Self

from supervise.children import Handle, Process, ending
from supervise.plan import Plan
from supervise.view import View
from wire.child import Deadline
from wire.errors import ExitCode, OctarmError, StartUpTimeoutError
from wire.run_config import dumps

REPORT_S = 2.0
"""After the order to stop: for the nodes to say where they stood."""
RECORD_S = 30.0
"""For the recorder to write what is waiting, when everybody is well."""
RECORD_FAULT_S = 3.0
"""The same when somebody is dead or frozen."""
GRACE_S = 2.0
"""Between SIGINT, SIGTERM and SIGKILL."""


class Interrupted(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


@dataclass
class Outcome:
    """How a run ended."""

    exit_code: ExitCode
    message: str
    """What went wrong and what to do; empty when all is well."""
    ticks: int
    """Ticks that the plant finished."""
    startup_s: float
    """From the first process to all links up."""
    run_s: float
    """From the first tick to the last."""
    totals: dict[str, int] = field(default_factory=dict)
    """The recorder's counters."""


class Conductor:
    """All processes of one run. Use as a context manager: leaving it leaves no process behind."""

    def __init__(self, plan: Plan, view: View) -> None:
        self._plan = plan
        self._view = view
        self._selector = selectors.DefaultSelector()
        self._log_path = plan.directory / "processes.log"
        self._log = self._log_path.open("ab")
        self._zygote: Process | None = None
        self._plant: Process | None = None
        self._recorder: Process | None = None
        self._nodes: dict[int, Handle] = {}
        self._linked: set[int] = set()
        self._missing: dict[str, list[str]] = {}
        """What each process that is up still waits for."""
        self._ready: set[str] = set()
        self._stopped: dict[int, dict[str, Any]] = {}
        self._ended: dict[str, str] = {}
        """Processes that ended without being asked: name and how."""
        self._failures: list[tuple[str, str]] = []
        self._plant_stop: dict[str, Any] | None = None
        self._complete = False
        self._closed: dict[str, Any] | None = None
        self._interrupts = 0
        self._leaving = False
        self._ticks = 0
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    # -- life -------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._selector.register(self._wake_read, selectors.EVENT_READ, self._woken)
        self._old_wakeup = signal.set_wakeup_fd(self._wake_write, warn_on_full_buffer=False)
        self._old_handlers = {
            number: signal.signal(number, self._on_signal)
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving = True
        try:
            self._end_all()
        finally:
            signal.set_wakeup_fd(self._old_wakeup)
            for number, handler in self._old_handlers.items():
                signal.signal(number, handler)
            self._plan.endpoints.close()
            self._selector.close()
            self._log.close()
            os.close(self._wake_read)
            os.close(self._wake_write)
            if self._log_path.exists() and self._log_path.stat().st_size == 0:
                self._log_path.unlink()

    def _on_signal(self, *_: object) -> None:
        self._interrupts += 1

    def _woken(self) -> None:
        try:
            os.read(self._wake_read, 4096)
        except BlockingIOError:
            return

    # -- the whole run ----------------------------------------------------------------------------

    def run(self) -> Outcome:
        """Start, link, run, stop; raises OctarmError if it never came to the first tick, or
        Interrupted."""
        began = monotonic()
        self._spawn()
        self._wait_linked(Deadline(self._plan.start_timeout_s))
        startup_s = monotonic() - began
        self._view.note(
            f"{self._plan.run.nodes} nodes, plant and recorder linked in {startup_s:.2f} s"
        )
        self._event(0, "info", "started", f"{self._plan.run.nodes} nodes linked")
        self._order(self._plant, do="start")
        first = monotonic()
        self._watch()
        run_s = monotonic() - first
        code, message, tick = self._judge()
        self._record_end(code, message, tick)
        if code is ExitCode.OK and (trouble := self._recording_trouble()):
            code, message = ExitCode.DEGRADED, trouble
        return Outcome(code, message, self._ticks, startup_s, run_s, self._totals())

    def _spawn(self) -> None:
        plan = self._plan
        own = str(os.getpid())
        self._zygote = self._start("zygote", "node", ["--zygote", "--parent", own])
        self._plant = self._start("plant", "plant", [own])
        self._recorder = self._start("recorder", "recorder", [own])
        self._plant.tell(dumps(plan.plant))
        self._recorder.tell(dumps(plan.recorder))
        for config in plan.nodes:
            if config.index in plan.by_hand:
                path = plan.directory / f"node-{config.index}.json"
                path.write_text(dumps(config) + "\n")
                self._view.note(f"node {config.index} is yours to start: python -m node {path}")
            else:
                self._zygote.tell(dumps(config))

    def _start(self, name: str, module: str, arguments: list[str]) -> Process:
        process = Process(name, module, arguments, self._log)
        self._selector.register(process.status, selectors.EVENT_READ, lambda: self._read(process))
        self._selector.register(process, selectors.EVENT_READ, lambda: self._gone(process))
        return process

    def _wait_linked(self, limit: Deadline) -> None:
        while not self._all_linked():
            self._turn(min(limit.left, 1.0))
            if self._interrupts:
                raise Interrupted
            if self._failures or self._ended:
                raise self._start_error()
            if limit.passed:
                raise StartUpTimeoutError(self._who_is_missing())

    def _all_linked(self) -> bool:
        return len(self._linked) == self._plan.run.nodes - len(self._plan.by_hand) and (
            "plant" in self._ready
        )

    def _who_is_missing(self) -> str:
        parts: list[str] = []
        for i in range(self._plan.run.nodes):
            if i in self._linked:
                continue
            name = f"node {i}"
            if name in self._missing:
                parts.append(f"{name} waits for {', '.join(self._missing[name])}")
            elif i in self._plan.by_hand:
                parts.append(f"{name} was not started (it is yours: --by-hand)")
            else:
                parts.append(f"{name} does not answer")
        for process in (self._plant, self._recorder):
            if process is not None and process.name not in self._ready:
                waits = self._missing.get(process.name)
                if waits is None:
                    parts.append(f"{process.name} does not answer")
                elif not parts:
                    parts.append(f"{process.name} waits for {', '.join(waits)}")
        shown = "; ".join(parts[:6]) + (f"; and {len(parts) - 6} more" if len(parts) > 6 else "")
        return (
            f"not every link was up after {self._plan.start_timeout_s:g} s: {shown}; see "
            f"{self._log_path} or give more time with --start-timeout"
        )

    def _start_error(self) -> OctarmError:
        if self._failures:
            text = "; ".join(dict.fromkeys(text for _, text in self._failures))
        else:
            text = "; ".join(f"{name} {how}" for name, how in self._ended.items())
        self._turn(0.05)
        return OctarmError(f"start-up failed: {text}; see {self._log_path}")

    def _watch(self) -> None:
        """Until the plant has stopped, or cannot any more."""
        ordered: Deadline | None = None
        while self._plant_stop is None and "plant" not in self._ended:
            if ordered is None:
                order = self._reason_to_stop()
                if order is not None:
                    self._order(self._plant, do="stop", cause=order[0], text=order[1])
                    ordered = Deadline(REPORT_S)
            self._turn(0.5 if ordered is None else min(0.5, ordered.left))
            if ordered is not None and ordered.passed:
                break

    def _reason_to_stop(self) -> tuple[str, str] | None:
        if self._interrupts:
            return "interrupted", "interrupted by the user"
        if self._failures:
            return "safety", self._failures[0][1]
        dead = [name for name in self._ended if name != "recorder"]
        if dead:
            return "safety", f"{dead[0]} {self._ended[dead[0]]}"
        return None

    def _judge(self) -> tuple[ExitCode, str, int]:
        """What the end of the run means: exit code, message, first tick not done."""
        stop = self._plant_stop
        if stop is None:
            how = self._ended.get("plant", "does not answer")
            tick = max([self._ticks, *(s["tick"] for s in self._stopped.values())])
            return ExitCode.SAFETY_STOP, f"the plant {how}: the run was stopped", tick
        tick = int(stop["tick"])
        self._ticks = tick
        if stop["cause"] == "finished":
            return ExitCode.OK, "", tick
        if self._interrupts:
            return ExitCode.INTERRUPTED, f"interrupted at tick {tick}", tick
        self._collect_reports()
        text = stop["text"]
        if not text.startswith("tick"):
            text = f"tick {tick}: {text}"
        details = [
            f"node {i} lacked the {' and the '.join(report['missing'])}"
            for i, report in sorted(self._stopped.items())
            if report["missing"] and f"node {i} waited" not in text
        ]
        silent = [
            f"node {i} does not answer"
            for i, handle in sorted(self._nodes.items())
            if i not in self._stopped and handle.alive
        ]
        more = "; ".join((silent + details)[:4])
        return ExitCode.SAFETY_STOP, f"safety stop: {text}" + (f" ({more})" if more else ""), tick

    def _collect_reports(self) -> None:
        limit = Deadline(REPORT_S)
        while not limit.passed and any(
            handle.alive and i not in self._stopped for i, handle in self._nodes.items()
        ):
            self._turn(min(0.2, limit.left))

    # -- the end ----------------------------------------------------------------------------------

    def _record_end(self, code: ExitCode, message: str, tick: int) -> None:
        """Let the recorder write everything that is on its way, and close the file."""
        names = {
            ExitCode.OK: ("info", "finished", f"all {tick} ticks done"),
            ExitCode.INTERRUPTED: ("warning", "interrupted", message),
        }
        self._event(tick, *names.get(code, ("error", "safety_stop", message)))
        well = code in (ExitCode.OK, ExitCode.INTERRUPTED)
        if not well:
            self._collect_reports()
        dead = [i for i, h in self._nodes.items() if not h.alive and i not in self._stopped]
        if self._plant_stop is None:
            dead.append(-1)
        seconds = RECORD_S if well else RECORD_FAULT_S
        self._order(self._recorder, do="finish", seconds=seconds, dead=dead)
        limit = Deadline(seconds + RECORD_S)
        while self._closed is None and "recorder" not in self._ended and not limit.passed:
            self._turn(min(0.5, limit.left))
            if self._interrupts > 1:
                return

    def _recording_trouble(self) -> str:
        where = self._plan.recorder.path
        if "recorder" in self._ended:
            return f"the recorder {self._ended['recorder']}: {where} can be read up to there"
        if self._closed is None:
            return f"the recorder did not finish: {where} may end early"
        run, lost = self._plan.run, int(self._closed["ticks_lost"])
        if lost or self._closed["ticks_recorded"] < run.ticks:
            return f"{where}: records of {lost} node ticks were lost"
        return ""

    def _totals(self) -> dict[str, int]:
        skip = ("from", "event")
        return {k: v for k, v in (self._closed or {}).items() if k not in skip}

    def _end_all(self) -> None:
        """SIGINT, SIGTERM, SIGKILL, each with a grace, to what this run started and still lives."""
        self._order(self._plant, do="end")
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            self._turn(0.0)
            everybody = [*self._nodes.values(), self._plant, self._recorder]
            if not any(h is not None and h.alive for h in everybody):
                break
            for handle in everybody:
                if handle is not None and handle.alive:
                    handle.signal(number)
            limit = Deadline(GRACE_S if self._interrupts < 2 else 0.2)
            while not limit.passed and any(h is not None and h.alive for h in everybody):
                self._turn(min(0.05, limit.left))
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self._zygote is not None and self._zygote.alive:
                self._zygote.signal(number)
                limit = Deadline(GRACE_S)
                while self._zygote.alive and not limit.passed:
                    self._turn(min(0.05, limit.left))
        for process in (self._zygote, self._plant, self._recorder):
            if process is not None:
                self._forget(process)
                process.reap()
                process.close()
        for handle in self._nodes.values():
            handle.close()

    # -- events -----------------------------------------------------------------------------------

    def _turn(self, seconds: float) -> None:
        """Wait for something to happen and handle it."""
        for key, _ in self._selector.select(seconds):
            act: Callable[[], None] = key.data
            act()

    def _forget(self, process: Process) -> None:
        for item in (process, process.status):
            try:
                self._selector.unregister(item)
            except (KeyError, ValueError):
                continue

    def _gone(self, process: Process) -> None:
        """A direct child has ended: read its last words, remember how if nobody asked it to."""
        self._read(process)
        code = process.reap()
        try:
            self._selector.unregister(process)
        except KeyError:
            return
        expected = self._leaving or (process is self._recorder and self._closed is not None)
        if not expected:
            self._ended[process.name] = ending(code)

    def _read(self, process: Process) -> None:
        lines = process.lines()
        if lines is None:
            with contextlib.suppress(KeyError):
                self._selector.unregister(process.status)
            return
        for line in lines:
            self._handle(line)

    def _handle(self, line: dict[str, Any]) -> None:
        name, event = line["from"], line["event"]
        node = int(name[5:]) if name.startswith("node ") else -1
        match event:
            case "born":
                self._nodes[line["node"]] = Handle(f"node {line['node']}", line["pid"])
            case "died":
                if not self._leaving:
                    self._ended[f"node {line['node']}"] = ending(line["code"])
            case "waiting":
                self._missing[name] = line["missing"]
            case "ready":
                self._ready.add(name)
                if node >= 0:
                    self._linked.add(node)
            case "up":
                self._missing.setdefault(name, ["its links"])
                if name == "recorder":
                    self._ready.add(name)
            case "failed":
                self._failures.append((name, line["message"]))
            case "progress":
                if name == "plant":
                    self._ticks = line["tick"]
                    self._view.progress(line["tick"])
                else:
                    self._view.errors(line["tip_error_m"], line["estimation_error"])
            case "stopped":
                if name == "plant":
                    self._plant_stop = line
                    self._view.progress(line["tick"])
                else:
                    self._stopped[node] = line
            case "complete":
                self._complete = True
            case "closed":
                self._closed = line
            case "note":
                self._view.note(f"{name}: {line['text']}")

    def _order(self, process: Process | None, **message: Any) -> None:
        if process is not None and process.alive:
            process.order(**message)

    def _event(self, tick: int, level: str, name: str, text: str) -> None:
        self._order(self._recorder, do="event", tick=tick, level=level, name=name, message=text)


def log_of(directory: Path) -> Path:
    """Where the children of a run write what they have to say."""
    return directory / "processes.log"
