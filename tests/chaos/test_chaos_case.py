"""Whole cases with real runs: those that are well, and those that were sabotaged and must be found out."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from chaos import inject
from chaos.case import Result, run_case
from chaos.draw import BEFORE, ENDLESS, PREPARED, RUN, Case, Fault, RunDraw
from chaos.processes import living, marked
from chaos.scene import Scene

WELL = RunDraw(3, 1, False, 0.0, 0, False, "hold", "unix", False, False, 1, 400)
AT_ONCE = Fault("hog", "run", RUN, 0.0)


def _done(tmp_path: Path, run: RunDraw, *faults: Fault) -> Result:
    return run_case(Case(0, 0, run, faults), tmp_path)


def _sabotage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Scene, Fault], str | None]
) -> list[str]:
    monkeypatch.setitem(inject.INJECTORS, "hog", spoil)
    result = _done(tmp_path, WELL, AT_ONCE)
    assert [hit["name"] for hit in result.hits] == ["hog"]
    if result.wrong:  # everything about it is kept
        kept = {path.name for path in Path(result.directory).iterdir()}
        assert {"case.json", "stderr.txt", "stdout.txt", "runs"} <= kept
    return result.wrong


@pytest.mark.every
def test_a_left_over_socket_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(scene: Scene, _: Fault) -> str:
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(scene.sockets / "stray"))
        return "a socket"

    (wrong,) = _sabotage(tmp_path, monkeypatch, spoil)
    assert wrong == "left in the run's TMPDIR: socket stray"


@pytest.mark.every
def test_an_orphan_is_found_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marks: list[str] = []

    def spoil(scene: Scene, _: Fault) -> str:
        marks.append(scene.mark)
        command = [sys.executable, "-c", "import time; time.sleep(60)"]
        orphans.append(subprocess.Popen(command, env={**os.environ, **marked(scene.mark)}))
        return "a process"

    orphans: list[subprocess.Popen[bytes]] = []
    (wrong,) = _sabotage(tmp_path, monkeypatch, spoil)
    (orphan,) = orphans
    assert wrong == f"still alive after 3 s: python (pid {orphan.pid})"
    assert orphan.wait(10) < 0
    assert living(marks[0]) == []


def test_a_cut_recording_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def spoil(scene: Scene, _: Fault) -> str:
        directory = scene.directory()
        assert directory is not None
        os.truncate(directory / "recording.mcap", 1000)
        return "truncated"

    wrong = _sabotage(tmp_path, monkeypatch, spoil)
    assert any("recording" in text for text in wrong), wrong


def test_a_run_that_ends_too_well_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A plant that is said to be killed, and lives. By the clock: a second and a half is more than what may be
    excused, a fault in a run's last half second."""
    monkeypatch.setitem(inject.INJECTORS, "kill", lambda _scene, _fault: "nothing")
    paced = replace(WELL, realtime=True, period_s=0.05, hold_ticks=20, ticks=30)
    (wrong,) = _done(tmp_path, paced, Fault("kill", "plant", RUN, 0.1)).wrong
    assert re.match("exit code [03], though kill plant", wrong)  # 3: a tick was late
    assert wrong.endswith("it demands 4")


def test_an_unexplained_stop_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node dies that no fault was meant for."""

    def spoil(scene: Scene, _: Fault) -> str | None:
        return inject.kill(scene, Fault("kill", "node", RUN, node=1))

    wrong = _sabotage(tmp_path, monkeypatch, spoil)
    assert "exit code 4, expected 0 or 3" in wrong


@pytest.mark.variants("kill node-", "freeze live+kill zygote-", "pause plant-")
@pytest.mark.parametrize(
    ("faults", "code"),
    [
        ((Fault("kill", "node", RUN, 0.2, node=1),), 4),
        ((Fault("kill", "launcher", RUN, 0.2),), -9),
        ((Fault("kill", "recorder", RUN, 0.2), Fault("terminate", "launcher", RUN, 0.5)), 130),
        ((Fault("freeze", "live", RUN, 0.1), Fault("kill", "zygote", RUN, 0.3)), 4),
        ((Fault("pause", "plant", RUN, 0.1, for_s=0.3),), 130),  # by the curtain
    ],
    ids=lambda value: "+".join(fault.name for fault in value) if type(value) is tuple else "",
)
def test_endless_runs_end_as_is_decided(
    tmp_path: Path, faults: tuple[Fault, ...], code: int
) -> None:
    result = _done(tmp_path, replace(WELL, ticks=ENDLESS, live=True), *faults)
    assert (result.exit_code, result.wrong) == (code, [])
    assert [hit["name"] for hit in result.hits if not hit["curtain"]] == [f.name for f in faults]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.variants(
    "gains-flipped", "scenario-truncated", "hosts-noise", "place-port", "keys-foreign"
)
@pytest.mark.parametrize(
    ("kind", "variant"), [(kind, one) for kind, many in PREPARED.items() for one in many]
)
def test_what_is_wrong_before_is_refused(tmp_path: Path, kind: str, variant: str) -> None:
    fault = Fault(kind, "run", BEFORE, variant=variant, amount=0.4, seed=2)
    secured = kind == "keys"
    run = replace(WELL, ticks=20, transport="tcp" if secured else "unix", keys=secured)
    result = _done(tmp_path, run, fault)
    assert result.wrong == []
    refused = 6 if kind == "gains" and variant != "missing" else 2
    assert result.exit_code == refused or (variant in ("truncated", "flipped") and result.begun)
