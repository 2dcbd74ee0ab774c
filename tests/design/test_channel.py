"""Norms against closed forms and dense sweeps, optima against hand-solved Riccati equations, brute force and
another solver."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from beam_modes import beam, controller_optimum

from design.channel import Channel, riccati_optimum, state_feedback_optimum

Array = npt.NDArray[np.float64]


def channel(A: object, B: object, C: object, D: object = 0.0) -> Channel:
    a, b, c, d = (np.atleast_2d(np.asarray(v, dtype=np.float64)) for v in (A, B, C, D))
    return Channel(a, b, c, np.broadcast_to(d, (len(c), b.shape[1])).astype(np.float64))


# H-infinity norms


def test_first_order_lag() -> None:
    """1 / (s + 1) has its peak 1 at frequency 0; 1 / (s + 1) - 1 = -s / (s + 1) at infinity."""
    assert channel(-1.0, 1.0, 1.0).hinf_norm() == pytest.approx(1.0, rel=1e-12)
    assert channel(-1.0, 1.0, 1.0, -1.0).hinf_norm() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("damping", [0.5, 1e-1, 1e-2, 1e-3])
@pytest.mark.parametrize("frequency", [0.037, 1.0, 3.51, 61.7])
def test_oscillator(frequency: float, damping: float) -> None:
    """w^2 / (s^2 + 2 z w s + w^2) peaks at 1 / (2 z sqrt(1 - z^2))."""
    w, z = frequency, damping
    A = w * np.array([[0.0, 1.0], [-1.0, -2.0 * z]])
    got = channel(A, [[0.0], [w]], [[1.0, 0.0]]).hinf_norm()
    assert got == pytest.approx(0.5 / (z * math.sqrt(1.0 - z**2)), rel=1e-3)


def test_several_peaks() -> None:
    """A dozen light modes of known peaks: the largest is found although others are nearby."""
    frequencies = np.array([0.31, 0.9, 2.2, 2.4, 7.0, 11.0, 19.0, 33.0, 52.0, 90.0, 150.0, 240.0])
    dampings = np.linspace(0.02, 0.05, frequencies.size)
    blocks = np.zeros((24, 24))
    B, C = np.zeros((24, 12)), np.zeros((12, 24))
    for k, (w, z) in enumerate(zip(frequencies, dampings, strict=True)):
        blocks[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = w * np.array([[0.0, 1.0], [-1.0, -2.0 * z]])
        B[2 * k + 1, k], C[k, 2 * k] = w, 1.0
    got = channel(blocks, B, C).hinf_norm()
    assert got == pytest.approx(0.5 / (0.02 * math.sqrt(1.0 - 0.02**2)), rel=1e-3)


def test_dense_sweep_of_random_systems() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        A = rng.normal(size=(8, 8))
        A -= (np.linalg.eigvals(A).real.max() + 0.3) * np.eye(8)
        B, C, D = rng.normal(size=(8, 3)), rng.normal(size=(2, 8)), 0.2 * rng.normal(size=(2, 3))
        got = Channel(A, B, C, D).hinf_norm()
        dense = max(
            float(np.linalg.svd(C @ np.linalg.inv(1j * w * np.eye(8) - A) @ B + D)[1][0])
            for w in np.concatenate([np.linspace(0.0, 12.0, 12001), np.geomspace(12.0, 1e4, 200)])
        )
        assert got == pytest.approx(dense, rel=1e-4)


def test_no_finite_norm_without_decay() -> None:
    assert channel(0.1, 1.0, 1.0).hinf_norm() == math.inf
    assert channel(0.0, 1.0, 1.0).hinf_norm() == math.inf
    unseen = channel(np.diag([-1.0, 0.5]), [[1.0], [0.0]], [[1.0, 0.0]])
    assert unseen.hinf_norm() == math.inf  # unstable though no output shows it


def test_decay() -> None:
    A = np.array([[-0.2, 5.0, 1.0], [-5.0, -0.2, 0.0], [0.0, 0.0, -0.7]])
    assert channel(A, np.ones((3, 1)), np.ones((1, 3))).decay() == pytest.approx(0.2, rel=1e-12)
    rng = np.random.default_rng(1)
    skew = rng.normal(size=(40, 40)) * 1e3
    skew = skew - skew.T
    oscillating = channel(skew, np.ones((40, 1)), np.ones((1, 40)))
    assert oscillating.decay() == 0.0  # rounding is no decay
    assert oscillating.hinf_norm() == math.inf
    slow = channel(skew - 1e-6 * np.eye(40), np.ones((40, 1)), np.ones((1, 40)))
    assert slow.decay() == pytest.approx(1e-6, rel=1e-3)


def test_nothing_in_or_out_has_norm_zero() -> None:
    stable = -np.eye(2)
    assert Channel(stable, np.zeros((2, 0)), np.ones((1, 2)), np.zeros((1, 0))).hinf_norm() == 0.0
    assert Channel(stable, np.ones((2, 1)), np.zeros((0, 2)), np.zeros((0, 1))).hinf_norm() == 0.0


# Riccati optima


@pytest.mark.parametrize(
    ("a", "w", "b", "c", "effort"),
    [(1.0, 1.0, 1.0, 1.0, 1.0), (-0.3, 2.0, 0.5, 1.5, 0.1), (4.0, 0.2, 3.0, 1.0, 2.0)],
)
def test_scalar_optimum(a: float, w: float, b: float, c: float, effort: float) -> None:
    """x_t = a x + w v + b u, z = (c x, r u): gamma* from q X^2 + 2 a X + c^2 = 0, q = w^2/g^2 - b^2/r^2.

    With u = -k x the norm at frequency 0 is w sqrt(c^2 + r^2 k^2) / (b k - a), and that is its peak;
    minimising over k > a / b gives k = -c^2 b / (a r^2) for a < 0, or lets k grow for a >= 0: w r / b
    is then the infimum unless a > 0, where no k does better than the minimum over k found here by a scan.
    """
    k = np.concatenate([np.linspace(0.0, 50.0, 200001), np.geomspace(50.0, 1e7, 20000)])
    k = k[b * k - a > 0.0]
    brute = float(np.min(w * np.sqrt(c**2 + effort**2 * k**2) / (b * k - a)))
    one = np.ones((1, 1))
    got = riccati_optimum(a * one, w * one, c * one, b * one, effort)
    assert got == pytest.approx(brute, rel=2e-4)
    if a < 0.0:
        closed = w * c / math.sqrt(a**2 + (b * c / effort) ** 2)
        assert got == pytest.approx(closed, rel=2e-4)


def test_optimum_against_another_solver() -> None:
    for modes, drag in ((3, 0.7), (5, 0.2)):
        model = beam(modes, drag)
        for effort in (0.05, 1.0):
            force = np.vstack([np.eye(modes), np.zeros((modes, modes))])
            got = riccati_optimum(model.A, model.B, model.C, force, effort)
            assert got == pytest.approx(controller_optimum(model, effort), rel=2e-4)


@pytest.mark.parametrize("effort", [1e-6, 1e-4, 1e4])
def test_optimum_with_extreme_weights(effort: float) -> None:
    """x_t = -x + v + u, z = (x, r u): the optimum is 1 / sqrt(1 + 1 / r^2)."""
    one = np.ones((1, 1))
    got = riccati_optimum(-one, one, one, one, effort)
    assert got == pytest.approx(1.0 / math.sqrt(1.0 + effort**-2.0), rel=2e-4)


def test_uncontrollable_growth_has_no_optimum() -> None:
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    assert riccati_optimum(one, one, one, zero, 1.0) == math.inf


@pytest.mark.parametrize(
    ("d11", "d12", "c1"),
    [
        ([[0.0], [0.0]], [[0.5], [1.0]], [[1.0], [0.3]]),  # z sees u beside x
        ([[0.4], [0.0]], [[0.0], [1.0]], [[1.0], [0.0]]),  # and w
        ([[0.3], [-0.5]], [[0.2], [0.8]], [[1.0], [-0.4]]),  # and both
        ([[-0.9], [0.6]], [[1.0], [0.1]], [[0.2], [2.0]]),
    ],
)
@pytest.mark.parametrize("a", [-0.7, 0.5])
def test_general_scalar_optimum(
    a: float, d11: list[list[float]], d12: list[list[float]], c1: list[list[float]]
) -> None:
    """Against a scan of all stabilising k: |z|^2 is (p + q omega^2) / (r + omega^2), largest at an end."""
    w, b = 1.3, 0.9
    D11, D12, C1 = (np.array(v) for v in (d11, d12, c1))
    k = np.concatenate([-np.geomspace(1e-4, 1e6, 40000), np.geomspace(1e-4, 1e6, 40000)])
    k = k[a + b * k < 0.0]
    omega = np.array([0.0, 1e12])
    state = w / (1j * omega[:, None] - (a + b * k))
    z = (C1 + D12 * k)[:, None, :] * state + D11[:, :, None]
    brute = float(np.min(np.max(np.linalg.norm(z, axis=0), axis=0)))
    one = np.ones((1, 1))
    got = state_feedback_optimum(a * one, w * one, b * one, C1, D11, D12, tolerance=1e-7)
    assert got == pytest.approx(brute, rel=1e-5)


def test_tolerance_of_the_bisection() -> None:
    """x_t = -x + v + u, z = (x, u): the optimum is 1 / sqrt(2)."""
    one = np.ones((1, 1))
    fine = riccati_optimum(-one, one, one, one, 1.0, tolerance=1e-10)
    assert fine == pytest.approx(math.sqrt(0.5), rel=2e-10)


def test_no_disturbance_costs_nothing() -> None:
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    assert riccati_optimum(-one, zero, one, one, 1.0) == 0.0


def test_control_without_a_cost_is_refused() -> None:
    one, zero = np.ones((1, 1)), np.zeros((1, 1))
    with pytest.raises(ValueError, match="cost on every control"):
        state_feedback_optimum(-one, one, one, one, zero, zero)
