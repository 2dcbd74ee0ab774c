"""Factors on their way to a node: plain dictionaries through msgpack and back, damage is named."""

from dataclasses import fields, replace
from typing import Any

import msgpack
import numpy as np
import pytest
from deploy_artefacts import make_artefact

from deploy import deploy
from wire.errors import UsageError
from wire.factors import NodeFactors, SweepFactors


@pytest.fixture(scope="module")
def nodes() -> tuple[NodeFactors, ...]:
    return deploy(make_artefact(), 3, 0.02).nodes


def test_round_trip_through_msgpack_is_bitwise(nodes: tuple[NodeFactors, ...]) -> None:
    for node in nodes:
        back = NodeFactors.from_plain(msgpack.unpackb(msgpack.packb(node.to_plain())))
        assert back.index == node.index
        np.testing.assert_array_equal(back.initial_estimate, node.initial_estimate)
        np.testing.assert_array_equal(back.initial_command, node.initial_command)
        assert len(back.setpoints) == len(node.setpoints)
        for one, other in zip(back.setpoints, node.setpoints, strict=True):
            for field in fields(SweepFactors):
                got, expected = getattr(one, field.name), getattr(other, field.name)
                assert got.shape == expected.shape
                assert got.tobytes() == expected.tobytes()
                assert got.flags.writeable


def damaged(plain: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    return {**plain, "setpoints": [{**plain["setpoints"][0], key: value}]}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([5, 7, b"123"], r"factor D: expected \[shape\.\.\., float64 bytes\]"),
        (None, "factor D: expected"),
        ([5, 7, np.full((5, 7), np.nan).tobytes()], "factor D: a number in it is not finite"),
        ([4, 7, np.zeros((4, 7)).tobytes()], r"factor D: expected float64 of shape \(5, 7\)"),
    ],
)
def test_damage_is_named(nodes: tuple[NodeFactors, ...], value: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        NodeFactors.from_plain(damaged(nodes[1].to_plain(), "D", value))


def test_missing_entries_are_named(nodes: tuple[NodeFactors, ...]) -> None:
    plain = nodes[0].to_plain()
    del plain["index"]
    with pytest.raises(UsageError, match="'index' is missing"):
        NodeFactors.from_plain(plain)
    plain = nodes[0].to_plain()
    del plain["setpoints"][1]["W"]
    with pytest.raises(UsageError, match="factor W"):
        NodeFactors.from_plain(plain)


def test_shapes_must_fit_together(nodes: tuple[NodeFactors, ...]) -> None:
    one = nodes[1].setpoints[0]
    with pytest.raises(UsageError, match="sweep factor P: expected float64 of shape"):
        replace(one, P=np.zeros((5, one.forward_received + 1)))
    with pytest.raises(UsageError, match="sweep factor W: expected a matrix"):
        replace(one, W=np.zeros(3))
    with pytest.raises(UsageError, match="no setpoint"):
        replace(nodes[1], setpoints=())
    with pytest.raises(UsageError, match=r"initial_estimate: expected shape \(1, 4\)"):
        replace(nodes[1], setpoints=nodes[1].setpoints[:1])
