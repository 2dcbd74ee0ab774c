"""Sectors with hysteresis, and the estimated arm put together segment by segment."""

from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.shape_error import face_positions
from node.scheduling import CLAMP, ArmEnd, Sectors
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


def test_the_arm_grows_segment_by_segment_to_the_shape_of_all_states() -> None:
    random = np.random.default_rng(2)
    faces = np.array([0.0, 0.1, 0.25, 0.6, 0.7, 1.0])
    states = random.standard_normal((5, 4)) * [1.0, 1.0, 0.1, 3.0]
    middle = 0.5 * (faces[1:] + faces[:-1])
    bend = np.diff(np.concatenate([[0.0], middle]))
    end, places = CLAMP, []
    for i, (_, _, strain, curvature) in enumerate(states):
        end = end.grown(strain, curvature, faces[i + 1] - faces[i], bend[i])
        places.append([end.x_m, end.y_m])
    np.testing.assert_allclose(places, face_positions(states, faces), rtol=1e-13, atol=1e-13)
