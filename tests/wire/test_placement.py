"""Core and scheduler of a process, in a child so that the test's own stay as they are."""

from __future__ import annotations

import os
import subprocess
import sys
from unittest import mock

from wire.placement import place


def test_a_child_is_pinned_and_its_scheduler_left_alone() -> None:
    cpu = min(os.sched_getaffinity(0))
    code = (
        "import os; from wire.placement import place; notes = []; "
        f"place({cpu}, None, notes.append); "
        "print(sorted(os.sched_getaffinity(0)), os.sched_getscheduler(0), notes)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == f"[{cpu}] {os.sched_getscheduler(0)} []"


def test_what_is_not_permitted_is_one_note_each() -> None:
    notes: list[str] = []
    no = PermissionError(1, "Operation not permitted")
    with (
        mock.patch("os.sched_setscheduler", side_effect=no),
        mock.patch("os.sched_setaffinity", side_effect=OSError(22, "Invalid argument")),
    ):
        place(77, 10, notes.append)
    assert len(notes) == 2
    assert notes[0] == "not pinned to core 77: Invalid argument"
    assert "SCHED_FIFO 10" in notes[1] and "not permitted" in notes[1]


def test_nothing_asked_nothing_done() -> None:
    with mock.patch("os.sched_setscheduler") as one, mock.patch("os.sched_setaffinity") as two:
        place(None, None, lambda _: None)
    assert not one.called and not two.called
