"""`octarm solve`: wrong arguments, the engine's process and what befalls it, JSON, exit codes, the suite."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import in_process
import pytest
from stand_in_engine import (
    breaks,
    certified,
    dies,
    dies_at_once,
    hangs,
    hangs_at_once,
    panics,
    refuses,
    well,
)

from design.pde.problem_file import Task
from design.solve_command import Choices, Request, facts, prepare
from design.solve_suite import Row, read_suite
from supervise import design_verbs
from supervise.engine import EngineDiedError
from supervise.shipped import EXAMPLES, SUITE
from supervise.solving import Answer, peak_memory_mb, solve_in_child
from supervise.suite import run_suite
from wire.config_json import finite
from wire.errors import OctarmError, UsageError

if TYPE_CHECKING:
    from conftest import Cli, Start

PROBLEMS = EXAMPLES / "problems"
G22 = str(PROBLEMS / "g22_heat.toml")
S1 = str(PROBLEMS / "s1_dirichlet.toml")
N1 = str(PROBLEMS / "n1_unstable.toml")
STAND_IN_CLI = Path(__file__).with_name("stand_in_cli.py")

WRONG = {
    "no file": ([], 2, "FILE"),
    "missing file": (["none.toml"], 2, "none.toml"),
    "directory": ([str(PROBLEMS)], 2, "problem file"),
    "unknown flag": ([G22, "--dgree", "3"], 2, "--dgree"),
    "unknown task": ([G22, "--task", "win"], 2, "win"),
    "task without measurements": ([G22, "--task", "observer"], 2, "outputs.measured"),
    "task without controls": ([N1, "--task", "controller"], 2, "inputs.controls"),
    "bisect of another task": (
        [N1, "--task", "gain", "--bisect", "lam", "0", "1"],
        2,
        "--bisect lam",
    ),
    "bisect unknown": ([S1, "--bisect", "lma", "0", "1"], 2, "did you mean lam?"),
    "bisect what": ([G22, "--bisect", "lam", "0", "1"], 2, "declared: none"),
    "bisect backwards": ([S1, "--bisect", "lam", "2", "1"], 2, "LOW < HIGH"),
    "bisect to nowhere": ([S1, "--bisect", "lam", "0", "inf"], 2, "LOW < HIGH"),
    "bisect one end": ([S1, "--bisect", "lam", "0"], 2, "--bisect"),
    "bisect and set": ([S1, "--bisect", "lam", "0", "1", "--set", "lam=1"], 2, "--set"),
    "set nothing": ([N1, "--set", "lam"], 2, "NAME=VALUE"),
    "set no name": ([N1, "--set", "=4"], 2, "NAME=VALUE"),
    "set no number": ([N1, "--set", "lam=four"], 2, "lam=four"),
    "set infinite": ([N1, "--set", "lam=inf"], 2, "finite"),
    "set twice": ([N1, "--set", "lam=1", "--set", "lam=2"], 2, "twice"),
    "set unknown": ([N1, "--set", "lma=1"], 2, "did you mean lam?"),
    "negative degree": ([G22, "--degree", "-1"], 2, "--degree"),
    "high degree": ([G22, "--degree", "1000"], 2, "--degree"),
    "half a degree": ([G22, "--degree", "1.5"], 2, "1.5"),
    "no time": ([G22, "--time-limit", "0"], 2, "--time-limit"),
    "endless": ([G22, "--time-limit", "inf"], 2, "--time-limit"),
    "time not a number": ([G22, "--time-limit", "nan"], 2, "--time-limit"),
    "dump into a file": ([G22, "--dump-problem", G22], 2, "--dump-problem"),
    "dump below a file": ([G22, "--dump-problem", f"{G22}/x"], 2, "--dump-problem"),
    "dump over something": ([G22, "--dump-problem", str(PROBLEMS)], 2, "nothing is written over"),
    "only without suite": (["--only", "S1"], 2, "--only"),
    "only with a file": ([G22, "--only", "S1"], 2, "--only"),
    "suite and file": ([G22, "--suite"], 2, "--suite"),
    "suite and degree": (["--suite", "--degree", "3"], 2, "--suite"),
    "suite and set": (["--suite", "--set", "lam=1"], 2, "--suite"),
    "suite and task": (["--suite", "--task", "gain"], 2, "--suite"),
    "suite and dump": (["--suite", "--dump-problem", "d"], 2, "--suite"),
    "suite and time": (["--suite", "--time-limit", "-3"], 2, "--time-limit"),
    "suite without the row": (["--suite", "--only", "S1", "s2"], 2, "did you mean S2?"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_argument(
    case: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """In this process, for speed: no process is started before every argument is checked."""
    arguments, code, culprit = WRONG[case]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("supervise.solving.solve_in_child", _nothing_may_start)
    assert in_process.octarm("solve", *arguments) == code
    out, err = capfd.readouterr()
    assert out == ""
    assert culprit in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def _nothing_may_start(*arguments: object, **options: object) -> None:
    raise AssertionError(f"started with {arguments}")


def test_every_choice_reaches_the_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Request] = []

    def solve(request: Request, progress: Callable[[str], None]) -> Answer:
        asked.append(request)
        progress("degree 1")
        numbers = (None, 9.5) if request.bisect else (0.7, None)
        return Answer(facts(request, certified(*numbers), 80.0))

    monkeypatch.setattr("supervise.solving.solve_in_child", solve)
    dump = tmp_path / "programs"
    code = design_verbs.solve(
        Path(N1), task="stability", bisect=("lam", -1.0, 9.0), degree=3, time_limit=7.0, solver="SCS",
        dump_problem=dump,
    )  # fmt: skip
    (request,) = asked
    assert code == 0
    assert request.task is Task.STABILITY
    assert request.bisect is not None
    assert dataclasses.astuple(request.bisect) == ("lam", -1.0, 9.0)
    assert dataclasses.astuple(request.options) == (3, 7.0, "SCS", dump)
    shown = capsys.readouterr()
    assert shown.err == "degree 1\n"
    assert "9.5" in shown.out
    design_verbs.solve(Path(N1), settings=("lam=2.5",), quiet=True)
    assert asked[1].problem.pde.parameters == {"lam": 2.5}
    assert asked[1].task is Task.OBSERVER
    assert capsys.readouterr().err == ""


def test_the_command_line_has_the_engines_defaults_and_tasks() -> None:
    hints = get_type_hints(design_verbs.solve)
    literal = next(part for part in get_args(hints["task"]) if part is not type(None))
    assert set(get_args(literal)) == {task.value for task in Task}
    parameters = inspect.signature(design_verbs.solve).parameters
    defaults = {name: parameter.default for name, parameter in parameters.items()}
    assert Choices() == Choices(
        defaults["task"], defaults["bisect"], defaults["settings"], defaults["degree"],
        defaults["time_limit"], defaults["solver"], defaults["dump_problem"],
    )  # fmt: skip


# The engine's process


def request(time_limit_s: float = 60.0) -> Request:
    return prepare(Path(G22), Choices(time_limit_s=time_limit_s))


def test_answer_and_progress_come_from_another_process(capfd: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    answer = solve_in_child(request(), told.append, work=well)
    assert told == ["degree 1", "degree 2"]
    assert not answer.interrupted
    memory = answer.facts["peak_memory_mb"]
    assert finite(answer.facts) == finite(facts(request(), certified(0.5), memory))
    assert math.isnan(answer.facts["attempts"][0]["value"])
    assert math.isinf(answer.facts["open_loop"])
    assert 10.0 < memory < 10_000.0
    out, err = capfd.readouterr()
    assert out == ""
    assert "a solver prints" in err  # standard output is the command's own


def test_peak_memory_counts_what_is_taken() -> None:
    before = peak_memory_mb()
    taken = b"x" * int((before + 50.0) * 2**20)
    assert peak_memory_mb() >= before + 40.0
    del taken


def test_a_time_limit_holds_though_the_engine_does_not_hear() -> None:
    began = time.monotonic()
    solve_in_child(request(), work=well)
    start_s = time.monotonic() - began  # of the engine's process, and little more
    limit_s = 1.0 + 2.0 * start_s  # it says its answer before, on a machine as busy as now
    began = time.monotonic()
    answer = solve_in_child(request(limit_s), work=hangs, grace_s=1.0)
    assert limit_s < time.monotonic() - began < limit_s + 30.0
    assert (answer.facts["status"], answer.facts["gamma"]) == ("certified", 0.6)
    assert "over its time limit" in answer.facts["message"]
    nothing = solve_in_child(request(0.5), work=hangs_at_once, grace_s=0.5).facts
    assert (nothing["status"], nothing["gamma"], nothing["attempts"]) == ("unreliable", None, [])
    assert "over its time limit" in nothing["message"]
    assert nothing["seconds"] > 0.9


def test_a_crash_loses_nothing_that_was_certified() -> None:
    answer = solve_in_child(request(), work=dies)
    assert (answer.facts["status"], answer.facts["gamma"]) == ("certified", 0.6)
    assert "SIGKILL" in answer.facts["message"]
    with pytest.raises(EngineDiedError, match=r"ended by SIGKILL before anything was certified"):
        solve_in_child(request(), work=dies_at_once)


def test_errors_of_the_user_and_of_the_engine_are_kept_apart() -> None:
    with pytest.raises(UsageError, match=r"^boundary\.conditions\[1\]: ill-posed$"):
        solve_in_child(request(), work=refuses)
    with pytest.raises(RuntimeError, match="ZeroDivisionError") as caught:
        solve_in_child(request(), work=breaks)
    assert "in breaks" in "".join(caught.value.__notes__)
    with pytest.raises(RuntimeError, match="PanicError"):
        solve_in_child(request(), work=panics)


# The command as a user sees it


@pytest.fixture
def stand_in(start: Start, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Cli]:
    """The command line with a stand-in for the engine."""
    from conftest import Cli

    def run(name: str, *arguments: str) -> Cli:
        monkeypatch.setenv("OCTARM_STAND_IN", name)
        work = start.work / f"solve{len(start.started)}"
        work.mkdir()
        cli = Cli(work, [str(STAND_IN_CLI), "solve", *arguments])
        start.started.append(cli)
        return cli

    return run


KEYS = {
    "task": str, "status": str, "gamma": float, "achieved": float, "limit": type(None), "seconds": float,
    "sdp": dict, "formulation": str,
    "gain": type(None), "degree": int, "attempts": list, "open_loop": type(None),
    "optimum": float, "peak_memory_mb": float,
    "message": str, "problem": dict, "bisect": type(None),
    "achieved_by_size": list, "achieved_converged": bool, "seconds_by_part": dict,
}  # fmt: skip
SDP_KEYS = {
    "gram_sizes": list, "equalities": int, "iterations": int, "solver": str, "residual": float,
    "smallest_gram_eigenvalue": float, "margin": float,
}  # fmt: skip


def strict(text: str) -> Any:
    """JSON without the NaN and Infinity that Python lets through."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_json_is_one_object_with_the_documented_keys(stand_in: Callable[..., Cli]) -> None:
    cli = stand_in("well", G22, "--json")
    assert cli.finish() == 0, cli.err
    found = strict(cli.out)
    assert {key: type(value) for key, value in found.items()} == KEYS
    assert {key: type(value) for key, value in found["sdp"].items()} == SDP_KEYS
    assert found["attempts"][0]["value"] is None  # NaN: nothing was shown at that degree
    assert (found["task"], found["status"], found["gamma"]) == ("gain", "certified", 0.5)
    assert (found["degree"], found["sdp"]["gram_sizes"]) == (2, [10, 20])
    assert found["seconds_by_part"]["solver"] == 2.0
    assert cli.err.strip() == "a solver prints"


def test_refused_answers_have_an_exit_code_of_their_own(stand_in: Callable[..., Cli]) -> None:
    cli = stand_in("unreliable", G22)
    assert cli.finish() == 6
    assert "unreliable" in cli.out
    assert "the margin is negative" in cli.out
    cli = stand_in("unreliable", G22, "--json")
    assert cli.finish() == 6
    found = strict(cli.out)
    assert (found["status"], found["gamma"], found["degree"]) == ("unreliable", None, 1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_at_once_and_shows_the_best(
    number: signal.Signals, stand_in: Callable[..., Cli]
) -> None:
    cli = stand_in("hangs", G22)
    cli.wait_for("degree 2")
    assert len(cli.processes()) >= 2
    began = time.monotonic()
    cli.popen.send_signal(number)
    assert cli.finish() == 130
    assert time.monotonic() - began < 10.0
    assert "interrupted" in cli.out
    assert "0.6 " in cli.out
    assert cli.err.endswith("octarm: interrupted\n")
    assert "Traceback" not in cli.err
    assert cli.gone() == {}


def test_an_interrupt_before_anything_is_certified(stand_in: Callable[..., Cli]) -> None:
    cli = stand_in("hangs_at_once", G22, "--json")
    limit = time.monotonic() + 30.0
    while "octarm-engine" not in cli.processes() and time.monotonic() < limit:
        time.sleep(0.02)
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    found = strict(cli.out)
    assert (found["status"], found["message"], found["gamma"]) == (
        "unreliable",
        "interrupted",
        None,
    )
    assert cli.gone() == {}


def test_the_engine_does_not_outlive_its_command(stand_in: Callable[..., Cli]) -> None:
    cli = stand_in("hangs_at_once", G22)
    cli.wait_for("degree 1")
    assert "octarm-engine" in cli.processes()
    os.kill(cli.popen.pid, signal.SIGKILL)
    assert cli.gone(10.0) == {}


def test_a_crash_and_an_error_are_internal(stand_in: Callable[..., Cli]) -> None:
    cli = stand_in("dies_at_once", G22, "--quiet")
    assert cli.finish() == 1
    assert cli.out == ""
    assert cli.err.startswith("octarm: the engine's process was ended by SIGKILL")
    cli = stand_in("breaks", G22, "--quiet")
    assert cli.finish() == 1
    assert "Traceback" not in cli.err
    (saved,) = cli.sockets.glob("octarm-error-*.txt")
    assert "in breaks" in saved.read_text()


# The suite


def test_rows_that_the_engine_solves(start: Start) -> None:
    """Quick ones of three kinds, from end to end; all of them: `octarm solve --suite`."""
    cli = start("solve", "--suite", "--only", "S2", "O1", "G22", "--json")
    assert cli.finish() == 0, cli.out
    found = strict(cli.out)
    assert found["ok"]
    for row in found["rows"]:
        assert row["ok"], row["reason"]
        assert row["seconds"] < row["seconds_allowed"]
        answer = row["answer"]
        assert answer["sdp"]["residual"] < 1e-6
        assert answer["achieved"] == pytest.approx(row["true"], rel=1e-4)
        assert answer["peak_memory_mb"] == row["peak_memory_mb"]


def test_an_answer_of_the_engine(start: Start) -> None:
    cli = start("solve", G22, "--set", "none=1")
    assert cli.finish() == 2
    assert "none" in cli.err
    cli = start("solve", G22, "--dump-problem", "programs")
    assert cli.finish() == 0, cli.out
    assert "certified" in cli.out
    assert "0.2083" in cli.out
    assert cli.err.startswith("degree ")
    assert list((cli.work / "programs").iterdir())


def prepared(values: dict[str, float]) -> Callable[[Request, Callable[[str], None]], Answer]:
    """An engine that knows its answers by the problem's name."""

    def solve(request: Request, progress: Callable[[str], None]) -> Answer:
        name = request.problem.pde.name
        progress(f"degree 1 of {name}")
        if name not in values:
            raise EngineDiedError("the engine's process was ended by SIGKILL")
        value = values[name]
        gamma, limit = (None, value) if request.bisect else (value, None)
        return Answer(facts(request, certified(gamma, limit, request.task), 150.0))

    return solve


def truth() -> dict[str, float]:
    return {row.id: row.true if isinstance(row.true, float) else 1.0 for row in read_suite(SUITE)}


def suite(values: dict[str, float], *only: str) -> tuple[dict[str, Any], list[str]]:
    told: list[str] = []
    rows = read_suite(SUITE, only)
    return run_suite(rows, SUITE.parent, Choices(), prepared(values), told.append), told


def test_a_suite_of_true_answers_holds() -> None:
    found, told = suite(truth())
    assert found["ok"]
    assert (found["not_run"], found["interrupted"]) == ([], False)
    assert [row["id"] for row in found["rows"]] == [row.id for row in read_suite(SUITE)]
    for row in found["rows"]:
        assert row["ratio"] == (None if row["true"] == "stable" else 1.0)
        assert (row["degree"], row["seconds"], row["peak_memory_mb"]) == (2, 5.0, 150.0)
        assert row["answer"]["status"] == "certified"
    assert told[:3] == ["S1 (1 of 17): limit, heat", "S1: degree 1 of S1", "S1: ok"]


def test_one_bad_row_fails_the_suite_and_leaves_the_others() -> None:
    values = truth() | {"G22": 0.2, "S2": 2.0}
    del values["N1"]
    found, told = suite(values)
    bad = {row["id"]: row["reason"] for row in found["rows"] if not row["ok"]}
    assert not found["ok"]
    assert len(found["rows"]) == 17
    assert bad.keys() == {"G22", "S2", "N1"}
    assert "below the truth" in bad["G22"]
    assert "at least 2.34403" in bad["S2"]
    assert bad["N1"] == "the engine's process was ended by SIGKILL"
    assert f"S2: FAILS, {bad['S2']}" in told


def test_rows_are_chosen_by_id_in_the_files_order() -> None:
    found, _ = suite(truth(), "G22", "S2")
    assert [row["id"] for row in found["rows"]] == ["S2", "G22"]


def test_no_row_has_settings_of_its_own() -> None:
    asked: list[Request] = []

    def solve(request: Request, progress: Callable[[str], None]) -> Answer:
        asked.append(request)
        return Answer(facts(request, certified(1.0)))

    run_suite(read_suite(SUITE), SUITE.parent, Choices(time_limit_s=33.0, solver="SCS"), solve)
    assert {request.options for request in asked} == {
        prepare(Path(G22), Choices(time_limit_s=33.0, solver="SCS")).options
    }
    assert [request.task for request in asked] == [row.task for row in read_suite(SUITE)]
    assert all(request.problem.task is request.task for request in asked)
    assert [r.bisect for r in asked] == [r.problem.bisect for r in asked]


@pytest.mark.parametrize("how", ["while a row runs", "between two rows"])
def test_an_interrupted_suite_keeps_its_rows(how: str) -> None:
    answer = prepared(truth())

    def solve(request: Request, progress: Callable[[str], None]) -> Answer:
        given = answer(request, progress)
        if request.problem.pde.name != "S3":
            return given
        if how == "between two rows":
            raise KeyboardInterrupt
        return Answer(given.facts, interrupted=True)

    found = run_suite(read_suite(SUITE, ["S1", "S2", "S3", "O1"]), SUITE.parent, Choices(), solve)
    assert [row["id"] for row in found["rows"]] == ["S1", "S2"]
    assert found["not_run"] == ["S3", "O1"]
    assert found["interrupted"]
    assert not found["ok"]


def test_what_is_wrong_with_all_rows_is_said_once() -> None:
    def solve(request: Request, progress: Callable[[str], None]) -> Answer:
        raise UsageError("--solver NOPE: expected a semidefinite solver")

    with pytest.raises(UsageError, match="--solver NOPE"):
        run_suite(read_suite(SUITE), SUITE.parent, Choices(solver="NOPE"), solve)


def test_an_error_within_the_engine_is_a_failed_row() -> None:
    def solve(request: Request, progress: Callable[[str], None]) -> Answer:
        if request.problem.pde.name == "S1":
            return prepared(truth())(request, progress)
        raise (UsageError if request.problem.pde.name == "S2" else RuntimeError)("it broke")

    found = run_suite(read_suite(SUITE, ["S1", "S2", "S3"]), SUITE.parent, Choices(), solve)
    assert [row["ok"] for row in found["rows"]] == [True, False, False]
    assert {row["reason"] for row in found["rows"]} == {"", "it broke"}
    assert isinstance(EngineDiedError("x"), OctarmError)


def test_the_suite_on_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("supervise.solving.solve_in_child", prepared(truth()))
    assert design_verbs.solve(suite=True) == 0
    shown = capsys.readouterr()
    assert "17 of 17 rows ok" in shown.out
    assert "S1: degree 1 of S1" in shown.err
    monkeypatch.setattr("supervise.solving.solve_in_child", prepared(truth() | {"O1": 0.6}))
    assert design_verbs.solve(suite=True, only=("O1", "O2"), json=True) == 6
    shown = capsys.readouterr()
    found = strict(shown.out)
    assert [(row["id"], row["ok"]) for row in found["rows"]] == [("O1", False), ("O2", True)]
    assert shown.err == ""


def test_the_suites_tasks_are_those_of_its_files() -> None:
    def check(row: Row) -> None:
        request = prepare(SUITE.parent / row.file, Choices())
        assert request.task == row.task
        assert request.problem.pde.name == row.id
        assert (request.bisect is not None) == row.asks_for_limit

    for row in read_suite(SUITE):
        check(row)
