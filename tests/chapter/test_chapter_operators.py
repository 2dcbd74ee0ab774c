"""Sections 3.1 to 3.3: the numbers of the page, and the printed forms failing where it says so."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from chapter.constants import CORRECTED, PRINTED, Constants
from chapter.conversion import (
    CLAMPED_FREE,
    FREE_FREE,
    Formulas,
    boundary_matrix,
    by_hand,
    errors,
    remainder,
    taylor,
)
from chapter.operator_checks import (
    application_error,
    axial_pde,
    axial_refusal,
    beam_values,
    composition_error,
    converter_difference,
    green_error,
    heat_limit,
    printed_shape_refused,
    ranks,
    singular_values,
    volterra,
    wave_frequencies,
)
from chapter.operators import h1_table
from chapter.pde import SETPOINTS, STRAIGHT, Form, Setpoint, matrices
from design.pde.convert import convert

ROUNDING = 1e-12
"""Rows are sums of some dozens of terms of size one; the worst seen is 1.4e-13."""


@pytest.mark.parametrize("constants", [PRINTED, CORRECTED], ids=lambda one: one.name)
@pytest.mark.parametrize("form", ["printed", "corrected"])
@pytest.mark.parametrize("setpoint", SETPOINTS, ids=lambda one: f"setpoint{one.name}")
def test_only_the_corrected_h1_gives_the_right_side(
    setpoint: Setpoint, constants: Constants, form: Form
) -> None:
    A = matrices(setpoint, constants, form)
    B = boundary_matrix(CLAMPED_FREE, 4)
    hand = by_hand(A, np.random.default_rng(11))
    of_T, right = errors(Formulas(A, B, "corrected").operators(), hand)
    _, wrong = errors(Formulas(A, B, "printed").operators(), hand)
    assert max(of_T.max(), right.max()) < ROUNDING
    assert wrong.min() > 0.03


def test_what_is_printed_fails_by_what_the_page_says() -> None:
    table = h1_table([SETPOINTS[2]], trials=2)
    assert len(table) == 8
    assert all(max(row.A) < ROUNDING for row in table if row.H1 == "corrected")
    assert all(min(row.A) > 0.03 for row in table if row.H1 == "printed")
    # The kinematic rows do not depend on material or setpoint.
    assert len({row.A[::2] for row in table if row.H1 == "printed"}) == 1


def test_the_error_of_h1_is_a_sum_of_l() -> None:
    A = matrices(SETPOINTS[1], CORRECTED, "corrected")
    printed = Formulas(A, boundary_matrix(CLAMPED_FREE, 4), "printed")
    right = replace(printed, form="corrected")
    s, t = 0.8, 0.3
    L = [(s - t) ** (3 - j) / math.factorial(3 - j) for j in range(4)]
    wanted = -sum((right.A_at(j, s) + np.eye(4)) * L[j] for j in range(4))
    assert np.allclose(printed.H1(s, t) - right.H1(s, t), wanted, rtol=0.0, atol=1e-12)


def test_taylor_with_remainder() -> None:
    """Boundary values of exp(s) from its Taylor coefficients at 0 and its fourth derivative."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    theta, w = 0.5 * (nodes + 1.0), 0.5 * weights
    rest = sum(w[k] * remainder(1.0, theta[k], 1)[:, 0] * math.exp(theta[k]) for k in range(12))
    values = taylor(1.0, 1) @ np.ones(4) + rest
    assert np.allclose(values, [1.0] * 4 + [math.e] * 4, rtol=0.0, atol=1e-14)


def test_the_general_converter_agrees() -> None:
    printed = matrices(SETPOINTS[0], PRINTED, "printed")
    corrected = matrices(SETPOINTS[2], CORRECTED, "corrected")
    assert max(*converter_difference(printed), *converter_difference(corrected)) < 1e-12


def test_operators_against_adaptive_quadrature() -> None:
    random = np.random.default_rng(3)
    assert application_error(random) < 1e-12
    assert composition_error(random) < 1e-11
    assert "expected a (2, 3) matrix, got (3, 2)" in printed_shape_refused()


def test_t_is_compact() -> None:
    A = matrices(SETPOINTS[0], CORRECTED, "corrected")
    T, _ = Formulas(A, boundary_matrix(CLAMPED_FREE, 4), "corrected").operators()
    expected = np.repeat(beam_values(8), 4)
    assert expected[0] == pytest.approx(1.8751040687119611**-4, rel=1e-12)
    assert singular_values(T)[:32] == pytest.approx(expected, rel=1e-10)
    assert green_error(A, np.random.default_rng(4)) < 1e-14


def test_full_rank_of_b_is_not_enough() -> None:
    assert ranks(CLAMPED_FREE) == (16, 16)
    assert ranks(FREE_FREE) == (16, 8)


def test_axial_motion_needs_two_conditions() -> None:
    straight = matrices(STRAIGHT, CORRECTED, "corrected")
    first = 0.5 * math.pi * math.sqrt(CORRECTED.axial_n / CORRECTED.mass_kg_m)
    found = wave_frequencies(convert(axial_pde(straight, 2)), 12)
    assert found[:2] == pytest.approx([first, 3.0 * first], rel=1e-7)
    for size in (8, 14, 20):
        assert np.abs(wave_frequencies(convert(axial_pde(straight, 4)), size) - first).min() > 0.2
    assert "uses derivative 3 of u" in axial_refusal(matrices(SETPOINTS[0], CORRECTED, "corrected"))


def test_smallest_inequalities() -> None:
    found = volterra()
    assert found.kernel_error < 1e-12
    assert 2.0 / math.pi <= found.certified < 1.001 * 2.0 / math.pi
    assert found.just_below < -1e-4 < 1e-4 < found.just_above
    assert 0.999 * math.pi**2 < heat_limit() <= math.pi**2
