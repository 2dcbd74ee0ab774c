"""The benchmark's JSON file: written whole or not at all, read back for a comparison.

docs/bench.md has every key.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from wire.errors import UsageError
from wire.files import DATA_BYTES, read_limited

FORMAT = "octarm-bench-1"


def write_results(facts: Mapping[str, Any], path: Path) -> None:
    """Write the file; UsageError if that cannot be done, ValueError for a number that is not finite."""
    text = json.dumps(facts, indent=1, allow_nan=False) + "\n"
    growing: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=".json")
        growing = Path(name)
        with os.fdopen(handle, "w") as file:
            file.write(text)
        growing.chmod(0o644)
        growing.replace(path)
    except OSError as error:
        raise UsageError(f"--out {path.parent}: {error.strerror or error}") from None
    finally:
        if growing is not None:
            with suppress(OSError):
                growing.unlink(missing_ok=True)


def read_results(path: Path) -> dict[str, Any]:
    """The content of a file that `write_results` wrote; UsageError if it is missing or damaged."""
    if path.is_dir():
        path /= "bench.json"
    try:
        facts = json.loads(read_limited(path, DATA_BYTES))
    except OSError as error:
        raise UsageError(f"--compare {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise UsageError(f"--compare {path}: not JSON ({error}); give a bench.json") from None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise UsageError(f'--compare {path}: expected a file with "format": "{FORMAT}"')
    if not isinstance(facts.get("date"), str):
        raise UsageError(f"--compare {path}: date is missing; the file is damaged")
    for table in ("rows", "rates"):
        rows = facts.get(table)
        if not isinstance(rows, list) or not all(_is_row(row) for row in rows):
            raise UsageError(
                f"--compare {path}: expected {table} to be a list of objects with pattern and nodes; "
                "the file is damaged"
            )
    return facts


def _is_row(row: object) -> bool:
    return (
        isinstance(row, dict)
        and isinstance(row.get("pattern"), str)
        and isinstance(row.get("nodes"), int)
    )
