"""The tables of `octarm solve`: every figure stands where a reader looks for it, whatever is missing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from analysis.folded_table import WIDTH
from analysis.solve_table import answer_table, suite_table
from design.solve_suite import read_suite

SUITE = Path(__file__).resolve().parents[2] / "examples" / "suite.toml"


def attempt(degree: int, value: float) -> dict[str, Any]:
    return {
        "degree": degree, "gram_sizes": [8, 20, 20], "equalities": 150, "value": value, "margin": 2e-6,
        "residual": 3e-12, "smallest_gram_eigenvalue": -4e-9, "solver_status": "optimal_inaccurate",
        "seconds": 1.25,
    }  # fmt: skip


def answer(**changes: Any) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "problem": {
            "name": "rod", "file": "rod.toml", "domain": [-1.0, 1.0], "parameters": {"lam": 1.5},
            "states": {"x": 2, "X": "ode"}, "disturbances": ["w", "f(s)"], "controls": [],
            "regulated": ["int(x)"], "measured": ["x(1) + w"], "norm_of": [], "norm_by": [],
        },
        "task": "observer", "bisect": None, "status": "certified", "message": "certified at degree 2",
        "gamma": 0.66, "limit": None, "achieved": 0.65, "achieved_by_size": [[15, 0.649], [23, 0.65]],
        "achieved_converged": True, "open_loop": math.inf, "optimum": 0.64, "formulation": "observer LPI",
        "degree": 2,
        "sdp": {"gram_sizes": [8, 20, 20], "equalities": 150, "solver": "CLARABEL"},
        "attempts": [attempt(1, math.nan), attempt(2, 0.66)], "seconds": 10.0,
        "seconds_by_part": {"assembly": 1.0, "modelling": 2.0, "solver": 4.0, "verification": 0.5},
        "peak_memory_mb": 149.6,
    }  # fmt: skip
    return facts | changes


def rows(text: str) -> dict[str, str]:
    """By first word, the line with its spaces made one."""
    lines = [" ".join(line.split()) for line in text.splitlines() if line.strip()]
    return {line.partition(" ")[0]: line for line in lines}


def test_all_of_an_answer() -> None:
    text = answer_table(answer())
    assert max(map(len, text.splitlines())) <= WIDTH
    found = rows(text)
    assert found["problem"] == "problem rod rod.toml"
    assert found["task"] == "task observer parameters lam = 1.5"
    assert found["states"].startswith("states x: 2, X: ode ")
    assert "s in [-1, 1]" in found["states"]
    assert found["disturbances"].startswith("disturbances w, f(s) ")
    assert "controls" not in found
    assert found["verdict"] == "verdict certified certified at degree 2"
    assert found["gamma"].startswith("gamma 0.66 ")
    assert found["achieved"].startswith("achieved 0.65 ")
    assert "by size 15: 0.649, 23: 0.65" in " ".join(text.split())
    assert found["open"].startswith("open loop unstable ")
    assert found["optimum"].startswith("optimum 0.64 ")
    assert "1.0312 times" in text
    assert found["formulation"].endswith(
        "degree 2: Gram matrices 8, 20, 20, 150 equalities, CLARABEL"
    )
    assert found["time"] == (
        "time 10.0 s assembly 10%, CVXPY 20%, solver 40%, verification 5%, other 25%"
    )
    assert found["peak"].startswith("peak memory 150 MB ")
    assert found["1"] == "1 8, 20, 20 150 - 2.0e-06 3.0e-12 -4.0e-09 optimal_inaccurate 1.2"
    assert found["2"] == "2 8, 20, 20 150 0.66 2.0e-06 3.0e-12 -4.0e-09 optimal_inaccurate 1.2"


def test_a_limit_of_stability() -> None:
    bisect = {"parameter": "lam", "low": 0.0, "high": 20.0}
    found = rows(answer_table(answer(task="stability", bisect=bisect, gamma=None, limit=9.8696044)))
    assert found["task"] == "task limit of stability, lam in [0, 20] parameters lam = 1.5"
    assert found["limit"].startswith("limit 9.8696 last lam ")
    assert "gamma" not in found
    assert "limit of the spectrum" in found["achieved"]


def test_an_answer_without_a_bound_shows_none() -> None:
    nothing = dict.fromkeys(
        ("gamma", "achieved", "open_loop", "optimum", "degree", "peak_memory_mb")
    )
    empty = {"status": "infeasible", "message": "unstable", "attempts": [], "formulation": ""}
    text = answer_table(answer(**nothing, **empty, achieved_by_size=[], achieved_converged=None))
    found = rows(text)
    assert found["verdict"] == "verdict infeasible unstable"
    assert not {"gamma", "achieved", "open", "optimum", "formulation", "peak"} & found.keys()
    assert found["time"] == "time 10.0 s"
    assert "proven" not in text


def test_values_that_did_not_converge_are_called_so() -> None:
    text = answer_table(
        answer(achieved_converged=False, achieved_by_size=[[15, math.inf], [23, 0.65]])
    )
    line = " ".join(text.split())
    assert "by size 15: unstable, 23: 0.65; not converged" in line


def test_long_texts_are_wrapped_and_not_cut() -> None:
    message = "no certificate " * 30
    text = answer_table(answer(message=message))
    assert text.count("certificate") == 30
    assert max(map(len, text.splitlines())) <= WIDTH


# The suite


def row(**changes: Any) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "id": "G20", "problem": "gain, transport", "true": 0.5, "ours": 0.5005, "ratio": 1.001,
        "published": [0.516, 0.501], "achieved": 0.49999, "degree": 3, "seconds": 4.26,
        "seconds_allowed": 30.0, "peak_memory_mb": 150.4, "status": "certified", "ok": True, "reason": "",
    }  # fmt: skip
    return facts | changes


def suite(*table: dict[str, Any], not_run: tuple[str, ...] = ()) -> str:
    return suite_table({"rows": list(table), "not_run": list(not_run), "seconds": 61.6})


def test_rows_of_the_suite() -> None:
    stable = row(id="S13", true="stable", ours=None, ratio=None, published=["stable"])
    lost = dict.fromkeys(
        ("ours", "ratio", "achieved", "degree", "seconds", "peak_memory_mb", "status")
    )
    text = suite(
        row(),
        stable,
        row(id="N1", ok=False, reason="below the truth"),
        row(id="N6", ok=False, reason="it died", **lost),
    )
    found = rows(text.partition("\n\n")[0])
    assert (
        found["G20"] == "G20 gain, transport 0.5 0.5005 1.0010 0.516 / 0.501 0.49999 3 4.3 150 ok"
    )
    assert found["S13"] == "S13 gain, transport stable stable - stable 0.49999 3 4.3 150 ok"
    assert found["N1"].endswith("150 FAILS")
    assert found["N6"] == "N6 gain, transport 0.5 - - 0.516 / 0.501 - - - - FAILS"
    below = text.partition("\n\n")[2].splitlines()
    assert below == [
        "N1 fails: below the truth",
        "N6 fails: it died",
        "2 of 4 rows ok, 62 s, largest peak memory 150 MB",
    ]


def test_a_stable_row_that_failed_is_not_called_stable() -> None:
    text = suite(
        row(true="stable", ours=None, ratio=None, status="unreliable", ok=False, reason="r")
    )
    assert rows(text)["G20"].startswith("G20 fails")
    assert " stable - - 0.516" in " ".join(text.split())


def test_slow_rows_and_rows_that_were_not_run_are_named() -> None:
    text = suite(row(seconds=31.2), row(id="S1"), not_run=("S2", "S3"))
    assert "G20 took 31 s, its time is 30 s\n" in text
    assert "S1 took" not in text
    assert "interrupted; not run: S2, S3\n" in text


def test_the_longest_rows_stay_on_one_line() -> None:
    problem = max((row.problem for row in read_suite(SUITE)), key=len)
    longest = row(
        id="NC1b", problem=problem, true=0.29814123, ours=0.29814199,
        published=[0.29814, 0.29814], achieved=0.29814111, seconds=119.9, peak_memory_mb=1234.0, ok=False,
    )  # fmt: skip
    head = suite(longest).splitlines()[:4]
    assert head[2].startswith("NC1b")
    assert head[2].endswith("FAILS")
    assert head[3] == ""
