"""What `octarm solve` does: one problem file, or the suite of reference problems; facts, table, verdict.

Between the command line and the engine's process (`supervise.solving`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.solve_table import answer_table, suite_table
from design.solve_command import Choices, prepare
from design.solve_suite import read_suite
from supervise import solving
from supervise.shipped import SUITE
from supervise.suite import run_suite
from wire.config_json import finite
from wire.errors import UsageError


@dataclass(frozen=True)
class Found:
    """What came out."""

    facts: dict[str, Any]
    """As --json prints them."""
    table: str
    well: bool
    """Certified; of the suite: every row."""
    interrupted: bool


def ask_file(
    file: Path | None, only: tuple[str, ...], choices: Choices, progress: Callable[[str], None]
) -> Found:
    """The answer to a problem file. Raises UsageError for a file or choice that cannot be used."""
    if file is None or only:
        raise UsageError(
            "--only: is for --suite" if only else "FILE: expected a problem file, or --suite"
        )
    answer = solving.solve_in_child(prepare(file, choices), progress)
    certified = answer.facts["status"] == "certified"
    return Found(finite(answer.facts), answer_table(answer.facts), certified, answer.interrupted)


def ask_suite(
    file: Path | None, only: tuple[str, ...], choices: Choices, progress: Callable[[str], None]
) -> Found:
    """The reference problems against what is true. Raises UsageError for a choice that cannot be used."""
    own = Choices(time_limit_s=choices.time_limit_s, solver=choices.solver)
    if file is not None or choices != own:
        raise UsageError(
            "--suite: takes --only, --time-limit and --solver, no file or other choice"
        )
    rows = read_suite(SUITE, only)
    table = run_suite(rows, SUITE.parent, choices, solving.solve_in_child, progress)
    return Found(finite(table), suite_table(table), table["ok"], table["interrupted"])
