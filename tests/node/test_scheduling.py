"""Sectors with hysteresis, and the estimated arm put together segment by segment."""

from __future__ import annotations

import math

import numpy as np
import pytest

from node.scheduling import Sectors
from wire.joints import CLAMP, ArmEnd, grow
from wire.run_config import SchedulingConfig

THREE = Sectors.of(SchedulingConfig((2, 0, 1), (30.0, 60.0), 2.0, 3.0))
"""Setpoint 2 below 30 degrees, 0 up to 60, 1 above."""


def tip(degrees: float, distance: float = 0.8) -> ArmEnd:
    angle = math.radians(degrees)
    return ArmEnd(0.0, distance * math.cos(angle), distance * math.sin(angle))


@pytest.mark.parametrize(
    ("current", "degrees", "chosen"),
    [
        (2, 10.0, 2),
        (2, 31.9, 2),
        (2, 32.1, 0),
        (0, 28.1, 0),
        (0, 27.9, 2),
        (0, 61.9, 0),
        (0, 62.1, 1),
        (1, 58.1, 1),
        (1, 57.9, 0),
        (1, 10.0, 2),  # over a whole sector at once
        (2, 89.0, 1),
        (2, -80.0, 2),
        (1, 179.0, 1),
    ],
)
def test_the_setpoint_stays_until_the_tip_is_well_beyond_its_sector(
    current: int, degrees: float, chosen: int
) -> None:
    assert THREE.choose(current, tip(degrees)) == chosen
    assert THREE.choose(current, tip(degrees, 0.1)) == chosen


def test_a_tip_that_trembles_on_a_boundary_changes_nothing() -> None:
    random = np.random.default_rng(1)
    current, changes = 2, 0
    for degrees in 30.0 + 1.9 * random.uniform(-1.0, 1.0, 500):
        now = THREE.choose(current, tip(float(degrees)))
        changes += now != current
        current = now
    assert changes == 0


def test_without_hysteresis_the_boundary_decides_and_a_setpoint_outside_is_left() -> None:
    sharp = Sectors((0, 1), (math.radians(45.0),), 0.0)
    assert [sharp.choose(0, tip(one)) for one in (44.99, 45.01)] == [0, 1]
    assert sharp.choose(7, tip(50.0)) == 1  # a run may start at a setpoint that it does not visit
    assert Sectors.only(3).choose(3, tip(80.0)) == 3


def test_the_arm_grows_segment_by_segment_as_turned_and_stretched_chords() -> None:
    random = np.random.default_rng(2)
    turns, stretches = 0.3 * random.standard_normal(5), 1.0 + 0.1 * random.standard_normal(5)
    chords = random.standard_normal((5, 2))
    end = CLAMP
    for turn, stretch, (x, y) in zip(turns, stretches, chords, strict=True):
        end = ArmEnd(*grow(end, float(turn), float(stretch), float(x), float(y)))
    whole = np.cumsum(turns)
    expected = sum(
        stretches[i] * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ chords[i]
        for i, a in enumerate(whole)
    )
    np.testing.assert_allclose(end, [whole[-1], *expected], rtol=1e-13, atol=1e-13)


def test_an_arm_that_bends_as_a_whole_is_seen_where_it_is() -> None:
    """Reference straight, estimate an arc: turned chords are the arc's own to second order in the segments."""
    n, bend = 40, 1.2
    end = CLAMP
    for i in range(n):
        end = ArmEnd(*grow(end, bend * (0.5 if i == 0 else 1.0) / n, 1.0, 1.0 / n, 0.0))
    assert end.x_m == pytest.approx(np.sin(bend) / bend, abs=1e-3)
    assert end.y_m == pytest.approx((1.0 - np.cos(bend)) / bend, abs=1e-3)
