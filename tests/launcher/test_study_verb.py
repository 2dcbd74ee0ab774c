"""`octarm study`, with a stand-in for the study: choices, files, refusals."""

from __future__ import annotations

import json
import math
import sys
import types
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any, get_args, get_type_hints
from unittest import mock

import in_process
import pytest

from supervise import design_verbs
from supervise.studying import STUDIES, keywords_of
from wire.artefact import GainsArtefact
from wire.errors import UsageError

ROOT = Path(__file__).resolve().parents[2]
seen: list[dict[str, Any]] = []


def run(
    artefact: GainsArtefact,
    progress: Callable[[str], None],
    *,
    setpoints: tuple[str, ...] = ("1", "2"),
    nodes: int = 10,
    tick_s: float = 0.1,
) -> dict[str, Any]:
    progress("case 1 of 2")
    seen.append({"setpoints": setpoints, "nodes": nodes, "tick_s": tick_s})
    return {"arm": artefact.arm.name, "rows": [{"gamma": 0.25}, {"gamma": math.inf}]}


def table(facts: dict[str, Any]) -> str:
    return "\n".join(f"gamma {row['gamma']}" for row in facts["rows"])


def plot(facts: dict[str, Any], path: Path) -> None:
    path.write_bytes(b"picture of " + facts["study"].encode())


@pytest.fixture
def octarm(monkeypatch: pytest.MonkeyPatch) -> Callable[..., object]:
    module = types.ModuleType("analysis.study.baselines")
    vars(module).update(run=run, table=table, plot=plot)
    monkeypatch.setitem(sys.modules, "analysis.study.baselines", module)
    seen.clear()

    def call(*arguments: str | Path) -> object:
        return in_process.octarm("study", *arguments)

    return call


def test_table_and_progress_go_where_they_belong(
    octarm: Callable[..., object], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "new" / "study"
    assert (
        octarm("baselines", "--nodes", "6", "--setpoint", "2", "--tick", "0.05", "--out", out) == 0
    )
    printed, told = capsys.readouterr()
    assert seen == [{"setpoints": ("2",), "nodes": 6, "tick_s": 0.05}]
    assert printed.splitlines()[:2] == ["gamma 0.25", "gamma inf"]
    assert told == "case 1 of 2\n"
    assert sorted(p.name for p in out.iterdir()) == ["baselines.json", "baselines.png"]
    written = json.loads((out / "baselines.json").read_text())
    assert written["rows"] == [{"gamma": 0.25}, {"gamma": None}]
    assert (out / "baselines.png").read_bytes() == b"picture of baselines"


def test_json_is_one_object_and_nothing_else(
    octarm: Callable[..., object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm("baselines", "--json") == 0
    printed, told = capsys.readouterr()
    facts = json.loads(printed)
    assert (facts["study"], facts["rows"][1]["gamma"], told) == ("baselines", None, "")
    assert seen == [{"setpoints": ("1", "2"), "nodes": 10, "tick_s": 0.1}]


def test_nothing_is_written_over_unasked(
    octarm: Callable[..., object], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "baselines.png").write_text("mine")
    assert octarm("baselines", "--out", tmp_path) == 2
    assert "baselines.png exists there already" in capsys.readouterr().err
    assert seen == []  # refused before anything is computed
    assert octarm("baselines", "--out", tmp_path, "--force") == 0
    assert (tmp_path / "baselines.png").read_bytes() == b"picture of baselines"


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (("baselines", "--ticks", "9"), "--ticks: the study of baselines does not offer"),
        (("baselines", "--jobs", "1"), "it has --setpoint, --nodes, --tick"),
        (
            ("baselines", "--nodes", "5", "--nodes", "6"),
            "--nodes: the study of baselines takes one",
        ),
        (("baselines", "--gains", "none.json"), "none.json"),
        (("baselines", "--out", ROOT / "Makefile"), "Makefile"),
        (("weather",), "weather"),
    ],
)
def test_a_wrong_choice_is_named(
    octarm: Callable[..., object],
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str | Path, ...],
    culprit: str,
) -> None:
    assert octarm(*arguments) == 2
    printed, told = capsys.readouterr()
    assert (printed, "Traceback" in told, culprit in told) == ("", False, True)
    assert seen == []


def test_a_study_that_fails_leaves_no_half_file(
    octarm: Callable[..., object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with mock.patch.dict(
        vars(sys.modules["analysis.study.baselines"]),
        {"plot": mock.Mock(side_effect=UsageError("no picture"))},
    ):
        assert octarm("baselines", "--out", tmp_path) == 2
    assert "no picture" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["baselines.json"]


def test_a_study_that_is_refused_leaves_no_directory(
    octarm: Callable[..., object], tmp_path: Path
) -> None:
    there = tmp_path / "there"
    there.mkdir()
    failing = mock.Mock(side_effect=UsageError("no such setpoint"), __signature__=signature(run))
    with mock.patch.dict(vars(sys.modules["analysis.study.baselines"]), {"run": failing}):
        assert octarm("baselines", "--out", tmp_path / "new") == 2
        assert octarm("baselines", "--out", there) == 2
    assert list(tmp_path.iterdir()) == [there]


def test_jobs_are_counted_from_one() -> None:
    def parallel(*, jobs: int | None = None) -> None: ...

    assert keywords_of("robustness", parallel, {"jobs": (2,)}) == {"jobs": 2}
    with pytest.raises(UsageError, match="--jobs: expected at least 1, got 0"):
        keywords_of("robustness", parallel, {"jobs": (0,)})


def test_the_verb_offers_what_there_is() -> None:
    assert get_args(get_type_hints(design_verbs.study)["name"]) == STUDIES
