"""Files that users write, damaged in every way: arm, problem, scenario, hosts, spacing, suite and bench.json;
each is read, or refused with a message that names it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import valid
from hypothesis import given
from hypothesis import strategies as st
from mutations import bytes_of, json_of, outcome, text_of

from bench.results import read_results
from design.arm_file import read_arm_file
from design.pde.problem_file import read_problem_file
from design.solve_suite import read_suite
from supervise.hosts import read_hosts
from supervise.options import RunOptions
from supervise.scenario import read_scenario, settle
from supervise.spacing import parse_spacing
from wire.errors import UsageError

BENCH = """{"format": "octarm-bench-1", "date": "2026-11-30T10:00:00+0000",
"rows": [{"pattern": "bare", "nodes": 5, "sweep_us": {"p50": 100.0, "p99": 200.0, "p99_9": 300.0},
"chain_us": {"p50": 90.0}, "cpu_us_per_tick": 800.0, "memory_mb": {"pss_per_node": 5.0, "pss_total": 50.0},
"start_s": 0.2}], "rates": [{"pattern": "bare", "nodes": 5, "held_hz": 500, "trials": []}]}"""
PROBLEMS = sorted(path.name for path in (valid.EXAMPLES / "problems").glob("*.toml"))
SCENARIOS = sorted(path.name for path in (valid.EXAMPLES / "scenarios").glob("*.toml"))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "the_file"


def read(file: Path, raw: bytes, reader: Callable[[], Any]) -> Any:
    """What the reader gives, None if it refuses; nothing else may happen, no warning either."""
    file.write_bytes(raw)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        got, refusal = outcome(reader, UsageError)
    assert not refusal or "the_file" in refusal
    assert len(refusal) < 8000
    return got


def finite(value: Any) -> bool:
    """Whether every number in a structure is."""
    value = msgspec.to_builtins(value)
    if isinstance(value, dict):
        return all(map(finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(finite, value))
    return not isinstance(value, float) or math.isfinite(value)


@given(data=st.data())
def test_arm_files(file: Path, data: st.DataObject) -> None:
    raw = data.draw(text_of(valid.example("chapter_arm.toml")))
    arm = read(file, raw, lambda: read_arm_file(file))
    if arm is not None:
        assert finite(arm) and finite(arm.arm())
        for setpoint in arm.design_setpoints():
            assert np.isfinite(setpoint.curvature).all()


@pytest.mark.parametrize("name", PROBLEMS)
@given(data=st.data())
def test_problem_files(file: Path, name: str, data: st.DataObject) -> None:
    raw = data.draw(text_of(valid.example(f"problems/{name}")))
    problem = read(file, raw, lambda: read_problem_file(file))
    if problem is not None:
        assert all(map(math.isfinite, problem.pde.parameters.values()))
        for equation in problem.pde.equations:
            assert all(math.isfinite(c) for _, polynomial in equation.terms for c in polynomial)


@pytest.mark.parametrize("name", SCENARIOS)
@given(data=st.data())
def test_scenario_files(file: Path, name: str, data: st.DataObject) -> None:
    file = file.with_suffix(".toml")
    raw = data.draw(text_of(valid.example(f"scenarios/{name}")))
    scenario = read(file, raw, lambda: read_scenario(str(file)))
    if scenario is None:
        return
    assert finite(scenario)
    try:
        course = settle(RunOptions(scenario=str(file)))
    except UsageError:
        return
    assert 1 <= course.ticks <= 10_000_000


@given(data=st.data())
def test_hosts_files(file: Path, data: st.DataObject) -> None:
    raw = data.draw(text_of(valid.example("hosts.toml")))
    hosts = read(file, raw, lambda: read_hosts(file, 10))
    if hosts is not None:
        assert sum(host.nodes for host in hosts.hosts) == 10


@given(data=st.data())
def test_suites(file: Path, data: st.DataObject) -> None:
    read(file, data.draw(text_of(valid.example("suite.toml"))), lambda: read_suite(file))


@given(data=st.data())
def test_boundaries(file: Path, data: st.DataObject) -> None:
    raw = data.draw(
        text_of("# from root to tip\n0.0, 0.1 0.3\n0.6 # three segments and a half\n1.0\n")
    )
    faces = read(file, raw, lambda: parse_spacing(str(file), 4))
    assert faces is None or len(faces) == 5


@given(data=st.data())
def test_results_of_a_benchmark(file: Path, data: st.DataObject) -> None:
    raw = data.draw(json_of(BENCH).map(str.encode) | bytes_of(BENCH.encode()))
    read(file, raw, lambda: read_results(file))


READERS: dict[str, Callable[[Path], Any]] = {
    "arm": read_arm_file,
    "problem": read_problem_file,
    "scenario": lambda path: read_scenario(str(path)),
    "hosts": lambda path: read_hosts(path, 10),
    "suite": read_suite,
    "spacing": lambda path: parse_spacing(str(path), 4),
    "bench": read_results,
}
HOSTILE = {
    "nothing": b"",
    "zeros": bytes(5000),
    "no text": bytes(range(256)) * 8,
    "a number of a million digits": b"name = " + b"9" * 1_000_000,
    "a hexadecimal number of a million digits": b"name = 0x" + b"f" * 1_000_000,
    "a fraction of a million digits": b"name = 0." + b"3" * 1_000_000,
    "a list in a list": b"name = " + b"[" * 100_000,
    "a list in a list, closed": b"name = " + b"[" * 2000 + b"]" * 2000,
    "a table in a table": b"name = " + b"{a=" * 50_000,
    "a name of many parts": b".".join([b"a"] * 3000) + b" = 1",
    "JSON in JSON": b"[" * 100_000,
    "a text of a million characters": b'name = "' + b"a" * 1_000_000 + b'"',
    "many tables": b"[[setpoints]]\nname = 'a'\n" * 20_000,
    "one line": b"a" * 1_000_000,
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("content", HOSTILE)
def test_what_is_made_to_hurt_is_refused_soon(file: Path, reader: str, content: str) -> None:
    at = file.with_suffix(".toml") if reader == "scenario" else file
    assert read(at, HOSTILE[content], lambda: READERS[reader](at)) is None
