"""`octarm solve` behind its command line: what is asked, how the engine is called, what is said of answers."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from design.lpi import engine
from design.lpi.reporter import Reporter
from design.lpi.result import Achieved, Attempt, Options, Result, Status
from design.pde.model import Pde
from design.pde.problem_file import Bisection, Task
from design.solve_command import Choices, Request, answer, facts, prepare
from design.solve_suite import Row, judge, read_suite, row_facts
from wire.config_json import finite
from wire.errors import UsageError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SUITE = EXAMPLES / "suite.toml"
ROD = """\
name = "rod"
domain = [0, 2]
parameters = { lam = 1.5, mu = 0.25 }
[states]
x = 2
X = "ode"
[inputs]
disturbances = ["w", "f(s)"]
[equations]
x = "x_ss + lam*x + f"
X = "-mu*X + w"
[boundary]
conditions = ["x(0)", "x_s(2)"]
"""
REGULATED = '[outputs]\nregulated = ["int(x)", "x"]\n'
MEASURED = 'measured = ["x(2) + w"]\n'
CONTROLS = 'controls = ["u"]\n'
NORM = '[norm]\nof = ["x"]\nby = ["x_s", "X"]\n'


def text(*parts: str, controls: bool = False) -> str:
    whole = ROD + "".join(parts)
    return whole.replace("[equations]", f"{CONTROLS}[equations]") if controls else whole


AUTONOMOUS = (
    text()
    .replace('[inputs]\ndisturbances = ["w", "f(s)"]\n', "")
    .replace(" + f", "")
    .replace(" + w", "")
)
NO_EQUATIONS = (
    'states = { x = 1 }\nboundary.conditions = ["x(0)"]\nnorm = { of = ["x"], by = ["x_s"] }\n'
)


def ask(folder: Path, content: str, **choices: Any) -> Request:
    path = folder / "rod.toml"
    path.write_text(content)
    return prepare(path, Choices(**choices))


# What is asked


IMPLIED = {
    "nothing but equations": (AUTONOMOUS, Task.STABILITY),
    "disturbed and regulated": (text(REGULATED), Task.GAIN),
    "measured": (text(REGULATED, MEASURED), Task.OBSERVER),
    "controlled": (text(REGULATED, controls=True), Task.CONTROLLER),
    "norm alone": (NO_EQUATIONS, Task.NORM),
    "bisect": ('bisect = ["lam", 0, 3]\n' + text(REGULATED), Task.STABILITY),
    "said": ('task = "stability"\n' + text(REGULATED, MEASURED, controls=True), Task.STABILITY),
}


@pytest.mark.parametrize("case", IMPLIED)
def test_task_that_the_file_implies(case: str, tmp_path: Path) -> None:
    content, task = IMPLIED[case]
    assert ask(tmp_path, content).task is task


AMBIGUOUS = {
    "measured and controlled": (
        text(REGULATED, MEASURED, controls=True),
        "stability, gain, observer, controller, h2, h2-observer",
    ),
    "disturbed only": (text(), "stability"),
    "equations and norm": (AUTONOMOUS + NORM, "stability, norm"),
    "everything": (
        text(REGULATED, MEASURED, NORM, controls=True),
        "stability, gain, observer, controller, norm, h2, h2-observer",
    ),
}


@pytest.mark.parametrize("case", AMBIGUOUS)
def test_several_tasks_are_possible(case: str, tmp_path: Path) -> None:
    content, choices = AMBIGUOUS[case]
    with pytest.raises(UsageError, match=rf"rod\.toml.*--task.*: {choices}$"):
        ask(tmp_path, content)
    assert ask(tmp_path, content, task="stability").task is Task.STABILITY


def test_the_choice_of_the_command_line_goes_before_the_files(tmp_path: Path) -> None:
    content = 'task = "observer"\nbisect = ["lam", 0, 3]\n' + text(REGULATED, MEASURED)
    assert ask(tmp_path, content).task is Task.OBSERVER
    assert ask(tmp_path, content).bisect is None
    assert ask(tmp_path, content, task="gain").bisect is None
    stability = ask(tmp_path, content, task="stability")
    assert (stability.task, stability.bisect) == (Task.STABILITY, Bisection("lam", 0.0, 3.0))
    other = ask(tmp_path, content, bisect=("mu", -1.0, 1.0))
    assert (other.task, other.bisect) == (Task.STABILITY, Bisection("mu", -1.0, 1.0))


def test_a_parameter_set_by_hand_is_not_searched(tmp_path: Path) -> None:
    content = 'bisect = ["lam", 0, 3]\n' + text()
    fixed = ask(tmp_path, content, parameters=("lam=2.5",))
    assert (fixed.task, fixed.bisect) == (Task.STABILITY, None)
    assert fixed.problem.pde.parameters == {"lam": 2.5, "mu": 0.25}
    other = ask(tmp_path, content, parameters=(" mu = -1e-1 ",))
    assert other.bisect == Bisection("lam", 0.0, 3.0)
    assert other.problem.pde.parameters == {"lam": 1.5, "mu": -0.1}


@pytest.mark.parametrize("task", ["stability", "gain"])
def test_a_norm_without_equations_is_nothing_else(task: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"rod\.toml: --task: .* needs "):
        ask(tmp_path, NO_EQUATIONS, task=task)


def test_unknown_task_and_missing_parts(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--task: expected one of stability.*did you mean gain\?"):
        ask(tmp_path, ROD, task="gian")
    with pytest.raises(
        UsageError, match=r"'observer' needs outputs\.regulated and outputs\.measured"
    ):
        ask(tmp_path, ROD, task="observer")


def test_ill_posed_conditions_are_refused_before_any_work(tmp_path: Path) -> None:
    twice = AUTONOMOUS.replace('"x_s(2)"', '"x(0) = 3*x(0)"')
    assert twice != AUTONOMOUS
    with pytest.raises(UsageError, match=r"rod\.toml: .*conditions do not determine the states"):
        ask(tmp_path, twice)


def test_options_reach_the_request(tmp_path: Path) -> None:
    assert ask(tmp_path, AUTONOMOUS).options == Options()
    dump = tmp_path / "a" / "b"
    chosen = ask(tmp_path, AUTONOMOUS, degree=0, time_limit_s=5.0, solver="SCS", dump=dump)
    assert chosen.options == Options(0, 5.0, "SCS", dump)
    assert not dump.exists()  # nothing is made before the work starts
    dump.mkdir(parents=True)
    assert ask(tmp_path, AUTONOMOUS, dump=dump).options.dump == dump
    assert pickle.loads(pickle.dumps(chosen)) == chosen


# How the engine is called


@pytest.fixture
def request_(tmp_path: Path) -> Request:
    return ask(tmp_path, text(REGULATED), parameters=("lam=0.5",))


def test_the_engine_gets_pde_task_and_options(
    request_: Request, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[Any, ...]] = []

    def solve(*arguments: Any) -> Result:
        calls.append(arguments)
        return Result("gain", Status.CERTIFIED, "")

    monkeypatch.setattr(engine, "solve", solve)
    reporter = Reporter()
    options = Options(dump=tmp_path / "new" / "dump")
    assert answer(replace(request_, options=options), reporter).status is Status.CERTIFIED
    assert calls == [(request_.problem.pde, "gain", options, reporter)]
    assert (tmp_path / "new" / "dump").is_dir()


def test_a_bisection_reads_the_problem_again_with_the_other_parameters_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Pde] = []

    def stability_limit(
        problem: Callable[[float], Pde], low: float, high: float, options: Options, progress: Any
    ) -> Result:
        seen.extend(problem(value) for value in (low, high))
        return Result("stability", Status.CERTIFIED, "", limit=high)

    monkeypatch.setattr(engine, "stability_limit", stability_limit)
    asked = ask(tmp_path, AUTONOMOUS, bisect=("lam", -1.0, 7.0), parameters=("mu=3",))
    assert answer(asked).limit == 7.0
    assert [pde.parameters for pde in seen] == [{"lam": -1.0, "mu": 3.0}, {"lam": 7.0, "mu": 3.0}]
    at_seven = ask(tmp_path, AUTONOMOUS, parameters=("lam=7", "mu=3")).problem.pde
    assert seen[1] == at_seven


def test_a_solver_that_is_not_there(request_: Request) -> None:
    bad = replace(request_, options=Options(solver="GUESS"))
    with pytest.raises(UsageError, match=r"--solver GUESS: .*CLARABEL"):
        answer(bad)


def test_no_limit_between_the_ends(tmp_path: Path) -> None:
    asked = ask(tmp_path, AUTONOMOUS, bisect=("lam", 20.0, 30.0))
    with pytest.raises(UsageError, match=r"rod\.toml: bisect lam: .* at both 20 and 30.*--bisect"):
        answer(asked)


# What is said of the answer


def attempt(degree: int, value: float) -> Attempt:
    return Attempt(
        degree, (4, 8), 30 + degree, 12, "CLARABEL", "optimal", 1e-12, -1e-9, 1e-6, value, 1e-5,
        assembly_s=1.0, modelling_s=0.5, solver_s=2.0, verification_s=0.25,
    )  # fmt: skip


def test_facts_of_an_answer(request_: Request) -> None:
    attempts = (attempt(1, math.nan), attempt(2, 0.7), attempt(3, 0.8))
    result = Result(
        task="gain",
        status=Status.CERTIFIED,
        message="well",
        gamma=0.7,
        achieved=Achieved(0.69, ((15, 0.68), (23, 0.69)), True, math.inf, 0.5),
        formulation="some",
        best=attempts[1],
        attempts=attempts,
        seconds=12.0,
    )
    found = facts(request_, result, 99.5)
    assert (found["task"], found["status"], found["message"]) == ("gain", "certified", "well")
    assert (found["gamma"], found["limit"], found["achieved"]) == (0.7, None, 0.69)
    assert (found["open_loop"], found["optimum"], found["degree"]) == (math.inf, 0.5, 2)
    assert found["achieved_by_size"] == [[15, 0.68], [23, 0.69]]
    assert (found["achieved_converged"], found["peak_memory_mb"]) == (True, 99.5)
    assert found["sdp"] == {
        "gram_sizes": [4, 8], "equalities": 32, "iterations": 12, "solver": "CLARABEL",
        "residual": 1e-12, "smallest_gram_eigenvalue": -1e-9, "margin": 1e-6,
    }  # fmt: skip
    assert [a["degree"] for a in found["attempts"]] == [1, 2, 3]
    assert found["attempts"][2]["seconds"] == 3.75
    assert found["seconds_by_part"] == {
        "assembly": 3.0, "modelling": 1.5, "solver": 6.0, "verification": 0.75,
    }  # fmt: skip
    assert found["problem"] == {
        "name": "rod", "file": request_.problem.source, "domain": [0.0, 2.0],
        "parameters": {"lam": 0.5, "mu": 0.25}, "states": {"x": 2, "X": "ode"},
        "disturbances": ["w", "f(s)"], "controls": [], "regulated": ["int(x)", "x"],
        "measured": [], "norm_of": [], "norm_by": [],
    }  # fmt: skip


def test_facts_without_an_attempt_have_the_same_keys(request_: Request) -> None:
    full = facts(request_, Result("gain", Status.CERTIFIED, "", best=attempt(1, 1.0)))
    empty = facts(request_, Result("gain", Status.INFEASIBLE, "unstable"))
    assert empty.keys() == full.keys()
    assert empty["sdp"].keys() == full["sdp"].keys()
    assert empty["sdp"]["gram_sizes"] == []
    assert (empty["degree"], empty["gamma"], empty["achieved"]) == (None, None, None)


def test_the_last_attempt_speaks_where_none_was_good(request_: Request) -> None:
    tried = (attempt(1, math.nan), attempt(2, math.nan))
    found = facts(request_, Result("gain", Status.UNRELIABLE, "no", attempts=tried))
    assert (found["degree"], found["sdp"]["equalities"]) == (2, 32)


def test_json_has_no_infinite_numbers() -> None:
    nested = {"a": [1.0, math.inf, (math.nan, 2)], "b": {"c": -math.inf, "d": "inf"}, "e": True}
    assert finite(nested) == {"a": [1.0, None, [None, 2]], "b": {"c": None, "d": "inf"}, "e": True}


# The suite


def row(**changes: Any) -> Row:
    values = {
        "id": "R", "problem": "p", "file": "f", "task": "gain", "true": 2.0, "published": (2.1,),
        "tolerance": 1.05, "seconds": 30.0,
    }  # fmt: skip
    return Row(**{**values, **changes})


def said(
    gamma: float | None = None, limit: float | None = None, status: str = "certified"
) -> dict[str, Any]:
    return {
        "status": status, "message": "m", "gamma": gamma, "limit": limit, "achieved": 1.9, "degree": 3,
        "seconds": 4.0, "peak_memory_mb": 100.0,
    }  # fmt: skip


LIMIT = {"task": "stability"}
JUDGED = {
    "true": (row(), said(2.0), True, ""),
    "within": (row(), said(2.0999), True, ""),
    "too far": (row(), said(2.1001), False, "not at most 2.1"),
    "wider tolerance": (row(tolerance=1.25), said(2.49), True, ""),
    "rounding below": (row(), said(1.99981), True, ""),
    "below the truth": (row(), said(1.99979), False, "below the truth, 2: no bound"),
    "infinite": (row(), said(math.inf), False, "not at most"),
    "NaN": (row(), said(math.nan), False, "not at most"),
    "no number": (row(), said(limit=2.0), False, "no number"),
    "not certified": (row(), said(2.0, status="unreliable"), False, "unreliable: m"),
    "infeasible": (row(), said(2.0, status="infeasible"), False, "infeasible: m"),
    "limit true": (row(**LIMIT), said(limit=2.0), True, ""),
    "limit within": (row(**LIMIT), said(limit=1.9001), True, ""),
    "limit too far": (row(**LIMIT), said(limit=1.8999), False, "not at least 1.9"),
    "limit rounding above": (row(**LIMIT), said(limit=2.00019), True, ""),
    "limit above the truth": (row(**LIMIT), said(limit=2.00021), False, "above the truth"),
    "limit NaN": (row(**LIMIT), said(limit=math.nan), False, "not at least"),
    "limit missing": (row(**LIMIT), said(2.0), False, "no number"),
    "stable": (row(task="stability", true="stable"), said(), True, ""),
    "not stable": (row(task="stability", true="stable"), said(status="unreliable"), False, "m"),
}


@pytest.mark.parametrize("case", JUDGED)
def test_judgement(case: str) -> None:
    problem, answered, ok, reason = JUDGED[case]
    judged = judge(problem, answered)
    assert judged.ok is ok
    assert reason in judged.reason
    assert bool(judged.reason) is not ok


def test_a_row_of_the_table() -> None:
    found = row_facts(row(), said(2.05))
    assert (found["ours"], found["ratio"]) == (2.05, 1.025)
    assert (found["ok"], found["status"], found["degree"], found["seconds"]) == (
        True,
        "certified",
        3,
        4.0,
    )
    lost = row_facts(row(), None, "it died")
    assert lost.keys() == found.keys()
    assert (lost["ok"], lost["reason"], lost["ours"], lost["seconds"]) == (
        False,
        "it died",
        None,
        None,
    )


TRUTH: dict[str, float | str] = {
    "S1": math.pi**2, "S2": math.pi**2 / 4, "S3": 4.653784, "S13": "stable", "O1": 2 / math.pi,
    "O2": 1 / math.pi, "G20": 0.5, "G22": 5 / 24, "G24": 8.2141230, "G29": 6.1307749, "N1": 0.636866,
    "N2": 0.298141, "N6": 0.390951, "C29": 1.0, "NC1b": 1.273241, "NC3": 0.961260, "NC4": 1.751990,
}  # fmt: skip
BEAMS = {"S13", "G29", "N6", "NC3", "NC4"}


def test_the_suites_truths_and_tolerances() -> None:
    rows = read_suite(SUITE)
    assert [r.id for r in rows] == list(TRUTH)
    for r in rows:
        true = TRUTH[r.id]
        assert r.true == (true if isinstance(true, str) else pytest.approx(true, rel=1e-12)), r.id
    assert {r.id for r in rows if r.tolerance != 1.05} == BEAMS
    assert {(r.tolerance, r.seconds) for r in rows} == {(1.05, 30.0), (1.25, 120.0)}
    assert {r.id for r in rows if r.seconds == 120.0} == BEAMS
    assert {r.id for r in rows if r.asks_for_limit} == {"S1", "S2", "S3"}


BAD_SUITES = {
    "no TOML": ("rows = [", "Invalid value"),
    "empty": ("", "rows"),
    "no rows": ("rows = []", "got none"),
    "unknown key": ("degree = 3\n", "degree"),
    "missing key": ("[[rows]]\nid = 'S1'\n", "problem"),
}


@pytest.mark.parametrize("case", BAD_SUITES)
def test_bad_suite(case: str, tmp_path: Path) -> None:
    content, culprit = BAD_SUITES[case]
    path = tmp_path / "s.toml"
    path.write_text(content)
    with pytest.raises(UsageError, match=rf"(?s)s\.toml.*{culprit}"):
        read_suite(path)


@pytest.mark.parametrize(
    "change",
    [
        ("tolerance = 1.05", "tolerance = 0.9"),
        ("seconds = 30", "seconds = 0"),
        ("true = 0.5", "true = -0.5"),
        ("true = 0.5", 'true = "stable"'),
        ("true = 0.5", 'true = "big"'),
        ('id = "S2"', 'id = "S1"'),
        ("true = 0.5", "true = 0.5\ndegree = 4"),
    ],
)
def test_bad_row(change: tuple[str, str], tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    before = SUITE.read_text()
    path.write_text(before.replace(*change))
    assert path.read_text() != before
    with pytest.raises(UsageError, match=r"s\.toml"):
        read_suite(path)


def test_missing_suite_and_unknown_row(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        read_suite(tmp_path / "none.toml")
    with pytest.raises(UsageError, match=r"--only NC2: there is no such row.*NC4"):
        read_suite(SUITE, ["S1", "NC2"])
