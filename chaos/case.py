"""One case: a run is started, hit and read to its end (chaos.trial); then all that must hold is checked.

Between `chaos.trial` and `chaos.worker`, a process that does one case after another.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from analysis.recording import Recording, read_recording
from chaos.aftermath import RECORDING, Remains, event_lines, violations
from chaos.draw import ENDING, Case
from chaos.expect import END_S, KILLED, Ended, Judge
from chaos.processes import end_all, living, outliving
from chaos.scene import Hit
from chaos.trial import CURTAIN, BrokenOffError, Trial
from wire.errors import OctarmError


@dataclass
class Result:
    """What became of a case."""

    number: int
    hits: list[dict[str, Any]] = field(default_factory=list)
    """Faults that came, each with name, instant and what was done."""
    missed: list[str] = field(default_factory=list)
    """Names of those whose target was not there."""
    exit_code: int | None = None
    begun: bool = False
    wrong: list[str] = field(default_factory=list)
    """Violations, in words."""
    seconds: float = 0.0
    end_s: dict[str, float] = field(default_factory=dict)
    """By name of a fault that ended the run: from it to the launcher's end."""
    gone_s: float = 0.0
    """From the launcher's end to that of everything else."""
    directory: str = ""
    """Where everything about it is kept; empty if nothing is."""


def check(trial: Trial, ended: Ended) -> tuple[list[str], float]:
    """What is not as it must be, and how long the run's other processes outlived the launcher, s."""
    judge = Judge(trial.case, trial.hits, ended, trial.prepared)
    expected = judge.expected()
    trial.scene.close()  # what the faults themselves started
    if ended.exit_code is None:
        stuck = ", ".join(map(str, living(trial.mark)))
        end_all(trial.mark)
        return [f"it hangs, with {stuck}; standard error: {ended.stderr[-400:]!r}"], 0.0
    left = outliving(trial.mark, expected.gone_s)
    gone_s = time.monotonic() - ended.ended_at
    if judge.frozen():  # a process that is stopped hears of no death
        for process in left:
            if process.stopped:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGKILL)
        outliving(trial.mark, END_S)
        gone_s = 0.0
    remains = Remains(
        trial.mark,
        trial.sockets,
        trial.work,
        ended.exit_code,
        trial.text("stdout"),
        ended.stderr,
    )
    wrong = violations(remains, expected)
    wrong += judge.too_mild(lambda: _last_tick(trial))
    stopped = ("passive: ", "safety_stop: ")
    if ended.exit_code == 130 and any(e.startswith(stopped) for e in _events(trial)):
        wrong.append("exit code 130, though the arm had been stopped for a fault before")
    return wrong, gone_s


def _recording(trial: Trial) -> Recording | None:
    for path in trial.work.rglob(RECORDING):
        with contextlib.suppress(OctarmError):
            return read_recording(path)
    return None


def _events(trial: Trial) -> list[str]:
    recording = _recording(trial)
    return [] if recording is None else event_lines(recording)


def _last_tick(trial: Trial) -> float | None:
    """When the last tick of a run that did all of them began, on the monotonic clock."""
    recording = _recording(trial)
    if recording is None or recording.ticks < recording.configuration.ticks:
        return None
    began = recording.table("/sweep/timing").numbers("started_wall_ns")
    return 1e-9 * (float(began[recording.ticks - 1]) + int(recording.facts["epoch_ns"]))


def _keep_strays(trial: Trial) -> None:
    """Copy what was left in the run's TMPDIR: a traceback, for example."""
    for path in trial.sockets.rglob("*"):
        if path.is_file():
            shutil.copy(path, trial.work)


def story(trial: Trial, ended: Ended) -> dict[str, Any]:
    """Everything about the case, as it is kept."""
    since = trial.began
    return {
        "seed": trial.case.seed,
        "number": trial.case.number,
        "command": trial.command,
        "plan": [asdict(fault) for fault in trial.case.faults],
        "begun_s": None if trial.begun_at is None else trial.begun_at - since,
        "ended_s": ended.ended_at - since,
        "exit_code": ended.exit_code,
        "hits": [told(hit, since) for hit in trial.hits],
        "missed": [str(fault) for fault in trial.missed],
    }


def told(hit: Hit, since: float) -> dict[str, Any]:
    """A hit for people and files; instants in s since the launch."""
    return {
        "fault": str(hit.fault),
        "name": hit.fault.name,
        "at_s": round(hit.at - since, 4),
        "what": hit.what,
        "begun": hit.begun,
        "curtain": hit.fault.variant == CURTAIN,
    }


def run_case(
    case: Case, out: Path, *, keep: bool = False, broken_off: Callable[[], bool] = lambda: False
) -> Result:
    """Do one case below `out`; its directory is kept if something is wrong, or with `keep`."""
    work = out / f"case-{case.number}"
    work.mkdir(parents=True)
    began = time.monotonic()
    with Trial(case, work, broken_off) as trial:
        try:
            ended = trial.finish()
            wrong, gone_s = check(trial, ended)
        except BrokenOffError:
            shutil.rmtree(work, ignore_errors=True)
            raise
        told_of = story(trial, ended)
        if wrong or keep:
            (work / "stderr.txt").write_text(ended.stderr)
            (work / "stdout.txt").write_text(trial.text("stdout"))
            _keep_strays(trial)
            (work / "case.json").write_text(json.dumps(told_of | {"wrong": wrong}, indent=1))
        else:
            shutil.rmtree(work)
        return Result(
            number=case.number,
            hits=told_of["hits"],
            missed=[fault.name for fault in trial.missed],
            exit_code=ended.exit_code,
            begun=ended.begun,
            wrong=wrong,
            seconds=time.monotonic() - began,
            end_s=_ends(trial.hits, ended),
            gone_s=gone_s if ended.exit_code == KILLED else 0.0,
            directory=str(work) if wrong or keep else "",
        )


def _ends(hits: Sequence[Hit], ended: Ended) -> dict[str, float]:
    """From the first fault that ends a run to the launcher's end, where it did."""
    if ended.exit_code not in (4, 130, KILLED):
        return {}
    if any(hit.fault.variant == CURTAIN for hit in hits):
        return {}
    first = next((hit for hit in hits if hit.fault.kind in ENDING and hit.begun), None)
    return {} if first is None else {first.fault.name: ended.ended_at - first.at}
