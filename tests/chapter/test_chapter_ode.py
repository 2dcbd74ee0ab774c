"""Sections 3.4.1 and 3.5.1: the LMIs against Riccati equations, norms, python-control, and where they end."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from chapter.ode import (
    VARIANTS,
    not_necessary,
    not_sufficient,
    scalar,
    seed_of,
    sign_table,
    signs_system,
    singular,
)
from chapter.ode_lmi import (
    System,
    controller_matrix,
    observer_matrix,
    random_system,
    solve_controller,
    solve_observer,
)
from chapter.ode_reference import (
    control_norm,
    feedback_plant,
    filter_plant,
    hinf_norm,
    hinfsyn,
    riccati_controller,
    riccati_observer,
    sweep_norm,
)

CASES = [(2, True, False), (3, False, True), (4, False, False), (6, True, True), (6, False, True)]


def system(n: int, stable: bool, feedthrough: bool) -> System:
    seed = seed_of(n, stable=stable, feedthrough=feedthrough)
    return random_system(seed, stable=stable, n=n, feedthrough=feedthrough)


@pytest.mark.parametrize(("n", "stable", "feedthrough"), CASES)
def test_observer(n: int, stable: bool, feedthrough: bool) -> None:
    s = system(n, stable, feedthrough)
    found = solve_observer(s)
    assert found.certified
    # 1e-3: the worst of the page's table is 5e-4, with gains of 2e4
    assert found.least == pytest.approx(riccati_observer(s), rel=1e-3)
    loop = s.error_system(found.gain)
    norm = hinf_norm(loop)
    assert sweep_norm(loop, 600) <= norm * (1.0 + 1e-6) < found.gamma
    assert norm > 0.997 * riccati_observer(s)


@pytest.mark.parametrize(("n", "stable", "feedthrough"), CASES)
def test_controller(n: int, stable: bool, feedthrough: bool) -> None:
    s = system(n, stable, feedthrough)
    found = solve_controller(s)
    assert found.certified
    assert found.least == pytest.approx(riccati_controller(s), rel=1e-3)
    loop = s.closed_loop(found.gain)
    norm = hinf_norm(loop)
    assert sweep_norm(loop, 600) <= norm * (1.0 + 1e-6) < found.gamma
    assert norm > 0.997 * riccati_controller(s)


def test_both_lmis_are_dual() -> None:
    s = system(3, True, True)
    assert solve_observer(s).least == pytest.approx(solve_controller(s.transposed).least, rel=1e-5)


def test_the_matrices_bound_the_energy() -> None:
    """The forms of both matrices are d<e, P e>/dt + |z|^2 / gamma - gamma |w|^2 (P^-1 under (19))."""
    random = np.random.default_rng(5)
    s = system(3, True, True)
    P = random.standard_normal((3, 3))
    P = P @ P.T
    L = random.standard_normal((3, 2))
    A, B, C, D = s.error_system(L)
    e, w = random.standard_normal(3), random.standard_normal(3)
    z = C @ e + D @ w
    gamma = 1.7
    rate = 2.0 * (A @ e + B @ w) @ P @ e + z @ z / gamma - gamma * w @ w
    vector = np.concatenate([w, z / gamma, e])
    assert vector @ observer_matrix(s, P, P @ L, gamma) @ vector == pytest.approx(rate, rel=1e-12)
    K = random.standard_normal((2, 3))
    A, B, C, D = s.closed_loop(K)
    z = C @ e + D @ w
    rate = 2.0 * (A @ e + B @ w) @ np.linalg.solve(P, e) + z @ z / gamma - gamma * w @ w
    vector = np.concatenate([np.linalg.solve(P, e), w, z / gamma])
    assert vector @ controller_matrix(s, P, K @ P, gamma) @ vector == pytest.approx(rate, rel=1e-9)


def test_signs() -> None:
    table = sign_table(signs_system())
    promised, achieved = table["as printed"]
    assert achieved <= promised
    names = list(VARIANTS)
    for name in names[1:3]:
        assert table[name][0] == pytest.approx(promised, rel=1e-6)
    for name in names[3:6]:
        assert table[name][0] > 1.2 * promised
    assert table["P B - Z D_21"][1] > 2.0 * table["P B - Z D_21"][0]
    without = sign_table(replace(signs_system(), D11=np.zeros((3, 3))))
    for name in names[:6]:
        assert without[name][0] == pytest.approx(without["as printed"][0], rel=1e-6)


def test_not_strict_is_neither_necessary_nor_sufficient() -> None:
    norm, least = not_necessary()
    assert norm == pytest.approx(1.0, rel=1e-6)
    assert least > 0.1
    eigenvalue, pole = not_sufficient()
    assert eigenvalue <= 0.0 == pole


def test_without_effort_gains_grow() -> None:
    for gamma, K, norm in singular():
        assert pytest.approx(-1.0 - 1.0 / gamma, rel=1e-4) == K
        assert norm == pytest.approx(gamma, rel=1e-3)
    with pytest.raises(np.linalg.LinAlgError, match="D_12 has not full column rank"):
        riccati_controller(scalar(1.0, 1.0, 1.0, 0.0))


def test_norm_in_closed_form() -> None:
    """1 / (s^2 + 2 z s + 1) has the peak 1 / (2 z sqrt(1 - z^2))."""
    z = 0.05
    A = np.array([[0.0, 1.0], [-1.0, -2.0 * z]])
    B, C, D = np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
    peak = 1.0 / (2.0 * z * math.sqrt(1.0 - z * z))
    assert hinf_norm((A, B, C, D)) == pytest.approx(peak, rel=1e-6)
    assert math.isinf(hinf_norm((-A, B, C, D)))


def test_python_control_agrees() -> None:
    pytest.importorskip("control")
    pytest.importorskip("slycot")
    s = system(3, True, False)
    observer, controller = solve_observer(s), solve_controller(s)
    for loop in (s.error_system(observer.gain), s.closed_loop(controller.gain)):
        assert control_norm(loop) == pytest.approx(hinf_norm(loop), rel=1e-6)
    for plant, found in ((filter_plant(s), observer), (feedback_plant(s), controller)):
        other = hinfsyn(plant)
        assert other is not None
        assert other == pytest.approx((found.least, found.least), rel=1e-3)
