"""What the faults that hit a run are decided to lead to: ways in which it may end, and ends that it must have.

Third step of a case, after the run has ended: from the plan, what really hit and what the launcher said, the
`chaos.aftermath.Expected` against which everything is checked. A way is an exit code together with the words
that must give its reason, so that a code is never right by chance. Of several faults every one may have come
first: the ways are united, and no end may be milder than any fault demands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from chaos.aftermath import Expected
from chaos.draw import (
    DEADLINE_S,
    ENDING,
    LAUNCHER,
    LIVE,
    NODE,
    PLANT,
    RECORDER,
    START_TIMEOUT_S,
    ZYGOTE,
    Case,
    RunDraw,
)
from chaos.prepare import Prepared
from chaos.scene import Hit

KILLED = -9
ORPHANS_S = 1.0
"""After the launcher's death everything else is gone within this."""
END_S = 3.0
LATE_S = 0.5
"""A fault so shortly before the last tick, or later, may find the run over."""
MARGIN_S = 0.5
"""A pause that is so much shorter than a deadline does not exceed it."""
PLANT_SILENT = r"the plant (does not answer|is gone|was ended)"
MANY_FILES = r"Too many open files"
SUMMARY_S = 2.0
"""So long the launcher may take from the last tick of a run to its own end."""
PATIENCE = 3
"""Deadlines that nodes wait for the plant, see node.process."""


@dataclass(frozen=True)
class Way:
    """A way in which a run may end."""

    code: int
    said: str = ""
    """Regular expression found in standard error: the reason."""


@dataclass(frozen=True)
class Demand:
    """An end that a fault must lead to, or to a graver one, unless the run was over."""

    code: int
    hit: Hit


@dataclass(frozen=True)
class Ended:
    """How a run ended, as its launcher showed it."""

    exit_code: int | None
    stderr: str
    begun: bool
    """It came to the first tick."""
    ended_at: float
    """On the monotonic clock."""


def _is(hit: Hit, kind: str, *targets: str) -> bool:
    return hit.fault.kind == kind and (not targets or hit.fault.target in targets)


class Judge:
    """The expectations of one case."""

    def __init__(
        self, case: Case, hits: Sequence[Hit], ended: Ended, prepared: Prepared | None
    ) -> None:
        self._run: RunDraw = case.run
        self._hits = hits
        self._ended = ended
        self._prepared = prepared

    def any(self, kind: str, *targets: str) -> bool:
        """Whether a fault of this kind hit one of these targets."""
        return any(_is(hit, kind, *targets) for hit in self._hits)

    # -- ends ---------------------------------------------------------------------------------------

    def ways(self) -> list[Way]:
        """Every way in which the run may end."""
        if self._prepared is not None and not (self._prepared.harmless and self._ended.begun):
            return [Way(self._prepared.code, self._prepared.said)]
        out = [*self._anyhow()]
        for hit in self._hits:
            out += self._running(hit) if self._ended.begun else self._starting(hit)
        return out

    def _anyhow(self) -> Iterator[Way]:
        """Without any fault: what a busy machine may do to a run by the clock."""
        if not self._ended.begun:
            return
        yield Way(0)
        if self._run.realtime:
            most = self._run.hold_ticks
            yield Way(3, r"ticks were late, their commands held")
            yield Way(3, r"sums between neighbours did not come in time and were bridged")
            # With --restart it goes on for some ticks more, if leaving nodes out may help.
            late = r"\d+" if self._run.restart else most + 1
            yield Way(4, rf"{late} late ticks in a row, {most} may be")
            if self._run.restart:  # nodes that the machine leaves no time are taken for stuck
                yield Way(3, r"(replaced|left out): node \d+")
                yield Way(4, r"more than half of the arm's")

    def _running(self, hit: Hit) -> Iterator[Way]:
        """What a fault may lead to in a run that has begun."""
        fault, restart = hit.fault, self._run.restart
        node = fault.node
        stuck = f"node {node} does not answer|no command within|waited .* s for"
        match fault.kind, fault.target:
            case "kill", "node":
                yield Way(4, rf"node {node} was ended by SIGKILL")
                yield Way(4, rf"nodes? ([\d, ]*, )?{node}(, [\d, ]*)? (is|are) gone")
                yield from self._replaced(hit)
            case "freeze", "node":
                if not self._run.realtime:
                    yield Way(4, stuck)
                yield from self._replaced(hit)
            case (("pause" | "slow"), "node"):
                if self._too_long(hit, DEADLINE_S):
                    yield Way(4, stuck)
                if self._run.realtime:
                    yield from self._replaced(hit)
            case "kill", "plant":
                yield Way(4, r"the plant was ended by SIGKILL")
            case "freeze", "plant":
                yield Way(4, PLANT_SILENT)
            case (("pause" | "slow"), "plant") if self._stop_ordered():
                yield Way(4, PLANT_SILENT)
            case "kill", "recorder":
                yield Way(3, r"the recorder was ended by SIGKILL")
            case "freeze", "recorder":
                yield Way(3, r"the recorder did not finish")
            case "kill", "zygote":
                yield Way(4, r"zygote was ended by SIGKILL|node \d+ |nodes [\d, ]+ are gone")
            case "disk", _:
                yield Way(3, r"the disk was full|File too large")
            case "directory gone", _:
                yield Way(3, r"it was deleted|it or its directory was moved or deleted")
            case "garbage", "node" if fault.variant == "nan":
                yield Way(4, r"not finite")
            case (("interrupt" | "terminate"), _):
                yield Way(130, r"interrupted")
            case "descriptors", "launcher":
                yield Way(2, MANY_FILES)
                yield Way(3, MANY_FILES)
            case (("kill" | "freeze"), "launcher"):
                yield Way(KILLED)
        if self._loses_records(hit):
            yield Way(3, r"records were lost \(\d+ node ticks")
        if restart and self._hampers_replacing(hit) and (self._deaths() or self._run.realtime):
            yield Way(4, r"not replaced within|cannot listen on")
            if _is(hit, "descriptors"):  # of the zygote: what it forks opens no session
                yield Way(4, r"node \d+( exited with code \d+|: Too many open files)")

    def _replaced(self, hit: Hit) -> Iterator[Way]:
        """A node process that is dead, or by the clock stuck, in a run with --restart."""
        if not self._run.restart:
            return
        yield Way(3, rf"(replaced|left out): .*node {hit.fault.node}\b")
        yield Way(4, r"node \d+ has had no ")  # a gap is bridged for so long and no longer
        if self._run.scenario != "hold":  # on the two sides of a gap
            yield Way(4, r"the next setpoint is")
        if len(self._deaths()) > len(self._run.firsts) // 2:
            yield Way(4, r"more than half of the arm's")

    def _deaths(self) -> set[int]:
        """Nodes that died or may have been taken for stuck."""
        kinds = ("kill", "freeze", "pause", "slow")
        return {h.fault.node for h in self._hits if any(_is(h, kind, NODE) for kind in kinds)}

    def _loses_records(self, hit: Hit) -> bool:
        held_up = any(_is(hit, kind, RECORDER) for kind in ("pause", "slow", "freeze"))
        return held_up or _is(hit, "hog") or _is(hit, "pause", PLANT) or _is(hit, "slow", PLANT)

    def _hampers_replacing(self, hit: Hit) -> bool:
        """Whether a node that has died may not be replaced in time, or not at all."""
        if _is(hit, "sockets gone") or _is(hit, "descriptors") or _is(hit, "flood"):
            return True
        return any(_is(hit, kind, ZYGOTE, LAUNCHER) for kind in ("pause", "freeze", "slow"))

    def _stop_ordered(self) -> bool:
        """Whether the plant may have been told to stop; it has a second to answer."""
        return any(self.any(kind) for kind in ENDING)

    def _too_long(self, hit: Hit, limit_s: float) -> bool:
        """Whether a pause, or pauses that follow each other, may exceed a deadline."""
        same = [
            h.fault.for_s
            for h in self._hits
            if (_is(h, "pause") or _is(h, "slow")) and h.fault.target == hit.fault.target
        ]
        return sum(same) > limit_s - MARGIN_S

    def _starting(self, hit: Hit) -> Iterator[Way]:
        """What a fault may lead to in a run that has not come to its first tick."""
        fault = hit.fault
        who = f"node {fault.node}" if fault.target == NODE else fault.target
        match fault.kind, fault.target:
            case (("interrupt" | "terminate"), _):
                yield Way(130, r"interrupted")
                if hit.alone:  # the interpreter was still being loaded
                    yield Way(-2)
                    yield Way(-15)
            case (("kill" | "freeze"), "launcher"):
                yield Way(KILLED)
            case "kill", _:
                yield Way(5, rf"start-up failed: .*{who} was ended by SIGKILL")
                if fault.target == ZYGOTE:
                    yield Way(5, r"start-up failed: .*node \d+ ")
            case "freeze", _:
                yield Way(5, r"not every link was up after")
            case (("pause" | "slow"), _) if self._too_long(hit, START_TIMEOUT_S):
                yield Way(5, r"not every link was up after")
            case "sockets gone", _:
                yield Way(5, r"cannot listen on|not every link was up after")
            case "directory gone", _:
                yield Way(2, r"recording .*: No such file or directory")
                yield Way(
                    2, r"processes.log: No such file or directory; the run's directory must stay"
                )
                yield Way(5, r"recording .*(No such file or directory|it was deleted)")
            case "disk", _:
                yield Way(2, r"recording .*: File too large")
            case "descriptors", _:
                yield Way(5, r"start-up failed|not every link was up after")
                yield Way(2, MANY_FILES)
                if hit.alone:  # the interpreter cannot even open its own modules
                    yield Way(1, MANY_FILES)

    # -- what must be -------------------------------------------------------------------------------

    def demands(self) -> Iterator[Demand]:
        """Ends that must be, if the run was not over when the fault came."""
        if not self._ended.begun:
            return
        restart, realtime = self._run.restart, self._run.realtime
        for hit in self._hits:
            fault = hit.fault
            match fault.kind, fault.target:
                case (("kill" | "freeze"), "launcher"):
                    yield Demand(KILLED, hit)
                case (("interrupt" | "terminate"), _):
                    yield Demand(130, hit)
                case "kill", ("plant" | "zygote"):
                    yield Demand(4, hit)
                case "freeze", "plant":
                    yield Demand(4, hit)
                case "kill", "node":
                    yield Demand(3 if restart else 4, hit)
                case "freeze", "node":
                    yield Demand(3 if restart and realtime else 4, hit)
                case (("kill" | "freeze"), "recorder"):
                    yield Demand(3, hit)
                case "directory gone", _:
                    yield Demand(3, hit)

    def expected(self) -> Expected:
        """For the check of everything else, given how the run ended."""
        ended, begun = self._ended, self._ended.begun
        fitting = [way for way in self.ways() if way.code == ended.exit_code]
        reasons = [way.said for way in fitting if way.said]
        explained = not fitting or len(reasons) < len(fitting)
        said = () if explained else ("|".join(reasons),)
        codes = tuple(sorted({way.code for way in self.ways()}))
        killed = ended.exit_code == KILLED
        disturbed = killed or any(
            self.any(kind, RECORDER) for kind in ("kill", "freeze", "disk", "descriptors")
        )
        gone = self.any("directory gone")
        whole = begun and not (disturbed or gone)
        return Expected(
            codes=codes,
            events=tuple(self._events()) if whole else (),
            said=said,
            recording=None if gone or disturbed else begun,
            finished=True if whole else None,
            ticks=0,
            # An interpreter that loads its modules says it no better.
            traceback=any(hit.alone and _is(hit, "descriptors", LAUNCHER) for hit in self._hits),
            gone_s=ORPHANS_S if killed else END_S,
        )

    def _events(self) -> Iterator[str]:
        yield r"^started: "
        match self._ended.exit_code:
            case 0 | 3:
                yield r"^finished: "
            case 4:
                yield r"^safety_stop: "
                plant_lost = self.any("kill", PLANT) or self.any("freeze", PLANT)
                if not plant_lost and not self.any("descriptors", PLANT):
                    yield r"^passive: "
            case 130:  # the summary of a run that is over can be interrupted as well
                yield r"^(interrupted|finished): "

    def frozen(self) -> bool:
        """Whether stopped processes may be left: the launcher was killed, and nobody else ends them."""
        targets = (NODE, PLANT, RECORDER, ZYGOTE, LIVE)
        return self._ended.exit_code == KILLED and self.any("freeze", *targets)

    def too_mild(self, last_tick: Callable[[], float | None]) -> Iterator[str]:
        """Demands that the end does not meet. `last_tick` says when the last tick of a run that did all of
        them began, None if it did not or nobody knows."""
        code = self._ended.exit_code
        if code is None:
            return
        for demand in self.demands():
            hit, wanted = demand.hit, demand.code
            if code == KILLED or self._grave_enough(code, wanted, hit):
                continue
            over = last_tick()
            if over is None and not self._run.endless:
                over = self._ended.ended_at - SUMMARY_S
            if over is not None and hit.at > over - LATE_S:
                continue
            yield f"exit code {code}, though {hit.fault} hit: it demands {wanted}"

    def _grave_enough(self, code: int, wanted: int, hit: Hit) -> bool:
        match wanted:
            case 3:
                return code != 0
            case 4:
                return code == 4 or (code == 130 and self._interrupted_before(hit))
            case 130:
                return code in (130, 4)
        return code == wanted

    def _interrupted_before(self, hit: Hit) -> bool:
        """Whether the user ended the run before a fault could be noticed."""
        notice_s = LATE_S
        if _is(hit, "freeze", NODE):
            notice_s += DEADLINE_S
        if _is(hit, "freeze", PLANT):
            notice_s += PATIENCE * DEADLINE_S
        asked = [h for h in self._hits if h.fault.kind in ("interrupt", "terminate")]
        return any(h.at < hit.at + notice_s for h in asked)
