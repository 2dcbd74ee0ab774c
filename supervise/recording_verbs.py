"""The verbs of the command line that look at recordings, one function each.

Part of launcher.py in a file of its own; what a verb does lives in `analysis` and `supervise`.
"""

from __future__ import annotations

import sys
from pathlib import Path

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


def diff(
    a: tyro.conf.Positional[Path],
    b: tyro.conf.Positional[Path],
    *,
    tolerance: float | None = None,
    all: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Are two recordings the same run bit for bit, and if not, where and how far apart? Exit code 3 if not.

    Args:
        a: A recording, or the run's directory that holds it.
        b: Another one.
        tolerance: Differences up to this share of a field's largest magnitude count as none, 1e-9 for example.
        all: Show every field of every channel, also where nothing differs, and every key.
        json: Print one JSON object instead of tables.
        quiet: No progress.
    """
    from analysis.diff import diff as compare
    from analysis.diff_table import diff_table

    facts = compare(a, b, tolerance, teller(silent=quiet or json))
    show_json(facts) if json else print(diff_table(facts, everything=all))
    return int(ExitCode.OK if facts["same"] else ExitCode.DEGRADED)


def export(
    recording: tyro.conf.Positional[Path],
    *,
    parquet: Flag = False,
    csv: Flag = False,
    npz: Flag = False,
    mat: Flag = False,
    out: Path | None = None,
    force: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Write a recording for pandas, polars, R or MATLAB, bit for bit. Exit code 3 if it was cut short.

    Args:
        recording: The recording, or the run's directory that holds it.
        parquet: A directory with a Parquet file a table; needs pyarrow (octarm[parquet]).
        csv: A directory with a CSV file a table.
        npz: One file with arrays for numpy.
        mat: One file with arrays for MATLAB (version 5), also read by GNU Octave and scipy.
        out: Directory (parquet, csv) or file (npz, mat) to write, with one format; default NAME-parquet,
            NAME-csv, NAME.npz, NAME.mat beside the recording.
        force: Write over an existing export.
        json: Print one JSON object instead of a line a format.
        quiet: No progress.
    """
    from analysis.export import export as write
    from analysis.export import export_lines

    wanted = {"parquet": parquet, "csv": csv, "npz": npz, "mat": mat}
    formats = [name for name, yes in wanted.items() if yes]
    facts = write(recording, formats, out, teller(silent=quiet or json), force=force)
    show_json(facts) if json else print(export_lines(facts))
    if not facts["complete"]:
        stops = facts["stops"] or "has no final counters"
        print(
            f"octarm export: the recording {stops}; everything before is exported", file=sys.stderr
        )
    return int(ExitCode.OK if facts["complete"] else ExitCode.DEGRADED)
