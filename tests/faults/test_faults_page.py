"""docs/faults.md: every row of its tables has all its columns and names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "faults.md").read_text()
COLUMNS = ["fault", "detection", "behaviour", "bound", "exit code", "test"]


def rows() -> list[list[str]]:
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in PAGE.splitlines()
        if line.startswith("|") and not line.startswith("|---")
    ]
    wide = [row for row in cells if len(row) == len(COLUMNS)]
    return [row for row in wide if row != COLUMNS and row[0] != "fault"]


def test_every_row_names_tests_that_exist() -> None:
    found = rows()
    assert len(found) > 50
    for row in found:
        assert all(row), row
        path = ""
        names = re.findall(r"(tests/[\w/]+\.py)?(?:::(\w+))?", row[-1])
        named = [(file, name) for file, name in names if file or name]
        assert named, row
        for file, name in named:
            path = file or path
            source = (ROOT / path).read_text()
            assert not name or f"def {name}(" in source, f"{path}::{name}"


def test_every_exit_code_is_one_that_is_documented() -> None:
    known = {"0", "1", "2", "3", "4", "5", "6", "130", "-9"}
    for row in rows():
        codes = re.findall(r"-?\d+", row[-2])
        assert codes or row[-2] in ("-", "the signal's"), row
        assert set(codes) <= known, row
