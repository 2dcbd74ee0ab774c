"""Recordings of older format versions: a real one is read, its figures are what they were."""

from __future__ import annotations

from pathlib import Path

import pytest

from analysis.summary import summarise

DATA = Path(__file__).parents[1] / "data"


def test_a_recording_of_version_3_is_read() -> None:
    """Three nodes, twelve ticks, made by the octarm of 2026-11-29; the values are what it printed."""
    summary = summarise(DATA / "recording_v3.mcap")
    assert summary["ticks"] == 12
    assert summary["neighbour_messages"] == 48
    assert summary["ended"] == "finished"
    assert summary["max_difference_to_central"] < 1e-12
    assert summary["tip_error_m"]["final"] == pytest.approx(0.36156724377897725, rel=1e-12)
