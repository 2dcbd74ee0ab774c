"""`octarm bench` with real processes: counts, files, comparison, interruption, refusals; not speed."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import in_process
import pytest

from bench.configs import PATTERNS, expected_messages
from bench.results import FORMAT

if TYPE_CHECKING:
    from conftest import Cli, Start

SHORT = ["--ticks", "20", "--repetitions", "2", "--rate-ticks", "10", "--sched", "other"]
FIGURES = {"count", "mean", "p50", "p95", "p99", "p99_9", "max"}


def nothing_left(cli: Cli) -> None:
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


def test_every_pattern_counts_its_messages_at_the_receivers(start: Start) -> None:
    nodes = ["--nodes", "2", "--nodes", "4"]
    cli = start("bench", "--gains", start.gains, *nodes, *SHORT, "--out", "out", "--json")
    assert cli.finish() == 0, cli.err
    nothing_left(cli)
    out = cli.work / "out"
    assert sorted(file.name for file in out.iterdir()) == ["bench.json", "bench.png"]
    assert (out / "bench.png").stat().st_size > 10_000
    facts = cli.json()
    assert facts == json.loads((out / "bench.json").read_text())
    assert (facts["format"], facts["ended"], facts["seed"]) == (FORMAT, "finished", 1)
    assert {"cpu", "cores", "kernel", "python", "virtualisation", "versions"} <= set(
        facts["machine"]
    )
    found = {(row["pattern"], row["nodes"]): row for row in facts["rows"]}
    assert set(found) == {(pattern, n) for pattern in PATTERNS for n in (2, 4)}
    for (pattern, n), row in found.items():
        expected = expected_messages(pattern, n)
        assert row["messages_per_tick"] == {"exchange": expected, "measurement": n, "command": n}
        assert row["rejected_messages"] == 0
        assert row["repetitions"] == 2
        assert set(row["sweep_us"]) == FIGURES
        assert row["sweep_us"]["count"] == 40
        assert (row["chain_us"] is not None) == (pattern in ("neighbour", "bare", "raw"))
        assert row["chain_us"] is None or row["chain_us"]["count"] == 40
        assert row["cpu_us_per_tick"] > 0
        assert row["memory_mb"]["pss_total"] > row["memory_mb"]["pss_per_node"] > 0
        assert row["start_s"] > 0
    for n in (2, 4):  # all patterns carry the payload that the nodes' sums have on average
        bytes_of = {p: found[p, n]["bytes_per_tick"]["exchange"] for p in PATTERNS}
        payload = found["bare", n]["payload_bytes"]
        assert all(bytes_of[p] == payload * expected_messages(p, n) for p in PATTERNS[1:])
        assert abs(bytes_of["neighbour"] / expected_messages("neighbour", n) - payload) < 4
    assert [rate["nodes"] for rate in facts["rates"]] == [2, 4]
    assert all(set(trial["finish_ms"]) == FIGURES for trial in facts["rates"][0]["trials"])
    assert {t["name"] for t in facts["targets"]} == {f"messages a tick, {p}" for p in PATTERNS}
    assert all(t["met"] for t in facts["targets"])


@pytest.mark.every
def test_compared_with_itself_every_ratio_is_one(start: Start, tmp_path: Path) -> None:
    chosen = ["--nodes", "3", "--pattern", "bare", "--pattern", "raw", "--no-rates", *SHORT]
    first = start("bench", "--gains", start.gains, *chosen, "--out", tmp_path / "old")
    assert first.finish() == 0, first.err
    assert "bench.png" in first.out
    assert "repetition 2 of 2" in first.err
    file = tmp_path / "old" / "bench.json"
    second = start("bench", "--gains", start.gains, *chosen, "--compare", file, "--json")
    assert second.finish() == 0, second.err
    facts = second.json()
    assert [(r["pattern"], r["nodes"]) for r in facts["ratios"]] == [("bare", 3), ("raw", 3)]
    assert all(r["sweep_p50"] > 0 and r["cpu"] > 0 for r in facts["ratios"])
    from bench.statistics import ratios

    same = json.loads(file.read_text())
    figures = [value for row in ratios(same, same) for key, value in row.items()]
    numbers = [value for value in figures if isinstance(value, float)]
    assert len(numbers) == 14
    assert set(numbers) == {1.0}
    nothing_left(second)


def interrupt_during(start: Start, number: signal.Signals) -> Cli:
    cli = start(
        "bench", "--gains", start.gains, "--nodes", "4", "--nodes", "5", "--ticks", "300",
        "--repetitions", "200", "--no-rates", "--sched", "other", "--out", "out",
    )  # fmt: skip
    cli.wait_for("4 nodes: repetition 1")
    assert {"octarm-node3", "octarm-bench3", "octarm-driver"} <= set(cli.processes())
    os.kill(cli.popen.pid, number)
    return cli


@pytest.mark.variants("2")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_keeps_what_is_finished_and_leaves_nothing(
    start: Start, number: signal.Signals
) -> None:
    cli = interrupt_during(start, number)
    assert cli.finish() == 130, cli.err
    nothing_left(cli)
    facts = json.loads((cli.work / "out" / "bench.json").read_text())
    assert facts["ended"] == "interrupted"
    assert {row["nodes"] for row in facts["rows"]} == {4}
    assert all(row["sweep_us"]["count"] >= 300 for row in facts["rows"])
    assert "interrupted" in cli.err
    assert "Traceback" not in cli.err


@pytest.mark.every
def test_a_killed_benchmark_leaves_no_process_and_no_socket(start: Start) -> None:
    cli = interrupt_during(start, signal.SIGKILL)
    assert cli.finish() == -signal.SIGKILL
    assert cli.gone(10.0) == {}
    assert list(cli.sockets.iterdir()) == []


def test_a_killed_worker_is_named(start: Start) -> None:
    cli = start(
        "bench", "--gains", start.gains, "--nodes", "4", "--pattern", "bare", "--ticks", "100000",
        "--repetitions", "20", "--no-rates", "--sched", "other", "--out", "out",
    )  # fmt: skip
    cli.wait_for("4 nodes: bursts")
    while "octarm-bench2" not in (found := cli.processes()):
        pass
    os.kill(found["octarm-bench2"], signal.SIGKILL)
    assert cli.finish() == 1
    assert "bare, 4 nodes: bare 2 was ended by SIGKILL" in cli.err
    assert "Traceback" not in cli.err
    nothing_left(cli)


WRONG: dict[str, tuple[list[str], str]] = {
    "one node": (["--nodes", "1"], "--nodes: expected 2..200, got 1"),
    "too many nodes": (["--nodes", "201"], "--nodes"),
    "unknown pattern": (["--pattern", "ring"], "--pattern: expected one of neighbour, bare"),
    "unknown rate pattern": (["--rate-pattern", "ring"], "--rate-pattern"),
    "no ticks": (["--ticks", "0"], "--ticks: expected 1.."),
    "no repetition": (["--repetitions", "0"], "--repetitions"),
    "no rate ticks": (["--rate-ticks", "0"], "--rate-ticks"),
    "negative seed": (["--seed", "-1"], "--seed"),
    "unknown scheduler": (["--sched", "batch"], "batch"),
    "no old file": (["--compare", "missing.json"], "--compare missing.json: No such file"),
    "no gains": (["--gains", "missing.json"], "missing.json"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_refused_before_anything_is_started(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, words = WRONG[case]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("subprocess.Popen", _nothing_may_start)
    assert in_process.octarm("bench", *arguments) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "Traceback" not in told
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").iterdir())


DAMAGED: dict[str, Any] = {
    "no JSON": "{",
    "a list": [],
    "another format": {"format": "octarm-bench-0"},
    "no date": {"format": FORMAT, "rows": [], "rates": []},
    "no rows": {"format": FORMAT, "date": "today", "rates": []},
    "a row without pattern": {"format": FORMAT, "date": "", "rows": [{"nodes": 5}], "rates": []},
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_no_comparison(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    content = DAMAGED[case]
    file = tmp_path / "old.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("subprocess.Popen", _nothing_may_start)
    assert in_process.octarm("bench", "--compare", file) == 2
    assert "old.json" in capsys.readouterr().err


def test_an_occupied_directory_is_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("subprocess.Popen", _nothing_may_start)
    (tmp_path / "mine").touch()
    assert in_process.octarm("bench", "--out", tmp_path) == 2
    assert "mine" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["mine"]


def _nothing_may_start(*_: object, **__: object) -> None:
    raise AssertionError("a process was started")
