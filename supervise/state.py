"""What the processes of a run have said so far, and what it means: who is missing, why it ended.

Filled by the conductor from status lines and pidfds; knows nothing of pipes and signals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import monotonic
from typing import Any

from supervise.children import FarNode, Handle
from supervise.plan import Plan
from wire.errors import ExitCode

SHOWN = 6
"""Causes that a message lists before it says how many more there are."""


@dataclass
class Outcome:
    """How a run ended."""

    exit_code: ExitCode
    message: str
    """What went wrong and what to do; empty when all is well."""
    ticks: int
    """Ticks that the plant finished."""
    run_s: float
    """From the first tick to the last, wall clock."""


@dataclass
class RunState:
    """Everything known about the processes of one run; names are "plant", "recorder", "node 3"."""

    plan: Plan
    nodes: dict[int, Handle | FarNode] = field(default_factory=dict)
    """Processes of the nodes that were forked here, or by a zygote on another host."""
    linked: set[int] = field(default_factory=set)
    ready: set[str] = field(default_factory=set)
    waiting: dict[str, list[str]] = field(default_factory=dict)
    """What each process that is up still waits for."""
    stopped: dict[int, dict[str, Any]] = field(default_factory=dict)
    """Last words of each node: its tick, and what that tick lacked."""
    ended: dict[str, str] = field(default_factory=dict)
    """Processes that ended without being asked: name and how."""
    failures: list[str] = field(default_factory=list)
    """Messages of processes that gave up."""
    plant_stop: dict[str, Any] | None = None
    closed: dict[str, Any] | None = None
    """The recorder's totals, once its file is closed."""
    recorder_spoke: float = 0.0
    ticks: int = 0

    def hear(self, line: dict[str, Any]) -> None:
        """Take one status line into account."""
        name, event = line["from"], line["event"]
        if name == "recorder":
            self.recorder_spoke = monotonic()
        node = int(name[5:]) if name.startswith("node ") else -1
        match event:
            case "waiting":
                self.waiting[name] = line["missing"]
            case "ready":
                self.ready.add(name)
                if node >= 0:
                    self.linked.add(node)
            case "up":
                self.waiting.setdefault(name, ["its links"])
                if name == "recorder":
                    self.ready.add(name)
            case "failed" if name == "live" and self.all_linked:
                return  # the run does not need it; its end is told
            case "failed":
                self.failures.append(line["message"])
            case "progress" if name == "plant":
                self.ticks = line["tick"]
            case "stopped" if name == "plant":
                self.plant_stop = line
                self.ticks = line["tick"]
            case "stopped":
                self.stopped[node] = line
            case "closed":
                self.closed = line

    @property
    def all_linked(self) -> bool:
        """Whether the run can begin."""
        own = len(self.plan.nodes) - len(self.plan.by_hand)
        shown = self.plan.live is None or "live" in self.ready
        return len(self.linked) == own and "plant" in self.ready and shown

    @property
    def unheard(self) -> list[int]:
        """Nodes that live but have not said their last words."""
        return [i for i, h in sorted(self.nodes.items()) if i not in self.stopped and h.alive]

    @property
    def dead(self) -> list[int]:
        """Nodes whose processes ended without being asked."""
        return [i for i in self.plan.run.firsts if f"node {i}" in self.ended]

    @property
    def silent(self) -> list[int]:
        """Senders from whom the recorder will hear nothing more (-1: the plant)."""
        if self.plant_stop is None:  # without the plant nothing reaches the recorder
            return [*range(self.plan.run.nodes), -1]
        quiet = {i for i, h in self.nodes.items() if not h.alive and i not in self.stopped}
        return [j for c in self.plan.nodes if c.index in quiet for j in range(c.index, c.last + 1)]

    def who_is_missing(self) -> str:
        """Which processes and links are not there, for the start-up's time limit."""
        started = [f"host {host.name}" for host in self.plan.hosts if host.start]
        parts = [f"{name} does not answer" for name in started if name not in self.waiting]
        for i in self.plan.run.firsts:
            name, host = f"node {i}", self.plan.host_of(i)
            if (
                i in self.linked
                or name in self.ready
                or f"host {host.name} does not answer" in parts
            ):
                continue
            if self.waiting.get(name):
                parts.append(f"{name} waits for {', '.join(self.waiting[name])}")
            elif i in self.plan.by_hand:
                why = f'host {host.name} has start = "print"' if host.by_hand else "--by-hand"
                parts.append(f"{name} was not started (it is yours: {why})")
            else:
                parts.append(f"{name} does not answer")
        shown = () if self.plan.live is None else ("live",)
        for name in ("plant", "recorder", *shown):
            if name in self.ready:
                continue
            if name not in self.waiting:
                parts.append(f"{name} does not answer")
            elif not parts:
                parts.append(f"{name} waits for {', '.join(self.waiting[name])}")
        more = f"; and {len(parts) - SHOWN} more" if len(parts) > SHOWN else ""
        return "; ".join(parts[:SHOWN]) + more

    def why_not_started(self) -> str:
        """What kept the run from beginning, if a process failed or died."""
        if self.failures:
            return "; ".join(dict.fromkeys(self.failures[:SHOWN]))
        return "; ".join(f"{name} {how}" for name, how in self.ended.items())

    def reason_to_stop(self) -> str | None:
        """Why the arm must be stopped now, None if nothing happened."""
        if self.failures:
            return self.failures[0]
        dead = [name for name in self.ended if name not in ("recorder", "live")]
        return f"{dead[0]} {self.ended[dead[0]]}" if dead else None

    def verdict(self, *, interrupted: bool) -> tuple[ExitCode, str, int]:
        """What the end of the run means: exit code, message, first tick not done."""
        stop = self.plant_stop
        if stop is None:
            how = self.ended.get("plant", "does not answer")
            tick = max([self.ticks, *(report["tick"] for report in self.stopped.values())])
            return ExitCode.SAFETY_STOP, f"safety stop: the plant {how}", tick
        tick, text = int(stop["tick"]), str(stop["text"])
        if stop["cause"] == "finished":
            return ExitCode.OK, "", tick
        if interrupted:
            return ExitCode.INTERRUPTED, f"interrupted at tick {tick}", tick
        if not text.startswith("tick"):
            text = f"tick {tick}: {text}"
        details = [f"node {i} does not answer" for i in self.unheard]
        details += [
            f"node {i} lacked the {' and the '.join(report['missing'])}"
            for i, report in sorted(self.stopped.items())
            if report["missing"] and f"node {i} waited" not in text
        ]
        more = f" ({'; '.join(details[:SHOWN])})" if details else ""
        return ExitCode.SAFETY_STOP, f"safety stop: {text}{more}", tick

    def recording_trouble(self) -> str:
        """What is wrong with the recording of a run that went well otherwise; empty if nothing."""
        where = self.plan.recorder.path
        if "recorder" in self.ended:
            return f"the recorder {self.ended['recorder']}: {where} can be read up to there"
        if self.closed is None:
            return f"the recorder did not finish: {where} may end early"
        lost = int(self.closed["ticks_lost"])
        if lost or self.closed["ticks_recorded"] < self.plan.run.ticks:
            return f"{where}: records were lost ({lost} node ticks)"
        return ""

    def pace_trouble(self) -> str:
        """What to say of a run that kept going, but not on time; empty if it did."""
        late = int((self.closed or {}).get("late_ticks", 0))
        if not late:
            return ""
        return (
            f"{late} of {self.plan.run.ticks} ticks were late, their commands held; for fewer give a longer "
            "--period or --sched fifo"
        )
