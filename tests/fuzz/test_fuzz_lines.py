"""The lines between launcher and children: whatever a child writes, the launcher goes on, and acts only on what
is of the right type; what is no order is none to a child."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import valid
from hypothesis import example, given
from hypothesis import strategies as st
from mutations import DEEP, damaged

from supervise.children import Process, ending
from supervise.state import RunState
from supervise.status_line import LONGEST, status_of
from wire.child import LINE_LIMIT, Child, send_status

SAID = [
    {"from": "plant", "event": "waiting", "missing": ["node 1", "recorder"]},
    {"from": "node 1", "event": "ready"},
    {"from": "zygote", "event": "born", "node": 1, "pid": 4242},
    {"from": "zygote", "event": "died", "node": 1, "pid": 4242, "code": -9},
    {"from": "plant", "event": "progress", "tick": 12},
    {
        "from": "recorder",
        "event": "progress",
        "tick": 12,
        "tip_error_m": 0.1,
        "estimation_error": None,
    },
    {"from": "node 2", "event": "failed", "code": "deadline", "message": "tick 3: it waited"},
    {"from": "node 2", "event": "stopped", "tick": 12, "missing": ["measurement"]},
    {
        "from": "plant",
        "event": "stopped",
        "tick": 12,
        "cause": "finished",
        "text": "all 12 ticks done",
    },
    {"from": "recorder", "event": "closed", "ticks_recorded": 12, "ticks_lost": 0, "late_ticks": 0},
    {"from": "node 0", "event": "note", "text": "no real-time scheduling"},
    {"from": "live", "event": "listening", "url": "http://127.0.0.1:80"},
]
LINES = [json.dumps(one) for one in SAID]


@pytest.mark.parametrize("line", LINES)
def test_what_children_say_is_understood(line: str) -> None:
    assert status_of(line.encode()) == json.loads(line)


@given(st.sampled_from(LINES).flatmap(damaged))
@example(b"")
@example(DEEP.encode())
@example(b'{"from":"plant","event":"stopped","tick":1}')
@example(b'{"from":"node x","event":"ready"}')
@example('{"from":"node \u00b2","event":"ready"}'.encode())
@example(b'{"from":["plant"],"event":"up"}')
@example(b'{"from":"plant","event":{}}')
def test_no_line_ends_the_launcher(line: bytes) -> None:
    status = status_of(line)
    if status is None:
        return
    state = RunState(valid.plan())
    state.hear(status)
    state.who_is_missing()
    state.why_not_started()
    state.reason_to_stop()
    state.recording_trouble()
    state.pace_trouble()
    state.verdict(interrupted=False)


@given(st.integers(-(2**63), 2**63) | st.none())
def test_every_exit_code_has_words(code: int | None) -> None:
    assert ending(code)


def test_garbage_between_status_lines_is_logged_and_the_lines_are_heard(tmp_path: Path) -> None:
    script = tmp_path / "child.py"
    script.write_text(
        "import os\n"
        "os.write(1, b'warning: something\\n\\xff\\xfe{\\n[]\\n\\n')\n"
        'os.write(1, b\'{"from":"x","event":"up"}\\n\')\n'
        f"os.write(1, b'a' * {2 * LONGEST})\n"
        'os.write(1, b\'\\n{"from":"x","event":"ready"}\\n\')\n'
    )
    heard: list[dict[str, Any]] = []
    with (tmp_path / "log").open("wb") as log:
        process = Process("x", [sys.executable, str(script)], log)
        try:
            while (lines := process.lines()) is not None:
                heard += lines
                assert len(process._partial) <= LONGEST
        finally:
            process.wait()
            process.reap()
            process.close()
    assert [one["event"] for one in heard] == ["up", "ready"]
    said = (tmp_path / "log").read_bytes()
    assert b"x: warning: something\n" in said
    assert b"x: \xff\xfe{\n" in said


@given(st.text(max_size=3000), st.lists(st.text(max_size=300), max_size=40))
@example("\U0001f419" * 1500, ["\u00e9" * 300] * 40)
def test_a_status_line_that_is_too_long_keeps_its_fields(message: str, missing: list[str]) -> None:
    """With 1500 letters of another alphabet it had lost them all, and the launcher its reason."""
    read, write = os.pipe()
    try:
        send_status(write, "node 1", "failed", code="internal", message=message)
        send_status(write, "node 1", "stopped", tick=3, missing=missing)
        lines = os.read(read, 1 << 20).split(b"\n")
    finally:
        os.close(read)
        os.close(write)
    assert all(len(line) <= LINE_LIMIT for line in lines)
    failed, stopped = (status_of(line) for line in lines[:2])
    assert failed is not None and message.startswith(failed["message"])
    assert stopped is not None and stopped["tick"] == 3


@given(
    st.lists(
        st.sampled_from((b"", b"{", b"[]", b"3", b'{"do":1}', b"\xff", DEEP.encode())), max_size=6
    )
)
def test_what_is_no_order_is_passed_over(garbage: list[bytes]) -> None:
    read, write = os.pipe()
    child = Child("x", control=read, status=-1, directory=None)
    try:
        child.watch(reads_control=True)
        os.write(write, b"\n".join([*garbage, b'{"do":"start"}', b""]))
        assert child.wait(1.0) == [{"do": "start"}]
        assert not child.stopping
    finally:
        child.close()
        os.close(read)
        os.close(write)
