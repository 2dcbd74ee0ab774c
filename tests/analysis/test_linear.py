"""The estimation on the linear model: its maps against a simulated loop, its times against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated_run import make_artefact

from analysis.linear import decay_time, error_maps
from deploy import deploy


def test_the_time_of_a_geometric_decay_is_its_logarithm() -> None:
    rate = 0.9
    found = decay_time(rate * np.eye(4), np.ones((1, 4)), np.ones((1, 4)), 0.5)
    first = math.ceil(math.log(0.01) / math.log(rate))
    assert found == pytest.approx(0.5 * first)


def test_what_does_not_decay_has_no_time_and_neither_has_no_error() -> None:
    assert decay_time(np.eye(4), np.ones((1, 4)), np.ones((1, 4)), 1.0) is None
    assert decay_time(1.01 * np.eye(4), np.ones((1, 4)), np.ones((1, 4)), 1.0) is None
    assert decay_time(0.5 * np.eye(4), np.zeros((1, 4)), np.ones((1, 4)), 1.0) is None


def test_the_maps_are_those_of_two_estimators_fed_with_the_model_itself() -> None:
    """Step observer and model side by side through the dense step and compare the differences."""
    deployment = deploy(make_artefact(), 4, 0.02)
    step = deployment.dense[0]
    observer_map, model_map = error_maps(step)
    random = np.random.default_rng(5)
    start = step.in_offset.reshape(4, 7)[:, :4]
    x = start + 1e-2 * random.standard_normal((4, 4))
    u = np.zeros((4, 1)) + step.in_offset.reshape(4, 7)[:, 4:5]

    def advance(estimate: np.ndarray, measured: np.ndarray) -> np.ndarray:
        return np.asarray(step(np.hstack([estimate, u, measured[:, [1, 3]]])))[:, :4]

    estimate = start + 1e-2 * random.standard_normal((4, 4))
    true_next = advance(x, x)
    corrected = advance(estimate, x) - true_next
    free = advance(estimate, estimate) - true_next
    error = (estimate - x).ravel()
    assert corrected.ravel() == pytest.approx(observer_map @ error, rel=1e-9, abs=1e-14)
    assert free.ravel() == pytest.approx(model_map @ error, rel=1e-9, abs=1e-14)
    assert np.linalg.norm(corrected) < np.linalg.norm(free)
