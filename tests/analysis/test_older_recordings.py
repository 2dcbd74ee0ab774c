"""Recordings of older format versions: a real one is read, its figures are what they were."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from analysis.info import info
from analysis.recording import read_recording
from analysis.replay_check import Verdict, check, story_of
from analysis.summary import summarise
from analysis.telemetry_rows import telemetry_channels, telemetry_rows, whole
from wire.channels import columns_of
from wire.columns import channel_name

DATA = Path(__file__).parents[1] / "data"


def test_a_recording_of_version_3_is_read() -> None:
    """Three nodes, twelve ticks, made by the octarm of 2026-11-29; the values are what it printed."""
    summary = summarise(DATA / "recording_v3.mcap")
    assert summary["ticks"] == 12
    assert summary["neighbour_messages"] == 48
    assert summary["ended"] == "finished"
    assert summary["max_difference_to_central"] < 1e-12
    assert summary["tip_error_m"]["final"] == pytest.approx(0.36156724377897725, rel=1e-12)


def test_a_recording_of_version_4_is_read_and_replayed() -> None:
    """Three nodes, twelve ticks, made by the octarm before version 5; the values are what it printed."""
    summary = summarise(DATA / "recording_v4.mcap")
    assert summary["ticks"] == 12
    assert summary["neighbour_messages"] == 48
    assert summary["intact_links"] == 4
    assert summary["max_difference_to_central"] == pytest.approx(1.6e-15, rel=0.05)
    assert 1e3 * summary["tip_error_m"]["final"] == pytest.approx(359.0, abs=0.5)
    assert 100 * summary["estimation_error"]["final"] == pytest.approx(45.8, abs=0.05)
    assert summary["degraded"]["health"] is None  # it did not say
    assert summary["degraded"]["first_degraded_tick"] is None
    story = story_of(read_recording(DATA / "recording_v4.mcap"))
    assert story.nodes.recorded
    assert check(story).verdict is Verdict.EQUAL
    assert info(DATA / "recording_v4.mcap")["health"] is None


@pytest.mark.parametrize("version", [3, 4])
def test_what_older_recordings_did_not_say_is_that_all_was_well(version: int) -> None:
    recording = read_recording(DATA / f"recording_v{version}.mcap")
    layout, rows = telemetry_channels(recording), telemetry_rows(recording)
    for sender, channels in layout.items():
        assert whole(rows[sender]).all()
        for channel in channels:
            if channel.topic in recording.tables:
                continue
            own = rows[sender][:, columns_of(channels, channel.topic)]
            expected = {"degraded": 0.0, "guard": 0.0, "health": 7.0}[channel_name(channel.topic)]
            assert (own == expected).all()
    assert {channel.topic for channel in layout[0]} - set(recording.tables) == {"/node/00/degraded"}
    # a tick that is not there is not there in these channels either
    shorter = dataclasses.replace(
        recording,
        tables={
            topic: dataclasses.replace(
                table,
                columns={name: column[table.ticks != 5] for name, column in table.columns.items()},
            )
            if topic.startswith("/node/01/")
            else table
            for topic, table in recording.tables.items()
        },
    )
    assert np.isnan(telemetry_rows(shorter)[1][5]).all()
