"""The layout shipped for Foxglove shows channels and fields that a recording of the default arm has."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from simulated_run import Scenario, write_recording

from analysis.mcap_file import McapContent, read_mcap
from wire.foxglove import EVENTS, FRAME, SCENE

LAYOUT: dict[str, Any] = json.loads(
    (Path(__file__).parents[2] / "examples" / "foxglove_layout.json").read_text()
)
PANELS: dict[str, Any] = LAYOUT["configById"]
PATHS = [
    (panel, path["value"]) for panel, config in PANELS.items() for path in config.get("paths", ())
]


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> McapContent:
    path = tmp_path_factory.mktemp("layout") / "recording.mcap"
    write_recording(path, Scenario(nodes=10, ticks=2))
    return read_mcap(path)


@pytest.mark.parametrize(("panel", "path"), PATHS)
def test_every_path_is_a_field_of_a_channel(panel: str, path: str, content: McapContent) -> None:
    topic, field = re.fullmatch(r"(/[\w/]+)\.(\w+)", path).groups()  # type: ignore[union-attr]
    assert isinstance(json.loads(content.payloads[topic][0])[field], int | float), panel


def test_the_arm_and_the_events_are_shown() -> None:
    assert PANELS["3D!arm"]["topics"] == {SCENE.topic: {"visible": True}}
    assert PANELS["3D!arm"]["followTf"] == FRAME
    assert PANELS["RosOut!events"]["topicToRender"] == EVENTS.topic


def test_every_panel_has_its_place_once() -> None:
    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        return [*leaves(node["first"]), *leaves(node["second"])]

    assert sorted(leaves(LAYOUT["layout"])) == sorted(PANELS)
