"""The main job from options to result: plan, directory, processes, summary, plot.

Between the command line, which only knows options and printing, and the conductor, which only knows
processes.
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from supervise.conductor import Conductor, Interrupted, log_of
from supervise.endpoints import Endpoints, check_live_port, choose, over_hosts
from supervise.entry import decide
from supervise.options import RunOptions
from supervise.own_directory import claim, tidy
from supervise.plan import make_plan, new_run_id, prepare
from supervise.state import Outcome
from supervise.view import View, choose_view
from wire.errors import ExitCode, UsageError
from wire.limits import files_exhausted, make_room_for_files, refusal

if TYPE_CHECKING:
    from supervise.secured import Secured

RECORDING = "recording.mcap"
PLOT = "plot.png"


@dataclass
class Result:
    """What a run left behind."""

    outcome: Outcome
    directory: Path
    recording: Path
    plot: Path | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    """From the recording (analysis.summary) and the launcher's own clock."""


def execute(options: RunOptions, *, quiet: bool, plot: bool) -> Result:
    """Run the arm once. Raises OctarmError if it did not come to the first tick."""
    check_live_port(options.live_port)
    if reason := make_room_for_files(-(-options.nodes // options.segments_per_process)):
        raise UsageError(f"--nodes {options.nodes}: {reason}")
    prepared = prepare(options)
    run_id = new_run_id()
    secured = _secured(options, run_id)
    endpoints = _meet(options)
    try:
        directory = Path("runs") / run_id if options.out is None else options.out
        made = claim(directory, log_of(directory).name)
        directory = directory.absolute()
        with choose_view(prepared.course.ticks, quiet=quiet) as view:
            if options.live and not options.realtime:
                view.note(
                    "--live: in lock-step the run is over as soon as it can be; to watch it add --realtime"
                )
            conductor: Conductor | None = None
            try:
                plan = make_plan(prepared, endpoints, run_id, directory, secured)
                conductor = Conductor(plan, view)
                outcome = _conduct(conductor)
            except BaseException:
                # Ctrl-C may also come when the processes have ended: then the recording is whole, and stays.
                if conductor is None or not conductor.begun:
                    _remove_if_empty(directory, made)
                raise
            result = Result(outcome, directory, directory / RECORDING)
            if outcome.run_s > 0.0:
                _conclude(result, view, plot)
            else:
                _remove_if_empty(directory, made)
    finally:
        endpoints.close()
    return result


def _secured(options: RunOptions, run_id: str) -> Secured | None:
    if options.keys is None:
        return None
    from supervise.secured import secure  # with `cryptography`, which other runs do without

    return secure(options, options.keys, run_id)


def _meet(options: RunOptions) -> Endpoints:
    tls = options.keys is not None
    if options.placed_on is not None:
        return over_hosts(options.placed_on, tls=tls)
    where = (options.transport, options.base_port, options.socket_dir)
    return choose(options.nodes, *where, tls=tls, later=True)


def _conduct(conductor: Conductor) -> Outcome:
    with conductor:
        try:
            outcome = conductor.run()
        except Interrupted:
            text = "interrupted before the first tick"
            return Outcome(ExitCode.INTERRUPTED, text, 0, 0.0)
        if outcome.exit_code is ExitCode.SAFETY_STOP:  # said even if the summary is interrupted
            decide(outcome.exit_code, f"{outcome.message}; interrupted before the summary")
        return outcome


def _remove_if_empty(directory: Path, made: bool) -> None:
    """Leave no empty directory behind a run that never began; keep what explains why."""
    if directory.is_dir():  # else somebody has removed it
        for file in directory.iterdir():
            if file.name == RECORDING or file.match("node-*.json"):
                file.unlink()
    tidy(directory, log_of(directory).name, made=made)


def _conclude(result: Result, view: View, plot: bool) -> None:
    """Read the recording back: figures and plot."""
    outcome = result.outcome
    if not result.recording.exists():
        _degrade(outcome, f"{result.recording} is gone: it or its directory was moved or deleted")
        return
    try:
        from analysis.recording import read_recording
        from analysis.summary import summary_of

        recording = read_recording(result.recording)
        result.summary = summary_of(recording)
        if plot and outcome.ticks > 1:
            from analysis.plot import plot_recording

            target = result.directory / PLOT
            try:
                plot_recording(recording, target)
                result.plot = target
            except UsageError as error:
                _degrade(outcome, str(error))
    except Exception as error:
        refused = refusal(error) or refusal(files_exhausted() or error)
        if refused is not None:
            _degrade(outcome, f"the run is recorded, but not summarised: {refused}")
            result.summary = _own_facts(result)
            return
        if outcome.exit_code is not ExitCode.OK:
            view.note(f"no summary of the broken-off run: {error}")
            return
        with log_of(result.directory).open("a") as log:
            traceback.print_exc(file=log)
        outcome.exit_code = ExitCode.INTERNAL
        outcome.message = (
            f"the run is recorded, but its summary failed: {error}; see {log_of(result.directory)}"
        )
    result.summary |= _own_facts(result)


def _own_facts(result: Result) -> dict[str, Any]:
    """What the launcher knows of the run."""
    outcome = result.outcome
    return {
        "run_s": outcome.run_s,
        "ticks_per_s": outcome.ticks / outcome.run_s if outcome.run_s > 0.0 else None,
        "recording": str(result.recording),
        "plot": None if result.plot is None else str(result.plot),
        "exit_code": int(outcome.exit_code),
        "message": outcome.message,
    }


def _degrade(outcome: Outcome, message: str) -> None:
    """Say that a run that went well otherwise left less than it should."""
    if outcome.exit_code in (ExitCode.OK, ExitCode.DEGRADED):
        outcome.exit_code = ExitCode.DEGRADED
        outcome.message = "; ".join(filter(None, (outcome.message, message)))
