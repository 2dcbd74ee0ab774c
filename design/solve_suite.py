"""The reference problems of `octarm solve --suite`: their file is read here and each answer judged.

Between `examples/suite.toml` and `supervise.suite`, which asks the engine. The rule is the same for all rows: a
bound on the wrong side of the truth fails whatever the solver said, one too far on the right side as well.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from design.lpi.result import Status
from design.pde.names import suggestion
from design.pde.problem_file import Task
from wire.errors import UsageError
from wire.files import TEXT_BYTES, read_limited

ROUNDING = 1e-4
"""Allowance on the wrong side of the truth, relative: the reference values are given to that many digits."""


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One problem with its truth; `examples/suite.toml` says what each key means."""

    id: str
    problem: str
    file: str
    task: str
    true: float | Literal["stable"]
    published: tuple[float | str, ...]
    tolerance: float
    seconds: float

    def __post_init__(self) -> None:
        if not self.id or not 1.0 < self.tolerance < 2.0 or not self.seconds > 0.0:
            raise ValueError("expected an id, 1 < tolerance < 2 and seconds > 0")
        if isinstance(self.true, float) and not self.true > 0.0:
            raise ValueError("true: expected a positive number")
        if self.true == "stable" and self.task != Task.STABILITY:
            raise ValueError('true = "stable" is for the task stability')

    @property
    def asks_for_limit(self) -> bool:
        """Whether the answer is a limit of stability: a lower bound; all other numbers are upper bounds."""
        return self.task == Task.STABILITY and self.true != "stable"


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Judgement:
    """Of one answer; value: its gamma or limit, ratio: value / true, reason: why it fails."""

    ok: bool
    reason: str = ""
    value: float | None = None
    ratio: float | None = None


def read_suite(path: Path, only: Sequence[str] = ()) -> tuple[Row, ...]:
    """The rows of a suite file, or those of the given ids, in the file's order.

    UsageError for a file that cannot be used and for an id that is not in it.
    """
    where = f"suite {path}"
    try:
        data = tomllib.loads(read_limited(path, TEXT_BYTES).decode())
        rows = msgspec.convert(data, _File).rows
    except OSError as error:
        raise UsageError(f"{where}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # of TOML, UTF-8 and msgspec
        raise UsageError(f"{where}: {error}") from None
    names = [row.id for row in rows]
    if not names or len(set(names)) < len(names):
        raise UsageError(
            f"{where}: expected rows with distinct ids, got {', '.join(names) or 'none'}"
        )
    unknown = [name for name in only if name not in names]
    if unknown:
        raise UsageError(
            f"--only {unknown[0]}: there is no such row{suggestion(unknown[0], names)} "
            f"(rows: {', '.join(names)})"
        )
    return tuple(row for row in rows if not only or row.id in only)


def judge(row: Row, facts: dict[str, Any]) -> Judgement:
    """Whether an answer (`solve_command.facts`) meets the row's truth within its tolerance."""
    value = facts["limit"] if row.asks_for_limit else facts["gamma"]
    if facts["status"] != Status.CERTIFIED:
        return Judgement(False, f"{facts['status']}: {facts['message']}", value)
    if not isinstance(row.true, float):
        return Judgement(True)
    if value is None:
        return Judgement(False, f"certified, but no number came: {facts['message']}")
    ratio = value / row.true
    if row.asks_for_limit:
        wrong, far = ratio > 1.0 + ROUNDING, not ratio >= 2.0 - row.tolerance
        side, bound = "above", f"at least {row.true * (2.0 - row.tolerance):.6g}"
    else:
        wrong, far = ratio < 1.0 - ROUNDING, not ratio <= row.tolerance
        side, bound = "below", f"at most {row.true * row.tolerance:.6g}"
    if wrong:
        reason = f"{value:.8g} is {side} the truth, {row.true:.8g}: no bound at all"
    elif far:
        reason = f"{value:.6g} is not {bound}, as the tolerance {row.tolerance:g} asks for"
    else:
        reason = ""
    return Judgement(not reason, reason, value, ratio)


def row_facts(row: Row, answer: dict[str, Any] | None, trouble: str = "") -> dict[str, Any]:
    """One row of the suite's table as plain data; without an answer the trouble is what it failed by."""
    judgement = judge(row, answer) if answer else Judgement(False, trouble)
    return {
        "id": row.id,
        "problem": row.problem,
        "file": row.file,
        "task": row.task,
        "true": row.true,
        "ours": judgement.value,
        "ratio": judgement.ratio,
        "published": list(row.published),
        "tolerance": row.tolerance,
        "achieved": answer and answer["achieved"],
        "degree": answer and answer["degree"],
        "seconds": answer and answer["seconds"],
        "seconds_allowed": row.seconds,
        "peak_memory_mb": answer and answer["peak_memory_mb"],
        "status": answer and answer["status"],
        "ok": judgement.ok,
        "reason": judgement.reason,
        "answer": answer,
    }
