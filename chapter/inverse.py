"""Section 4, first paragraph, reproduced: P^-1 by the exact formula, where it ends, and R_0^-1 by polynomials.

Between the formula (`chapter.inverse_formula`), the operators it is tried on (`chapter.inverse_cases`,
`chapter.inverse_rational`, `chapter.inverse_equal`) and the page.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from chapter.inverse_arm import RANK_TOLERANCES, ArmRow, arm_row
from chapter.inverse_cases import (
    SERIES_TERMS,
    OneKernel,
    best_kernel_errors,
    formula_error,
    membrane,
    membrane_kernel,
    octarm_error,
    of_one_kernel,
    one_kernel,
    one_kernels,
    operator_of,
    polynomials,
    rational,
)
from chapter.inverse_equal import least_gammas
from chapter.inverse_figures import degrees, kernels
from chapter.inverse_formula import in_letters
from chapter.inverse_rational import RationalRow, row, valley
from chapter.inverse_reference import Nystrom
from chapter.inverse_text import text
from chapter.part import Claim, Part, Tell
from chapter.rounding import gap, significant
from design import legendre
from design.inverse import solve_gain
from design.operators import PIOperator, Shape

Array = npt.NDArray[np.float64]

DEGREES = (2, 4, 6, 8, 12, 16, 20, 24, 32, 40)
SIZES = (2, 4, 8, 16, 32)
CS = (1.0, 10.0, 30.0, 100.0, 300.0, 450.0, 1000.0)
SHOWN = 30.0
THETA = 0.4
TOLERANCES = (1e-4, 1e-6, 1e-8)
SETPOINTS = ("1", "2", "3")


def part(tell: Tell) -> Part:
    """Everything that the first paragraph of section 4 says, checked."""
    tell("inverse: the formula for R_1 = R_2 against quadrature")
    exact = _exact()
    tell("inverse: R_1 != R_2 in closed form")
    rows = [one_kernel(c) for c in CS]
    best = best_kernel_errors(operator_of(membrane(SHOWN), 1), SIZES)
    cut = [polynomials(SHOWN, tolerance) for tolerance in TOLERANCES]
    tell("inverse: the arm's P")
    arms = [arm_row(name) for name in SETPOINTS]
    tell("inverse: R_0^-1 by polynomials")
    fits = rational_rows()
    tell("inverse: what R_1 = R_2 costs the arm")
    equal = {name: least_gammas(name) for name in SETPOINTS[:2]}
    figures = {
        "inverse-degree.png": degrees(DEGREES, fits, SIZES, best),
        "inverse-kernels.png": kernels(*_curves(), rows, SHOWN),
    }
    facts: dict[str, Any] = {
        "formula": exact,
        "series_terms": SERIES_TERMS,
        "membrane": [_membrane_facts(one) for one in rows],
        "best_kernel": {str(k): significant(v, 2) for k, v in zip(SIZES, best, strict=True)},
        "polynomials": [asdict(replace(one, error=significant(one.error, 1))) for one in cut],
        "arm": [_arm_facts(one) for one in arms],
        "rational": [_rational_facts(one) for one in fits],
        "equal": {name: significant(list(pair), 4) for name, pair in equal.items()},
    }
    return Part(
        key="inverse",
        title="The inverse of P",
        section="4 (first paragraph)",
        text=text(facts),
        claims=_claims(facts),
        figures=figures,
        facts=facts,
    )


def rational_rows() -> list[RationalRow]:
    """Three valleys and the full matrix of `rational`, whose determinant has degree 3."""
    scalar = [row(f"$R_0 = {a:g}^2 + (s - 1/2)^2$", valley(a), 2, DEGREES) for a in (0.5, 0.2, 0.1)]
    return [*scalar, row("2 x 2 matrix", rational(), 3, DEGREES)]


def _exact() -> dict[str, Any]:
    operators = {
        "self-adjoint, coercive": rational(),
        "not self-adjoint": rational(self_adjoint=False),
        "self-adjoint, indefinite": rational(sign=-1.0),
    }
    out: dict[str, Any] = {}
    for name, operator in operators.items():
        rule = Nystrom(operator.parameters, 40)
        values = rule.eigenvalues()
        out[name] = {
            "least": significant(float(values[0]), 3),
            "greatest": significant(float(values[-1]), 3),
            "formula": decade(formula_error(operator)),
            "octarm": decade(octarm_error(operator.parameters, 4)[0]),
        }
    operator = rational()
    found = operator.inverse()
    letters = in_letters(operator)
    out["letters"] = gap(
        max(
            float(np.abs(a - b).max())
            for a, b in zip(letters, (found.P, found.H1, found.Gamma), strict=True)
        ),
        1e-12,
    )
    return out


def decade(error: float) -> float:
    """The next power of ten above, 1e-11 at least: rounding differs from machine to machine."""
    return float(f"1e{max(math.ceil(math.log10(max(error, 1e-300))), -11)}")


def _curves() -> tuple[Array, float, dict[str, Array]]:
    """The kernel of P^-1 of the membrane at theta, by every way."""
    s = np.linspace(0.0, 1.0, 401)
    theta = np.full_like(s, THETA)
    P = operator_of(membrane(SHOWN), 1)
    gain = solve_gain(P, PIOperator.identity(Shape(0, 1)))

    def product(outer: Array, inner: Array) -> Array:
        a, b = legendre.fit(outer[0]), legendre.fit(inner[:, 0])
        return np.asarray(
            legendre.basis(s, a.shape[1]) @ a.T @ (b @ legendre.basis(THETA, b.shape[1])[0])
        )

    below, above = product(gain.outer2, gain.inner2), product(gain.outer1, gain.inner1)
    curves = {
        "closed form": membrane_kernel(SHOWN, s, theta),
        "octarm": np.where(s < THETA, below, above),
    }
    for name, kernel in one_kernels(P).items():
        curves[f"formula, {name}"] = of_one_kernel(P, kernel).inverse().kernel(s, theta)[:, 0, 0]
    return s, THETA, curves


def _membrane_facts(one: OneKernel) -> dict[str, Any]:
    return {
        "c": one.c,
        "condition": significant(one.condition, 3),
        "quadrature": decade(one.quadrature),
        "octarm": None if math.isnan(one.octarm) else decade(one.octarm),
        "octarm_functions": decade(one.octarm_functions),
        "series": decade(one.series),
        "one_kernel": {k: significant(gap(v, 1e-12), 2) for k, v in one.one.items()},
    }


def _arm_facts(one: ArmRow) -> dict[str, Any]:
    return {
        "setpoint": one.setpoint,
        "least": significant(one.least, 3),
        "greatest": significant(one.greatest, 3),
        "octarm": decade(one.octarm),
        "octarm_gain": decade(one.octarm_gain),
        "one_kernel": {k: significant(v, 2) for k, v in one.one.items()},
        "rank": one.rank,
        "ranks": {f"{t:g}": k for t, k in zip(RANK_TOLERANCES, one.ranks, strict=True)},
    }


def _rational_facts(one: RationalRow) -> dict[str, Any]:
    return {
        "name": one.name.replace("$", ""),
        "rho": significant(one.rho, 4),
        "measured": significant(one.measured, 3),
        "errors": {
            str(d): significant(gap(e, 1e-12), 2) for d, e in zip(DEGREES, one.errors, strict=True)
        },
        "toolbox": significant(one.toolbox, 2),
        "least": significant(one.least, 2),
        "degree_1e6": one.degree_1e6,
    }


def _claims(facts: dict[str, Any]) -> tuple[Claim, ...]:
    exact, arms, fits = facts["formula"], facts["arm"], facts["rational"]
    worst = max(exact[k]["formula"] for k in exact if k != "letters")
    ways = [arm["one_kernel"] for arm in arms]
    low, high = (
        f(w[k] for w in ways for k in ("R_1 on both sides", "mean of R_1 and R_2"))
        for f in (min, max)
    )
    with_s, without = facts["equal"]["1"]
    errors = [fit["toolbox"] for fit in fits]
    return (
        Claim(
            "4, P^-1",
            "a self-adjoint, bounded and coercive 4-PI operator has an inverse that is a 4-PI operator",
            "yes with bounded R_0^-1 and square-integrable kernels, and separable kernels keep their ranks "
            f"({arms[0]['rank']} for the arm's P and its inverse); not with polynomials",
            holds=True,
        ),
        Claim(
            "4, self-adjoint, coercive",
            "what the formula asks for",
            "enough; needed are only R_0(s)^-1 and the inverse of one matrix: not self-adjoint or indefinite, "
            f"the formula is as exact ({worst:.0e})",
            holds=True,
        ),
        Claim(
            "4, R_1 = R_2",
            "exact formula for the inverse (Theorem 8 of [11])",
            f"derived anew (Woodbury); within {worst:.0e} of quadrature, and equal to the closed form in the "
            "toolbox's letters",
            holds=True,
        ),
        Claim(
            "4, R_1 = R_2",
            "the case that gains are computed in",
            "octarm's P for the arm is not of it: with R_1 = R_2 its inequality is no longer strict, and gamma "
            f"at setpoint 1 is {without:.4f} for {with_s:.4f}. The formula with one kernel for two is wrong by "
            f"{low:.0%} to {high:.0%} of L. With R_1 != R_2: a linear ODE, exact too",
            holds=False,
        ),
        Claim(
            "4, R_0^-1",
            "to find P^-1 we approximate it by a polynomial",
            "no need: the formula takes values of R_0^-1. A polynomial of degree d is off by rho^-d, rho from "
            f"the nearest root of det R_0; degree 6 by {min(errors):.1%} to {max(errors):.0%} here, and can be "
            "indefinite",
            holds=False,
        ),
        Claim(
            "4, K_i, L_i",
            "matrix-valued polynomials",
            "only after a fit: rational if R_1 = R_2, cosh and sinh for R_0 = 1 and kernels of degree one if "
            "R_1 != R_2. The certificate has to be that of the fitted gain",
            holds=False,
        ),
    )
