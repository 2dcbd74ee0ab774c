"""Pinning and real-time scheduling: done where it is allowed, said in one sentence where it is not."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from typing import Any

import pytest

from wire.placement import FIFO_PRIORITY, place

SCRIPT = """
import json, os, sys
from threading import Thread
from wire.placement import place
notes = []
place(int(sys.argv[1]) if sys.argv[1] else None, None, notes.append)
of_thread = []
thread = Thread(target=lambda: of_thread.extend(os.sched_getaffinity(0)))
thread.start()
thread.join()
print(json.dumps([sorted(os.sched_getaffinity(0)), sorted(of_thread), notes]))
"""


class Calls:
    """Stands in for the system: what it was asked, and what it answers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[tuple[str, Any]] = []
        self.refuse: dict[str, OSError] = {}
        for name in ("sched_setaffinity", "sched_setscheduler"):
            monkeypatch.setattr(os, name, self._call(name))

    def _call(self, name: str) -> Any:
        def call(*arguments: Any) -> None:
            self.asked.append((name, arguments))
            if name in self.refuse:
                raise self.refuse[name]

        return call


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    return Calls(monkeypatch)


def test_nothing_asked_for_is_nothing_done(calls: Calls) -> None:
    notes: list[str] = []
    place(None, None, notes.append)
    assert calls.asked == []
    assert notes == []


def test_what_is_allowed_is_done_without_a_word(calls: Calls) -> None:
    notes: list[str] = []
    place(3, FIFO_PRIORITY, notes.append)
    assert notes == []
    (affinity, (process, cores)), (scheduler, (same, policy, parameter)) = calls.asked
    assert (affinity, process, cores) == ("sched_setaffinity", 0, {3})
    assert (scheduler, same, policy) == ("sched_setscheduler", 0, os.SCHED_FIFO)
    assert parameter.sched_priority == FIFO_PRIORITY


def test_real_time_scheduling_that_is_not_permitted_is_said_with_what_helps(calls: Calls) -> None:
    calls.refuse["sched_setscheduler"] = PermissionError(errno.EPERM, "Operation not permitted")
    notes: list[str] = []
    place(2, 10, notes.append)
    (note,) = notes
    assert note == (
        "no real-time scheduling (SCHED_FIFO 10): Operation not permitted; run as root, or allow it with "
        "`ulimit -r` or CAP_SYS_NICE"
    )
    assert [name for name, _ in calls.asked] == ["sched_setaffinity", "sched_setscheduler"]


def test_a_core_that_is_not_there_is_said_and_the_rest_is_done(calls: Calls) -> None:
    calls.refuse["sched_setaffinity"] = OSError(errno.EINVAL, "Invalid argument")
    notes: list[str] = []
    place(77, 10, notes.append)
    assert notes == ["not pinned to core 77: Invalid argument"]
    assert [name for name, _ in calls.asked] == ["sched_setaffinity", "sched_setscheduler"]


def _placed(core: str) -> tuple[list[int], list[int], list[str]]:
    end = subprocess.run(
        [sys.executable, "-c", SCRIPT, core], check=True, capture_output=True, text=True
    )
    own, of_thread, notes = json.loads(end.stdout)
    return own, of_thread, notes


def test_a_process_and_its_later_threads_run_on_the_core_that_it_is_given() -> None:
    allowed = sorted(os.sched_getaffinity(0))
    for core in (allowed[0], allowed[-1]):
        assert _placed(str(core)) == ([core], [core], [])
    assert _placed("") == (allowed, allowed, [])


def test_a_process_that_gets_no_core_goes_on_where_it_was() -> None:
    allowed = sorted(os.sched_getaffinity(0))
    own, _, (note,) = _placed("1000")
    assert own == allowed
    assert note.startswith("not pinned to core 1000: ")


STEP_BACK = """
import json, os, threading
from wire.placement import place, step_back
notes, seen = [], {}
place(None, 10, notes.append)
ready, stop = threading.Event(), threading.Event()

def other():
    seen["other"] = [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority]
    seen["other nice"] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    ready.set()
    stop.wait()
    seen["other later"] = [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority]

thread = threading.Thread(target=other)
thread.start()
ready.wait()
step_back(10)
stop.set()
thread.join()
seen["main"] = [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority]
seen["main nice"] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
seen["noted"] = bool(notes)
print(json.dumps(seen))
"""


def test_a_main_thread_that_steps_back_is_behind_the_threads_that_were_there() -> None:
    end = subprocess.run(
        [sys.executable, "-c", STEP_BACK], check=True, capture_output=True, text=True
    )
    seen = json.loads(end.stdout)
    assert seen["other"] == seen["other later"]
    if seen["noted"]:  # no real-time scheduling here: it is nicer
        assert seen["main nice"] > seen["other nice"]
    else:
        assert seen["other"] == [os.SCHED_FIFO, 10]
        assert seen["main"][0] == os.SCHED_FIFO
        assert 0 < seen["main"][1] < 10
