"""Figures of merit against cases worked out by hand."""

import math

import numpy as np
import pytest

from analysis.metrics import (
    control_effort,
    decay_rate,
    energy_norm,
    extrapolated_time_below,
    relative,
    time_below,
)
from wire.errors import UsageError


def test_energy_norm_is_the_root_of_the_weighted_squares() -> None:
    weights = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    deviation = np.zeros((3, 2, 4))
    deviation[1, 0] = [1.0, 0.0, 2.0, 0.0]  # 1 + 12
    deviation[1, 1] = [0.0, 0.0, 0.0, -3.0]  # 72
    deviation[2, 1, 1] = 10.0  # 600
    assert energy_norm(deviation, weights) == pytest.approx(
        [0.0, math.sqrt(85.0), math.sqrt(600.0)]
    )


def test_energy_norm_names_the_shapes_that_do_not_fit() -> None:
    with pytest.raises(UsageError, match=r"\(\.\.\., 3, 4\) like the weights, got \(5, 2, 4\)"):
        energy_norm(np.zeros((5, 2, 4)), np.ones((3, 4)))


def test_relative_divides_by_the_first_value() -> None:
    assert relative(np.array([4.0, 2.0, 1.0])).tolist() == [1.0, 0.5, 0.25]
    assert np.isnan(relative(np.array([0.0, 2.0]))).all()
    assert relative(np.array([])).size == 0


def test_time_below_counts_only_what_stays_below() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    values = np.array([1.0, 0.005, 0.02, 0.009, 0.008, 0.001])
    assert time_below(times, values, 0.01) == 3.0  # the dip at 1 s does not count
    assert time_below(times, values, 2.0) == 0.0
    assert time_below(times, values, 0.001) is None  # not below, equal
    assert time_below(times, np.array([1.0, 0.0, 0.0, 0.0, 0.0, np.nan]), 0.01) is None
    assert time_below(np.array([]), np.array([]), 0.01) is None


def test_decay_rate_of_an_exponential_is_its_exponent() -> None:
    times = np.linspace(0.0, 40.0, 81)
    values = 3.0 * np.exp(-0.07 * times)
    values[:40] = 17.0  # the first half does not count
    assert decay_rate(times, values) == pytest.approx(0.07, rel=1e-12)
    assert decay_rate(times, np.exp(0.5 * times)) == pytest.approx(-0.5, rel=1e-12)
    assert decay_rate(times[:10], values[:10]) is None
    assert decay_rate(np.array([]), np.array([])) is None


def test_extrapolation_reaches_the_threshold_of_an_exponential() -> None:
    times = np.linspace(0.0, 40.0, 81)
    values = np.exp(-0.07 * times)
    assert extrapolated_time_below(times, values, 0.01) == pytest.approx(math.log(100.0) / 0.07)
    assert extrapolated_time_below(times, np.exp(0.1 * times), 0.01) is None


def test_control_effort_of_a_ramp() -> None:
    # Faces 0, 1, 3; u = (2, 6): constant 2 on [0, 1], then from 2 to 6 on [1, 3].
    # int u^2 ds = 4 * 1 + 2 * (4 + 12 + 36) / 3 = 4 + 104/3.
    over_arm = 4.0 + 104.0 / 3.0
    effort = control_effort(np.array([[2.0, 6.0], [0.0, 0.0]]), np.array([0.0, 1.0, 3.0]), 0.5)
    assert effort.peak_n_per_m == 6.0
    assert effort.integral_n2_s_per_m == pytest.approx(over_arm * 0.5)
    assert effort.rms_n_per_m == pytest.approx(math.sqrt(over_arm / 2.0 / 3.0))


def test_control_effort_names_the_shapes_that_do_not_fit() -> None:
    with pytest.raises(UsageError, match=r"\(K, 2\) for 3 faces, got \(4, 3\)"):
        control_effort(np.zeros((4, 3)), np.array([0.0, 0.5, 1.0]), 0.1)
