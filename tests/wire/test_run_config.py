"""Configurations survive JSON unchanged, and a wrong one is refused naming the field."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wire.config_json import dumps, loads
from wire.errors import UsageError
from wire.run_config import (
    DisturbanceConfig,
    LegConfig,
    LinkConfig,
    NodeConfig,
    NoiseConfig,
    PaceConfig,
    RunConfig,
    SchedulingConfig,
    SegmentConfig,
)

LINKS = LinkConfig(("a",), ("b", "c"), None, 2.5, 10**18, 1, 10)
SEGMENT = SegmentConfig(
    factors={"D": [5, 7, bytes(range(256))], "deep": {"x": [b"", 1.5, None]}},
    reference={"tick_s": 0.1, "legs": []},
)


def node(**changes: Any) -> NodeConfig:
    fields: dict[str, Any] = {
        "run_id": "r",
        "index": 1,
        "nodes": 3,
        "setpoint": 0,
        "scheduling": SchedulingConfig((0, 1), (30.0,), 2.0, 3.0),
        "batch_ticks": 32,
        "skip_ticks": 0,
        "links": LINKS,
        "segments": (SEGMENT,),
    }
    return NodeConfig(**(fields | changes))


def test_round_trip_with_bytes() -> None:
    assert loads(NodeConfig, dumps(node()), "here") == node()
    assert "\n" not in dumps(node())


@given(st.floats(min_value=1e-300, max_value=1e300))
def test_numbers_come_back_exactly(value: float) -> None:
    links = LinkConfig((), (), None, value, 0, None, None)
    assert loads(LinkConfig, dumps(links), "here").deadline_s == value


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"index": None}, "index: expected int"),
        ({"index": 1.0}, "index: expected int"),
        ({"index": True}, "index: expected int"),
        ({"index": 3}, r"index: expected 1 of the segments 0\.\.2, got 3\.\.3"),
        ({"index": -1}, r"index: expected 1 of the segments 0\.\.2, got -1\.\.-1"),
        ({"nodes": 1}, "index: expected 1 of the segments"),
        ({"run_id": 3}, "run_id: expected str"),
        ({"colour": 3}, "'colour' is not a known field"),
        ({"links": []}, "links: expected an object"),
        ({"batch_ticks": 0}, "batch_ticks"),
        ({"skip_ticks": -1}, "skip_ticks: expected 0 or more, got -1"),
        ({"ticks": 10}, "'ticks' is not a known field"),
        ({"segments": []}, "segments: expected at least one"),
        ({"segments": {}}, "segments: expected a list"),
        ({"segments": [3]}, r"segments\[0\]: expected an object"),
    ],
)
def test_wrong_fields_are_named(change: dict[str, Any], words: str) -> None:
    data = json.loads(dumps(node()))
    with pytest.raises(UsageError, match=words):
        loads(NodeConfig, json.dumps(data | change), "here")


@pytest.mark.parametrize("key", ["run_id", "index", "nodes", "links", "segments", "skip_ticks"])
def test_missing_fields_are_named(key: str) -> None:
    data = json.loads(dumps(node()))
    del data[key]
    with pytest.raises(UsageError, match=f"{key} is missing"):
        loads(NodeConfig, json.dumps(data), "here")


def test_a_node_has_one_or_several_segments_of_the_arm() -> None:
    assert [node(index=i).last for i in range(3)] == [0, 1, 2]
    several = node(segments=(SEGMENT, SEGMENT))
    assert several.last == 2
    assert loads(NodeConfig, dumps(several), "here") == several
    with pytest.raises(UsageError, match=r"expected 3 of the segments 0\.\.2, got 1\.\.3"):
        node(segments=(SEGMENT,) * 3)


def test_nested_fields_are_named_with_their_path() -> None:
    data = json.loads(dumps(node()))
    factors = data["segments"][0].pop("factors")
    with pytest.raises(UsageError, match=r"here\.segments\[0\]: factors is missing"):
        loads(NodeConfig, json.dumps(data), "here")
    data["segments"][0]["factors"] = factors
    data["links"]["connect"][1] = 5
    with pytest.raises(UsageError, match=r"here\.links\.connect\[1\]: expected str"):
        loads(NodeConfig, json.dumps(data), "here")
    data["links"]["connect"] = []
    data["links"]["deadline_s"] = float("inf")
    with pytest.raises(UsageError, match=r"deadline_s"):
        loads(NodeConfig, json.dumps(data), "here")


@given(st.text(max_size=50) | st.binary(max_size=50))
def test_no_text_does_anything_but_load_or_be_refused(text: str | bytes) -> None:
    with pytest.raises(UsageError):
        loads(NodeConfig, text, "here")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (((0, 1), (), 2.0, 3.0), "boundaries_deg: expected 1 numbers for 2"),
        (((0, 1, 2), (30.0, 20.0), 2.0, 3.0), "boundaries_deg: expected to increase"),
        (((0,), (), -1.0, 3.0), "hysteresis_deg"),
        (((0,), (), 2.0, 0.0), "bump_s"),
    ],
)
def test_scheduling_is_checked(fields: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        SchedulingConfig(*fields)


@pytest.mark.parametrize(
    ("move_s", "hold_s", "word"), [(0.0, 1.0, "move_s"), (1.0, -1.0, "hold_s")]
)
def test_legs_take_time(move_s: float, hold_s: float, word: str) -> None:
    with pytest.raises(UsageError, match=word):
        LegConfig("2", (), move_s, hold_s)


@pytest.mark.parametrize(
    ("period_s", "hold_ticks", "word"),
    [
        (0.0, 2, "period_s: expected a positive"),
        (-0.1, 2, "period_s"),
        (float("nan"), 2, "period_s"),
        (float("inf"), 2, "period_s"),
        (0.1, -1, "hold_ticks: expected 0 or more, got -1"),
    ],
)
def test_the_pace_is_checked(period_s: float, hold_ticks: int, word: str) -> None:
    with pytest.raises(UsageError, match=word):
        PaceConfig(period_s, hold_ticks)
    assert PaceConfig(0.1, 0).hold_ticks == 0


def run(**changes: Any) -> RunConfig:
    nodes = changes.get("nodes", 7)
    fields: dict[str, Any] = {
        "run_id": "r",
        "scenario": "s",
        "nodes": nodes,
        "spacing": "equispaced",
        "faces_m": tuple(float(i) for i in range(nodes + 1)),
        "tick_s": 0.1,
        "ticks": 10,
        "seed": 1,
        "setpoint": "b",
        "setpoint_names": ("a", "b"),
        "first_hold_s": 0.0,
        "legs": (LegConfig("a", ("b",), 1.0, 0.0),),
        "scheduling": SchedulingConfig((0, 1), (30.0,), 2.0, 3.0),
        "control": True,
        "initial": "rest",
        "disturbance": DisturbanceConfig(),
        "noise": NoiseConfig(),
        "plant_cells": 40,
        "artefact_path": "p",
        "artefact_sha256": "0",
        "initial_estimates": ((0.0, 0.0, 0.0, 0.0),) * nodes,
        "initial_commands_n_per_m": (0.0,) * nodes,
        "energy_weights": ((1.0, 1.0, 1.0, 1.0),) * nodes,
        "segments_per_process": 1,
        "pace": None,
    }
    return RunConfig(**(fields | changes))


@pytest.mark.parametrize("pace", [None, PaceConfig(0.02, 3)])
def test_a_run_with_and_without_a_pace_comes_back(pace: PaceConfig | None) -> None:
    assert loads(RunConfig, dumps(run(pace=pace)), "here") == run(pace=pace)


@given(nodes=st.integers(2, 60), per_process=st.integers(1, 80))
def test_every_segment_is_in_one_process(nodes: int, per_process: int) -> None:
    firsts = run(nodes=nodes, segments_per_process=per_process).firsts
    sizes = [b - a for a, b in pairwise([*firsts, nodes])]
    assert firsts[0] == 0
    assert sum(sizes) == nodes
    assert all(size == per_process for size in sizes[:-1])
    assert 1 <= sizes[-1] <= per_process


@pytest.mark.parametrize("count", [0, -1])
def test_a_process_without_segments_is_refused(count: int) -> None:
    with pytest.raises(UsageError, match=f"segments_per_process: expected at least 1, got {count}"):
        run(segments_per_process=count)


@pytest.mark.parametrize("tick_s", [0.0, -0.1, 5e-324, 9e-10, 9.1e8, float("inf"), float("nan")])
def test_a_tick_that_cannot_be_recorded_in_nanoseconds_is_refused(tick_s: float) -> None:
    with pytest.raises(UsageError, match="tick_s: expected 1e-09 s to 9e\\+08 s for 10 ticks, got"):
        run(tick_s=tick_s)
    assert run(tick_s=1e-9).tick_s == 1e-9


def test_the_setpoint_at_the_start_is_one_that_is_visited() -> None:
    with pytest.raises(UsageError, match=r"setpoints \(0,\) without 1, the one at the start"):
        run(scheduling=SchedulingConfig((0,), (), 2.0, 3.0))


def test_half_a_surrogate_pair_is_no_text_but_any_name_of_a_file_is() -> None:
    with pytest.raises(UsageError, match=r"here.run_id: expected text, got '\\ud800'"):
        loads(RunConfig, dumps(run(run_id="\ud800")), "here")
    named = run(artefact_path=b"\xff.json".decode(errors="surrogateescape"))
    assert loads(RunConfig, dumps(named), "here") == named
