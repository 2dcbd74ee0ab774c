"""The main job from options to result: plan, directory, processes, summary, plot.

Between the command line, which only knows options and printing, and the conductor, which only knows
processes.
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from supervise.conductor import Conductor, Interrupted, log_of
from supervise.endpoints import Endpoints, check_live_port, choose, over_hosts
from supervise.options import RunOptions
from supervise.plan import Plan, make_plan, new_run_id, prepare
from supervise.state import Outcome
from supervise.view import View, choose_view
from wire.errors import ExitCode, UsageError

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
    prepared = prepare(options)
    run_id = new_run_id()
    endpoints = _meet(options)
    try:
        directory, made = _make_directory(options.out, run_id)
        with choose_view(prepared.course.ticks, quiet=quiet) as view:
            if options.live and not options.realtime:
                view.note(
                    "--live: in lock-step the run is over as soon as it can be; to watch it add --realtime"
                )
            try:
                outcome = _conduct(make_plan(prepared, endpoints, run_id, directory), view)
            except BaseException:
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


def _meet(options: RunOptions) -> Endpoints:
    if options.placed_on is not None:
        return over_hosts(options.placed_on)
    return choose(options.nodes, options.transport, options.base_port, options.socket_dir)


def _conduct(plan: Plan, view: View) -> Outcome:
    with Conductor(plan, view) as conductor:
        try:
            return conductor.run()
        except Interrupted:
            text = "interrupted before the first tick"
            return Outcome(ExitCode.INTERRUPTED, text, 0, 0.0)


def _make_directory(out: Path | None, run_id: str) -> tuple[Path, bool]:
    """The run's own directory, and whether it was made here; nothing is ever written over."""
    directory = Path("runs") / run_id if out is None else out
    try:
        made = not directory.exists()
        directory.mkdir(parents=True, exist_ok=True)
        occupied = next((file.name for file in directory.iterdir()), None)
        if occupied is None:
            occupied = _claim(log_of(directory))
    except OSError as error:
        raise UsageError(
            f"--out {directory}: {error.strerror or error}; give a directory that can be written"
        ) from None
    if occupied is not None:
        raise UsageError(
            f"--out {directory}: there is something in it already ({occupied}); nothing is "
            "written over, give another directory"
        )
    return directory.absolute(), made


def _claim(log: Path) -> str | None:
    """Make the run's log, empty; its name if another run was quicker to take the directory."""
    try:
        log.touch(exist_ok=False)
    except FileExistsError:
        return log.name
    return None


def _remove_if_empty(directory: Path, made: bool) -> None:
    """Leave no empty directory behind a run that never began; keep what explains why."""
    for file in directory.iterdir():
        empty_log = file == log_of(directory) and file.stat().st_size == 0
        if file.name == RECORDING or file.match("node-*.json") or empty_log:
            file.unlink()
    if made and not any(directory.iterdir()):
        directory.rmdir()


def _conclude(result: Result, view: View, plot: bool) -> None:
    """Read the recording back: figures and plot."""
    outcome = result.outcome
    if not result.recording.exists():
        return
    try:
        from analysis.recording import read_recording
        from analysis.summary import summary_of

        recording = read_recording(result.recording)
        result.summary = summary_of(recording)
        if plot and outcome.ticks > 1:
            from analysis.plot import plot_recording

            target = result.directory / PLOT
            plot_recording(recording, target)
            result.plot = target
    except Exception as error:
        if outcome.exit_code is not ExitCode.OK:
            view.note(f"no summary of the broken-off run: {error}")
            return
        with log_of(result.directory).open("a") as log:
            traceback.print_exc(file=log)
        outcome.exit_code = ExitCode.INTERNAL
        outcome.message = (
            f"the run is recorded, but its summary failed: {error}; see {log_of(result.directory)}"
        )
    result.summary |= {
        "run_s": outcome.run_s,
        "ticks_per_s": outcome.ticks / outcome.run_s if outcome.run_s > 0.0 else None,
        "recording": str(result.recording),
        "plot": None if result.plot is None else str(result.plot),
        "exit_code": int(outcome.exit_code),
        "message": outcome.message,
    }
