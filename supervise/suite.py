"""`octarm solve --suite`: every reference problem in turn, each in a process of its own, against the truth.

One rule for all rows: the engine chooses, no row has settings of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from design.lpi.result import Progress, silent
from design.solve_command import Choices, Request, prepare
from design.solve_suite import Row, row_facts
from supervise.solving import Answer
from wire.errors import OctarmError, UsageError

Solve = Callable[[Request, Progress], Answer]


def run_suite(
    rows: Sequence[Row],
    folder: Path,
    choices: Choices,
    solve: Solve,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The suite's table as plain data; rows that fail for any reason are in it, Ctrl-C ends it early.

    folder: that the rows' files are in. choices: time limit and solver for every row. solve: answers one
    request (`supervise.solving.solve_in_child`). UsageError, before any work, for a file that cannot be used.
    """
    began = time.monotonic()
    requests = [
        prepare(
            folder / row.file,
            Choices(task=row.task, time_limit_s=choices.time_limit_s, solver=choices.solver),
        )
        for row in rows
    ]
    done: list[dict[str, Any]] = []
    interrupted = False
    for number, (row, request) in enumerate(zip(rows, requests, strict=True), start=1):
        progress(f"{row.id} ({number} of {len(rows)}): {row.problem}")

        def tell(text: str, name: str = row.id) -> None:
            progress(f"{name}: {text}")

        try:
            answer = solve(request, tell)
        except KeyboardInterrupt:  # between two children
            interrupted = True
            break
        except (OctarmError, RuntimeError) as error:
            if isinstance(error, UsageError) and not done:
                raise  # what is wrong with the first row is wrong with all: a solver that is not there
            done.append(row_facts(row, None, str(error)))
        else:
            if answer.interrupted:
                interrupted = True
                break
            done.append(row_facts(row, answer.facts))
        progress(f"{row.id}: {'ok' if done[-1]['ok'] else 'FAILS, ' + done[-1]['reason']}")
    return {
        "ok": not interrupted and all(row["ok"] for row in done),
        "interrupted": interrupted,
        "not_run": [row.id for row in rows[len(done) :]],
        "seconds": time.monotonic() - began,
        "rows": done,
    }
