"""The page on the model: tables of coefficients and what they mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from chapter.derivation import Term
from chapter.markdown import table

Leading = Sequence[tuple[str, str, Sequence[float]]]


def text(
    second: Sequence[Term],
    third: Sequence[Term],
    fifth: Sequence[Term],
    facts: Mapping[str, Any],
    leading: Leading,
) -> str:
    """Markdown below the title."""
    return "\n".join(
        (
            _checks(facts["differences"]),
            _material(facts["material"]),
            _second(second),
            f"## (3), coefficient by coefficient\n{_table(third, 'from (2) as printed')}\n",
            "f in (3) is the deviation from the load that holds the setpoint, not the f of (2).\n",
            f"## (5), entry by entry (times rho)\n{_table(fifth, 'from (3) as printed')}\n",
            "Entries that are zero in all three are left out. At the setpoints of Fig. 2, where u_e = 0,\n"
            "A_1[2,3] and the first column of row 4 remain.\n",
            _BOUNDARY,
            _needs(facts["needs"]),
            _waves(facts),
            _leading(leading),
        )
    )


def _checks(checks: Mapping[str, float]) -> str:
    return f"""## How it was checked
sympy expands (1) with tan theta = w_x/(1 + u_x) and e = sqrt((1 + u_x)^2 + w_x^2) - 1 in u, w and their
derivatives, keeps total degree 2, and linearises at (u_e, w_e). A second computation knows no algebra: u
and w are polynomials in x, (1) is evaluated by Taylor series in x with 60 digits, and differences in the
size of the displacement give each coefficient. Largest difference between the two
(1e-14 stands for less):

| | derived | printed |
|---|---|---|
| (2), 44 coefficients in each equation | {checks["(2) derived"]:.0e} | {checks["(2) printed"]:.0f} |
| A_1 to A_4 of (5) at 20 points | {checks["(5) corrected"]:.0e} | {checks["(5) printed"]:.2g} |

(EA = 1 or EI = 1; for (5) at five points of four setpoints, relative to the setpoint's derivatives.)
"""


def _material(material: Mapping[str, Mapping[str, float]]) -> str:
    rows = "\n".join(
        f"| {label} | {material['printed'][key]:.4g} | {material['corrected'][key]:.4g} |"
        for label, key in (
            ("mass per length, kg/m", "mass_kg_m"),
            ("EA, N", "EA_n"),
            ("EI, N m2", "EI_n_m2"),
            ("first bending frequency, rad/s", "first_bending_rad_s"),
            ("its period, s", "first_period_s"),
            ("axial wave speed, m/s", "axial_speed_m_s"),
        )
    )
    return f"""## Material and (1)
| | rho as printed | rho A |
|---|---|---|
{rows}

(1) is the Euler-Lagrange equation of the energy EA e^2/2 + EI theta_x^2/2 per length (a symbolic identity),
and the first display with J = 0. The first display's second equation has the wrong sign before J: J
theta_t^2/2 enters by d theta/d u_x = -sin theta/(1 + e) and d theta/d w_x = cos theta/(1 + e), so the two
equations differ in sign. With the printed sign the linear beam is rho w_tt + J w_xxtt = ..., of negative
inertia for k > sqrt(rho/J), which is 2/radius = 80/m.
"""


def _second(terms: Sequence[Term]) -> str:
    return f"""## (2), monomial by monomial
{_table(terms, None)}

u2 w3 stands for u_xx w_xxx. The line EI(u_xx w_xx + u_x w_xxx) lacks a 1/m against the others: each w lost
a derivative, EI d/dx(u_x w_xxx) is meant. The derived (2) is the Euler-Lagrange equation of the energy cut
after degree 3,

    EA (u_x^2 + u_x w_x^2)/2 + EI (w_xx^2/2 - u_x w_xx^2 - w_x u_xx w_xx),

so it conserves energy; the printed one comes from no energy at all (its linearisation is not self-adjoint).
The energy cut after degree 3 is not bounded below: see the last section.
"""


_BOUNDARY = """## Boundary conditions
The variation of the exact energy leaves N_x delta u + N_y delta w + EI theta_x delta theta at each end.
Clamped: u = w = theta = 0. Free: N_x = N_y = 0 (the brackets of (1)) and theta_x = 0. Three an end, not
four: the fourth derivatives enter by theta alone, the matrix before them has rank one. For a straight arm
u(0) = 0, u_x(L) = 0; w(0) = w_x(0) = 0, w_xx(L) = w_xxx(L) = 0. The printed u(0) = u_x(0) = 0 are Cauchy
data of rho u_tt = EA u_xx at x = 0 for all time, and leave u = 0 only.

The truncated (2) does have u_xxxx where w_x is not zero. Its energy leaves at the tip

    w_x w_xx = 0,   w_xx - 2 u_x w_xx - w_x u_xx = 0,
    EA (u_x + w_x^2/2) + EI w_x w_xxx = 0,
    EA u_x w_x - EI (w_xxx - 2 u_x w_xxx - 2 u_xx w_xx - w_x u_xxx) = 0,

so w_xx = u_xx = 0 as printed if w_x(L) is not zero, but then a force, not u_xxx; and at the root (w_x = 0)
no condition on u_x. With the printed conditions the free tip carries the axial force EA (u_x + w_x^2/2).
Printed as conditions on accelerations they also hold for every shape at rest, and for a clamp that moves at
constant speed.
"""


def _needs(needs: Mapping[str, Mapping[str, float]]) -> str:
    rows = "\n".join(
        f"| {n} | {v['transverse_n_m']:.3g} | {v['axial_n_m']:.3g} | {v['tip_axial_n']:.3g} | "
        f"{v['tip_transverse_n']:.2g} | {v['tip_moment_n_m']:.2g} | {v['stretch']:.3g} |"
        for n, v in needs.items()
    )
    return f"""## Are the shapes of Fig. 2 setpoints?
What (2) needs to rest at u_e = 0, w_e, largest values over the arm:

| setpoint | f, N/m | axial load, N/m | axial tip force, N | transverse, N | tip couple, N m | stretch e |
|---|---|---|---|---|---|---|
{rows}

f can be supplied, the rest cannot: (2) has no axial load and the tip is free. u_e = 0 keeps every point at
its x, which stretches the arm to the length of the graph. An unstretched arm has u_e' = cos theta - 1.
"""


def _waves(facts: Mapping[str, Any]) -> str:
    sizes = facts["ritz_sizes"]
    rows = "\n".join(
        f"| {n} | {by['cubic'][0]:.3g} | {by['cubic'][-1]:.3g} | {by['exact'][-1]:.2g} | "
        f"{facts['ritz_first_frequency_rad_s'][n]:.4f} |"
        for n, by in facts["ritz_growth_per_s"].items()
    )
    heads = " | ".join(f"{n} shapes" for n in facts["galerkin_sizes"])
    rules = "---|" * len(facts["galerkin_sizes"])
    galerkin = "\n".join(
        f"| {n} | {form} | " + " | ".join(f"{v:.3g}" for v in values) + " |"
        for n, by in facts["galerkin_growth_per_s"].items()
        for form, values in by.items()
    )
    return f"""## Waves that grow
With u_e = 0, A_2 and A_4 frozen where the slope is c, and K = EI k^2/EA, waves grow where K < c^2 (K -
1)^2: short ones, K > K2, and long ones, K < 1/K2, with K2 = (2 c^2 + 1 + sqrt(4 c^2 + 1))/(2 c^2).

- Short: the leading matrix (EI/rho) [[0, c], [c, -1]] has the eigenvalue (EI/rho) (sqrt(1 + 4 c^2) - 1)/2 >
  0, the growth rate rises as k^2: ill-posed. K2 is near 1/c^2 for small slopes but never below 1, so that k
  > sqrt(EA/EI)/c is right for small c only; at setpoint 3 the band starts at 88/m, not at 16/m.
- Long: the matrix EA [[1, c], [c, 0]] of (u~_x, w~_x) is indefinite, as the stiffness EA c^2 is of degree 4
  in the energy. Growth is about c k sqrt(EA/rho) for small c, and no grid is too coarse to see it.

Both come from the cut after degree 2, not from the arm (the exact energy is never negative), and printed
and corrected (5) share them.

![Growth rate against wave number](model-growth.png)

Dots: wave packets within a fifth of the arm, the force of (5) applied to them by quadrature. Nothing is
frozen there, nor below: Ritz values of the second variation of both energies on the whole clamped-free arm;
growth rates are lower bounds. "unstretched": octarm's setpoints (u_e' = cos theta - 1, without the holding
load's strain).

| setpoint | (5), {sizes[0]} shapes, 1/s | (5), {sizes[-1]} shapes, 1/s | (1), 1/s | (1), lowest, rad/s |
|---|---|---|---|---|
{rows}

![Growth rate of the whole arm against the number of shape functions](model-ritz.png)

The same under the printed boundary conditions, which a design on (5) uses: Galerkin with polynomials that meet
them, number of shapes for each of u~ and w~, growth rates in 1/s. Even the straight arm grows with some numbers
of shapes: u~(0) = u~_x(0) = u~_xx(L) = u~_xxx(L) = 0 does not fit the wave equation.

| setpoint | form | {heads} |
|---|---|{rules}
{galerkin}

A design on (5) at a bent setpoint therefore has to stabilise growth of several 1/s, without bound as the grid
is refined, that the arm with its first period of 67 s does not have. octarm designs on the linearisation of (1)
without prestress. (rho A = 2.16 kg/m throughout; with 1100 kg/m all rates are 23 times smaller, the bands are
the same.)
"""


def _leading(leading: Leading) -> str:
    rows = "\n".join(
        f"| {entry} | {form} | " + " | ".join(f"{v:.3f}" for v in values) + " |"
        for entry, form, values in leading
    )
    return f"""What the cut takes away, at u_e = 0 where the arclength is 1 m, A_2 in EA/rho, A_4 in EI/rho:

| entry | from | setpoint 1 | setpoint 2 | setpoint 3 |
|---|---|---|---|---|
{rows}
"""


def _table(terms: Sequence[Term], follows: str | None) -> str:
    """Markdown table of a comparison; `follows` heads the middle column, None leaves it out."""
    heads = ["coefficient of", "printed", *([follows] if follows else []), "from (1)", ""]
    return table(
        heads,
        [
            (
                *(t.where, t.printed, *([t.follows] if follows else []), t.derived),
                "" if t.right else "**wrong**",
            )
            for t in terms
        ],
    )
