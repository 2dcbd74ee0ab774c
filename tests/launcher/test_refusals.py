"""Wrong input of every kind: one message that names the culprit, the documented exit code, no
traceback."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TYPE_CHECKING

import in_process
import pytest

from supervise.execute import execute
from supervise.options import RunOptions
from wire.errors import UsageError

if TYPE_CHECKING:
    from conftest import Cli, Start

WRONG = {
    "unknown flag": (["--nodse", "4"], 2, "--nodse"),
    "one node": (["--nodes", "1"], 2, "--nodes"),
    "no number": (["--nodes", "four"], 2, "four"),
    "too many nodes": (["--nodes", "100000"], 2, "--nodes"),
    "negative ticks": (["--ticks", "-5"], 2, "--ticks"),
    "too many ticks": (["--ticks", "9" * 30], 2, "--ticks"),
    "zero ticks": (["--ticks", "0"], 2, "--ticks"),
    "negative tick": (["--tick", "-0.1"], 2, "--tick"),
    "tick not a number": (["--tick", "nan"], 2, "--tick"),
    "tick of less than 1 ns": (["--tick", "5e-324"], 2, "--tick"),
    "tick too long": (["--tick", "1"], 2, "longest stable tick"),
    "negative seed": (["--seed", "-1"], 2, "--seed"),
    "unknown setpoint": (["--setpoint", "7"], 2, "straight, 1"),
    "unknown initial": (["--initial", "crooked"], 2, "crooked"),
    "unknown disturbance": (["--disturbance", "storm"], 2, "storm"),
    "infinite amplitude": (["--disturbance-amplitude", "inf"], 2, "amplitude"),
    "negative noise": (["--noise-velocity", "-1"], 2, "velocity"),
    "coarse plant": (["--plant-cells", "3"], 2, "plant cells"),
    "unknown spacing": (["--spacing", "random"], 2, "random"),
    "unknown transport": (["--transport", "pigeon"], 2, "pigeon"),
    "port without tcp": (["--base-port", "20000"], 2, "--base-port"),
    "low port": (["--transport", "tcp", "--base-port", "80"], 2, "80"),
    "sockets with tcp": (["--transport", "tcp", "--socket-dir", "x"], 2, "--socket-dir"),
    "zero start time": (["--start-timeout", "0"], 2, "--start-timeout"),
    "by hand who": (["--by-hand", "12"], 2, "--by-hand"),
}


def refused(cli: Cli, code: int, culprit: str) -> None:
    assert cli.finish() == code, cli.err
    assert culprit in cli.err
    assert "Traceback" not in cli.err
    assert cli.out == ""
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []
    assert not list(cli.work.glob("runs/*"))


@pytest.mark.parametrize("case", WRONG)
def test_wrong_option(
    case: str,
    gains: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """In this process, for speed: no process is started before every option is checked."""
    arguments, code, culprit = WRONG[case]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("subprocess.Popen", _nothing_may_start)
    assert in_process.octarm("run", "--gains", gains, *arguments) == code
    out, err = capfd.readouterr()
    assert culprit in err
    assert "Traceback" not in err
    assert out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "verb",
    [["deploy", "--out"], ["animate"], ["plot"], ["replay"], ["diff", "a"], ["export", "--csv"]],
)
def test_a_name_that_is_too_long_for_a_file(
    verb: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    assert in_process.octarm(*verb, "x" * 5000) == 2
    assert capfd.readouterr().err.endswith("xxx: File name too long\n")


def _nothing_may_start(*arguments: object, **options: object) -> None:
    raise AssertionError(f"started {arguments}")


def test_a_plan_that_is_refused_leaves_no_directory(
    gains: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise UsageError("two tips in one direction")

    monkeypatch.setattr("supervise.execute.make_plan", refuse)
    out = tmp_path / "there"
    with pytest.raises(UsageError, match="two tips"):
        execute(RunOptions(gains=gains, nodes=2, out=out), quiet=True, plot=False)
    assert not out.exists()


def test_two_runs_at_once_into_one_directory(
    gains: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one comes before the first one has made a recording, and leaves everything alone."""

    def meanwhile(*_: object) -> None:
        with pytest.raises(UsageError, match="something in it already"):
            execute(options, quiet=True, plot=False)
        assert list(tmp_path.iterdir()) != []
        raise UsageError("the first one ends")

    options = RunOptions(gains=gains, nodes=2, out=tmp_path)
    monkeypatch.setattr("supervise.execute.make_plan", meanwhile)
    with pytest.raises(UsageError, match="the first one ends"):
        execute(options, quiet=True, plot=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("case", ["unknown flag", "one node", "tick too long"])
def test_wrong_option_as_a_user_sees_it(start: Start, case: str) -> None:
    arguments, code, culprit = WRONG[case]
    refused(start.run(*arguments), code, culprit)


def test_missing_gains(start: Start, tmp_path: Path) -> None:
    refused(start("run", "--gains", tmp_path / "none.json"), 2, "none.json")


def test_damaged_gains(start: Start, tmp_path: Path) -> None:
    whole = start.gains.read_bytes()
    for name, content in (
        ("cut", whole[: len(whole) // 2]),
        ("edited", whole.replace(b'"radius_m":0.025', b'"radius_m":0.035')),
        ("empty", b""),
        ("noise", bytes(range(256))),
        ("future", whole.replace(b'"version":2', b'"version":9')),
    ):
        path = tmp_path / f"{name}.json"
        path.write_bytes(content)
        refused(start("run", "--gains", path), 6, path.name)


def test_occupied_socket_directory(start: Start, tmp_path: Path) -> None:
    used = tmp_path / "s"
    used.mkdir()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(used / "plant"))
        refused(start.run("--socket-dir", used), 2, "plant")
    assert (used / "plant").exists()


def test_unusable_socket_directory(start: Start, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    refused(start.run("--socket-dir", file), 2, "not a directory")
    refused(start.run("--socket-dir", tmp_path / ("long" * 40)), 2, "too long")
    refused(start.run("--socket-dir", "what?"), 2, "may not contain")


def test_socket_directory_of_a_running_run(start: Start, tmp_path: Path) -> None:
    shared = tmp_path / "s"
    first = start.run("--nodes", "2", "--ticks", "1000000", "--no-plot", "--socket-dir", shared)
    first.wait_for("tick ")
    refused(start.run("--socket-dir", shared), 2, "in use by another run")
    first.popen.terminate()
    assert first.finish() == 130
    assert not shared.exists()


def test_nothing_is_written_over(start: Start, tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "recording.mcap").write_text("mine")
    refused(start.run("--out", full), 2, "nothing is written over")
    assert (full / "recording.mcap").read_text() == "mine"
    refused(start("deploy", "--gains", start.gains, "--out", full / "recording.mcap"), 2, "exists")


def test_design_writes_nothing_over_and_names_a_missing_arm(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def design(*arguments: str | Path) -> str:
        assert in_process.octarm("design", *arguments) == 2
        return capfd.readouterr().err

    out = tmp_path / "gains.json"
    assert "none.toml" in design("--arm", tmp_path / "none.toml", "--out", out)
    assert not out.exists()
    out.write_text("mine")
    assert "exists already" in design("--out", out)
    assert out.read_text() == "mine"
    assert "--time-limit" in design("--out", tmp_path / "b", "--time-limit", "0")


def test_no_verb_and_unknown_verb(start: Start) -> None:
    for arguments, word in (([], "run"), (["fly"], "fly")):
        cli = start(*arguments)
        assert cli.finish() == 2
        assert word in cli.err
        assert "Traceback" not in cli.err


def test_closed_output_is_no_error(start: Start) -> None:
    cli = start("deploy", "--gains", start.gains, "--json")
    assert cli.popen.stdout is not None
    cli.popen.stdout.close()
    cli.popen.stdout = None
    assert cli.finish() == 0
    assert "Traceback" not in cli.err
