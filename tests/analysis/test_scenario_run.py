"""What a run with moves reports: its legs and changes of gains, recomputed here from the recorded numbers."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from simulated_run import Scenario, make_artefact, write_recording

from analysis.estimated_arm import estimated_arms
from analysis.goals import active_setpoints, colour, reference_tips
from analysis.open_loop import compare_with_open_loop
from analysis.panels.frame import runs_of
from analysis.plot import draw_run
from analysis.recording import Recording, read_recording
from analysis.render import render
from analysis.scene import Scene
from analysis.summary import summary_of
from wire.run_config import LegConfig

DOCS = Path(__file__).parents[2] / "docs"
LEGS = (LegConfig("bent", (), 12.0, 6.0), LegConfig("straight", (), 12.0, 4.0))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Straight for 4 s, to bent until 16 s, there until 22 s, back until 34 s, there until 38 s."""
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    scenario = Scenario(
        nodes=4,
        ticks=190,
        tick_s=0.2,
        setpoint="straight",
        initial="setpoint",
        first_hold_s=4.0,
        legs=LEGS,
    )
    write_recording(path, scenario)
    return read_recording(path)


@pytest.fixture(scope="module")
def summary(recording: Recording) -> dict[str, object]:
    return summary_of(recording)


def test_the_distributed_run_is_the_central_one_through_changes_of_gains(
    summary: dict[str, float],
) -> None:
    assert summary["max_difference_to_central"] < 1e-12


def test_legs_have_the_tips_distance_from_where_the_setpoint_has_it(recording: Recording) -> None:
    """At rest the reference's tip is the setpoint's; the artefact's leaves out 0.4 mm of strain."""
    legs = summary_of(recording)["legs"]
    assert [leg["way"] for leg in legs] == ["hold straight", "to bent", "to straight"]
    artefact = make_artefact()
    for leg, (first, end) in zip(legs, ((0, 20), (80, 110), (170, 190)), strict=True):
        goal = artefact.setpoints[artefact.setpoint_index(leg["to"])].tip_m
        apart = np.hypot(*(recording.shapes_m[first:end, -1] - goal).T)
        assert leg["tip_error_end_m"] == pytest.approx(apart[-1], abs=6e-4)
        assert leg["tip_error_largest_in_hold_m"] == pytest.approx(apart.max(), abs=6e-4)
        assert leg["gains_at_end"] == leg["to"]
    assert legs[0]["tip_error_largest_in_move_m"] is None
    assert reference_tips(recording)[50] == pytest.approx(recording.tips_m[50], abs=0.1)


def test_changes_of_gains_are_where_the_tip_crosses_into_the_other_sector(
    recording: Recording,
) -> None:
    """Boundary midway between the tips, 1 degree of hysteresis, decided two ticks before."""
    _, bent = make_artefact().setpoints
    middle = 0.5 * math.degrees(math.atan2(bent.tip_m[1], bent.tip_m[0]))
    there, back = summary_of(recording)["switches"]
    assert (there["from"], there["to"]) == ("straight", "bent")
    assert (back["from"], back["to"]) == ("bent", "straight")
    for switch, boundary in ((there, middle + 1.0), (back, middle - 1.0)):
        step = abs(np.diff(np.degrees(np.arctan2(*recording.tips_m[:, ::-1].T)))).max()
        # The nodes see the tip with a coarse arm of four segments: about a degree off.
        assert abs(switch["tip_angle_deg"] - boundary) < 3.0 * step + 1.5
        k = switch["tick"]
        for node in range(4):
            used = recording.table(f"/node/{node:02d}/schedule").numbers("setpoint")
            assert used[k - 1 : k + 1].tolist() == ([0.0, 1.0] if switch is there else [1.0, 0.0])
        assert switch["command_jump_n_per_m"] == np.abs(recording.bumps[k + 1]).max() > 0.0
        assert switch["command_step_n_per_m"] < 2.0 * switch["command_step_before_n_per_m"] + 1e-4


def test_the_open_loop_model_follows_the_reference(recording: Recording) -> None:
    """Commands hold the arm's weight of shape, so without noise to correct the model stays near as well."""
    observer, model = compare_with_open_loop(recording)
    assert 0.0 < observer.shape.norm.max() < 0.05
    assert 0.0 < model.shape.norm.max() < 0.1


def test_the_estimated_arm_is_drawn_on_the_true_one(recording: Recording) -> None:
    """Also on the way: the shape between setpoints is what the commands hold there."""
    ticks = [10, 50, 65, 95, 140]
    for k, arm in zip(ticks, estimated_arms(recording, ticks, 33), strict=True):
        assert np.hypot(*(arm - recording.shapes_m[k]).T).max() < 0.01


def test_the_table_has_legs_and_changes(recording: Recording) -> None:
    text = render(summary_of(recording))
    assert "scenario simulated" in text
    assert re.search(r"^hold straight +0 to 4 s +[\d.]+ mm", text, re.MULTILINE)
    assert re.search(r"^to bent +16 to 22 s ", text, re.MULTILINE)
    assert re.search(r"^straight -> bent +\d+ \([\d.]+ s\) +[\d.]+ degrees", text, re.MULTILINE)
    assert "None" not in text
    assert "->" not in next(line for line in text.splitlines() if line.startswith("estimation"))


def test_every_key_is_documented_and_json(summary: dict[str, object]) -> None:
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    page = (DOCS / "summary.md").read_text()
    legs, switches = summary["legs"], summary["switches"]
    assert isinstance(legs, list)
    assert isinstance(switches, list)
    for key in (*summary, *legs[0], *switches[0]):
        assert f"`{key}`" in page, key


def test_the_plot_shows_the_way_in_the_colours_of_the_gains(recording: Recording) -> None:
    figure = draw_run(recording)
    way = next(ax for ax in figure.axes if "way" in ax.get_title(loc="left"))
    tips = recording.tips_m
    stretches = runs_of(active_setpoints(recording))
    assert [index for index, _, _ in stretches] == [0, 1, 0]
    for index, first, end in stretches:
        drawn = [
            line
            for line in way.lines
            if line.get_color() == colour(index)
            and np.array_equal(np.asarray(line.get_xydata()), tips[first : end + 1])
        ]
        assert len(drawn) == 1
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert "(b)  Shape estimation error" in titles
    assert "(c)  Tip error; holds are grey" in titles


def test_the_film_changes_its_colours_with_the_gains(recording: Recording) -> None:
    scene = Scene(recording, [0, 95], 320)
    for tick, index, name in ((0, 0, "straight"), (95, 1, "bent")):
        pixels = scene.draw(tick).reshape(-1, 3)
        tone = [int(colour(index)[i : i + 2], 16) for i in (1, 3, 5)]
        other = [int(colour(1 - index)[i : i + 2], 16) for i in (1, 3, 5)]
        assert (pixels == tone).all(axis=1).sum() > 2 * (pixels == other).all(axis=1).sum()
        assert f"setpoint {name}" in [text.get_text() for text in scene.figure.texts]


def test_a_scenario_cut_short_says_what_was_not_reached(
    recording: Recording, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    raw = recording.path.read_bytes()
    cut.write_bytes(raw[: int(0.7 * len(raw))])
    short = summary_of(read_recording(cut))
    last = short["legs"][-1]
    assert last["until_s"] == pytest.approx(0.2 * short["ticks"])
    text = render(short)
    assert "None" not in text
    draw_run(read_recording(cut))
