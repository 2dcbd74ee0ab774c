"""Sections 3.1 to 3.3 reproduced: PI operators, the conversion of (4) to a PIE, what an LPI is.

Between the formulas (`chapter.conversion`), their checks (`chapter.operator_checks`) and the page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from chapter import markdown
from chapter.constants import CORRECTED, PRINTED
from chapter.conversion import CLAMPED_FREE, Formulas, boundary_matrix, by_hand, errors
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
    rank_examples,
    singular_values,
    volterra,
    wave_frequencies,
)
from chapter.operator_figures import h1_errors, kernels
from chapter.part import Claim, Part, Tell
from chapter.pde import SETPOINTS, STRAIGHT, Form, Setpoint, matrices
from chapter.rounding import gap, significant
from design.pde.convert import convert

FORMS: tuple[Form, Form] = ("printed", "corrected")
SEED = 20261130
ROUNDING = 1e-12
"""Differences below this are shown as this: what they are differs from machine to machine."""


@dataclass(frozen=True)
class Row:
    """Errors of T f and A f against integration by hand, in one case."""

    setpoint: str
    constants: str
    matrices: Form
    """Of (5)."""
    H1: Form
    T: float
    """Largest of the four rows, relative."""
    A: tuple[float, float, float, float]
    """The rows of u, u_t, w, w_t, each relative to the row's size."""


def h1_table(setpoints: Sequence[Setpoint] = SETPOINTS, trials: int = 5) -> list[Row]:
    """Setpoint x constants x form of (5) x form of H_1.

    Of `trials` random polynomials d_s^4 x of degree 6 the worst for the corrected H_1, the mildest for the
    printed one.
    """
    B = boundary_matrix(CLAMPED_FREE, 4)
    table = []
    for setpoint in setpoints:
        for constants in (PRINTED, CORRECTED):
            for of_5 in FORMS:
                A = matrices(setpoint, constants, of_5)
                random = np.random.default_rng(SEED)
                hands = [by_hand(A, random) for _ in range(trials)]
                for of_h1 in FORMS:
                    operators = Formulas(A, B, of_h1).operators()
                    found = [errors(operators, hand) for hand in hands]
                    judge = np.min if of_h1 == "printed" else np.max
                    u, u_t, w, w_t = (float(v) for v in judge([a for _, a in found], axis=0))
                    worst = max(float(t.max()) for t, _ in found)
                    row = Row(setpoint.name, constants.name, of_5, of_h1, worst, (u, u_t, w, w_t))
                    table.append(row)
    return table


def _shown(row: Row) -> Row:
    """The same with rounding errors shown as that."""
    u, u_t, w, w_t = (gap(value, ROUNDING) for value in row.A)
    return replace(row, T=gap(row.T, ROUNDING), A=(u, u_t, w, w_t))


def _compared(table: Sequence[Row], setpoint: str) -> dict[str, list[float]]:
    """By form of H_1, with the corrected constants and matrices."""
    return {
        row.H1: list(row.A)
        for row in table
        if (row.setpoint, row.constants, row.matrices) == (setpoint, "corrected", "corrected")
    }


def part(tell: Tell) -> Part:
    """Everything that the chapter says in sections 3.1 to 3.3, checked."""
    random = np.random.default_rng(SEED)
    tell("operators: (6) and (7) against adaptive quadrature")
    applied = gap(application_error(random), ROUNDING)
    composed = gap(composition_error(random), ROUNDING)
    tell("operators: (11) on three setpoints, against integration by hand")
    table = [_shown(row) for row in h1_table()]
    A = matrices(SETPOINTS[0], CORRECTED, "corrected")
    converter = [
        converter_difference(matrices(setpoint, constants, form))
        for setpoint in SETPOINTS
        for constants in (PRINTED, CORRECTED)
        for form in FORMS
    ]
    T, _ = Formulas(A, boundary_matrix(CLAMPED_FREE, 4), "corrected").operators()
    singular, expected = singular_values(T), beam_values(8)
    decay = gap(float(np.abs(singular[: 4 * 8 : 4] / expected - 1.0).max()), ROUNDING)
    green, rank = gap(green_error(A, random), 1e-14), rank_examples()
    tell("operators: the axial state with two conditions")
    straight = matrices(STRAIGHT, CORRECTED, "corrected")
    refused = axial_refusal(A)
    axial = 0.5 * math.pi * math.sqrt(CORRECTED.axial_n / CORRECTED.mass_kg_m)
    two, *four = (
        float(np.abs(wave_frequencies(convert(axial_pde(straight, order)), size) - axial).min())
        for order, size in ((2, 16), (4, 10), (4, 14), (4, 20))
    )
    two, four = gap(two, 1e-8), significant(four, 2)
    tell("operators: two LPIs of the form (12)")
    norm, limit = volterra(), heat_limit()
    worst_right = max(max(row.A) for row in table if row.H1 == "corrected")
    mildest_wrong = min(min(row.A) for row in table if row.H1 == "printed")
    worst_T = max(row.T for row in table)
    claims = (
        Claim(
            "(6), dimensions",
            "N_0 in R^(n x m), N_1, N_2 in R^(m x n)",
            "all three in R^(n x m): otherwise only n = m makes sense of the sum",
            holds=False,
        ),
        Claim(
            "(6), (7)",
            "PI operators are bounded, closed under sums, composition and adjoints (3.6)",
            f"application and composition agree with adaptive quadrature to {max(applied, composed):.0e}",
            holds=True,
        ),
        Claim(
            '(8), "any linear PDE can be represented"',
            "by (9) to (11) if rank(B) = 4 n",
            f"B T(b) must be invertible: free-free conditions have rank(B) = {rank['free-free'][0]} and "
            f"rank(B T(b)) = {rank['free-free'][1]}",
            holds=False,
        ),
        Claim(
            "(10), G_0, G_1, G_2",
            "0, -K_0 M + L_0, -K_0 M with M = (B T(b))^-1 B Q(b, .)",
            f"T f = x to {worst_T:.0e}; the kernel is the cantilever's Green's function to {green:.0e}",
            holds=True,
        ),
        Claim(
            "(10), H_0, H_2",
            "A_4, -sum A_j K_j M",
            "differentiate x = T f",
            holds=True,
        ),
        Claim(
            "(10), H_1",
            "-sum (A_j K_j M + L_j)",
            f"sum A_j (-K_j M + L_j): error {worst_right:.0e}, printed at least {mildest_wrong:.2g} in "
            "every row (1 = as large as the row itself)",
            holds=False,
        ),
        Claim(
            "(10), B_i",
            "a 3-PI operator {B_i, 0, 0} for w in R",
            "a number drives through Q_2 of (7); {B_i, 0, 0} is right for f(s, t) of (4), which is a function",
            holds=False,
        ),
        Claim(
            "(10), C_i = 0",
            "zero",
            "only if nothing is measured or regulated; (22) sets them",
            holds=False,
        ),
        Claim(
            "(11), sums j = 0 .. 3",
            "A_4 appears in H_0 only",
            "d_s^4 x = f is the multiplier; checked by the same comparison",
            holds=True,
        ),
        Claim(
            "section 2.1 with (9)",
            "four conditions each for u and u_t",
            f"two: u then has the axial frequency {axial:.3f} rad/s to {two:.0e}; with four the nearest "
            f"numbers {', '.join(f'{v:.2f}' for v in four)} rad/s away (degrees 10, 14, 20) do not converge",
            holds=False,
        ),
        Claim(
            "(12)",
            "an LPI is linear in the numbers x_k, with self-adjoint operators",
            f"norm of the Volterra operator: {norm.certified:.5f} certified, 2/pi = {2 / math.pi:.5f}",
            holds=True,
        ),
    )
    bars = {setpoint.name: _compared(table, setpoint.name) for setpoint in SETPOINTS}
    numbers = {
        "quadrature": {"application": applied, "composition": composed},
        "h1": [asdict(row) for row in table],
        "printed_h1_least": mildest_wrong,
        "corrected_h1_worst": worst_right,
        "converter": {
            "T": gap(max(a for a, _ in converter), ROUNDING),
            "A": gap(max(b for _, b in converter), ROUNDING),
        },
        "green": green,
        "singular_values": [float(v) for v in singular[: 4 * 8 : 4]],
        "singular_values_relative_error": decay,
        "ranks": {name: list(pair) for name, pair in rank.items()},
        "axial": {"exact_rad_s": axial, "two_conditions": two, "four_conditions": four},
        "volterra": {
            "certified": norm.certified,
            "exact": 2.0 / math.pi,
            "below": norm.just_below,
            "above": norm.just_above,
        },
        "heat_limit": {"certified": limit, "exact": math.pi**2},
    }
    facts: dict[str, Any] = significant(numbers, 5)
    return Part(
        key="operators",
        title="PI operators and the partial integral equation",
        section="3.1 to 3.3",
        text=_text(facts, refused, printed_shape_refused()),
        claims=claims,
        figures={
            "operators-h1.png": h1_errors(bars),
            "operators-kernels.png": kernels(matrices(SETPOINTS[1], CORRECTED, "corrected"), "2"),
        },
        facts=facts,
    )


def _text(facts: dict[str, Any], refused: str, shapes: str) -> str:
    volterra_, heat, axial = facts["volterra"], facts["heat_limit"], facts["axial"]
    singular = ", ".join(f"{v:.2e}" for v in facts["singular_values"][:5])
    four = ", ".join(f"{v:.2f}" for v in axial["four_conditions"])
    cases: dict[tuple[str, ...], dict[str, list[float]]] = {}
    for row in facts["h1"]:
        case = tuple(row[key] for key in ("setpoint", "constants", "matrices"))
        cases.setdefault(case, {})[row["H1"]] = row["A"]
    h1 = markdown.table(
        (
            "setpoint",
            "constants",
            "matrices (5)",
            *("printed H_1: u", "u_t", "w", "w_t"),
            "corrected H_1, worst row",
        ),
        [
            (*case, *(f"{v:.2g}" for v in of["printed"]), f"{max(of['corrected']):.0e}")
            for case, of in cases.items()
        ],
    )
    return f"""## Operators, (6) and (7)

`design.operators.PIOperator` is (7) with polynomial parameters, sums, compositions and adjoints exact in an
orthonormal Legendre basis. For random, non-square parameters it agrees with (7) evaluated by adaptive
quadrature to {facts["quadrature"]["application"]:.0e}, and A B y with A (B y) to
{facts["quadrature"]["composition"]:.0e}.

The text before (6) gives N_0 the dimensions n x m, but N_1 and N_2 m x n. They are summed, so all three are n
x m; the algebra says "{shapes}". (7) has it right. In (12) the off-diagonal parameters are Q_k and its
transpose: the printed symbol leaves the second one out.

## From (4) to a PIE, (8) to (11)

State x = (u, u_t, w, w_t), n = 4, fundamental state d_s^4 x. B of (9) is 16 x 32: clamped at 0, free at 1, the
same four conditions for each component. (The chapter writes them for the accelerations; with
shape and velocity that meet them at the start they are the same.) `chapter.conversion` has (11) letter by
letter, with either form of H_1.

The check shares nothing with it: a random polynomial d_s^4 x of degree 6 is integrated four times with
`numpy.polynomial`, from the tip for the third and second derivative, from the root for the first and x
itself; put into (4) it gives the right side. Largest differences at 12 Gauss points, relative to each row's
size (five random polynomials; the mildest one for the printed form, the worst one for the corrected; T f = x
to the same 1e-12, which is rounding):

{h1}

![Error of A f with H_1 as printed and corrected](operators-h1.png)

With M = (B T(b))^-1 B Q(b, .) differentiating x = T f gives d_s^j x = int (-K_j M + L_j 1(theta < s)) f, so
H_1 = sum_j A_j (-K_j M + L_j). The printed -sum_j (A_j K_j M + L_j) has the wrong sign at L_j and no A_j
before it; its error is the operator with kernel -sum_j (A_j + I) L_j. It is no matter of taste: L_0 to L_3
have four different units, so their sum means nothing. The general converter (`design.pde.convert`), written
for any orders and conditions, gives the corrected T and A to {facts["converter"]["T"]:.0e} and
{facts["converter"]["A"]:.0e} for all twelve combinations.

![Kernels of T and A](operators-kernels.png)

Other points:

- T(b), Q: Taylor's formula about a with integral remainder; right as printed, also for u_t and w_t, whose
  conditions are those of u and w differentiated in time. H_0 = A_4, and the sums end at j = 3, because
  d_s^4 x = f itself.
- rank(B) = 4 n does not suffice: free at both ends has rank {facts["ranks"]["free-free"][0]} too, but B T(b),
  which (11) inverts, has rank {facts["ranks"]["free-free"][1]}. Such conditions need free constants in the
  fundamental state (`design.pde.convert` puts them there).
- B_i drives by a number, so it is Q_2 of a 4-PI operator, not the 3-PI operator {{B_i, 0, 0}}; that form fits
  f(s, t) of (4). C_i = 0, D_ij = 0 leave nothing to observe; (22) says otherwise.

## Four conditions for the axial displacement

u obeys a wave equation of second order in s, so it bears one condition an end. With u, u_t of order 2 (u(0) =
0, u_s(L) = 0) the straight arm's PIE has the axial frequency {axial["exact_rad_s"]:.4f} rad/s = (pi/2)
sqrt(EA/rho)/L to {axial["two_conditions"]:.0e}. With the chapter's four there is no axial motion at all: u_tt
= (EA/rho) u_ss with u = u_s = 0 at one end has only u = 0, and the numbers that a discretisation gives stay
{four} rad/s away from the frequency at degrees 10, 14 and 20. Formula (11) itself cannot take the two: it
asks for 4 n conditions. Mixed orders can, but not at a curved setpoint, where (4) contains third and fourth
derivatives of u: the converter says

> {refused}

So the chapter's form and a well-posed axial motion exclude each other; the states of strain and velocity
(docs/design.md) have neither problem.

## T is compact

G_0 = 0, so T is an integral operator. Its kernel is the Green's function of a cantilever (to
{facts["green"]:.0e}), its singular values are 1 / beta_k^4 with cos(beta) cosh(beta) = -1, four times each:
{singular}, ... (relative difference of the first eight from these roots:
{facts["singular_values_relative_error"]:.0e}). They go to zero, so along the singular functions f_k, which
are orthonormal, T f_k -> 0 and every <f_k, T* X f_k> with bounded X does: no inequality of the form (18) can
be <= -eps I on them.

## LPIs, (12)

The smallest LPI: the least x_1 with x_1 I - V* V >= 0, (V y)(s) = int_0^s y, N = 1, P_1 = I, P_0 = -V* V with
R_1 = R_2 = -(1 - max(s, theta)). Its square root is the norm of V, 2 / pi = {volterra_["exact"]:.5f}; the
engine certifies {volterra_["certified"]:.5f}. With 0.999 and 1.001 times 2 / pi the least eigenvalue of the
form on 40 Legendre functions is {volterra_["below"]:.1e} and {volterra_["above"]:.1e}. The second: the
largest lam for which x_t = lam x + x_ss, x = 0 at both ends, has a Lyapunov function <x, P x>; certified
{heat["certified"]:.4f}, exact pi^2 = {heat["exact"]:.4f}.
"""
