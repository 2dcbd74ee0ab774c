"""Sections 2.1 and 2.2: equations (1) to (5), what is printed beside what (1) gives, and which waves grow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import sympy as sp
from numpy.polynomial import Polynomial

from chapter import (
    derivation,
    differences,
    equilibrium,
    model_claims,
    model_figures,
    model_text,
    waves,
)
from chapter.constants import AREA_M2, CORRECTED, LENGTH_M, PRINTED, Constants
from chapter.derivation import EQUATIONS
from chapter.fig_two import arc_end
from chapter.part import Part, Tell
from chapter.pde import SETPOINTS, STRAIGHT, Form, Setpoint, matrices
from chapter.rounding import gap, significant

FIRST_ROOT = 1.8751040687119611
"""cos(b) cosh(b) = -1: the first bending frequency is b^2 sqrt(EI / rho) / L^2."""
DIGITS = 4
"""Of the facts: Ritz values of sixteen shapes are not known much better."""
RITZ_SIZES = (2, 4, 6, 8, 12, 16)
GALERKIN_SIZES = (3, 4, 8, 12)
FORMS: tuple[Form, ...] = ("printed", "corrected")
PACKET_WAVES = (400.0, 700.0, 1200.0)
"""In 1/m."""
POINTS = (0.0, 0.21, 0.47, 0.73, 1.0)
"""Where the coefficients of (3) are compared with finite differences."""
GENERAL = Setpoint(
    "general",
    Polynomial([0.0, 0.0, 0.9, -0.7, 0.4, 0.1]),
    Polynomial([0.0, 0.3, -0.2, 0.5, -0.4, 0.2]),
)
"""A setpoint with u_e, so that its terms of (3) are compared too."""


def part(tell: Tell) -> Part:
    """Derive, compare, check by differences, and look for growing waves (some ten seconds)."""
    tell("equations (2), (3), (5) from (1)")
    second, third, fifth = (
        derivation.compare_second(),
        derivation.compare_third(),
        derivation.compare_fifth(),
    )
    energy = energy_facts()
    tell("the same by finite differences of (1)")
    checks = {
        "(2) derived": gap(second_error("derived")),
        "(2) printed": second_error("printed"),
        "(5) corrected": gap(fifth_error("corrected")),
        "(5) printed": fifth_error("printed"),
    }
    tell("growing waves")
    ends = {s.name: arc_end(s.w) for s in SETPOINTS}
    steep = {s.name: waves.steepest(s, ends[s.name]) for s in SETPOINTS}
    bands = {name: waves.growing_bands(c, CORRECTED) for name, (_, c) in steep.items()}
    shapes = {s.name: s for s in SETPOINTS}
    shapes |= {f"{s.name}, unstretched": equilibrium.octarm(i) for i, s in enumerate(SETPOINTS)}
    ritz = {
        name: {
            e: [waves.ritz_growth(s, CORRECTED, e, n) for n in RITZ_SIZES]
            for e in ("cubic", "exact")
        }
        for name, s in shapes.items()
    }
    packets = {s.name: packet_rows(s, ends[s.name]) for s in SETPOINTS}
    galerkin = {
        s.name: {
            form: [waves.galerkin_growth(s, CORRECTED, form, n) for n in GALERKIN_SIZES]
            for form in FORMS
        }
        for s in (STRAIGHT, *SETPOINTS)
    }
    needs = {
        f"{s.name}, x to {end:.3g}": equilibrium.need(s, CORRECTED, end)
        for s in SETPOINTS
        for end in (LENGTH_M, ends[s.name])
    }
    facts = {
        "material": material(),
        "energy": energy,
        "wrong_terms": {
            "(2)": [t.where for t in second if not t.right],
            "(3)": [t.where for t in third if not t.right],
            "(5)": [t.where for t in fifth if not t.right],
        },
        "differences": checks,
        "steepest": {n: {"x_m": x, "slope": c} for n, (x, c) in steep.items()},
        "growing_below_per_m": {n: b[0] for n, b in bands.items()},
        "growing_above_per_m": {n: b[1] for n, b in bands.items()},
        "ritz_sizes": list(RITZ_SIZES),
        "ritz_growth_per_s": {
            n: {e: [g for g, _ in rows] for e, rows in by.items()} for n, by in ritz.items()
        },
        "ritz_first_frequency_rad_s": {n: by["exact"][-1][1] for n, by in ritz.items()},
        "packet_growth_per_s": packets,
        "galerkin_sizes": list(GALERKIN_SIZES),
        "galerkin_growth_per_s": galerkin,
        "needs": {n: vars(v) for n, v in needs.items()},
    }
    figures = {
        "model-growth.png": model_figures.growth(steep, bands, packets),
        "model-ritz.png": model_figures.ritz(ritz, RITZ_SIZES),
    }
    text = model_text.text(second, third, fifth, facts, leading_rows(ends))
    return Part(
        "model",
        "The model and its linearisation",
        "2.1, 2.2",
        text,
        model_claims.claims(facts),
        figures,
        significant(facts, DIGITS),
    )


def packet_rows(setpoint: Setpoint, end: float) -> list[tuple[float, float]]:
    """(wave number, lower bound of the growth rate) of wave packets where the arm is steep."""
    centre = min(waves.steepest(setpoint, end)[0], 0.9 * end)
    return [
        (k, waves.packet_growth(setpoint, CORRECTED, k, centre, 0.1 * end)) for k in PACKET_WAVES
    ]


def material() -> dict[str, dict[str, float]]:
    """First bending frequency, its period and the axial wave speed, with rho as printed and as mass per
    length."""
    found = {}
    for c in (PRINTED, CORRECTED):
        frequency = FIRST_ROOT**2 * math.sqrt(c.bending_n_m2 / c.mass_kg_m) / LENGTH_M**2
        found[c.name] = {
            "EA_n": c.axial_n,
            "EI_n_m2": c.bending_n_m2,
            "mass_kg_m": c.mass_kg_m,
            "first_bending_rad_s": frequency,
            "first_period_s": 2.0 * math.pi / frequency,
            "axial_speed_m_s": math.sqrt(c.axial_n / c.mass_kg_m),
        }
    found["corrected"]["mass_ratio"] = PRINTED.mass_kg_m / CORRECTED.mass_kg_m
    found["corrected"]["area_m2"] = AREA_M2
    return found


def energy_facts() -> dict[str, bool]:
    """What is an Euler-Lagrange equation of what; each a symbolic identity."""
    exact = derivation.exact_energy()
    cubic = derivation.truncated(exact, 3)
    ends = derivation.tip_conditions(exact)
    flux = derivation.exact_flux()
    by_cubic = derivation.euler(cubic)
    along = ends["couple u"] * derivation.COSINE + ends["couple w"] * derivation.SINE
    across = -ends["couple u"] * derivation.SINE + ends["couple w"] * derivation.COSINE
    moment = derivation.EI * derivation.D(derivation.ANGLE) / derivation.STRETCH
    inertia = {
        "u": (sp.diff(derivation.ANGLE, derivation.U[1]), -derivation.SINE / derivation.STRETCH),
        "w": (sp.diff(derivation.ANGLE, derivation.W[1]), derivation.COSINE / derivation.STRETCH),
    }
    return {
        "(1) is the Euler-Lagrange equation of EA e^2/2 + EI theta_x^2/2": all(
            derivation.vanishes(ends[f"force {q}"] - flux[q]) for q in EQUATIONS
        ),
        "(1) leaves one couple at an end, EI theta_x": derivation.vanishes(along)
        and derivation.vanishes(across - moment),
        "(2) derived is the Euler-Lagrange equation of the energy to degree 3": all(
            sp.expand(by_cubic[q] - derivation.second()[q]) == 0 for q in EQUATIONS
        ),
        "(2) derived has an energy": derivation.is_gradient(derivation.second()),
        "(2) printed has an energy": derivation.is_gradient(derivation.printed_second()),
        # J theta_tt enters as the x-derivative of J theta_tt d theta/d u_x and d theta/d w_x: signs - and +
        "rotary inertia acts with -sin and +cos": all(
            derivation.vanishes(a - b) for a, b in inertia.values()
        ),
    }


def second_error(form: str) -> float:
    """Largest difference of a coefficient of (2), "printed" or "derived", from finite differences of (1)."""
    right = derivation.printed_second() if form == "printed" else derivation.second()
    worst = 0.0
    names = [(q, i) for q in EQUATIONS for i in range(1, 5)]
    for at, first in enumerate(names):
        unit = differences.linear_coefficient([0.0] * 4, [0.0] * 4, first)
        worst = max(worst, _deviation(right, (first,), unit))
        for other in names[at:]:
            measured = differences.product_coefficient(first, other)
            worst = max(worst, _deviation(right, (first, other), measured))
    return worst


def _deviation(
    right: object, factors: Sequence[tuple[str, int]], measured: dict[str, tuple[float, float]]
) -> float:
    jets = [*derivation.U[1:5], *derivation.W[1:5]]
    powers = [0] * 8
    for name, order in factors:
        powers[order - 1 + (4 if name == "w" else 0)] += 1
    worst = 0.0
    for i, q in enumerate(EQUATIONS):
        coefficient = sp.Poly(right[q], *jets).coeff_monomial(tuple(powers))  # type: ignore[index]
        for k, stiffness in enumerate((derivation.EA, derivation.EI)):
            expected = float(sp.expand(coefficient).coeff(stiffness))
            worst = max(worst, abs(expected - measured[("EA", "EI")[k]][i]))
    return worst


def fifth_error(form: Form) -> float:
    """Largest difference of an entry of `chapter.pde.matrices` from finite differences of (1), EA = 1 or
    EI = 1.

    At `POINTS`, relative to the largest derivative of the setpoint there; the setpoints and a general u_e.
    """
    worst = 0.0
    for constants in (Constants("EA", 1.0, 0.0, 1.0), Constants("EI", 0.0, 1.0, 1.0)):
        for setpoint in (*SETPOINTS, GENERAL):
            found = matrices(setpoint, constants, form)
            for x in POINTS:
                u = [float(setpoint.u.deriv(j)(x)) for j in range(1, 5)]
                w = [float(setpoint.w.deriv(j)(x)) for j in range(1, 5)]
                scale = max(1.0, *map(abs, (*u, *w)))
                for order in range(1, 5):
                    for column, name in ((0, "u"), (2, "w")):
                        measured = differences.linear_coefficient(u, w, (name, order))
                        for i, row in enumerate((1, 3)):
                            entry = float(found[order][row][column](x))
                            gap = abs(entry - measured[constants.name][i]) / scale
                            worst = max(worst, gap)
    return worst


def leading_rows(ends: dict[str, float]) -> list[tuple[str, str, list[float]]]:
    """(entry, form, values at the tips of the setpoints): what truncation at degree 2 does to (5).

    In units of EA / rho for A_2, EI / rho for A_4; the exact values linearise (1) by differences.
    """
    rows = []
    for entry, order, of, row, stiffness in (
        ("A_2[2,1]", 2, "u", 0, "EA"),
        ("A_2[2,3]", 2, "w", 0, "EA"),
        ("A_2[4,3]", 2, "w", 1, "EA"),
        ("A_4[2,1]", 4, "u", 0, "EI"),
        ("A_4[2,3]", 4, "w", 0, "EI"),
        ("A_4[4,3]", 4, "w", 1, "EI"),
    ):
        both: dict[str, list[float]] = {"(5) corrected": [], "(1)": []}
        for s in SETPOINTS:
            x = ends[s.name]
            u = [0.0] * 4
            w = [float(s.w.deriv(j)(x)) for j in range(1, 5)]
            for name, of_form in (
                ("(5) corrected", differences.linear_coefficient),
                ("(1)", differences.exact_linear_coefficient),
            ):
                both[name].append(of_form(u, w, (of, order))[stiffness][row])
        rows += [(entry, name, values) for name, values in both.items()]
    return rows


def symbolic_values(setpoint: Setpoint, constants: Constants, form: Form, x: float) -> np.ndarray:
    """(5) from sympy, A_0 to A_4 of shape (5, 4, 4) at x, for the comparison with `chapter.pde.matrices`."""
    symbolic = (
        derivation.printed_state_form()
        if form == "printed"
        else derivation.state_form(derivation.third())
    )
    values = {derivation.EA: constants.axial_n, derivation.EI: constants.bending_n_m2}
    for j in range(5):
        values[derivation.UE[j]] = float((setpoint.u.deriv(j) if j else setpoint.u)(x))
        values[derivation.WE[j]] = float((setpoint.w.deriv(j) if j else setpoint.w)(x))
    found = np.array([np.array(m.subs(values), dtype=np.float64) for m in symbolic])
    found[1:] /= constants.mass_kg_m
    return found
