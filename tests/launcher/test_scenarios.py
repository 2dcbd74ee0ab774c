"""Scenario files: what is wrong is named; options win; gains change at one tick in every node."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from analysis.central import compare_with_central
from analysis.recording import read_recording
from plant.process import PlantProcess
from supervise.endpoints import choose
from supervise.options import RunOptions
from supervise.plan import make_plan, prepare, scheduling
from supervise.scenario import read_scenario, settle
from supervise.shipped import SCENARIOS
from wire.channels import SCHEDULE
from wire.child import Child
from wire.errors import UsageError
from wire.run_config import LegConfig

if TYPE_CHECKING:
    from conftest import Start

GOOD = """
name = "there"
start = "straight"
hold_s = 0.5
[[legs]]
to = "1"
move_s = 4.0
hold_s = 1.5
[[legs]]
to = "straight"
move_s = 4.0
[disturbance]
name = "sine"
amplitude = 2e-3
[noise]
velocity_y_m_per_s = 1e-4
curvature_per_m = 1e-3
[scheduling]
hysteresis_deg = 1.0
bump_s = 0.8
"""
BAD = {
    "not TOML": (GOOD + "=", "Invalid"),
    "no name": (GOOD.replace('name = "there"', ""), "missing required field `name`"),
    "no start": (GOOD.replace('start = "straight"', ""), "missing required field `start`"),
    "unknown key": ("speed = 3\n" + GOOD, "unknown field `speed`"),
    "text for a number": (GOOD.replace("hold_s = 0.5", 'hold_s = "long"'), r"hold_s"),
    "key of a leg": (
        GOOD.replace("move_s = 4.0\nhold", "takes_s = 4.0\nhold"),
        r"legs\[0\]|takes_s",
    ),
    "no move": (
        GOOD.replace("move_s = 4.0\nhold", "move_s = 0.0\nhold"),
        r"legs\[0\]\.move_s: expected a",
    ),
    "negative rest": (
        GOOD.replace("hold_s = 1.5", "hold_s = -1.5"),
        r"legs\[0\]\.hold_s: expected 0 s",
    ),
    "endless rest": (GOOD.replace("hold_s = 0.5", "hold_s = inf"), "hold_s: expected 0 s or more"),
    "to itself": (
        GOOD.replace('to = "1"', 'to = "straight"'),
        r"legs\[0\]: goes from a setpoint to itself",
    ),
    "through itself": (
        GOOD.replace('to = "1"', 'to = "1"\nthrough = ["1"]'),
        "straight -> 1 -> 1",
    ),
    "no time": ('name = "x"\nstart = "1"', "it takes 0 s"),
    "initial": ('initial = "bent"\n' + GOOD, "initial shape 'bent' is not known"),
    "disturbance": (GOOD.replace('"sine"', '"storm"'), "disturbance 'storm' is not known"),
    "amplitude": (GOOD.replace("2e-3", "nan"), "amplitude must be finite"),
    "noise": (GOOD.replace("1e-4", "-1e-4"), "velocity"),
    "hysteresis": (
        GOOD.replace("deg = 1.0", "deg = -1.0"),
        r"scheduling\.hysteresis_deg: expected 0",
    ),
    "bump": (
        GOOD.replace("bump_s = 0.8", "bump_s = 0.0"),
        r"scheduling\.bump_s: expected a positive",
    ),
    "cells": ("plant_cells = 2\n" + GOOD, "plant cells"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_file_is_refused_naming_file_and_key(case: str, tmp_path: Path) -> None:
    text, message = BAD[case]
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=message) as caught:
        read_scenario(str(path))
    assert "wrong.toml" in str(caught.value)


def test_names_and_files_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match="no scenario of that name; known: chapter, hold, reach, track"
    ):
        read_scenario("dance")
    with pytest.raises(UsageError, match="no scenario of that name"):
        read_scenario("x" * 5000)
    with pytest.raises(UsageError, match=r"none\.toml: No such file.* chapter, hold, reach, track"):
        read_scenario(str(tmp_path / "none.toml"))
    with pytest.raises(UsageError, match="directory"):
        read_scenario(str(tmp_path) + "/")


def test_a_scenario_that_goes_where_the_gains_do_not_is_refused(
    gains: Path, tmp_path: Path
) -> None:
    path = tmp_path / "far.toml"
    path.write_text(GOOD.replace('to = "1"', 'to = "1"\nthrough = ["7"]'))
    with pytest.raises(
        UsageError, match="setpoint '7' is not in the gains artefact; it has: straight, 1"
    ):
        prepare(RunOptions(gains=gains, scenario=str(path)))


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_scenarios_can_be_read_by_name(path: Path) -> None:
    scenario = read_scenario(path.stem)
    assert scenario.name == path.stem
    assert scenario.duration_s > 30.0


def test_the_default_scenario_is_the_run_without_one() -> None:
    course = settle(RunOptions())
    assert course == settle(RunOptions(scenario="hold"))
    assert (course.setpoint, course.initial, course.ticks, course.legs) == (
        "1",
        "chapter",
        1200,
        (),
    )
    assert (course.disturbance.name, course.disturbance.amplitude) == ("chapter", 1.0)
    assert (course.noise.velocity_y_m_per_s, course.noise.curvature_per_m) == (1e-4, 1e-3)
    assert course.control
    assert course.plant_cells == 40
    assert not settle(RunOptions(scenario="chapter")).control


def test_options_win_over_the_scenario(tmp_path: Path) -> None:
    path = tmp_path / "good.toml"
    path.write_text(GOOD)
    plain = settle(RunOptions(scenario=str(path)))
    assert plain.ticks == 100
    assert plain.visited == ("straight", "1")
    changed = settle(
        RunOptions(
            scenario=str(path),
            ticks=7,
            setpoint="2",
            initial="straight",
            disturbance_amplitude=0.5,
            noise_velocity=0.0,
            plant_cells=64,
        )
    )
    assert (changed.ticks, changed.setpoint, changed.initial) == (7, "2", "straight")
    assert (changed.disturbance.name, changed.disturbance.amplitude) == ("sine", 0.5)
    assert (changed.noise.velocity_y_m_per_s, changed.noise.curvature_per_m) == (0.0, 1e-3)
    assert changed.plant_cells == 64
    assert changed.legs == plain.legs
    calm = settle(RunOptions(scenario=str(path), disturbance="none"))
    assert (calm.disturbance.name, calm.disturbance.amplitude) == ("none", 1.0)
    assert settle(RunOptions(scenario=str(path), tick_s=0.05)).ticks == 200


@pytest.mark.parametrize("hold_s", ["1e7", "1e308"])
def test_a_scenario_that_never_ends_is_refused_unless_ticks_are_given(
    hold_s: str, tmp_path: Path
) -> None:
    path = tmp_path / "long.toml"
    path.write_text(GOOD.replace("hold_s = 0.5", f"hold_s = {hold_s}").replace("1.5", hold_s))
    with pytest.raises(UsageError, match=r"scenario there: it takes .* at most 10000000 ticks"):
        settle(RunOptions(scenario=str(path)))
    assert settle(RunOptions(scenario=str(path), ticks=5)).ticks == 5


def test_a_move_within_a_tick_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "quick.toml"
    path.write_text(GOOD.replace("move_s = 4.0\nhold", "move_s = 0.05\nhold"))
    with pytest.raises(UsageError, match=r"legs\[0\]\.move_s: expected at least a tick, 0\.1 s"):
        settle(RunOptions(scenario=str(path)))
    assert settle(RunOptions(scenario=str(path), tick_s=0.05)).ticks == 121


def test_sectors_lie_midway_between_the_tips_that_are_visited(gains: Path) -> None:
    prepared = prepare(RunOptions(gains=gains, setpoint="1"))
    alone = scheduling(prepared.artefact, prepared.course)
    assert (alone.setpoints, alone.boundaries_deg) == ((1,), ())
    x, y = prepared.artefact.setpoints[1].tip_m
    there = replace(prepared.course, legs=(LegConfig("straight", (), 1.0, 0.0),))
    both = scheduling(prepared.artefact, there)
    assert both.setpoints == (0, 1)
    assert both.boundaries_deg[0] == pytest.approx(0.5 * np.degrees(np.arctan2(y, x)))


def test_a_run_changes_gains_at_one_tick_in_every_node(start: Start, tmp_path: Path) -> None:
    """No message more, the central computer decides the same, and no command jumps."""
    path = tmp_path / "there.toml"
    path.write_text(GOOD)
    nodes, ticks = 5, 100
    cli = start.run("--scenario", path, "--nodes", str(nodes), "--json", "--no-plot")
    assert cli.finish() == 0, cli.err
    summary = cli.json()
    assert summary["neighbour_messages"] == summary["neighbour_messages_sent"]
    assert summary["neighbour_messages"] == 2 * (nodes - 1) * ticks
    assert summary["rejected_messages"] == 0
    assert summary["max_difference_to_central"] <= 1e-12
    recording = read_recording(cli.recording())
    schedule = recording.of_nodes("schedule", SCHEDULE)
    active, bumps = schedule[:, :, 0], schedule[:, :, 1]
    assert (active == active[:, :1]).all()
    changes = 1 + np.flatnonzero(np.diff(active[:, 0]))
    assert active[[0, *changes], 0].tolist() == [0.0, 1.0, 0.0]
    assert compare_with_central(recording).changes == tuple(changes)

    # The gains change at tick K: u(K) is still of the old ones, u(K + 1) deviates from its reference as u(K).
    wanted = np.stack([recording.references.states(k)[:, 4] for k in range(ticks)])
    deviation = recording.commands - wanted
    fade = np.exp(-0.1 / 0.8)
    for tick in changes:
        assert not bumps[: changes[0] + 1].any()
        np.testing.assert_allclose(deviation[tick + 1], deviation[tick], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(bumps[tick + 2], fade * bumps[tick + 1], rtol=1e-12)
        assert np.abs(bumps[tick + 1]).max() > 0.0

    events = recording.table("/event")
    told = [
        m
        for n, m in zip(events.column("name"), events.column("message"), strict=True)
        if n == "setpoint"
    ]
    assert told == [
        f"setpoint straight -> 1 at tick {changes[0]}",
        f"setpoint 1 -> straight at tick {changes[1]}",
    ]
    tip = recording.of_plant("tip", ("x_m", "y_m", "error_m", "reference_x_m", "reference_y_m"))
    assert np.hypot(*(tip[:, :2] - tip[:, 3:]).T) == pytest.approx(tip[:, 2], abs=1e-12)
    assert np.ptp(tip[:, 4]) > 0.2
    # The announcement travels with the backward sums one tick before the change.
    announced = recording.table("/node/00/backward_sum").by_tick(("setpoint",), ticks)[:, 0]
    np.testing.assert_array_equal(announced[:-1], active[1:, 0])


def test_without_control_the_commands_are_the_holding_load(start: Start) -> None:
    cli = start.run("--scenario", "chapter", "--nodes", "3", "--ticks", "40", "--json", "--no-plot")
    assert cli.finish() == 0, cli.err
    recording = read_recording(cli.recording())
    np.testing.assert_allclose(
        recording.commands, np.tile(recording.initial_commands, (40, 1)), rtol=0.0, atol=1e-15
    )
    assert cli.json()["max_difference_to_central"] <= 1e-12
    error = cli.json()["estimation_error"]
    assert error["final"] < error["initial"]


def test_nodes_that_go_on_with_different_setpoints_stop_the_arm(
    gains: Path, tmp_path: Path
) -> None:
    path = tmp_path / "there.toml"
    path.write_text(GOOD)
    prepared = prepare(RunOptions(gains=gains, scenario=str(path), nodes=3))
    endpoints = choose(3, "unix", None, tmp_path / "s")
    try:
        plan = make_plan(prepared, endpoints, "a run", tmp_path)
    finally:
        endpoints.close()
    plant = PlantProcess(plan.plant, Child("plant", control=-1, status=-1, directory=None))
    exchange = plant._exchange
    assert plant._take(4) is None
    exchange._said = [1, 1, 1]
    assert plant._take(5) is None
    assert exchange.setpoint == 1
    exchange._said = [1, 0, 1]
    stop = plant._take(6)
    assert stop is not None
    assert (stop.tick, stop.cause) == (6, "safety")
    assert stop.text == "tick 6: node 1: the next setpoint is straight, but 1 for node 0"
