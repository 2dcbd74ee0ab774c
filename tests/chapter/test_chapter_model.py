"""Equations (1) to (5): derivation against differences of (1), the numpy matrices, the growing waves."""

import math
from decimal import Decimal

import numpy as np
import pytest
import sympy as sp
from numpy.polynomial import Polynomial

from chapter import derivation, differences, equilibrium, model, waves
from chapter.constants import CORRECTED, PRINTED
from chapter.derivation import EI
from chapter.fig_two import arc_end
from chapter.pde import SETPOINTS, STRAIGHT, Form, Setpoint, matrices

FORMS: tuple[Form, ...] = ("printed", "corrected")


def test_derived_coefficients_of_2_are_those_of_differences_of_1_and_the_printed_are_not() -> None:
    assert model.second_error("derived") < 1e-15
    # one term of (2) is off by a whole EI, and two that should be there are short by one
    assert model.second_error("printed") == pytest.approx(1.0, abs=1e-15)


def test_matrices_5_are_those_of_differences_of_1_in_the_corrected_form_only() -> None:
    # rounding of the setpoint's derivatives, up to 4e3, divided out
    assert model.fifth_error("corrected") < 1e-14
    assert model.fifth_error("printed") > 0.5


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("setpoint", [*SETPOINTS, model.GENERAL], ids=lambda s: s.name)
def test_numpy_matrices_equal_sympys(setpoint: Setpoint, form: Form) -> None:
    found = matrices(setpoint, CORRECTED, form)
    for x in model.POINTS:
        numbers = np.array([[[e(x) for e in row] for row in m] for m in found])
        expected = model.symbolic_values(setpoint, CORRECTED, form, x)
        np.testing.assert_allclose(numbers, expected, rtol=1e-12, atol=1e-12)


def test_which_terms_are_misprinted() -> None:
    wrong = [t.where for t in derivation.compare_second() if not t.right]
    assert sorted(wrong) == ["w: u1 w3", "w: u1 w4", "w: u2 w2", "w: u2 w3"]
    third = {t.where: t for t in derivation.compare_third()}
    assert [n for n, t in third.items() if not t.right] == [
        "w: D^1 u", "w: D^2 u", "w: D^2 w", "w: D^3 w", "w: D^4 w",
    ]  # fmt: skip
    # the one misprint of (3) that is not (2)'s
    assert [n for n, t in third.items() if t.printed != t.follows] == ["w: D^3 w"]
    assert third["w: D^3 w"].follows == "EI u_e' + 3 EI u_e''"
    assert third["w: D^3 w"].derived == "4 EI u_e''"
    fifth = {t.where: t for t in derivation.compare_fifth()}
    assert [n for n, t in fifth.items() if t.printed != t.follows] == ["A_1[2,3]", "A_3[4,3]"]
    assert fifth["A_1[2,3]"].derived == "EA w_e'' + EI w_e''''"
    assert sum(not t.right for t in fifth.values()) == 6
    assert fifth["B_1[4]"].right


def test_what_has_an_energy() -> None:
    facts = model.energy_facts()
    assert facts.pop("(2) printed has an energy") is False
    assert all(facts.values()), facts


def test_rotary_inertia_by_lagrange() -> None:
    t, inertia = sp.symbols("t J")
    p, q = sp.Function("p")(t), sp.Function("q")(t)  # u_x, w_x
    theta = sp.atan(q / (1 + p))
    kinetic = inertia * sp.diff(theta, t) ** 2 / 2
    stretch = sp.sqrt((1 + p) ** 2 + q**2)
    acceleration = inertia * sp.diff(theta, t, 2)
    # D of these is taken from the right: rho u_tt + D(J theta_tt sin/(1+e)), rho w_tt - D(J theta_tt cos/(1+e))
    for a, factor in ((p, -q / stretch**2), (q, (1 + p) / stretch**2)):
        force = sp.diff(sp.diff(kinetic, sp.diff(a, t)), t) - sp.diff(kinetic, a)
        assert sp.simplify(force - acceleration * factor) == 0


def test_tip_conditions_of_the_page() -> None:
    found = derivation.tip_conditions(derivation.truncated(derivation.exact_energy(), 3))
    page = {
        "couple u": "-EI*w1*w2",
        "couple w": "EI*(w2 - 2*u1*w2 - w1*u2)",
        "force u": "EA*(u1 + w1**2/2) + EI*w1*w3",
        "force w": "EA*u1*w1 - EI*(w3 - 2*u1*w3 - 2*u2*w2 - w1*u3)",
    }
    for name, text in page.items():
        assert sp.expand(found[name] - derivation.read(text)) == 0


def test_both_forms_are_the_beam_and_the_wave_equation_for_a_straight_arm() -> None:
    printed, corrected = (matrices(STRAIGHT, CORRECTED, f) for f in FORMS)
    for a, b in zip(printed, corrected, strict=True):
        assert [[e(0.3) for e in row] for row in a] == [[e(0.3) for e in row] for row in b]
    assert corrected[2][1][0](0.3) == CORRECTED.axial_n / CORRECTED.mass_kg_m
    assert corrected[4][3][2](0.3) == -CORRECTED.bending_n_m2 / CORRECTED.mass_kg_m


def test_a_changed_term_has_no_energy_and_no_identity() -> None:
    spoilt = dict(derivation.second())
    spoilt["w"] += EI * derivation.U[2] * derivation.W[3]
    assert not derivation.is_gradient(spoilt)
    flux = derivation.exact_flux()["u"]
    assert derivation.vanishes(flux - flux)
    assert not derivation.vanishes(flux - derivation.truncated(flux, 2))


def test_exact_forces_of_a_circle() -> None:
    # an unstretched arc of curvature c: no axial force, theta_xx = 0, so nothing acts on it
    c = 1.7
    at = 0.3
    u = [math.cos(c * at) - 1, *(c**j * math.cos(c * at + j * math.pi / 2) for j in (1, 2, 3))]
    w = [c**j * math.sin(c * at + j * math.pi / 2) for j in range(4)]
    decimal = [[Decimal(v) for v in jet] for jet in (u, w)]
    for part in ((1, 0), (0, 1)):
        for force in differences.forces(decimal[0], decimal[1], *part):
            assert abs(float(force)) < 1e-14


def test_first_bending_frequency_and_the_printed_mass() -> None:
    facts = model.material()
    # Ritz on the exact energy shares no formula with the characteristic root
    _, frequency = waves.ritz_growth(STRAIGHT, CORRECTED, "exact", 8)
    assert facts["corrected"]["first_bending_rad_s"] == pytest.approx(frequency, rel=1e-8)
    assert facts["corrected"]["first_period_s"] == pytest.approx(67.05, abs=0.01)
    assert facts["corrected"]["axial_speed_m_s"] == pytest.approx(2.132, abs=1e-3)
    assert PRINTED.mass_kg_m / CORRECTED.mass_kg_m == pytest.approx(509.3, abs=0.1)


@pytest.mark.parametrize("setpoint", SETPOINTS, ids=lambda s: s.name)
def test_bands_of_growing_waves(setpoint: Setpoint) -> None:
    x, slope = waves.steepest(setpoint, arc_end(setpoint.w))
    low, high = waves.growing_bands(slope, CORRECTED)
    k = np.array([0.99 * low, 1.01 * low, 0.99 * high, 1.01 * high])
    growth = waves.energy_growth(setpoint, CORRECTED, "cubic", x, k)
    # w_e'' and w_e''' at that point move the band's edges by less than a percent
    assert growth[0] > 0.0 and growth[3] > 0.0 and growth[1] == growth[2] == 0.0
    assert not waves.energy_growth(setpoint, CORRECTED, "exact", x, np.geomspace(1, 1e4, 50)).any()
    short = np.array([3e4])
    for form in FORMS:
        rate = waves.frozen_growth(setpoint, CORRECTED, form, x, short)[0]
        assert rate == pytest.approx(waves.leading_growth(slope, 3e4, CORRECTED), rel=1e-4)


def test_a_packet_on_the_arm_grows_like_k_squared() -> None:
    rates = [waves.packet_growth(SETPOINTS[0], CORRECTED, k, 0.75, 0.1) for k in (2e3, 4e3)]
    assert rates[1] / rates[0] == pytest.approx(4.0, rel=0.05)
    assert rates[1] == pytest.approx(waves.leading_growth(0.3356, 4e3, CORRECTED), rel=0.05)


@pytest.mark.parametrize(("position", "least"), [(0, 5.0), (1, 13.0), (2, 17.0)])
def test_the_truncated_arm_grows_where_the_exact_one_does_not(position: int, least: float) -> None:
    setpoint = equilibrium.octarm(position)
    growth, _ = waves.ritz_growth(setpoint, CORRECTED, "cubic", 2)
    assert growth > least
    exact, frequency = waves.ritz_growth(setpoint, CORRECTED, "exact", 12)
    assert exact == 0.0
    assert frequency == pytest.approx(0.094, abs=1e-3)


def test_galerkin_of_the_matrices_under_the_printed_conditions() -> None:
    # w~ of the straight arm: the first clamped-free frequencies, roots of cos b cosh b = -1
    squares = np.sort(-waves.galerkin_squares(STRAIGHT, CORRECTED, "printed", 8).real)
    unit = math.sqrt(CORRECTED.bending_n_m2 / CORRECTED.mass_kg_m)
    found = np.sqrt(squares[squares > 0.0][:2]) / unit
    np.testing.assert_allclose(found, [1.875104068711961**2, 4.694091132974175**2], rtol=1e-6)
    # u~ with one shape, v'' = (1 - x)^2: EA int v v'' / int v^2 is positive, the conditions do not fit
    v = Polynomial([1.0, -2.0, 1.0]).integ(2)
    quotient = (v * v.deriv(2)).integ()(1.0) / (v * v).integ()(1.0)
    expected = math.sqrt(CORRECTED.axial_n / CORRECTED.mass_kg_m * quotient)
    assert waves.galerkin_growth(STRAIGHT, CORRECTED, "printed", 1) == pytest.approx(expected)
    for form in FORMS:
        rates = [waves.galerkin_growth(SETPOINTS[1], CORRECTED, form, n) for n in (2, 4, 8)]
        assert 4.0 < rates[0] < rates[1] < rates[2]


def test_one_shape_by_hand_makes_the_energy_of_5_negative() -> None:
    # w~ = x^2, u~_x = -w_e' w~_x: EA (u~_x^2 + 2 w_e' u~_x w~_x) is -EA (w_e' w~_x)^2; from A_1 .. A_4 by parts
    setpoint = SETPOINTS[0]
    slope, w = setpoint.w.deriv(), Polynomial([0.0, 0.0, 1.0])
    u = (-slope * w.deriv()).integ()
    fields, power = (u, w), Polynomial([0.0])
    for order, matrix in enumerate(matrices(setpoint, CORRECTED, "corrected")[1:], start=1):
        for i, row in enumerate((1, 3)):
            for j, column in enumerate((0, 2)):
                power = power + fields[i] * matrix[row][column] * fields[j].deriv(order)
    EA, EI_, rho = CORRECTED.axial_n, CORRECTED.bending_n_m2, CORRECTED.mass_kg_m
    ends = rho * power.integ()(1.0)
    # boundary terms at the free end: u~ N_x + w~ N_y + u~_x M_u + w~_x M_w of the linearised truncated model
    c = [setpoint.w.deriv(j)(1.0) for j in (1, 2, 3)]
    du, dw = ([f.deriv(j)(1.0) for j in (1, 2, 3)] for f in (u, w))
    axial = EA * (du[0] + c[0] * dw[0]) + EI_ * (c[0] * dw[2] + c[2] * dw[0])
    across = (
        EA * c[0] * du[0] - EI_ * dw[2] + EI_ * (2 * du[0] * c[2] + 2 * du[1] * c[1] + du[2] * c[0])
    )
    by_u = -EI_ * (c[0] * dw[1] + c[1] * dw[0])
    by_w = EI_ * (dw[1] - 2 * du[0] * c[1] - du[1] * c[0])
    energy = -ends + axial * u(1.0) + across * w(1.0) + by_u * du[0] + by_w * dw[0]
    mass = rho * (u * u + w * w).integ()(1.0)
    rate = math.sqrt(-energy / mass)
    assert rate > 1.0
    # the best of more shapes grows at least as fast
    assert waves.ritz_growth(setpoint, CORRECTED, "cubic", 8)[0] > rate
    expected = -EA * ((slope * w.deriv()) ** 2).integ()(1.0)
    assert energy == pytest.approx(expected, rel=0.02)


def test_what_the_printed_setpoints_need() -> None:
    needs = [equilibrium.need(s, CORRECTED, 1.0) for s in SETPOINTS]
    # f_e = EI w_e'''' = 24 w_4 EI
    assert [n.transverse_n_m for n in needs] == pytest.approx(
        [24 * v * CORRECTED.bending_n_m2 for v in (0.09, 0.94, 71.7)]
    )
    assert [n.tip_axial_n for n in needs] == pytest.approx([0.5026, 11.963, 73060.6], rel=1e-4)
    for setpoint, n in zip(SETPOINTS, needs, strict=True):
        # (1) itself along the arm, in place of (2): the sum of the axial forces is the tip's, to degree 4
        small = Setpoint("small", 1e-4 * setpoint.w)
        jet = [float(small.w.deriv(j)(0.6)) for j in range(1, 5)]
        split = differences.degree_one_and_two([0.0] * 4, jet)
        axial = CORRECTED.axial_n * split["EA"][0] + CORRECTED.bending_n_m2 * split["EI"][0]
        w = [setpoint.w.deriv(j)(0.6) for j in range(1, 5)]
        by_hand = CORRECTED.axial_n * w[0] * w[1] + CORRECTED.bending_n_m2 * (
            w[1] * w[2] + w[0] * w[3]
        )
        assert axial == pytest.approx(1e-8 * by_hand, rel=1e-9)
        assert n.axial_n_m >= abs(by_hand)


def test_the_page_shows_every_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "RITZ_SIZES", (2, 3))
    monkeypatch.setattr(model, "PACKET_WAVES", (400.0,))
    found = model.part(lambda _: None)
    assert found.key == "model" and set(found.figures) == {"model-growth.png", "model-ritz.png"}
    assert all(f"({name})" in found.text for name in found.figures)
    assert found.text.count("**wrong**") == 4 + 5 + 6
    holds = {c.where: c.holds for c in found.claims}
    assert holds["(1)"] and holds["(3), u"] and not holds["(5), A_1[2,3]"]
    assert all(isinstance(c.holds, bool) for c in found.claims)
