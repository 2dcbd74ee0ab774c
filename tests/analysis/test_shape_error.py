"""Shapes rebuilt from node states against hand-computed arcs, and the distance between two of them."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.metrics import relative
from analysis.shape_error import face_positions, shape_error
from wire.errors import UsageError

FACES = np.array([0.0, 0.2, 0.5, 1.0])


def state(curvature: float, strain: float = 0.0, nodes: int = 3) -> np.ndarray:
    out = np.zeros((nodes, 4))
    out[:, 2], out[:, 3] = strain, curvature
    return out


def test_a_straight_stretched_arm_ends_at_its_stretched_length() -> None:
    positions = face_positions(state(0.0, 0.1), FACES)
    assert positions == pytest.approx(np.stack([1.1 * FACES[1:], np.zeros(3)], axis=1), abs=1e-15)


@pytest.mark.parametrize("curvature", [1.3, -0.7])
def test_constant_curvature_is_an_arc_at_second_order(curvature: float) -> None:
    """Tip of an arc of angle k L: (sin, 1 - cos)(k L) / k; the sign of y is the sign of k."""
    tip = np.array([np.sin(curvature), 1.0 - np.cos(curvature)]) / curvature
    errors = []
    for nodes in (10, 20):
        faces = np.linspace(0.0, 1.0, nodes + 1)
        found = face_positions(state(curvature, nodes=nodes), faces)[-1]
        errors.append(float(np.linalg.norm(found - tip)))
    assert errors[1] < 1e-3
    assert 3.5 < errors[0] / errors[1] < 4.5


def test_the_distance_of_two_straight_arms_is_the_rms_of_the_differences() -> None:
    found = shape_error(state(0.0, 0.1)[None], state(0.0, 0.0)[None], FACES)
    assert found == pytest.approx([0.1 * np.sqrt(np.mean(FACES[1:] ** 2))], rel=1e-12)


def test_equal_states_have_no_distance_and_a_flipped_sign_has() -> None:
    one = state(0.8)[None]
    assert shape_error(one, one, FACES)[0] == 0.0
    assert shape_error(-one, one, FACES)[0] > 0.3


def test_shapes_that_do_not_fit_are_named() -> None:
    with pytest.raises(UsageError, match="expected states of shape"):
        face_positions(np.zeros((2, 4)), FACES)


def test_without_an_initial_error_nothing_is_relative_to_it() -> None:
    assert np.all(np.isnan(relative(np.array([1e-18, 0.3, 0.2]))))
    assert relative(np.array([0.4, 0.2])) == pytest.approx([1.0, 0.5])
