"""The verification of an arm: the straight arm against beam modes."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from beam_modes import beam, controller_optimum, norm, observer_optimum

from design.verify import GRIDS, verify_controller, verify_observer
from wire.artefact import Arm, Certificate, OperatorFactors, PolynomialMatrix, Setpoint

Array = npt.NDArray[np.float64]
LENGTH, RADIUS, MODULUS, DENSITY = 0.7, 0.02, 8e3, 1.2e3
TIME = LENGTH**2 * math.sqrt(DENSITY * 4.0 / (MODULUS * RADIUS**2))
DRAG = 0.7
"""Nondimensional."""


# The arm on the grids


def arm(drag: float = DRAG) -> Arm:
    return Arm("other", LENGTH, RADIUS, MODULUS, DENSITY, drag / TIME)


def multiplier(entries: Array) -> OperatorFactors:
    """A gain that acts point by point, with constant coefficients and no sums."""
    q, m = entries.shape
    return OperatorFactors(
        n0=PolynomialMatrix.from_array(entries[:, :, None]),
        n1a=PolynomialMatrix.from_array(np.zeros((q, 0, 1))),
        n1b=PolynomialMatrix.from_array(np.zeros((0, m, 1))),
        n2a=PolynomialMatrix.from_array(np.zeros((q, 0, 1))),
        n2b=PolynomialMatrix.from_array(np.zeros((0, m, 1))),
    )


def straight(damping: float) -> Setpoint:
    """Observer v_y' = ... - damping (v_y - y) and controller f = -damping v_y, nondimensional damping."""
    observer, controller = np.zeros((4, 2)), np.zeros((1, 4))
    observer[1, 0] = -damping / TIME
    controller[0, 1] = -damping * DENSITY * math.pi * RADIUS**2 / TIME
    blank = Certificate("unverified", *(0.0,) * 9, [], 0, 0, "", "", 0.0)
    return Setpoint(
        "straight", [0.0], [0.0], [0.0], [LENGTH, 0.0],
        multiplier(observer), multiplier(controller), blank, blank,
    )  # fmt: skip


MODES = 10


def test_straight_arm_with_a_known_gain() -> None:
    """Both gains add drag to every mode: in beam modes the closed loops are known."""
    added, weight = 2.0, 0.3
    model = beam(MODES, DRAG)
    damp = np.diag(np.repeat([-added, 0.0], MODES))
    observer = verify_observer(arm(), straight(added), weight)
    noise = -weight * damp[:, :MODES]
    exact = norm(model.A + damp, np.hstack([model.B, noise]), model.C)
    assert observer.gamma == pytest.approx(exact, rel=2e-3)
    assert observer.optimum_gamma == pytest.approx(observer_optimum(model, weight), rel=5e-3)
    assert observer.gamma_by_grid[0] != observer.gamma_by_grid[1]
    assert observer.gamma >= observer.gamma_by_grid[1]

    controller = verify_controller(arm(), straight(added), weight)
    effort = np.hstack([-weight * added * np.eye(MODES), np.zeros((MODES, MODES))])
    exact = norm(model.A + damp, model.B, np.vstack([model.C, effort]))
    assert controller.gamma == pytest.approx(exact, rel=2e-3)
    assert controller.optimum_gamma == pytest.approx(controller_optimum(model, weight), rel=5e-3)

    open_loop = norm(model.A, model.B, model.C)
    for achieved in (observer, controller):
        assert achieved.open_loop_gamma == pytest.approx(open_loop, rel=2e-3)
        # what decays slowest is the axial motion, which keeps the arm's own drag alone
        assert achieved.decay_per_s == pytest.approx(0.5 * DRAG / TIME, rel=1e-3)
        assert achieved.optimum_gamma < achieved.gamma < achieved.open_loop_gamma


def test_grids_converge_to_second_order() -> None:
    """So that the extrapolated norm is worth more than the finest grid's."""
    model = beam(MODES, DRAG)
    damp = np.diag(np.repeat([-2.0, 0.0], MODES))
    effort = np.hstack([-0.6 * np.eye(MODES), np.zeros((MODES, MODES))])
    exact = norm(model.A + damp, model.B, np.vstack([model.C, effort]))
    coarse, fine = verify_controller(arm(), straight(2.0), 0.3).gamma_by_grid
    assert GRIDS[1] == 2 * GRIDS[0]
    assert (coarse - exact) / (fine - exact) == pytest.approx(4.0, abs=1.0)


def test_gain_of_the_wrong_sign() -> None:
    achieved = verify_controller(arm(), straight(-2.0), 0.3)
    assert achieved.gamma == math.inf
    assert achieved.decay_per_s < 0.0


def test_undamped_arm_has_no_finite_norm() -> None:
    """The gains do not reach the axial motion, which goes on for ever."""
    achieved = verify_observer(arm(0.0), straight(2.0), 0.3)
    assert achieved.gamma == achieved.open_loop_gamma == math.inf
    assert achieved.decay_per_s == 0.0
