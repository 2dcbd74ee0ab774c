"""A recording with late ticks: what is held in them, that nothing counts as missing, and what is reported."""

from pathlib import Path

import numpy as np
import pytest
from simulated_run import Scenario, write_recording

from analysis.central import compare_with_central
from analysis.goals import active_setpoints
from analysis.plot import draw_run
from analysis.recording import Recording, read_recording
from analysis.render import render
from analysis.summary import summary_of
from wire.run_config import LegConfig

LATE = frozenset({1, 30, 31, 32, *range(48, 139, 3)})
"""Also while the reference moves and where gains change; the longest gap is of three ticks."""
TICKS = 140


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    scenario = Scenario(
        nodes=4,
        ticks=TICKS,
        tick_s=0.2,
        setpoint="straight",
        initial="setpoint",
        first_hold_s=2.0,
        legs=(LegConfig("bent", (), 10.0, 4.0), LegConfig("straight", (), 10.0, 2.0)),
        late=LATE,
    )
    write_recording(path, scenario)
    return read_recording(path)


@pytest.fixture(scope="module")
def summary(recording: Recording) -> dict[str, object]:
    return summary_of(recording)


def test_late_ticks_are_those_that_are_marked(recording: Recording) -> None:
    assert recording.ticks == TICKS
    assert set(np.flatnonzero(recording.late)) == LATE
    for recorded in (recording.estimates, recording.measurements):
        assert np.array_equal(np.isnan(recorded).any(axis=(1, 2)), recording.late)
    for recorded in (recording.truth, recording.tips_m, recording.commands):
        assert np.isfinite(recorded).all()


def test_in_late_ticks_the_commands_are_those_before(recording: Recording) -> None:
    for k in LATE:
        np.testing.assert_array_equal(recording.commands[k], recording.commands[k - 1])


def test_the_central_run_leaves_the_same_ticks_out(recording: Recording) -> None:
    comparison = compare_with_central(recording)
    assert comparison.ticks == TICKS
    assert comparison.missing == 0
    assert comparison.worst.relative < 1e-12
    assert len(comparison.changes) == 2


def test_what_the_recorder_did_not_get_of_another_tick_is_missing_all_the_same(
    tmp_path: Path,
) -> None:
    path = tmp_path / "recording.mcap"
    scenario = Scenario(nodes=3, ticks=20, late=frozenset({5, 6}))
    write_recording(path, scenario, skip=frozenset({(12, 1)}))
    comparison = compare_with_central(read_recording(path))
    assert comparison.ticks == 13
    assert comparison.missing == 5
    assert comparison.worst.relative < 1e-12


def test_the_setpoint_in_use_stays_over_late_ticks(recording: Recording) -> None:
    active = active_setpoints(recording)
    assert set(np.unique(active)) == {0, 1}
    assert np.count_nonzero(np.diff(active)) == 2
    for k in LATE:
        assert active[k] in (active[k - 1], active[k + 1])


def test_the_summary_says_how_the_pace_was_kept(summary: dict[str, object]) -> None:
    assert summary["realtime"] == {
        "period_s": 0.2,
        "hold_ticks": 3,
        "late_ticks": len(LATE),
        "longest_hold_ticks": 3,
    }
    assert summary["neighbour_messages_per_tick"] == 6
    assert summary["ticks_lost"] == 0
    assert f"{len(LATE)} late" in render(summary)


def test_every_figure_of_a_run_with_late_ticks_is_a_number(summary: dict[str, object]) -> None:
    """NaN rows of late ticks get into none of them."""

    def nothing(value: object, path: str) -> list[str]:
        if isinstance(value, dict):
            return [p for key, inner in value.items() for p in nothing(inner, f"{path}.{key}")]
        if isinstance(value, list):
            return [p for i, inner in enumerate(value) for p in nothing(inner, f"{path}[{i}]")]
        return [path] if value is None else []

    on_time = summary["estimation_error_root_joule"], summary["tip_error_m"], summary["legs"]
    missing = [path for part in on_time for path in nothing(part, "")]
    assert [path for path in missing if "below" not in path and "move" not in path] == []


def test_a_run_in_lock_step_has_no_pace(tmp_path: Path) -> None:
    write_recording(tmp_path / "recording.mcap", Scenario(nodes=2, ticks=10))
    recording = read_recording(tmp_path / "recording.mcap")
    assert not recording.late.any()
    assert summary_of(recording)["realtime"] is None


def test_a_run_with_late_ticks_is_drawn(recording: Recording, tmp_path: Path) -> None:
    draw_run(recording).savefig(tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 10_000
