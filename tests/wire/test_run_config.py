"""Configurations survive JSON unchanged, and a wrong one is refused naming the field."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wire.errors import UsageError
from wire.run_config import LegConfig, LinkConfig, NodeConfig, SchedulingConfig, dumps, loads

LINKS = LinkConfig(("a",), ("b", "c"), None, 2.5, 10**18, 1, 10)


def node(**changes: Any) -> NodeConfig:
    fields: dict[str, Any] = {
        "run_id": "r",
        "index": 1,
        "nodes": 3,
        "ticks": 10,
        "setpoint": 0,
        "scheduling": SchedulingConfig((0, 1), (30.0,), 2.0, 3.0),
        "batch_ticks": 32,
        "links": LINKS,
        "factors": {"D": [5, 7, bytes(range(256))], "deep": {"x": [b"", 1.5, None]}},
        "reference": {"tick_s": 0.1, "legs": []},
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
        ({"index": 3}, "index: expected 0..2"),
        ({"run_id": 3}, "run_id: expected str"),
        ({"colour": 3}, "'colour' is not a known field"),
        ({"links": []}, "links: expected an object"),
        ({"batch_ticks": 0}, "batch_ticks"),
        ({"factors": 3}, "factors: expected an object"),
    ],
)
def test_wrong_fields_are_named(change: dict[str, Any], words: str) -> None:
    data = json.loads(dumps(node()))
    with pytest.raises(UsageError, match=words):
        loads(NodeConfig, json.dumps(data | change), "here")


@pytest.mark.parametrize("key", ["run_id", "index", "nodes", "links", "factors"])
def test_missing_fields_are_named(key: str) -> None:
    data = json.loads(dumps(node()))
    del data[key]
    with pytest.raises(UsageError, match=f"{key} is missing"):
        loads(NodeConfig, json.dumps(data), "here")


def test_nested_fields_are_named_with_their_path() -> None:
    data = json.loads(dumps(node()))
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
