"""`octarm export`: a recording in the formats of other tools. Chooses the places, calls the writers.

The numbers are `analysis.export_tables`', the files `analysis.export_files`'.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from analysis.export_files import (
    FORMAT,
    RUN,
    check_pyarrow,
    write_csv,
    write_mat,
    write_npz,
    write_parquet,
)
from analysis.export_tables import DICTIONARY, Exported
from analysis.recording import find_recording, read_recording
from analysis.whole_directory import check_free_directory, whole_directory
from analysis.whole_file import check_free, whole
from wire.errors import UsageError

DIRECTORIES = {"parquet": write_parquet, "csv": write_csv}
"""Formats that make a directory with a file a table."""
FILES = {"npz": write_npz, "mat": write_mat}
"""Formats that make one file with arrays."""


def export(
    path: Path,
    formats: Sequence[str],
    out: Path | None,
    progress: Callable[[str], None] = lambda _: None,
    *,
    force: bool = False,
) -> dict[str, Any]:
    """Write a recording (or that of a run's directory) in other formats; facts for --json.

    `formats` are of `DIRECTORIES` and `FILES`. `out` None is NAME-parquet, NAME-csv, NAME.npz, NAME.mat beside
    the recording. Each appears whole or not at all. Of a recording that was cut short everything that is there
    is exported, and `complete` is False. Raises UsageError if the recording cannot be read, no format is
    given, several are given with `out`, pyarrow is not there for parquet, or a target exists (without `force`)
    or cannot be written.
    """
    if not formats:
        raise UsageError("export: give at least one of --parquet, --csv, --npz, --mat")
    if out is not None and len(formats) > 1:
        raise UsageError(
            f"--out {out}: one name for {len(formats)} formats; give one format, or leave --out away"
        )
    path = find_recording(path)
    targets = {name: _target(path, name, out) for name in formats}
    if "parquet" in targets:
        check_pyarrow()
    for name, target in targets.items():
        if name in DIRECTORIES:
            check_free_directory(target, _is_export, force=force)
        else:
            check_free(target, force=force)
    progress(f"reading {path}")
    recording = read_recording(path)
    exported = Exported(recording)
    written = []
    for name, target in targets.items():
        progress(f"writing {target}")
        if name in DIRECTORIES:
            with whole_directory(target, _is_export, force=force) as growing:
                rows = DIRECTORIES[name](growing, exported)
        else:
            with whole(target, force=force) as growing:
                rows = FILES[name](growing, exported)
        files = sorted(target.iterdir()) if target.is_dir() else [target]
        written.append(
            {
                "format": name,
                "path": str(target),
                "bytes": sum(file.stat().st_size for file in files),
                "rows" if name in DIRECTORIES else "values": rows,
            }
        )
    return {
        "recording": str(path),
        "complete": recording.complete,
        "stops": recording.unfinished,
        "nodes": recording.nodes,
        "ticks": exported.ticks,
        "exports": written,
    }


def _target(path: Path, name: str, out: Path | None) -> Path:
    if out is None:
        beside = f"{path.stem}-{name}" if name in DIRECTORIES else f"{path.stem}.{name}"
        return path.with_name(beside)
    if name in FILES and out.suffix.lower() != f".{name}":
        raise UsageError(f"--out {out}: expected a name that ends in .{name}, got {out.name}")
    return out


def _is_export(folder: Path) -> bool:
    """Whether a directory is one that was made here, with nothing of the user's in it."""
    made = {RUN, *(f"{table}.{kind}" for table in DICTIONARY for kind in DIRECTORIES)}
    if not {file.name for file in folder.iterdir()} <= made:
        return False
    try:
        facts = json.loads((folder / RUN).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(facts, dict) and facts.get("format") == FORMAT


def export_lines(facts: dict[str, Any]) -> str:
    """The facts of `export` as text, a line a format."""
    lines = []
    for one in facts["exports"]:
        if "rows" in one:
            inside = ", ".join(f"{name} {rows}" for name, rows in one["rows"].items())
            inside = f"rows: {inside}"
        else:
            inside = f"{len(one['values'])} arrays, {sum(one['values'].values())} values"
        lines.append(f"{one['path']}: {inside}; {one['bytes'] / 1e6:.2f} MB")
    return "\n".join(lines)
