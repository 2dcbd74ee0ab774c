"""One tick against the equations it is made of, its energy balance, its limit for short ticks."""

import dataclasses

import numpy as np
import numpy.typing as npt
import pytest
from deploy_artefacts import ARM, make_artefact

import deploy.step
from deploy.grid import SegmentGrid, make_grid
from deploy.step import Loop, make_loop, make_step
from wire.artefact import Arm

Array = npt.NDArray[np.float64]
UNDAMPED = Arm(
    name="undamped",
    length_m=ARM.length_m,
    radius_m=ARM.radius_m,
    youngs_modulus_pa=ARM.youngs_modulus_pa,
    density_kg_per_m3=ARM.density_kg_per_m3,
    drag_per_s=0.0,
)


def grid_and_loop(n: int, arm: Arm = ARM, spacing: str = "equispaced") -> tuple[SegmentGrid, Loop]:
    grid = make_grid(arm.length_m, n, spacing)
    return grid, make_loop(arm, make_artefact(arm=arm).setpoints[1], grid)


def tick_in_si(loop: Loop, h: float, xh: Array, u: Array, y: Array) -> tuple[Array, Array]:
    """The module's equations taken literally, SI, explicit inverses."""
    A, B, C, L, K = loop.model.A, loop.model.B, loop.model.C, loop.L, loop.K
    p = deploy.step.IMPLICITNESS
    X = h * L @ np.linalg.inv(np.eye(len(y)) - h * C @ L)
    Kh = np.linalg.inv(np.eye(len(u)) - h * K @ B) @ K
    corrected = xh + X @ (C @ xh - y)
    right = corrected + (1.0 - p) * h * A @ corrected + h * B @ u
    estimate = np.linalg.solve(np.eye(len(xh)) - p * h * A, right)
    return np.asarray(estimate, dtype=np.float64), np.asarray(Kh @ estimate, dtype=np.float64)


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
@pytest.mark.parametrize("h", [0.003, 0.1, 2.0])
def test_whole_tick_is_the_equations(h: float, spacing: str) -> None:
    n = 7
    _, loop = grid_and_loop(n, spacing=spacing)
    step = make_step(loop, h)
    random = np.random.default_rng(4)
    inputs = random.standard_normal((n, 7)) / step.scale_in.reshape(n, 7)
    out = (step.whole() @ (step.scale_in * inputs.ravel()) / step.scale_out).reshape(n, 5)
    estimate, command = tick_in_si(
        loop, h, inputs[:, :4].ravel(), inputs[:, 4], inputs[:, 5:].ravel()
    )
    scale = np.max(np.abs(estimate.reshape(n, 4)), axis=0)
    np.testing.assert_allclose(out[:, :4] / scale, estimate.reshape(n, 4) / scale, atol=1e-11)
    np.testing.assert_allclose(out[:, 4], command, atol=1e-11 * np.max(np.abs(command)))


def test_short_ticks_agree_with_the_continuous_observer_to_first_order() -> None:
    _, loop = grid_and_loop(4)
    model = loop.model
    random = np.random.default_rng(5)
    xh, u, y = (
        random.standard_normal(size) / scale
        for size, scale in (
            (16, loop.state_scale),
            (4, loop.command_scale),
            (8, loop.measurement_scale),
        )
    )
    rate = model.A @ xh + model.B @ u + loop.L @ (model.C @ xh - y)
    errors = []
    for h in (1e-4, 0.5e-4):
        step = make_step(loop, h)
        inputs = np.hstack([xh.reshape(4, 4), u[:, None], y.reshape(4, 2)]).ravel()
        out = (step.whole() @ (step.scale_in * inputs) / step.scale_out).reshape(4, 5)
        moved = loop.state_scale * ((out[:, :4].ravel() - xh) / h - rate)
        commanded = loop.command_scale * (out[:, 4] - loop.K @ xh)
        errors.append([np.linalg.norm(moved), np.linalg.norm(commanded)])
    assert errors[0][0] < 0.02 * np.linalg.norm(loop.state_scale * rate)
    np.testing.assert_allclose(np.array(errors[0]) / errors[1], 2.0, rtol=0.05)


@pytest.mark.parametrize("h", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
def test_midpoint_prediction_keeps_the_energy_exactly(
    h: float, spacing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deploy.step, "IMPLICITNESS", 0.5)
    _, loop = grid_and_loop(8, UNDAMPED, spacing)
    transition = make_step(loop, h).transition
    x = np.random.default_rng(6).standard_normal(32)
    before = float(x @ x)
    for _ in range(20):
        x = transition @ x
    assert float(x @ x) == pytest.approx(before, rel=1e-10)


@pytest.mark.parametrize("h", [0.01, 1.0, 100.0])
def test_prediction_never_gains_energy_and_drops_what_is_too_fast(h: float) -> None:
    _, loop = grid_and_loop(8, UNDAMPED)
    transition = make_step(loop, h).transition
    assert np.linalg.norm(transition, 2) <= 1.0 + 1e-12
    if h == 100.0:
        p = deploy.step.IMPLICITNESS
        values = np.abs(np.linalg.eigvals(transition))
        np.testing.assert_allclose(values, (1.0 - p) / p, rtol=0.1)


def test_correction_contracts_where_the_gain_takes_energy_out() -> None:
    """The multiplier part of the observer alone: I + X C divides v_y and k by 1 + h g."""
    _, loop = grid_and_loop(5)
    pointwise = dataclasses.replace(loop, L=-0.3 * loop.model.C.T)
    for h in (0.01, 10.0, 1e4):
        step = make_step(pointwise, h)
        factor = np.eye(20) + step.correction @ step.measure
        expected = np.tile([1.0, 1.0 / (1.0 + 0.3 * h), 1.0, 1.0 / (1.0 + 0.3 * h)], 5)
        np.testing.assert_allclose(factor, np.diag(expected), atol=1e-12)


def test_energy_is_drained_by_drag_at_its_rate() -> None:
    grid, loop = grid_and_loop(6)
    x = np.zeros((6, 4))
    x[:, 0] = 1.0
    rate = (loop.model.A @ x.ravel()).reshape(6, 4)
    power = float(np.sum(2.0 * grid.energy_weights(ARM) * x * rate))
    kinetic = float(np.sum(grid.energy_weights(ARM) * x**2))
    assert power == pytest.approx(-2.0 * ARM.drag_per_s * kinetic)
