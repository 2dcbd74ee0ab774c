"""Writes the tables of a recording as Parquet or CSV, its arrays as npz or mat, and run.json about them.

Last step of the export; every double survives bit for bit in each of them.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from analysis.export_tables import DICTIONARY, ColumnInfo, Exported
from analysis.facts import fact
from analysis.table import Column
from wire.channels import SUMMARY
from wire.errors import UsageError

FORMAT = "octarm-export"
VERSION = 1
RUN = "run.json"
NO_PYARROW = "--parquet: it needs pyarrow, which is not installed; pip install 'octarm[parquet]'"


def run_facts(exported: Exported) -> dict[str, Any]:
    """What run.json has: the run, and for every table its rows and its columns with unit and description."""
    recording = exported.recording
    return {
        "format": FORMAT,
        "version": VERSION,
        "recording": recording.path.name,
        "complete": recording.complete,
        "stops": recording.unfinished,
        "nodes": recording.nodes,
        "ticks": exported.ticks,
        "tick_s": recording.tick_s,
        "configuration": json.loads(recording.facts["run"]),  # as wire.config_json has read it
        "arm": msgspec.to_builtins(recording.artefact.arm),
        "metadata": {k: fact(v) for k, v in recording.facts.items() if k != "run"},
        SUMMARY: {k: fact(v) for k, v in (recording.counters or {}).items()},
        "tables": {
            name: [dataclasses.asdict(column) for column in columns]
            for name, columns in DICTIONARY.items()
        },
    }


def run_text(exported: Exported) -> str:
    """The text of run.json."""
    return json.dumps(run_facts(exported), indent=1, allow_nan=False) + "\n"


def write_csv(folder: Path, exported: Exported) -> dict[str, int]:
    """A CSV file (RFC 4180 but with LF, UTF-8) for each table, and run.json; returns the numbers of rows.

    Doubles have as many digits as it takes to read the same one back, at most 17; what is missing is empty.
    """
    rows = {}
    for name in DICTIONARY:
        table = exported.table(name)
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table)
            writer.writerows(zip(*map(_cells, table.values()), strict=True))
        rows[name] = _rows(table)
    (folder / RUN).write_text(run_text(exported), encoding="utf-8")
    return rows


def _cells(column: Column) -> list[Any]:
    values = column.tolist()
    if column.dtype == np.float64 and np.isnan(column).any():
        return ["" if math.isnan(value) else value for value in values]
    return list(values)


def write_parquet(folder: Path, exported: Exported) -> dict[str, int]:
    """A Parquet file for each table, and run.json; returns the numbers of rows. What is missing is null.

    Every field's metadata has `unit` and `description`. Raises UsageError if pyarrow is not installed.
    """
    check_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {"int64": pa.int64(), "double": pa.float64(), "text": pa.string()}
    rows = {}
    for name, columns in DICTIONARY.items():
        table = exported.table(name)
        schema = pa.schema(
            [pa.field(one.name, kinds[one.type], metadata=_about(one)) for one in columns],
            metadata={
                "octarm": json.dumps(
                    {"table": name, "run_id": exported.recording.configuration.run_id}
                )
            },
        )
        arrays = [
            pa.array(values, kind, mask=np.isnan(values) if values.dtype == np.float64 else None)
            for values, kind in zip(table.values(), schema.types, strict=True)
        ]
        pq.write_table(
            pa.Table.from_arrays(arrays, schema=schema),
            folder / f"{name}.parquet",
            compression="zstd",
        )
        rows[name] = _rows(table)
    (folder / RUN).write_text(run_text(exported), encoding="utf-8")
    return rows


def check_pyarrow() -> None:
    """Raise UsageError if pyarrow is not installed."""
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise UsageError(NO_PYARROW) from None


def _about(column: ColumnInfo) -> dict[str, str]:
    return {"unit": column.unit, "description": column.description}


def write_npz(path: Path, exported: Exported) -> dict[str, int]:
    """All arrays in one compressed npz without pickles, and the text of run.json; returns their sizes."""
    arrays = {name: _unicode(values) for name, values in exported.arrays().items()}
    with path.open("wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, **arrays, run_json=np.array(run_text(exported))
        )
    return _sizes(arrays)


def _unicode(values: Column) -> Column:
    return values.astype(np.str_) if values.dtype == object else values


def write_mat(path: Path, exported: Exported) -> dict[str, int]:
    """All arrays in one MAT-file (version 5, compressed), texts as cell arrays; returns their sizes.

    Raises UsageError if an array is too large for the format (4 GiB).
    """
    from scipy.io import savemat
    from scipy.io.matlab import MatWriteError

    arrays = exported.arrays()
    try:
        savemat(
            path,
            {**arrays, "run_json": run_text(exported)},
            appendmat=False,
            do_compression=True,
            oned_as="column",
        )
    except MatWriteError as error:
        raise UsageError(f"--mat: {error}; use --npz or --parquet for a run so long") from None
    return _sizes(arrays)


def _rows(table: dict[str, Column]) -> int:
    return int(next(iter(table.values())).size)


def _sizes(arrays: Mapping[str, Column]) -> dict[str, int]:
    return {name: int(values.size) for name, values in arrays.items()}
