"""Configurations, factors and references: what a process is told is whole and finite, or refused by name."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
import valid
from hypothesis import given
from hypothesis import strategies as st
from mutations import DEEP, NUMBERS, ODD, damaged, outcome

from node.configured import sweeps_of
from wire.config_json import dumps, loads
from wire.errors import OctarmError, UsageError
from wire.factors import NodeFactors
from wire.reference import Reference
from wire.run_config import LiveConfig, NodeConfig, PlantConfig, RecorderConfig, RunConfig

CONFIGS = {
    "node": NodeConfig,
    "plant": PlantConfig,
    "recorder": RecorderConfig,
    "live": LiveConfig,
    "run": RunConfig,
}


def numbers_in(value: Any) -> list[float]:
    """Every float of a configuration whose fields say what they are."""
    if dataclasses.is_dataclass(value):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, tuple | list):
        return [number for one in value for number in numbers_in(one)]
    return [value] if isinstance(value, float) else []


@pytest.mark.parametrize("kind", CONFIGS)
@given(data=st.data())
def test_a_damaged_configuration_is_finite_or_refused_by_name(
    kind: str, data: st.DataObject
) -> None:
    raw = data.draw(damaged(getattr(valid.lines(), kind)))
    config, refusal = outcome(lambda: loads(CONFIGS[kind], raw, "the line"), UsageError)
    if config is None:
        assert refusal.startswith("the line")
        assert len(refusal) < 1000
        return
    assert all(map(math.isfinite, numbers_in(config)))
    assert loads(CONFIGS[kind], dumps(config), "again") == config


@given(damaged(valid.lines().node))
def test_a_damaged_node_is_refused_before_it_has_a_session(raw: bytes) -> None:
    try:
        sweeps = sweeps_of(loads(NodeConfig, raw, "the line"))
    except OctarmError:
        return
    for sweep in sweeps:
        assert np.isfinite(sweep.state).all()


def plain(value: Any) -> st.SearchStrategy[Any]:
    """A dictionary of `to_plain` with one or two of its values replaced."""
    odd = st.sampled_from((*NUMBERS, *ODD, b"", b"\0" * 8, b"\xff" * 8))

    @st.composite
    def changed(draw: st.DrawFn) -> Any:
        def change(one: Any) -> Any:
            if isinstance(one, dict | list) and one and draw(st.integers(0, 5)):
                keys: Any = list(one) if isinstance(one, dict) else range(len(one))
                key = draw(st.sampled_from(keys))
                out = one.copy()
                if draw(st.integers(0, 7)):
                    out[key] = change(one[key])
                else:
                    del out[key]
                return out
            return draw(odd)

        out = change(value)
        return change(out) if draw(st.booleans()) else out

    return changed()


FACTORS = valid.plan().nodes[1].segments[0]


@given(plain(FACTORS.factors))
def test_damaged_factors_are_finite_or_refused(factors: Any) -> None:
    try:
        got = NodeFactors.from_plain(factors)
    except UsageError:
        return
    arrays = [getattr(one, f.name) for one in got.setpoints for f in dataclasses.fields(one)]
    assert all(np.isfinite(a).all() for a in (*arrays, got.initial_estimate, got.initial_command))
    assert math.isfinite(got.bend_m)


@given(plain(FACTORS.reference), st.integers(0, 10_000))
def test_a_damaged_reference_is_finite_or_refused(reference: Any, tick: int) -> None:
    try:
        got = Reference.from_plain(reference)
    except UsageError:
        return
    assert math.isfinite(got.tick_s) and got.tick_s > 0.0
    assert all(np.isfinite(leg.coefficients).all() for leg in got.legs)
    with np.errstate(over="ignore", invalid="ignore"):  # of coefficients of 1e308
        got.at(tick)


SMALLEST: dict[str, tuple[str, Any, str]] = {
    "an integer beyond all doubles": (
        "run",
        ("tick_s", 10**400),
        "the line.tick_s: expected a finite number",
    ),
    "and below": ("run", ("tick_s", -(10**400)), "the line.tick_s: expected a finite number"),
    "estimates of other nodes": (
        "run",
        ("initial_estimates", []),
        "the line.initial_estimates: expected 3",
    ),
    "energies of another state": (
        "run",
        ("energy_weights", [[1.0]] * 3),
        "the line.energy_weights: expected 3",
    ),
    "more ticks than a recording can have": (
        "run",
        ("ticks", 10**9),
        "the line.ticks: expected 1..",
    ),
    "nested more deeply than the stack": ("run", ("seed", "@deep@"), "the line"),
}
"""Each did something else once: another exception, an object that failed later, a message without a place."""


@pytest.mark.parametrize("name", SMALLEST)
def test_what_was_found(name: str) -> None:
    kind, (key, value), words = SMALLEST[name]
    text = json.dumps({**json.loads(getattr(valid.lines(), kind)), key: value}).replace(
        '"@deep@"', DEEP
    )
    with pytest.raises(UsageError) as refused:
        loads(CONFIGS[kind], text, "the line")
    assert str(refused.value).startswith(words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"index": None}, "factors of a node: expected whole numbers"),
        ({"nodes": math.nan}, "factors of a node: expected whole numbers"),
        ({"setpoints": 3}, "factors of a node: expected whole numbers"),
        ({"bend_m": "1"}, "factors of a node, bend_m"),
        ({"initial_command": [2**70, b""]}, "factor initial_command"),
    ],
)
def test_what_was_found_in_factors(change: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        NodeFactors.from_plain({**FACTORS.factors, **change})


@pytest.mark.parametrize(
    "change",
    [
        *({"tick_s": one} for one in (0, math.nan, math.inf, 10**400)),
        {"held": 99},
        {"held": -1},
        {"held": math.nan},
        {"held": []},
        *(
            {"legs": [one]}
            for one in ([10**400, 0.0, 4, 1, 1, bytes(32)], [0.0, 0.0, 2**70, 1, 1, b""])
        ),
    ],
    ids=str,
)
def test_what_was_found_in_references(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="reference"):
        Reference.from_plain({**FACTORS.reference, **change})
