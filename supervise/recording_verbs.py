"""The verbs of the command line that look at recordings, one function each.

Part of launcher.py in a file of its own; what a verb does lives in `analysis` and `supervise`.
"""

from __future__ import annotations

from pathlib import Path

import tyro

from supervise.entry import show_json, teller
from wire.errors import ExitCode

Flag = tyro.conf.FlagCreatePairsOff[bool]


def plot(
    recording: tyro.conf.Positional[Path],
    *,
    out: Path | None = None,
    only: tuple[str, ...] = (),
    width: float | None = None,
    dpi: int = 100,
    force: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Plot a run: shapes, errors, curvature, commands, sweeps, messages. Exit code 3 if it was cut short.

    Args:
        recording: The recording, or the run's directory that holds it.
        out: File to write, .png, .pdf or .svg; default panels.png or <the one panel>.png beside the recording.
        only: Panels to draw, default all: shapes, estimation, tip, curvature, curvature-error, deviation,
            curvature-course, velocity-course, regulated, commands, feedback, energy, sweeps, sweep-course,
            messages.
        width: Of the figure in inches; default 14, for one panel 9.
        dpi: Dots an inch; in .pdf and .svg only of the maps.
        force: Write over an existing file.
        json: Print one JSON object instead of a line.
        quiet: No progress.
    """
    from analysis.plot import Choice, plot_file, plot_line

    progress = teller(silent=quiet or json)
    facts = plot_file(recording, out, Choice(only, width, dpi), progress, force=force)
    show_json(facts) if json else print(plot_line(facts))
    return int(ExitCode.OK if facts["recording_complete"] else ExitCode.DEGRADED)


def animate(
    recording: tyro.conf.Positional[Path],
    *,
    out: Path | None = None,
    fps: float = 15.0,
    speed: float | None = None,
    width: int = 480,
    force: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Make a film of a run: true and estimated arm, reference and active setpoint over time.

    Args:
        recording: The recording, or the run's directory that holds it.
        out: File to write, .gif or .mp4 (for that ffmpeg must be there); default arm.gif beside the recording.
        fps: Frames a second of the film; a GIF has 50 at most, an MP4 60.
        speed: Seconds of the arm's time in a second of the film; default: the film lasts 10 s.
        width: Of the film in pixels.
        force: Write over an existing file.
        json: Print one JSON object instead of a line.
        quiet: No progress.
    """
    from analysis.animate import Film, film_line
    from analysis.animate import animate as make_film

    progress = teller(silent=quiet or json)
    facts = make_film(recording, out, Film(fps, speed, width), progress, force=force)
    show_json(facts) if json else print(film_line(facts))
    return int(ExitCode.OK)
