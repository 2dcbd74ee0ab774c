"""What Foxglove is given: the fields that it asks for, in the schemas that the file states."""

from __future__ import annotations

import json

import pytest

from wire.channels import Channel, columns_of, plant_channels
from wire.foxglove import (
    ESTIMATED_ARM,
    EVENTS,
    LEVELS,
    REFERENCE_TIP,
    SCENE,
    TRUE_ARM,
    log_message,
    scene_every,
    scene_update,
)

ARM = [(0.0, 0.0), (0.5, 0.1234567), (0.9, 0.3)]


def test_a_scene_has_both_arms_and_the_reference() -> None:
    scene = scene_update(1_500_000_000, ARM, ARM[:2], (0.8, 0.4))
    true, estimated, tip = scene["entities"]
    assert [true["id"], estimated["id"], tip["id"]] == [TRUE_ARM, ESTIMATED_ARM, REFERENCE_TIP]
    assert true["timestamp"] == {"sec": 1, "nsec": 500_000_000}
    (line,) = true["lines"]
    assert [(p["x"], p["y"]) for p in line["points"]] == [(0.0, 0.0), (0.5, 0.12346), (0.9, 0.3)]
    assert len(estimated["lines"][0]["points"]) == 2
    (sphere,) = tip["spheres"]
    assert sphere["pose"]["position"] == {"x": 0.8, "y": 0.4, "z": 0.0}


def test_an_unknown_estimate_is_left_out() -> None:
    scene = scene_update(0, ARM, None, (0.8, 0.4))
    assert [entity["id"] for entity in scene["entities"]] == [TRUE_ARM, REFERENCE_TIP]


@pytest.mark.parametrize(
    ("tick_s", "every"), [(1.0, 1), (0.1, 1), (0.05, 1), (0.02, 2), (0.004, 12)]
)
def test_scenes_come_at_most_twenty_times_a_second_of_the_arm(tick_s: float, every: int) -> None:
    assert scene_every(tick_s) == every


def test_an_event_is_a_line_of_a_log() -> None:
    line = log_message(2_000_000_001, "warning", "late", "text")
    assert line["timestamp"] == {"sec": 2, "nsec": 1}
    assert (line["level"], line["name"], line["message"]) == (3, "late", "text")
    assert LEVELS == {"info": 2, "warning": 3, "error": 4}


@pytest.mark.parametrize("channel", [EVENTS, SCENE])
def test_the_schema_names_the_channel_s_fields(channel: Channel) -> None:
    schema = json.loads(channel.schema)
    assert schema["title"] == channel.schema_name
    assert schema["required"] == ["tick", "time_s", *channel.fields]


def test_columns_of_a_row() -> None:
    channels = plant_channels(3)
    assert columns_of(channels, "/plant/tip") == slice(12, 17)
    assert columns_of(channels, "/plant/tip", "error_m") == slice(14, 15)
    with pytest.raises(KeyError):
        columns_of(channels, "/plant/nothing")
    with pytest.raises(ValueError, match="side by side"):
        columns_of(channels, "/plant/tip", "x_m", "error_m")
