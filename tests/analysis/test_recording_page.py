"""docs/recording.md names every channel, field and metadata key that there is."""

import re
from pathlib import Path

import pytest
from simulated_run import Scenario, write_recording

from analysis.recording import read_recording
from wire.channels import FORMAT_VERSION, Channel, node_channels, plant_channels
from wire.foxglove import EVENTS, SCENE

PAGE = (Path(__file__).parents[2] / "docs" / "recording.md").read_text()
CHANNELS = [*node_channels(1, 3, 5, 3), *plant_channels(3), EVENTS, SCENE]


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda channel: channel.topic)
def test_the_page_names_the_channel_and_its_fields(channel: Channel) -> None:
    topic = re.sub(r"\d\d", "NN", channel.topic)
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| `{topic}`"))
    if "as `/node/NN/estimate`" in row:
        return
    for field in channel.fields:
        if not re.fullmatch(r"[cd]\d|[xy]\d\d_m", field):
            assert f"`{field}`" in row


def test_the_page_names_the_metadata(tmp_path: Path) -> None:
    write_recording(tmp_path / "recording.mcap", Scenario(nodes=2, ticks=2))
    recording = read_recording(tmp_path / "recording.mcap")
    assert recording.counters is not None
    for key in (*recording.facts, *recording.counters):
        assert f"`{re.sub(r'/[0-9]+', '/NN', key)}`" in PAGE
    assert f"Format version {FORMAT_VERSION}." in PAGE
