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
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, Self

from supervise.by_hand import explain, offer
from supervise.children import FarNode, Handle, Process, ending, module
from supervise.far import FarZygote
from supervise.plan import Plan
from supervise.state import Outcome, RunState
from supervise.view import View
from wire.child import Deadline
from wire.errors import ExitCode, OctarmError, StartUpTimeoutError
from wire.run_config import dumps

REPORT_S = 1.0
"""After the order to stop: for the nodes to say where they stood."""
RECORD_S = 30.0
"""For the recorder to write what is waiting, when everybody is well."""
RECORD_FAULT_S = 2.0
"""The same when somebody is dead or frozen."""
RECORDER_SILENT_S = 5.0
"""A recorder that says nothing for so long, while it should be writing, is given up."""
ZYGOTE_GRACE_S = 5.0
"""The zygote needs more: it ends its own children first."""
GRACE_S = 1.0
"""Between SIGINT, SIGTERM and SIGKILL."""


_ENDINGS = {
    ExitCode.OK: "finished",
    ExitCode.DEGRADED: "finished",
    ExitCode.INTERRUPTED: "interrupted",
}
"""What the live page calls an exit code; any other is a safety stop."""


class Interrupted(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


class Conductor:
    """All processes of one run. Use as a context manager: leaving it leaves no process behind."""

    def __init__(self, plan: Plan, view: View) -> None:
        self._plan = plan
        self._view = view
        self._selector = selectors.DefaultSelector()
        self._log_path = plan.directory / "processes.log"
        self._log = self._log_path.open("ab")
        self._zygote: Process | None = None
        self._far: dict[str, FarZygote] = {}
        """By the names of their hosts."""
        self._plant: Process | None = None
        self._recorder: Process | None = None
        self._live: Process | None = None
        self._state = RunState(plan)
        self._noted: set[str] = set()
        self._interrupts = 0
        self._leaving = False
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

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: object
    ) -> None:
        self._leaving = True
        # Heard only by a page that has not been told how the run ended.
        self._show(
            "finish",
            state="failed",
            message=f"it did not begin: {str(error or '') or 'interrupted'}",
        )
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
        """Start, link, run, stop; raises OctarmError if it never came to the first tick.

        Interrupted is raised instead if the user asked for the end before.
        """
        began = monotonic()
        self._spawn()
        self._wait_linked(Deadline(self._plan.start_timeout_s))
        nodes = _how_many(self._plan)
        self._view.note(f"{nodes}, plant and recorder linked in {monotonic() - began:.2f} s")
        self._event(0, "info", "started", f"{self._plan.run.nodes} nodes linked")
        self._order(self._plant, do="start")
        self._show("start")
        first = monotonic()
        self._watch()
        run_s = monotonic() - first
        self._collect_reports()
        code, message, tick = self._state.verdict(interrupted=self._interrupts > 0)
        self._show("ending", message=message)
        self._finish_recording(code, message, tick)
        troubles = (self._state.recording_trouble(), self._state.pace_trouble())
        if code is ExitCode.OK and any(troubles):
            code, message = ExitCode.DEGRADED, "; ".join(filter(None, troubles))
        self._show(
            "finish",
            state=_ENDINGS.get(code, "safety_stop"),
            message=message or f"all {tick} ticks done",
        )
        return Outcome(code, message, tick, run_s)

    def _spawn(self) -> None:
        plan = self._plan
        own = str(os.getpid())
        for host in plan.hosts:
            if host.start:
                self._far[host.name] = far = FarZygote(host, self._log)
                self._follow(far)
                self._selector.register(
                    far.errors, selectors.EVENT_READ, lambda far=far: self._read_errors(far)
                )
        if any(host.local for host in plan.hosts):
            self._zygote = self._start("zygote", "node", "--zygote", "--parent", own)
        self._plant = self._start("plant", "plant", own)
        self._recorder = self._start("recorder", "recorder", own)
        self._plant.tell(dumps(plan.plant))
        self._recorder.tell(dumps(plan.recorder))
        if plan.live is not None:
            self._live = self._start("live", "live", own)
            self._live.tell(dumps(plan.live))
        for host in plan.hosts:
            zygote = self._far.get(host.name, self._zygote)
            hand = plan.by_hand.intersection(host.indices)
            if hand and not host.local:
                self._view.note(explain(plan, host))
            for node in plan.nodes:
                if node.index in hand:
                    self._view.note(offer(plan, node))
                elif node.index in host.indices and zygote is not None:
                    zygote.tell(dumps(node))

    def _start(self, name: str, room: str, *arguments: str) -> Process:
        process = Process(name, module(room, *arguments), self._log)
        self._follow(process)
        return process

    def _follow(self, process: Process) -> None:
        self._selector.register(process.status, selectors.EVENT_READ, lambda: self._read(process))
        self._selector.register(process, selectors.EVENT_READ, lambda: self._gone(process))

    def _wait_linked(self, limit: Deadline) -> None:
        state = self._state
        while not state.all_linked:
            self._turn(min(limit.left, 1.0))
            if self._interrupts:
                raise Interrupted
            if state.failures or state.ended:
                self._turn(0.05)  # the others may know more
                raise OctarmError(
                    f"start-up failed: {state.why_not_started()}; see {self._log_path}"
                )
            if limit.passed:
                raise StartUpTimeoutError(
                    f"not every link was up after {self._plan.start_timeout_s:g} s: "
                    f"{state.who_is_missing()}; give more time with --start-timeout or see "
                    f"{self._log_path}"
                )

    def _watch(self) -> None:
        """Until the plant has stopped, or cannot any more."""
        state = self._state
        ordered: Deadline | None = None
        while state.plant_stop is None and "plant" not in state.ended:
            if ordered is None:
                cause, reason = "safety", state.reason_to_stop()
                if self._interrupts:
                    cause, reason = "interrupted", "interrupted by the user"
                if reason is not None:
                    self._order(self._plant, do="stop", cause=cause, text=reason)
                    ordered = Deadline(REPORT_S)
            self._turn(0.5 if ordered is None else min(0.5, ordered.left))
            if ordered is not None and ordered.passed:
                return

    def _collect_reports(self) -> None:
        """After the plant's order to stop: let the nodes say where they stood."""
        limit = Deadline(REPORT_S if self._state.plant_stop is not None else 0.0)
        while not limit.passed and self._state.unheard:
            self._turn(min(0.2, limit.left))

    # -- the end ----------------------------------------------------------------------------------

    def _finish_recording(self, code: ExitCode, message: str, tick: int) -> None:
        """Let the recorder write everything that is on its way, and close the file."""
        names = {
            ExitCode.OK: ("info", "finished", f"all {tick} ticks done"),
            ExitCode.INTERRUPTED: ("warning", "interrupted", message),
        }
        self._event(tick, *names.get(code, ("error", "safety_stop", message)))
        seconds = RECORD_S if code in names else RECORD_FAULT_S
        self._order(self._recorder, do="finish", seconds=seconds, dead=self._state.silent)
        # It reports while it writes, however long that takes; without a word it is frozen.
        state = self._state
        state.recorder_spoke = monotonic()
        while state.closed is None and "recorder" not in state.ended:
            self._turn(0.2)
            if self._interrupts > 1 or monotonic() - state.recorder_spoke > RECORDER_SILENT_S:
                return

    def _end_all(self) -> None:
        """SIGINT, SIGTERM, SIGKILL, each with a grace, to what this run started and still lives."""
        self._order(self._plant, do="end")
        for far in self._far.values():  # no signal reaches their nodes; they end meanwhile
            self._let_go(far)
        own = [h for h in self._state.nodes.values() if isinstance(h, Handle)]
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            self._end(number, [*own, self._plant, self._recorder, self._live])
        # Last the zygotes, which end whatever they have forked in the meantime.
        if self._zygote is not None:
            self._zygote.control.close()
        self._await_end([far for far in self._far.values() if far.up], ZYGOTE_GRACE_S)
        self._end(signal.SIGTERM, [self._zygote, *self._far.values()], ZYGOTE_GRACE_S)
        self._end(signal.SIGKILL, [self._zygote, *self._far.values(), *own])
        direct = (self._zygote, *self._far.values(), self._plant, self._recorder, self._live)
        for process in direct:
            if process is not None:
                self._forget(process)
                process.reap()
                process.close()
        for handle in self._state.nodes.values():
            handle.close()

    def _end(
        self,
        number: signal.Signals,
        handles: Sequence[Handle | None],
        grace_s: float = GRACE_S,
    ) -> None:
        """Send a signal to those that live, and give them time."""
        self._turn(0.0)
        living = [handle for handle in handles if handle is not None and handle.alive]
        for handle in living:
            handle.signal(number)
        self._await_end(living, grace_s)

    def _await_end(self, handles: Sequence[Handle], grace_s: float) -> None:
        limit = Deadline(grace_s if self._interrupts < 2 else 0.2)
        while not limit.passed and any(handle.alive for handle in handles):
            self._turn(min(0.05, limit.left))

    # -- events -----------------------------------------------------------------------------------

    def _turn(self, seconds: float) -> None:
        """Wait for something to happen and handle it."""
        for key, _ in self._selector.select(seconds):
            act: Callable[[], None] = key.data
            act()
        for far in self._far.values():
            far.beat()

    def _forget(self, process: Process) -> None:
        for item in (process, process.status, getattr(process, "errors", -1)):
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(item)

    def _let_go(self, far: FarZygote) -> None:
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(far.control)
        far.let_go()

    def _push(self, far: FarZygote) -> None:
        if far.push():
            self._selector.unregister(far.control)

    def _read_errors(self, far: FarZygote) -> None:
        if not far.read_errors():
            self._selector.unregister(far.errors)

    def _gone(self, process: Process) -> None:
        """A direct child has ended: read its last words, remember how if nobody asked it to."""
        self._read(process)
        code = process.reap()
        try:
            self._selector.unregister(process)
        except KeyError:
            return
        how = ending(code)
        if isinstance(process, FarZygote):
            process.read_errors()
            how += process.last_words
            for node in process.nodes:
                node.close()
        expected = self._leaving or (process is self._recorder and self._state.closed is not None)
        if not expected:
            self._state.ended[process.name] = how
            if process is self._recorder and self._state.all_linked:
                self._view.note(f"the recorder {ending(code)}: the run goes on unrecorded")
            if process is self._live and self._state.all_linked:
                self._view.note(f"the live page {ending(code)}: the run goes on unseen")

    def _read(self, process: Process) -> None:
        lines = process.lines()
        if lines is None:
            with contextlib.suppress(KeyError):
                self._selector.unregister(process.status)
            return
        for line in lines:
            self._handle(process, line)

    def _handle(self, process: Process, line: dict[str, Any]) -> None:
        state = self._state
        state.hear(line)
        match line["event"]:
            case "up" if isinstance(process, FarZygote) and line["from"] == process.name:
                process.up = True
                if not self._leaving:  # not before somebody reads there
                    self._selector.register(
                        process.control, selectors.EVENT_WRITE, lambda: self._push(process)
                    )
            case "born":
                node = line["node"]
                state.nodes[node] = process.adopt(f"node {node}", line["pid"])
            case "died":
                node = line["node"]
                if isinstance(far := state.nodes[node], FarNode):
                    far.close()
                if not self._leaving:
                    state.ended[f"node {node}"] = ending(line["code"])
            case "listening":
                self._view.say(f"live at {line['url']}")
            case "progress" if line["from"] == "plant":
                self._view.progress(line["tick"])
            case "progress":
                self._view.errors(line["tip_error_m"], line["estimation_error"])
            case "stopped" if line["from"] == "plant":
                self._view.progress(line["tick"])
            case "note" if line["text"] not in self._noted:  # n nodes have it to say
                self._noted.add(line["text"])
                self._view.note(f"{line['from']}: {line['text']}")

    def _order(self, process: Process | None, **message: Any) -> None:
        if process is not None and process.alive:
            process.order(**message)

    def _show(self, what: str, **about: str) -> None:
        """Tell the live page, if there is one, how the run goes on."""
        self._order(self._live, do=what, dead=self._state.dead, **about)

    def _event(self, tick: int, level: str, name: str, text: str) -> None:
        self._order(self._recorder, do="event", tick=tick, level=level, name=name, message=text)


def _how_many(plan: Plan) -> str:
    nodes, processes = plan.run.nodes, len(plan.nodes)
    return f"{nodes} nodes" if nodes == processes else f"{nodes} segments in {processes} nodes"


def log_of(directory: Path) -> Path:
    """Where the children of a run write what they have to say."""
    return directory / "processes.log"
