"""The design's jobs: several at once, what befalls them, what is kept and what the next design takes again.

The jobs are stand-ins.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from stand_in_gains import Immediate, arm, arm_text, finished, well

from design.arm_file import read_arm_file
from design.command import assemble, jobs
from design.gain import Options
from supervise import designing
from supervise.designing import Request, run_design
from supervise.engine import EngineDiedError
from supervise.gain_parts import GainParts
from wire.artefact import GainsArtefact, digest, read_artefact
from wire.errors import GainsRefusedError, UsageError

if TYPE_CHECKING:
    from conftest import Start

STAND_IN_CLI = Path(__file__).with_name("stand_in_cli.py")
ROLES = ("observer", "controller")


def expected(path: Path) -> GainsArtefact:
    """The artefact that stand-ins design."""
    file = read_arm_file(path)
    return assemble(file, {job: finished(job.index, job.role) for job in jobs(file)})


# Jobs in processes


def test_what_fails_is_named_and_the_rest_is_kept_for_the_next_design(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")  # an artefact does not depend on it
    out = tmp_path / "out.json"
    told: list[str] = []
    with pytest.raises(EngineDiedError) as caught:
        run_design(Request(arm(tmp_path, "dies", "refuses"), out, jobs=2), told.append, well)
    message = str(caught.value)
    assert "setpoint dies, controller: the engine's process was ended by SIGKILL" in message
    assert "setpoint refuses, controller: the LPI is infeasible" in message
    balance = message.splitlines()[-1]
    assert f"no artefact was written, 2 of 4 gains are kept in {out}.parts" in balance
    assert not out.exists()
    for name in ("dies", "refuses"):
        for role in ROLES:
            assert f"setpoint {name}, {role}: at work, threads 1" in told
    assert "setpoint dies, controller: failed" in told
    assert [line for line in told if line.endswith("2 of 4 gains")]
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2"

    again = arm(tmp_path, "1", "2")  # the same but for the names
    (damaged,) = [p for p in Path(f"{out}.parts").iterdir() if '"dies"' in p.read_text()]
    damaged.write_text("damaged")
    told.clear()
    done = run_design(Request(again, out, jobs=1), told.append, well)
    assert done.artefact == expected(again) == read_artefact(out)
    assert done.sha256 == digest(done.artefact)
    assert list(done.gains) == jobs(read_arm_file(again))
    assert f"setpoint 1, observer: {damaged}: no whole part" in "\n".join(told)
    assert any(line.startswith("setpoint 2, observer: taken from ") for line in told)
    assert "setpoint 2, observer: started" not in told
    assert "setpoint 1, controller: at work, threads 1" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arm.toml", "out.json"]


def test_a_job_that_overruns_is_stopped(tmp_path: Path) -> None:
    options = Options(time_limit_s=0.25)
    request = Request(arm(tmp_path, "hangs"), tmp_path / "out.json", options, jobs=2)
    began = time.monotonic()
    with pytest.raises(
        GainsRefusedError, match=r"hangs, controller: stopped after 4 s.*--time-limit"
    ):
        run_design(request, work=well, grace_s=3.0)
    assert 3.5 < time.monotonic() - began < 40.0


def test_an_interrupt_ends_all_jobs_and_keeps_what_is_finished(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Meanwhile the output is taken, and another one in the same directory is free."""
    from conftest import Cli

    monkeypatch.setenv("OCTARM_STAND_IN", "gains")
    path = arm(start.work, "hangs")
    arguments = ["design", "--arm", str(path), "--out", "out.json", "--jobs", "2"]
    cli = Cli(start.work, [str(STAND_IN_CLI), *arguments])
    start.started.append(cli)
    cli.wait_for("setpoint hangs, observer: finished, 1 of 2 gains")
    cli.wait_for("setpoint hangs, controller: at work")
    assert "octarm-controll" in cli.processes()

    out = start.work / "out.json"
    with pytest.raises(UsageError, match="another `octarm design` is at work there"):
        run_design(Request(path, out), work=well)
    elsewhere = start.work / "other.json"
    with monkeypatch.context() as patch:
        patch.setattr(designing, "_Pool", Immediate)
        run_design(Request(arm(start.work, "1"), elsewhere), work=well)
    assert read_artefact(elsewhere) == expected(path)

    began = time.monotonic()
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert time.monotonic() - began < 10.0
    assert cli.gone() == {}
    assert cli.out == ""
    assert (
        "interrupted; no artefact was written, 1 of 2 gains are kept in out.json.parts" in cli.err
    )
    assert cli.err.endswith("octarm: interrupted\n")
    assert "Traceback" not in cli.err
    assert not out.exists()
    (kept,) = Path(f"{out}.parts").iterdir()
    assert kept.name.endswith("-observer.json")


# Without processes


@pytest.fixture
def immediate(monkeypatch: pytest.MonkeyPatch) -> type[Immediate]:
    monkeypatch.setattr(designing, "_Pool", Immediate)
    return Immediate


def test_the_longest_jobs_come_first(tmp_path: Path, immediate: type[Immediate]) -> None:
    run_design(Request(arm(tmp_path, "little", "bent"), tmp_path / "out.json"), work=well)
    assert immediate.order == [
        "setpoint bent, observer",
        "setpoint bent, controller",
        "setpoint little, observer",
        "setpoint little, controller",
    ]


def test_other_weights_of_one_role_leave_the_other_roles_gains(
    tmp_path: Path, immediate: type[Immediate]
) -> None:
    path, out = arm(tmp_path, "1", "refuses"), tmp_path / "out.json"
    with pytest.raises(GainsRefusedError, match="3 of 4 gains are kept"):
        run_design(Request(path, out), work=well)
    path.write_text(arm_text("1", "2").replace("control_effort = 0.3", "control_effort = 0.4"))
    told: list[str] = []
    artefact = run_design(Request(path, out), told.append, well).artefact
    assert artefact is not None
    assert immediate.order == ["setpoint 2, controller", "setpoint 1, controller"]
    assert artefact.weights == {"measurement_noise": 0.2, "control_effort": 0.4}
    assert f"{out}.parts: 1 part of other data, options or versions, not used" in told
    assert not Path(f"{out}.parts").exists()


def test_fresh_takes_nothing(tmp_path: Path, immediate: type[Immediate]) -> None:
    path, out = arm(tmp_path, "refuses"), tmp_path / "out.json"
    with pytest.raises(GainsRefusedError):
        run_design(Request(path, out), work=well)
    with pytest.raises(GainsRefusedError):
        run_design(Request(path, out), work=well)
    assert immediate.order == ["setpoint refuses, controller"]
    path.write_text(arm_text("1"))
    run_design(Request(path, out, fresh=True), work=well)
    assert immediate.order == ["setpoint 1, observer", "setpoint 1, controller"]


def test_some_gains_only(tmp_path: Path, immediate: type[Immediate]) -> None:
    """They are kept for the whole design; an artefact that is there stays."""
    path, out = arm(tmp_path, "1", "2"), tmp_path / "out.json"
    out.write_text("mine")
    done = run_design(Request(path, out, only=("2:controller", "1")), work=well)
    assert [str(job) for job in done.gains] == [
        "setpoint 1, observer",
        "setpoint 1, controller",
        "setpoint 2, controller",
    ]
    assert (done.artefact, done.sha256) == (None, None)
    assert len(list(done.parts.iterdir())) == 3
    assert out.read_text() == "mine"
    told: list[str] = []
    run_design(Request(path, out, force=True), told.append, well)
    assert immediate.order == ["setpoint 2, observer"]
    assert read_artefact(out) == expected(path)
    assert not any("not used" in line for line in told)
    for wrong in ("3", "1:", "1:both", "observer"):
        with pytest.raises(UsageError, match=rf"--only {wrong}: .*1:observer.*2:controller"):
            run_design(Request(path, out, only=(wrong,)), work=well)


def test_a_refusal_leaves_everything_as_it_was(tmp_path: Path, immediate: type[Immediate]) -> None:
    def refuse(*_: object) -> Any:
        raise GainsRefusedError("setpoint 1, observer: no")

    path, out = arm(tmp_path, "1"), tmp_path / "new" / "out.json"
    with pytest.raises(GainsRefusedError, match=r"no artefact was written$"):
        run_design(Request(path, out), work=refuse)
    assert [p.name for p in tmp_path.iterdir()] == ["arm.toml"]
    mine = tmp_path / "mine.json"
    mine.write_text("mine")
    with pytest.raises(GainsRefusedError):
        run_design(Request(path, mine, force=True), work=refuse)
    assert mine.read_text() == "mine"


@pytest.mark.usefixtures("immediate")
def test_nothing_is_written_over_what_came_meanwhile(tmp_path: Path) -> None:
    path, out = arm(tmp_path, "1"), tmp_path / "out.json"

    def told(text: str) -> None:
        out.write_text("somebody's")

    with pytest.raises(UsageError, match="exists already"):
        run_design(Request(path, out), told, well)
    assert out.read_text() == "somebody's"
    done = run_design(Request(path, out, force=True), work=well)
    assert read_artefact(out) == done.artefact


@pytest.mark.usefixtures("immediate")
def test_a_disk_that_is_full_costs_the_parts_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(GainParts, "keep", full)
    path, out = arm(tmp_path, "1"), tmp_path / "out.json"
    told: list[str] = []
    run_design(Request(path, out), told.append, well)
    assert read_artefact(out) == expected(path)
    assert sum("not kept" in line and "No space left" in line for line in told) == 2
    monkeypatch.undo()
    monkeypatch.setattr(designing, "_Pool", Immediate)
    monkeypatch.setattr(designing, "write_artefact", full)
    with pytest.raises(UsageError, match=r"--out .*out\.json: No space left"):
        run_design(Request(path, out, force=True), work=well)
    assert len(list(Path(f"{out}.parts").iterdir())) == 2


def test_failures_of_the_program_come_before_those_of_gains(tmp_path: Path) -> None:
    broken = RuntimeError("broken")
    broken.add_note("its traceback")
    refused = GainsRefusedError("refused")
    first, second = jobs(read_arm_file(arm(tmp_path, "1")))
    joined = designing._joined({first: refused, second: broken}, "nothing was written")
    assert type(joined) is RuntimeError
    assert str(joined) == "refused\nbroken\nnothing was written"
    assert joined.__notes__ == ["its traceback"]
    assert type(designing._joined({first: refused}, "")) is GainsRefusedError
    assert type(designing._joined({first: refused, second: UsageError("")}, "")) is UsageError
