import math

import numpy as np
import pytest
from plant_arms import CHAPTER_ARM, THICK_ARM

from plant.disturbance import NAMES, DisturbanceSpec, make_disturbance
from wire.errors import UsageError

S = np.array([0.1, 0.7])


def _at(spec: DisturbanceSpec, *times: float) -> list[float]:
    load = make_disturbance(spec, CHAPTER_ARM)(np.array(times), S)
    assert load.shape == (len(times), 2)
    np.testing.assert_array_equal(load[:, 0], load[:, 1])  # all are uniform
    return [float(value) for value in load[:, 0]]


@pytest.mark.parametrize("name", NAMES)
def test_every_name_builds_and_is_finite(name: str) -> None:
    assert np.all(np.isfinite(_at(DisturbanceSpec(name, 2.0), 0.0, 1e-9, 3.0, 1e6)))


def test_none_is_none() -> None:
    assert _at(DisturbanceSpec("none", 5.0), 0.0, 4.0) == [0.0, 0.0]


def test_chapter_is_a_body_force_over_the_cross_section() -> None:
    area = math.pi * 0.025**2
    found = _at(DisturbanceSpec("chapter", 3.0), 0.0, 1e-4, 2.0, 10.0)
    expected = [3.0 * area * 0.1] + [
        3.0 * area * math.sin(t) / (10.0 * t) for t in (1e-4, 2.0, 10.0)
    ]
    assert found == pytest.approx(expected, rel=1e-12)
    thick = make_disturbance(DisturbanceSpec("chapter"), THICK_ARM)(np.zeros(1), S)
    assert thick[0, 0] / (0.1 * area) == pytest.approx((0.06 / 0.025) ** 2)


def test_sine_has_amplitude_and_frequency() -> None:
    spec = DisturbanceSpec("sine", 0.02, frequency_rad_per_s=0.5)
    assert _at(spec, 0.0, math.pi, 3 * math.pi) == pytest.approx([0.0, 0.02, -0.02], abs=1e-15)


def test_gust_is_a_smooth_pulse() -> None:
    spec = DisturbanceSpec("gust", 0.02, start_s=2.0, duration_s=4.0)
    found = _at(spec, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    assert found == pytest.approx([0.0, 0.0, 0.01, 0.02, 0.01, 0.0, 0.0], abs=1e-15)
    edge = _at(spec, 2.0, 2.001)
    assert abs(edge[1] - edge[0]) < 1e-7  # starts without a jump or a kink


def test_step_starts_on_time() -> None:
    spec = DisturbanceSpec("step", -0.02, start_s=2.0)
    assert _at(spec, 1.999, 2.0, 50.0) == [0.0, -0.02, -0.02]


def test_unknown_name_lists_the_known() -> None:
    with pytest.raises(UsageError, match=r"'wind'.*none, chapter, sine, gust, step"):
        DisturbanceSpec("wind")


@pytest.mark.parametrize("key", ["amplitude", "frequency_rad_per_s", "start_s", "duration_s"])
def test_non_finite_parameter_is_refused_by_name(key: str) -> None:
    with pytest.raises(UsageError, match=key):
        DisturbanceSpec("sine", **{key: float("nan")})


def test_pulse_without_length_is_refused() -> None:
    with pytest.raises(UsageError, match="duration_s must be positive"):
        DisturbanceSpec("gust", duration_s=0.0)
