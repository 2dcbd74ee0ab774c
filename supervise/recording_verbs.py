"""The verbs of the command line that look at recordings, one function each.

Part of launcher.py in a file of its own; what a verb does lives in `analysis` and `supervise`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from supervise.entry import show_json, teller
from wire.errors import ExitCode

Flag = tyro.conf.FlagCreatePairsOff[bool]


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
    """Make a GIF of a run: true and estimated arm, reference and active setpoint over time.

    Args:
        recording: The recording, or the run's directory that holds it.
        out: GIF to write, default arm.gif beside the recording.
        fps: Frames a second of the film.
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


def info(
    recording: tyro.conf.Positional[Path],
    *,
    every: Annotated[Flag, tyro.conf.arg(name="all")] = False,
    json: Flag = False,
) -> int:
    """Say what a recording is: the run, its messages and latencies, the file and whether it is whole.

    Args:
        recording: The recording, or the run's directory that holds it; also one that was cut short or damaged.
        every: Show every topic, process, link and event, instead of those of all nodes together.
        json: Print one JSON object instead of the tables.
    """
    from analysis.info import info as facts_of
    from analysis.info_table import info_table
    from analysis.recording import find_recording

    facts = facts_of(find_recording(recording))
    show_json(facts) if json else print(info_table(facts, every=every), end="")
    return int(ExitCode.OK if facts["whole"] else ExitCode.DEGRADED)


def recover(
    recording: tyro.conf.Positional[Path],
    *,
    out: Path | None = None,
    force: Flag = False,
    json: Flag = False,
) -> int:
    """Make a closed, indexed recording of what is left of one that was cut short or damaged.

    Args:
        recording: The recording, or the run's directory that holds it; a whole one is left alone.
        out: File to write, default NAME.recovered.mcap beside the recording.
        force: Write over an existing file.
        json: Print one JSON object instead of lines.
    """
    from analysis.recording import find_recording
    from analysis.recover import recover as make_whole
    from analysis.recover import recover_text

    facts = make_whole(find_recording(recording), out, force=force)
    show_json(facts) if json else print(recover_text(facts))
    return int(ExitCode.OK)
