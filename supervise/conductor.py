"""Starts the processes of a run, waits for their links, watches them, and ends them whatever
happens.

One loop, one thread: what the children say, and that they end, comes through `supervise.pipes`. It decides
nothing about the arm; it only tells the plant to stop when a process fails, because only the plant can tell
everybody at one tick.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path
from time import monotonic
from typing import Any, Self

from supervise.by_hand import explain, offer
from supervise.children import FarNode, Handle, Process, ending, module
from supervise.ending import Ending
from supervise.far import FarZygote
from supervise.interrupts import Interrupts
from supervise.pipes import Pipes
from supervise.plan import Plan
from supervise.replacing import Replacements
from supervise.state import Outcome, RunState
from supervise.view import View
from wire.child import Deadline
from wire.config_json import dumps
from wire.errors import ExitCode, StartUpFailedError, StartUpTimeoutError, UsageError

REPORT_S = 1.0
"""After the order to stop: for the nodes to say where they stood."""
RECORD_S = 30.0
"""For the recorder to write what is waiting, when everybody is well."""
RECORD_FAULT_S = 2.0
"""The same when somebody is dead or frozen."""
HURRY_S = 1.0
"""So long the recorder has to close its file when the user asks for the end a second time."""
RECORDER_SILENT_S = 5.0
"""A recorder that says nothing for so long, while it should be writing, is given up."""
RECORDER_PATIENCE = 20
"""Words of progress of the plant, ten a second at most, in which the recorder should have said one as well."""
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
        self._pipes = Pipes(self._handle, self._gone)
        self._log_path = plan.directory / "processes.log"
        try:
            self._log = self._log_path.open("ab")
        except OSError as error:
            raise UsageError(
                f"{self._log_path}: {error.strerror}; the run's directory must stay as long as it runs"
            ) from None
        self._zygote: Process | None = None
        self._far: dict[str, FarZygote] = {}
        """By the names of their hosts."""
        self._plant: Process | None = None
        self._recorder: Process | None = None
        self._live: Process | None = None
        self._state = RunState(plan)
        self._replacements = Replacements(plan)
        self.begun = False
        """The first tick was ordered: a node that dies is one of a moving arm, and there is a recording."""
        self._noted: set[str] = set()
        self._interrupts = Interrupts()
        self._leaving = False

    # -- life -------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._pipes.watch(self._interrupts.wakes, self._interrupts.woken)
        self._interrupts.begin()
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
            self._interrupts.end()
            self._plan.endpoints.close()
            self._pipes.close()
            self._log.close()
            self._interrupts.close()
            if self._log_bytes() == 0:
                self._log_path.unlink(missing_ok=True)

    def _log_bytes(self) -> int:
        """How much the children had to say; nothing if somebody has removed the run's directory."""
        try:
            return self._log_path.stat().st_size
        except OSError:
            return 0

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
        self.begun = True
        self._show("start")
        first = monotonic()
        self._watch()
        run_s = monotonic() - first
        self._collect_reports()
        code, message, tick = self._state.verdict(interrupted=self._interrupts.count > 0)
        self._show("ending", message=message)
        self._finish_recording(code, message, tick)
        troubles = (
            self._replacements.trouble(),
            self._state.recording_trouble(),
            self._state.pace_trouble(),
        )
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
                self._pipes.follow_far(far)
        if any(host.local for host in plan.hosts):
            private = plan.endpoints.private
            where = () if private is None else ("--directory", private)
            self._zygote = self._start("zygote", "node", "--zygote", "--parent", own, *where)
        plan.endpoints.make()  # now that there is somebody to remove it if this process is killed
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
        self._pipes.follow(process)
        return process

    def _wait_linked(self, limit: Deadline) -> None:
        state = self._state
        while not state.all_linked:
            self._pipes.turn(min(limit.left, 1.0))
            if self._interrupts.count:
                raise Interrupted
            if state.failures or state.ended:
                self._pipes.turn(0.05)  # the others may know more
                more = f"; see {self._log_path}" if self._log_bytes() else ""
                raise StartUpFailedError(
                    f"start-up failed: {state.why_not_started()}{more}",
                    state.gave_up or ExitCode.START_UP_TIMEOUT,
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
        by_user = False
        while state.plant_stop is None and "plant" not in state.ended:
            if ordered is None or (
                self._interrupts.count and not by_user
            ):  # who need not see the arm rest
                cause, reason = "safety", state.reason_to_stop()
                if self._interrupts.count:
                    cause, reason, by_user = "interrupted", "interrupted by the user", True
                if reason is not None:
                    self._order(self._plant, do="stop", cause=cause, text=reason)
                    ordered = Deadline(REPORT_S)
            self._pipes.turn(0.5 if ordered is None else min(0.5, ordered.left))
            if ordered is not None and ordered.passed and not state.passive_s_left:
                return

    def _collect_reports(self) -> None:
        """After the plant's order to stop: let the nodes say where they stood, the zygote how others ended."""
        limit = Deadline(REPORT_S if self._state.plant_stop is not None else 0.0)
        while not limit.passed and (self._state.unheard or self._unexplained):
            self._pipes.turn(min(0.2, limit.left))

    @property
    def _unexplained(self) -> list[int]:
        alive = self._zygote is not None and self._zygote.alive
        return self._state.unexplained if alive else []

    # -- the end ----------------------------------------------------------------------------------

    def _finish_recording(self, code: ExitCode, message: str, tick: int) -> None:
        """Let the recorder write everything that is on its way, and close the file."""
        names = {
            ExitCode.OK: ("info", "finished", f"all {tick} ticks done"),
            ExitCode.INTERRUPTED: ("warning", "interrupted", message),
        }
        self._event(tick, *names.get(code, ("error", "safety_stop", message)))
        well = code in names and not (code is ExitCode.INTERRUPTED and self._state.unheard)
        seconds = RECORD_S if well else RECORD_FAULT_S
        about = {"dead": self._state.silent, "refused": self._state.refused_peers}
        self._order(self._recorder, do="finish", seconds=seconds, **about)
        # It reports while it writes, however long that takes; without a word it is frozen.
        state = self._state
        state.recorder_spoke = monotonic()
        hurry: Deadline | None = None
        while state.closed is None and "recorder" not in state.ended:
            if (
                self._interrupts.count > 1 and hurry is None
            ):  # the file is closed, but waits for nobody
                hurry = Deadline(HURRY_S)
                self._order(self._recorder, do="finish", seconds=0.0, **about)
            self._pipes.turn(0.2)
            hurried = hurry is not None and (hurry.passed or self._interrupts.count > 2)
            if hurried or monotonic() - state.recorder_spoke > RECORDER_SILENT_S:
                return

    def _end_all(self) -> None:
        """SIGINT, SIGTERM, SIGKILL, each with a grace, to what this run started and still lives."""
        self._order(self._plant, do="end")
        far = list(self._far.values())
        for host in far:  # no signal reaches their nodes; they end meanwhile
            self._pipes.let_go(host)
        own = [h for h in self._state.nodes.values() if isinstance(h, Handle)]
        direct = [one for one in (self._plant, self._recorder, self._live) if one is not None]
        end = Ending(self._pipes.turn, lambda: self._interrupts.count > 1)
        end.processes([*own, *direct])
        # Before the zygotes are waited for: nobody is left who would remove them if the launcher died now.
        self._plan.endpoints.close()
        # Last the zygotes, which end whatever they have forked in the meantime.
        end.zygotes(self._zygote, far, own)
        for process in (self._zygote, *far, *direct):
            if process is not None:
                self._pipes.forget(process)
                process.reap()
                process.close()
        for handle in self._state.nodes.values():
            handle.close()

    # -- events -----------------------------------------------------------------------------------

    def _gone(self, process: Process, code: int | None) -> None:
        """A direct child has ended: remember how if nobody asked it to."""
        how = ending(code)
        if isinstance(process, FarZygote):
            process.read_errors()
            how += process.last_words
            for node in process.nodes:
                node.close()
        expected = self._leaving or (process is self._recorder and self._state.closed is not None)
        if not expected:
            self._state.ended[process.name] = how
            unsaid = process is self._recorder and not self._state.unrecorded
            if unsaid and self._state.all_linked:
                self._view.note(f"the recorder {ending(code)}: the run goes on unrecorded")
            if process is self._live and self._state.all_linked:
                self._view.note(f"the live page {ending(code)}: the run goes on unseen")

    def _handle(self, process: Process, line: dict[str, Any]) -> None:
        state = self._state
        if line["event"] == "refused" and (line["from"], line["what"]) not in state.refused:
            text = f"{line['from']} refused {line['what']}"
            self._view.note(text)
            self._event(state.ticks, "warning", "refused_peer", text)
        state.hear(line)
        match line["event"]:
            case "up" if isinstance(process, FarZygote) and line["from"] == process.name:
                process.up = True
            case "born":
                node = line["node"]
                state.nodes[node] = process.adopt(f"node {node}", line["pid"])
            case "died":
                node = line["node"]
                if isinstance(far := state.nodes[node], FarNode):
                    far.close()
                self._died(node, ending(line["code"]))
            case "out":
                self._replacements.out(line["node"])
                text = f"node {line['node']} is left out: it is {line['why']}"
                self._event(line["tick"], "error", "node_gone", f"tick {line['tick']}: {text}")
                handle = state.nodes.get(line["node"])
                if line["why"] == "stuck" and isinstance(handle, Handle):
                    handle.signal(signal.SIGKILL)  # it is replaced as one that has died
            case "back":
                self._is_back(line["node"], line["tick"])
            case "passive":
                self._event(line["tick"], "error", "passive", line["text"])
            case "listening":
                self._view.say(f"live at {line['url']}")
            case "progress" if line["from"] == "plant":
                self._view.progress(line["tick"])
                silent = state.unheard_progress == RECORDER_PATIENCE
                if silent and "recorder" not in state.ended:
                    self._view.note(
                        "the recorder does not answer: records may be lost, the run goes on"
                    )
            case "failed" if line["from"] == "recorder" and state.unrecorded:
                self._view.note(f"{state.unrecorded}: the run goes on unrecorded")
            case "progress":
                self._view.errors(line["tip_error_m"], line["estimation_error"])
            case "stopped" if line["from"] == "plant":
                self._view.progress(line["tick"])
            case "note" if line["text"] not in self._noted:  # n nodes have it to say
                self._noted.add(line["text"])
                self._view.note(f"{line['from']}: {line['text']}")

    def _died(self, node: int, how: str) -> None:
        """A node's process has ended: replace it, or remember how it ended if nobody asked it to."""
        running = self.begun and not self._leaving and self._state.plant_stop is None
        if running and self._replacements.replaceable(node):
            self._state.nodes[node].close()
            self._order(self._plant, do="gone", node=node)
            self._view.note(f"node {node} {how}: it is replaced, the others go on")
            host = self._plan.host_of(node)
            zygote = self._far.get(host.name, self._zygote)
            if zygote is not None:
                zygote.tell(dumps(self._replacements.replacement(node)))
        elif not self._leaving:
            self._state.ended[f"node {node}"] = how
            self._order(
                self._plant, do="gone", node=node
            )  # its token may vanish later than this is known

    def _is_back(self, node: int, tick: int) -> None:
        away_s = self._replacements.back(node)
        after = "" if away_s is None else f" after {away_s:.2f} s"
        text = f"node {node} works again from tick {tick} on{after}"
        self._view.note(text)
        self._event(tick, "info", "node_back", text)

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
