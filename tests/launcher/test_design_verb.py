"""`octarm design`: wrong arguments, table and JSON; and the straight arm from end to end."""

from __future__ import annotations

import fcntl
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import in_process
import pytest
from stand_in_gains import Immediate, arm, arm_text, well

import launcher
from design.gain import Options
from supervise import design_verbs, designing
from supervise.designing import Request, run_design
from wire.artefact import GainsArtefact, digest, read_artefact
from wire.errors import GainsRefusedError, UsageError

STRAIGHT = Path(__file__).resolve().parents[1] / "straight_arm.toml"
ROLES = ("observer", "controller")

# Refusals before the work starts


def _nothing_may_start(*_: object, **__: object) -> Any:
    raise AssertionError("the design started")


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(designing, "_Pool", _nothing_may_start)


@pytest.mark.usefixtures("idle")
def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path, tmp_path / "file" / "out.json", tmp_path / "file" / "deep" / "out.json"):
        with pytest.raises(UsageError, match="--out"):
            run_design(Request(STRAIGHT, out))
    with pytest.raises(UsageError, match=r"exists already.*--force"):
        run_design(Request(STRAIGHT, tmp_path / "file"))
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def octarm(capfd: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[object, str, str]:
    """`octarm design` in this process: exit code, standard output, standard error."""
    code = in_process.octarm("design", *arguments)
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    return code, out, err


WRONG = {
    "unknown solver": (["--solver", "ABACUS"], "CLARABEL"),
    "no jobs": (["--jobs", "0"], "--jobs: expected at least 1"),
    "half a job": (["--jobs", "1.5"], "1.5"),
    "no time": (["--time-limit", "0"], "--time-limit"),
    "endless": (["--time-limit", "inf"], "--time-limit"),
    "time not a number": (["--time-limit", "nan"], "--time-limit"),
    "unknown flag": (["--afresh"], "--afresh"),
    "no arm file": (["--arm", "none.toml"], "none.toml"),
    "a directory": (["--out", "."], "directory"),
}


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("case", WRONG)
def test_wrong_argument(
    case: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    arguments, culprit = WRONG[case]
    monkeypatch.chdir(tmp_path)
    code, out, err = octarm(capfd, *arguments)
    assert (code, out) == (2, "")
    assert culprit in err
    assert list(tmp_path.iterdir()) == []


BAD = {
    "not TOML": ("this is no arm", "line 1"),
    "empty": ("", "missing required field"),
    "wrong unit": (arm_text("1").replace("length_m = 1.0", "length_cm = 100.0"), "length_m"),
    "negative": (arm_text("1").replace("5e3", "-5e3"), "youngs_modulus_pa"),
}


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("case", BAD)
def test_bad_arm_file(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text, culprit = BAD[case]
    bad = tmp_path / "bad.toml"
    bad.write_text(text)
    code, out, err = octarm(capfd, "--arm", bad, "--out", tmp_path / "out.json")
    assert (code, out) == (2, "")
    assert "bad.toml" in err
    assert culprit in err
    assert list(tmp_path.iterdir()) == [bad]


# The verb


@pytest.fixture
def verb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[object, str, str]]:
    """`octarm design` of an arm of two setpoints with stand-ins in this process."""
    path = arm(tmp_path, "1", "2")
    monkeypatch.setattr(designing, "_Pool", Immediate)
    monkeypatch.setattr(designing.run_design, "__defaults__", (lambda _: None, well, 1.0))

    def run(*arguments: str | Path) -> tuple[object, str, str]:
        return octarm(capfd, "--arm", path, *arguments)

    return run


def test_table(verb: Callable[..., tuple[object, str, str]], tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    code, shown, told = verb("--out", out)
    assert code == 0
    assert shown.splitlines()[2].split()[:3] == ["1", "observer", "0.1414"]
    assert shown.splitlines()[-1] == f"{out}, SHA-256 {digest(read_artefact(out))[:16]}"
    assert "setpoint 2, controller: finished, " in told
    code, shown, told = verb("--out", out)  # nothing is written over
    assert (code, shown) == (2, "")
    assert "exists" in told
    code, shown, told = verb("--out", out, "--force", "--quiet")
    assert (code, told) == (0, "")
    assert len(shown.splitlines()) > 6


def test_json(verb: Callable[..., tuple[object, str, str]], tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    code, shown, told = verb("--out", out, "--json")
    assert (code, told) == (0, "")
    found = json.loads(shown)
    assert found["artefact"] == str(out)
    assert found["sha256"] == digest(read_artefact(out))
    assert [(g["setpoint"], g["role"]) for g in found["gains"]] == [
        (name, role) for name in "12" for role in ROLES
    ]
    assert found["gains"][0]["certified_gamma"] == 0.1414
    assert found["parts"] is None


def test_some_gains_only(verb: Callable[..., tuple[object, str, str]], tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    code, shown, _ = verb("--out", out, "--only", "2:observer", "1")
    assert code == 0
    assert [line.split()[:2] for line in shown.splitlines()[2:5]] == [
        ["1", "observer"],
        ["1", "controller"],
        ["2", "observer"],
    ]
    assert shown.splitlines()[-1] == f"kept in {out}.parts"
    code, shown, _ = verb("--out", out, "--only", "1:observer", "--json")
    found = json.loads(shown)
    assert (found["artefact"], found["sha256"], found["parts"]) == (None, None, f"{out}.parts")
    assert len(found["gains"]) == 1
    assert not out.exists()


def test_every_choice_reaches_the_design(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    asked: list[Request] = []

    def refuse(request: Request, progress: Callable[[str], None]) -> Any:
        asked.append(request)
        progress("working")
        raise GainsRefusedError("setpoint 1, observer: no")

    monkeypatch.setattr(designing, "run_design", refuse)
    code, out, err = octarm(
        capfd, "--arm", "a.toml", "--out", "b.json", "--jobs", "3", "--solver", "SCS",
        "--time-limit", "7", "--fresh", "--force", "--only", "1", "2:observer",
    )  # fmt: skip
    assert (code, out, err) == (6, "", "working\noctarm: setpoint 1, observer: no\n")
    octarm(capfd, "--arm", "mine/my.arm.toml")
    assert asked == [
        Request(
            Path("a.toml"),
            Path("b.json"),
            Options("SCS", 7.0),
            3,
            fresh=True,
            force=True,
            only=("1", "2:observer"),
        ),
        Request(Path("mine/my.arm.toml"), Path("my.arm.gains.json")),
    ]


def test_the_command_line_has_the_defaults_of_the_room() -> None:
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(design_verbs.design).parameters.items()
    }
    assert Options(defaults["solver"], defaults["time_limit"]) == Options()
    request = Request(Path("a"), Path("b"))
    assert (request.jobs, request.fresh, request.force) == (
        defaults["jobs"],
        defaults["fresh"],
        defaults["force"],
    )


# The straight arm from end to end


@dataclass(frozen=True)
class Designed:
    artefact: GainsArtefact
    told: str
    facts: dict[str, Any]
    left: list[str]


@pytest.fixture(scope="session")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Designed:
    """One design for all processes of this test run."""
    shared = tmp_path_factory.getbasetemp()
    shared = shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared
    work = shared / "straight"
    work.mkdir(exist_ok=True)
    with (shared / "straight.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (work / "out.txt").exists():
            arguments = ["design", "--arm", str(STRAIGHT), "--out", "s.json", "--jobs", "2"]
            done = subprocess.run(
                [sys.executable, str(Path(launcher.__file__)), *arguments],
                cwd=work, capture_output=True, text=True, timeout=280, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr
            (work / "err.txt").write_text(done.stderr)
            (work / "out.txt").write_text(done.stdout)
    artefact = read_artefact(work / "s.json")
    return Designed(
        artefact,
        (work / "err.txt").read_text(),
        {"table": (work / "out.txt").read_text()},
        sorted(p.name for p in work.iterdir()),
    )


def test_certificates(straight: Designed) -> None:
    (setpoint,) = straight.artefact.setpoints
    for certificate in (setpoint.observer_certificate, setpoint.controller_certificate):
        assert certificate.outcome == "certified"
        assert certificate.solver_status in ("optimal", "optimal_inaccurate")
        assert certificate.achieved_gamma <= certificate.certified_gamma * 1.001
        assert certificate.certified_gamma <= 1.3 * certificate.optimum_gamma
        assert certificate.achieved_gamma <= 1.15 * certificate.optimum_gamma
        assert certificate.optimum_gamma <= certificate.achieved_gamma
        assert certificate.achieved_gamma < 0.15 * certificate.open_loop_gamma
        # the axial motion, out of reach of force and sensor, decays with half the drag
        half_drag = 0.5 * straight.artefact.arm.drag_per_s
        assert certificate.decay_per_s == pytest.approx(half_drag, rel=1e-6)
        assert certificate.open_loop_decay_per_s == pytest.approx(half_drag, rel=1e-6)
        assert certificate.smallest_eigenvalue_p > 0.05
        assert certificate.largest_eigenvalue_lpi <= 1e-6
        assert certificate.equality_residual <= 1e-6
        assert certificate.gain_norm < 60.0
        assert 0.5 < certificate.seconds < 200.0


def test_nothing_else_is_left(straight: Designed) -> None:
    assert straight.left == ["err.txt", "out.txt", "s.json"]
    assert straight.facts["table"].endswith(f"SHA-256 {digest(straight.artefact)[:16]}\n")


def test_progress_names_setpoint_and_gain(straight: Designed) -> None:
    for role in ROLES:
        lines = [
            line
            for line in straight.told.splitlines()
            if line.startswith(f"setpoint straight, {role}: ")
        ]
        assert len(lines) >= 6
        assert lines[0].endswith("started")
        assert "certified" in lines[-2] and "achieved" in lines[-2]
        assert "finished" in lines[-1]
