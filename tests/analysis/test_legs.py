"""Legs and changes of gains from arrays that are made up, so that every figure is known."""

import math

import numpy as np
import pytest

from analysis.legs import leg_facts, make_legs, switch_facts
from wire.run_config import LegConfig

MOVES = (LegConfig("2", (), 10.0, 20.0), LegConfig("1", ("3",), 5.0, 15.0))


def test_legs_follow_each_other() -> None:
    legs = make_legs("1", 30.0, MOVES, 80.0)
    assert [leg.way for leg in legs] == ["hold 1", "to 2", "by 3 to 1"]
    assert [(leg.move_from_s, leg.hold_from_s, leg.until_s) for leg in legs] == [
        (0.0, 0.0, 30.0),
        (30.0, 40.0, 60.0),
        (60.0, 65.0, 80.0),
    ]


@pytest.mark.parametrize(
    ("moves", "first", "end", "untils"),
    [
        ((), 0.0, 50.0, [50.0]),
        (MOVES, 30.0, 100.0, [30.0, 60.0, 100.0]),  # the last hold lasts on
        (MOVES, 30.0, 62.0, [30.0, 60.0, 62.0]),
        (MOVES, 30.0, 45.0, [30.0, 45.0]),
        (MOVES, 0.0, 80.0, [30.0, 80.0]),  # no hold at the start
    ],
)
def test_legs_end_with_the_run(
    moves: tuple[LegConfig, ...], first: float, end: float, untils: list[float]
) -> None:
    assert [leg.until_s for leg in make_legs("1", first, moves, end)] == untils


def test_figures_of_a_leg_are_taken_from_its_own_ticks() -> None:
    times = np.linspace(0.0, 79.5, 160)
    tip = np.full(160, 0.3)
    tip[60:80] = np.linspace(0.5, 0.02, 20)  # the move, 30 s to 40 s
    tip[80:120] = np.linspace(0.02, 0.001, 40)  # the hold
    shape = np.full(160, 0.9)
    shape[119] = 0.004
    active = ["1"] * 70 + ["2"] * 90
    _, leg, last = make_legs("1", 30.0, MOVES, 62.0)
    facts = leg_facts(leg, times, tip, shape, active)
    below = np.flatnonzero(tip[80:120] < 0.01)[0]
    assert facts == {
        "way": "to 2",
        "to": "2",
        "move_from_s": 30.0,
        "hold_from_s": 40.0,
        "until_s": 60.0,
        "tip_error_end_m": pytest.approx(0.001),
        "tip_error_largest_in_hold_m": pytest.approx(0.02),
        "tip_error_largest_in_move_m": 0.5,
        "tip_below_1_cm_after_s": pytest.approx(0.5 * below),
        "shape_estimation_error_end_m": 0.004,
        "gains_at_end": "2",
    }
    unheld = leg_facts(last, times[:124], tip[:124], shape[:124], active)
    assert unheld["tip_error_end_m"] is None
    assert unheld["tip_below_1_cm_after_s"] is None
    assert unheld["tip_error_largest_in_move_m"] == 0.3


def test_a_tip_that_comes_back_out_has_not_arrived() -> None:
    times = np.linspace(0.0, 9.0, 10)
    tip = np.array([0.5, 0.005, 0.005, 0.011, 0.009, 0.008, 0.007, 0.006, 0.005, 0.004])
    (leg,) = make_legs("1", 0.0, (), 10.0)
    facts = leg_facts(leg, times, tip, tip, ["1"] * 10)
    assert facts["tip_below_1_cm_after_s"] == 4.0
    facts = leg_facts(leg, times, tip[::-1], tip, ["1"] * 10)
    assert facts["tip_below_1_cm_after_s"] is None


def test_a_change_of_gains_says_what_the_commands_did() -> None:
    """The gains of tick 5 are the first new ones, so the command of tick 6 is."""
    active = np.array([0, 0, 0, 0, 0, 2, 2, 2])
    tips = np.tile([1.0, 0.0], (8, 1))
    tips[5] = [1.0, math.sqrt(3.0)]
    commands = np.zeros((8, 3))
    commands[5] = [0.0, 0.1, 0.0]
    commands[6] = [0.3, 0.1, -0.2]
    bumps = np.zeros((8, 3))
    bumps[6] = [0.1, -0.7, 0.2]
    (facts,) = switch_facts(active, ("1", "2", "3"), 0.5, tips, commands, bumps)
    assert facts == {
        "tick": 5,
        "time_s": 2.5,
        "from": "1",
        "to": "3",
        "tip_angle_deg": pytest.approx(60.0),
        "command_jump_n_per_m": 0.7,
        "command_step_n_per_m": pytest.approx(0.3),
        "command_step_before_n_per_m": pytest.approx(0.1),
    }
    (cut,) = switch_facts(active[:6], ("1", "2", "3"), 0.5, tips, commands[:6], bumps[:6])
    assert cut["command_jump_n_per_m"] is None
    assert switch_facts(np.zeros(8, dtype=np.int64), ("1",), 0.5, tips, commands, bumps) == []
