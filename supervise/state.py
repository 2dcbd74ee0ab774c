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


PASSIVE_TICKS = 20
PASSIVE_S = 1.0
"""A plant watches a passive arm for so many ticks (plant.process.SAFE_TICKS), and needs a second to stop."""


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
    plant_passive: float | None = None
    """Until when the plant may watch a passive arm, on the monotonic clock; None before it is."""
    passive_text: str = ""
    """Why the arm is passive, in the plant's words."""
    unrecorded: str = ""
    """Why nothing is recorded any more, in the recorder's words."""
    unheard_progress: int = 0
    """So often the plant has told of its progress since the recorder last said a word."""
    gave_up: ExitCode | None = None
    """Exit code of the first process that gave up."""
    ticks: int = 0
    refused: dict[tuple[str, str], int] = field(default_factory=dict)
    """Whom a process did not let in, and how often: by the process and by what was wrong."""

    def hear(self, line: dict[str, Any]) -> None:
        """Take one status line into account."""
        name, event = line["from"], line["event"]
        if name == "recorder":
            self.recorder_spoke = monotonic()
            self.unheard_progress = 0
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
            case "failed" if name == "recorder" and self.all_linked:
                self.unrecorded = line["message"]  # the arm does not need it
            case "failed":
                self.failures.append(line["message"])
                self.gave_up = self.gave_up or _code_of(line)
            case "passive":
                pace = self.plan.run.pace
                watching_s = 0.0 if pace is None else PASSIVE_TICKS * pace.period_s
                self.plant_passive = monotonic() + watching_s + PASSIVE_S
                self.passive_text = line["text"]
            case "progress" if name == "plant":
                self.ticks = line["tick"]
                self.unheard_progress += 1
            case "stopped" if name == "plant":
                self.plant_stop = line
                self.ticks = line["tick"]
            case "stopped":
                self.stopped[node] = line
            case "refused":
                self.refused[name, line["what"]] = line["count"]
            case "closed":
                self.closed = line

    @property
    def passive_s_left(self) -> float:
        """How long the plant, whose arm is passive, may still take to stop; 0 if it is not."""
        return max(0.0, (self.plant_passive or 0.0) - monotonic())

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
    def unexplained(self) -> list[int]:
        """Nodes forked here that are dead and of which their zygote has yet to say how they ended."""
        gone = {i for i, h in self.nodes.items() if isinstance(h, Handle) and h.has_ended}
        return sorted(i for i in gone - self.stopped.keys() if f"node {i}" not in self.ended)

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
        if dead:
            return f"{dead[0]} {self.ended[dead[0]]}"
        # Frozen while it watches a passive arm, when the nodes have ended in order: nobody else misses it.
        overdue = self.plant_passive is not None and not self.passive_s_left
        return "the plant does not answer" if overdue else None

    def verdict(self, *, interrupted: bool) -> tuple[ExitCode, str, int]:
        """What the end of the run means: exit code, message, first tick not done."""
        stop = self.plant_stop
        if stop is None:
            how = self.ended.get("plant", "does not answer")
            tick = max([self.ticks, *(report["tick"] for report in self.stopped.values())])
            text = (
                f"{self.passive_text} (the plant {how})"
                if self.passive_text
                else f"the plant {how}"
            )
            return ExitCode.SAFETY_STOP, f"safety stop: {text}", tick
        tick, text = int(stop["tick"]), str(stop["text"])
        if stop["cause"] == "finished":
            return ExitCode.OK, "", tick
        if interrupted and stop["cause"] != "safety":
            return ExitCode.INTERRUPTED, f"interrupted at tick {tick}", tick
        if not text.startswith("tick"):
            text = f"tick {tick}: {text}"
        details = [f"node {i} does not answer" for i in self.unheard]
        details += [
            f"node {i} lacked the {' and the '.join(report['missing'])}"
            for i, report in sorted(self.stopped.items())
            if report["missing"] and f"node {i} waited" not in text
        ]
        details = [
            f"{name} {how}"
            for name, how in self.ended.items()
            if name not in ("recorder", "live") and f"{name} {how}" not in text
        ] + details
        more = f" ({'; '.join(details[:SHOWN])})" if details else ""
        return ExitCode.SAFETY_STOP, f"safety stop: {text}{more}", tick

    def recording_trouble(self) -> str:
        """What is wrong with the recording of a run that went well otherwise; empty if nothing."""
        where = self.plan.recorder.path
        if self.unrecorded:
            return f"{self.unrecorded}: the rest of the run is not recorded"
        if "recorder" in self.ended:
            return f"the recorder {self.ended['recorder']}: {where} can be read up to there"
        if self.closed is None:
            return f"the recorder did not finish: {where} may end early"
        cut = int(self.closed["disk_full_at"])
        if cut >= 0:
            return f"{where}: the disk was full, the recording ends before tick {cut}"
        lost, recorded = int(self.closed["ticks_lost"]), int(self.closed["ticks_recorded"])
        if lost or recorded < self.plan.run.ticks:
            rest = f", and all from tick {recorded} on" if recorded < self.plan.run.ticks else ""
            return f"{where}: records were lost ({lost} node ticks{rest})"
        return ""

    @property
    def refused_peers(self) -> list[dict[str, Any]]:
        """The same as the recording has it."""
        return [
            {"by": name, "what": what, "count": count}
            for (name, what), count in sorted(self.refused.items())
        ]

    def pace_trouble(self) -> str:
        """What to say of a run that kept going, but not on time; empty if it did."""
        late = int((self.closed or {}).get("late_ticks", 0))
        bridged = int((self.closed or {}).get("bridged_sums", 0))
        if not late and bridged and not self.plan.run.restart:
            return f"{bridged} sums between neighbours did not come in time and were bridged"
        if not late:
            return ""
        return (
            f"{late} of {self.plan.run.ticks} ticks were late, their commands held; for fewer give a longer "
            "--period or --sched fifo"
        )


def _code_of(line: dict[str, Any]) -> ExitCode:
    """What a process that gave up before the first tick means for the launcher's exit code."""
    if line["code"] == "internal":
        return ExitCode.INTERNAL
    code = ExitCode(line.get("exit", ExitCode.START_UP_TIMEOUT))
    # Nothing internal is meant by an error without a code of its own: something was not to be had.
    return ExitCode.START_UP_TIMEOUT if code is ExitCode.INTERNAL else code
