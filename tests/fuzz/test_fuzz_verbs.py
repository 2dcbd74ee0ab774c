"""Damaged files through the command line: the documented exit code and one message, never a traceback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import valid
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from in_process import octarm
from mutations import bytes_of, damaged, fewer, text_of

OK, USAGE, DEGRADED, REFUSED = 0, 2, 3, 6
FEW = fewer(12, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "the_file"


def said(
    capsys: pytest.CaptureFixture[str], verb: str, file: Path, raw: bytes, *more: str | Path
) -> object:
    """The exit code; standard error must hold one message that names the file if it is one of refusal."""
    file.write_bytes(raw)
    code = octarm(verb, *more)
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    assert "internal error" not in err
    if code in (USAGE, REFUSED):
        assert err.startswith("octarm")
        assert "the_file" in err
        assert out == ""
    return code


RECORDING: dict[str, Callable[[Path], tuple[str | Path, ...]]] = {
    "info": lambda path: (path, "--all"),
    "recover": lambda path: (path, "--out", path.with_suffix(".out"), "--force"),
    "replay": lambda path: (path, "--quiet"),
    "plot": lambda path: (
        path,
        "--only",
        "tip",
        "--out",
        path.with_suffix(".png"),
        "--force",
        "--quiet",
    ),
    "export": lambda path: (path, "--npz", "--out", path.with_suffix(".npz"), "--force", "--quiet"),
    "diff": lambda path: (path, path, "--quiet"),
}


@pytest.mark.parametrize("verb", RECORDING)
@FEW
@given(data=st.data())
def test_recordings(
    capsys: pytest.CaptureFixture[str], file: Path, verb: str, data: st.DataObject
) -> None:
    file = file.with_suffix(".mcap")
    raw = data.draw(
        bytes_of(data.draw(st.sampled_from((valid.recording(), valid.cut_recording()))))
    )
    code = said(capsys, verb, file, raw, *RECORDING[verb](file))
    assert code in (OK, USAGE, DEGRADED, REFUSED)


@pytest.mark.parametrize("verb", ["run", "deploy"])
@FEW
@given(raw=damaged(valid.gains_text()))
def test_gains(capsys: pytest.CaptureFixture[str], file: Path, verb: str, raw: bytes) -> None:
    """With a setpoint that there is not, so that no run begins should the gains be whole."""
    more = ("--setpoint", "the_file", "--quiet") if verb == "run" else ("--nodes", "3")
    assert said(capsys, verb, file, raw, "--gains", file, *more) in (OK, USAGE, REFUSED)


@FEW
@given(raw=text_of(valid.example("scenarios/reach.toml")))
def test_scenarios(capsys: pytest.CaptureFixture[str], file: Path, raw: bytes) -> None:
    """With gains that there are not, so that no run begins should the scenario be whole."""
    file = file.with_suffix(".toml")
    code = said(
        capsys, "run", file, raw, "--scenario", file, "--gains", file.with_name("the_file.json")
    )
    assert code == USAGE


@FEW
@given(raw=text_of(valid.example("hosts.toml")))
def test_hosts(capsys: pytest.CaptureFixture[str], file: Path, raw: bytes) -> None:
    gains = file.with_name("the_file.json")
    assert said(capsys, "run", file, raw, "--hosts", file, "--gains", gains) == USAGE


@FEW
@given(raw=text_of(valid.example("chapter_arm.toml")))
def test_arms(capsys: pytest.CaptureFixture[str], file: Path, raw: bytes) -> None:
    """Into a directory that there is already, so that nothing is designed should the arm be whole."""
    out = file.with_name("the_files")
    out.mkdir(exist_ok=True)
    code = said(capsys, "design", file, raw, "--arm", file, "--out", out)
    assert code == USAGE


@FEW
@given(raw=text_of(valid.example("problems/heat_insulated.toml")))
def test_problems(capsys: pytest.CaptureFixture[str], file: Path, raw: bytes) -> None:
    """With a solver that there is not, so that nothing is solved should the problem be whole."""
    code = said(capsys, "solve", file, raw, file, "--solver", "the_file")
    assert code == USAGE
