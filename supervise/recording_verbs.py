"""The verbs of the command line that look at recordings, one function each.

Part of launcher.py in a file of its own; what a verb does lives in `analysis` and `supervise`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from supervise.entry import show_json, teller
from wire.errors import ExitCode

Flag = tyro.conf.FlagCreatePairsOff[bool]
From = Annotated[str | None, tyro.conf.arg(name="from")]


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
            messages, health.
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
    return int(ExitCode.OK if facts["recording_complete"] else ExitCode.DEGRADED)


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


def replay(
    recording: tyro.conf.Positional[Path],
    *,
    node: int | None = None,
    publish: Flag = False,
    first: From = None,
    to: str | None = None,
    deadline: float | None = None,
    rate: float | None = None,
    loop: Flag = False,
    at_once: Flag = False,
    listen: str | None = None,
    live: Flag = False,
    live_port: int | None = None,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Replay a recording: every node's mathematics, or one real process, compared bit for bit; or publish it.

    Args:
        recording: The recording, or the run's directory that holds it.
        node: Feed the recorded messages to the real process that has this node, over Zenoh.
        publish: Publish the telemetry over Zenoh again, for viewers, instead of comparing anything.
        first: First tick that is compared or published, or an instant of the arm such as 12.5s; default: 0.
        to: Last tick, or instant, that is compared or published; default: the last one.
        deadline: Longest wait for the process's answer in seconds, with --node; default: the run's.
        rate: Seconds of the arm's time in one of the clock, with --publish; default 1.
        loop: Begin again at the end, with --publish, until Ctrl-C.
        at_once: Begin without waiting for a subscriber, with --publish.
        listen: Zenoh endpoint for viewers, with --publish: tcp/ADDRESS:PORT or unixsock-stream/PATH; default:
            a free port of loopback.
        live: Serve a page that shows the arm, as `octarm run --live` does, with --publish, and begin when it is
            opened.
        live_port: Port of 127.0.0.1 for the page, with --live; default: a free one.
        json: Print one JSON object instead of the lines.
        quiet: No progress.
    """
    from supervise.replaying import Options, run_replay

    options = Options(
        recording=recording,
        node=node,
        publish=publish,
        first=first,
        last=to,
        deadline_s=deadline,
        rate=rate,
        loop=loop,
        at_once=at_once,
        listen=listen,
        live=live,
        live_port=live_port,
    )
    done = run_replay(options, teller(silent=quiet or json))
    show_json(done.facts) if json else print(done.text)
    return int(done.exit_code)


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
