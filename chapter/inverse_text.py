"""The page of the inverse, from its facts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def text(facts: Mapping[str, Any]) -> str:
    """Markdown below the claims."""
    formula = facts["formula"]
    exact = "\n".join(
        f"| {name} | {one['least']:g} .. {one['greatest']:g} | {one['formula']:.0e} | {one['octarm']:.0e} |"
        for name, one in formula.items()
        if name != "letters"
    )
    ways = list(facts["membrane"][0]["one_kernel"])
    of_formula = " | ".join(f"formula, {way}" for way in ways)
    rules = "---|" * len(ways)
    membrane = "\n".join(
        f"| {one['c']:g} | {one['condition']:.3g} | {one['quadrature']:.0e} | "
        f"{'refused' if one['octarm'] is None else format(one['octarm'], '.0e')} | "
        f"{one['octarm_functions']:.0e} | {one['series']:.0e} | "
        f"{' | '.join(format(one['one_kernel'][way], '.1e') for way in ways)} |"
        for one in facts["membrane"]
    )
    best = ", ".join(f"{k}: {v:.1e}" for k, v in facts["best_kernel"].items())
    arm = "\n".join(
        f"| {one['setpoint']} | {one['least']:.3g} .. {one['greatest']:.3g} | {one['octarm']:.0e} | "
        f"{one['octarm_gain']:.0e} | {' | '.join(format(one['one_kernel'][way], '.1e') for way in ways)} | "
        f"{one['rank']} | {', '.join(map(str, one['ranks'].values()))} |"
        for one in facts["arm"]
    )
    tolerances = ", ".join(facts["arm"][0]["ranks"])
    fits = "\n".join(
        f"| {one['name']} | {one['rho']:.4g} | {one['measured']:.3g} | "
        f"{' | '.join(format(one['errors'][d], '.1e') for d in ('4', '8', '16', '32'))} | "
        f"{one['degree_1e6']} | {one['toolbox']:.1e} | {one['least']:+.2f} |"
        for one in facts["rational"]
    )
    cut = "\n".join(
        f"| {one['tolerance']:g} | {one['rank']} | {one['degree']} | {one['error']:.0e} |"
        for one in facts["polynomials"]
    )
    gammas = "; ".join(
        f"setpoint {name}: {pair[0]:.4f} with S, {pair[1]:.4f} without"
        for name, pair in facts["equal"].items()
    )
    return f"""## The formula for R_1 = R_2

With Q_1 = H_1 Z, Q_2 = Z' H_2', R_1 = R_2 = Z(s)' Gamma Z(theta) (polynomial kernels always have this form, Z
monomials), P (x, y) = (f, g) depends on y through the numbers m = int Z y only. From the second row y =
R_0^-1 (g - Z' (H_2' x + Gamma m)); put into the first row and into m it leaves

    [ P         H_1         ] [x]   [ f              ]
    [ K H_2'    I + K Gamma ] [m] = [ int Z R_0^-1 g ],     K = int Z R_0^-1 Z',

and with [A, B; C, D] the inverse of this matrix

    P^ = A,   Q_1^ = B Z R_0^-1,   Q_2^ = -R_0^-1 Z' (H_2' A + Gamma C),
    R_0^ = R_0^-1,   R_1^ = R_2^ = -R_0^-1 Z' (H_2' B + Gamma D) Z R_0^-1.

It is Woodbury's identity; Gamma need not have an inverse. In the letters of the toolbox's routine
(`inv_opvar_old.m`), P^ = (I + P^-1 H T K H') P^-1 with T = (I + K Gamma - K H' P^-1 H)^-1, it gives the same
numbers ({formula["letters"]:.0e}); a factor b - a that the routine has there is 1 on [0, 1] and does not
belong to (7). Checked against a collocation that takes the integrals up to s and from s on by Gauss rules of
their own and knows neither R_0^-1 nor Gamma; the operator has two numbers, two functions and kernels of
degree 2. Relative, over all polynomials of degree < 6; beside it octarm's P^-1 (`design/inverse.py`,
`design/lpi/gains.py`), which does not use that R_1 = R_2:

| operator | symmetric part | formula | octarm |
|---|---|---|---|
{exact}

Coercive and self-adjoint is enough, and more than is needed: R_0(s) and the matrix above must have inverses.
Coercivity gives both, because a sequence of functions that concentrates at one s turns P >= delta I into
R_0(s) >= delta I. For K = Z P^-1 take L = P^-1 Z with adjoints: K = ((P*)^-1 Z*)*. In (18) and (21) P has no
finite part; then the first row and column are empty.

## Necessarily a 4-PI operator

P^-1 - R_0^-1 is a Hilbert-Schmidt operator, so it has a square-integrable kernel and P^-1 is a 4-PI operator
in that sense. If P's kernels are sums of r_1 and r_2 products, so are those of P^-1 (below:
{facts["arm"][0]["rank"]} and {facts["arm"][0]["ranks"]["1e-10"]}). With polynomials as parameters, as
everywhere else in the chapter, it is not true: 1 / R_0 is rational, and for R_1 != R_2 not even R_0 = 1
helps. The smallest example, self-adjoint and >= I:

    P x = x + c int min(s, theta) x(theta) d theta,      R_1 = c theta, R_2 = c s,   w = sqrt(c):
    P^-1 has the kernel  -w sinh(w min(s, theta)) cosh(w (1 - max(s, theta))) / cosh(w).

u = int min x solves -u'' + c u = y, u(0) = u'(1) = 0, and x = y - c u.

## R_1 != R_2

octarm takes kernels F_1(s) G_1(theta), F_2(s) G_2(theta) as what they are: P x = y is a linear ODE in int_0^s
G_1 x and int_s^1 G_2 x with conditions at both ends (Gohberg, Goldberg, Kaashoek). The formula above can be
given one kernel for the two; errors of P^-1 against the closed form, relative, over polynomials of degree <
6; "functions": P^-1 of these polynomials alone, without kernels; "series": the same ODE by
{facts["series_terms"]} terms of Picard's series:

| c | condition of P | quadrature | octarm | octarm, functions | series | {of_formula} |
|---|---|---|---|---|---|{rules}
{membrane}

![Kernels of the inverse, and errors of all ways](inverse-kernels.png)

One kernel for the two is wrong by the size of the answer: R_1 = c theta alone is not even self-adjoint, and
the mean c (s + theta) / 2 has a negative eigenvalue (where it is near -1 the error is largest). The best
polynomial of many degrees is a way out for smooth y, but it is a Galerkin method, not an exact formula: as an
operator it is of second order in the number of polynomials ({best}, for c = 30), because of the edge at s =
theta (the arm's kernels even jump there), and every polynomial is a number to be sent between nodes, where the
exact kernels have rank one.

octarm's own limit is in the table too. The ODE's solutions grow and decay by e^w, so it is integrated from node
to node, and two bases, of the solutions that meet the conditions at either end, are carried by QR. That loses
nothing however large c is, and P^-1 of functions (all that an observer of finitely many outputs needs) is exact
as long as polynomials resolve it. Kernels are products of polynomials on the whole arm, w sinh(w theta) and
cosh(w (1 - s)) / cosh(w), each right to rounding of its largest value; what is small beside that, at s =
theta, is the gain. So sinh(w) times rounding is left: 1e-8 at c = 300, 1e-6 (acceptance) at c = 450. At
1000 it says what is lost and gives no gain. (Shooting from one end to the other loses e^(2 w): 1e-6 at c =
100, everything at 300.) P of the LPIs are far from that:

## The arm's P

P = q I + kappa S + H* W H of the observers for (22) ([lpi.md](lpi.md), epsilon = 0.001). R_0 = q is a number;
H* W H has R_1 = R_2, the virtual work S has not. P^-1 over polynomials of degree < 6 against quadrature; then
P^-1 Z for Z = P L with the polynomial gain L itself, so that the answer is known: by octarm and by the formula.
Rank of R_1, and of the inverse's R_1^ without directions below {tolerances} of the operator's size:

| setpoint | eigenvalues of P | octarm, P^-1 | octarm, L | {of_formula} | rank of R_1 | of R_1^ |
|---|---|---|---|{rules}---|---|
{arm}

Can P be had with R_1 = R_2, kappa = 0? Not strictly: the high strain modes are held below zero by kappa alone
(drag acts on velocities). With <= 0 in place of < 0 smallest gamma of octarm's observer LPI (y = (v_y, k) +
0.1 noise, two polynomials a state): {gammas}; 0.1 is the noise weight, what an observer reaches that only
leans on its measurement. In that case R_0^-1 = 1 / q, and the exact formula gives polynomials without any
approximation.

## R_0^-1 by a polynomial

The formula needs R_0^-1 at points only: at those of the quadrature for K, and at the s_i of the nodes. A
polynomial is wanted only to write the gain down. Then 1 / R_0 is analytic up to the nearest root of det R_0,
and with rho the sum of the half axes of the ellipse through it (foci at the ends of [-1, 1]) the error falls
like rho^-d. R_1 = R_2 of degree 2, P^-1 relative; "measured" from degrees 8 to 32; the last columns for
degree 6 by least squares at 101 equidistant points, K from the exact R_0^-1, which is what `inv_opvar_old.m`
of the chapter's toolbox does, and the least eigenvalue of that R_0^-1 relative to its largest:

| R_0 | rho | measured | d = 4 | d = 8 | d = 16 | d = 32 | d for 1e-6 | degree 6 | least |
|---|---|---|---|---|---|---|---|---|---|
{fits}

![Errors by degree](inverse-degree.png)

A negative eigenvalue means that what stands for P^-1 is not the inverse of anything coercive, and no
certificate is left. The degree is to be chosen by the error, not fixed, and the inequality is to be checked
with the gain that comes out; octarm does so after every cut (`lpi_eigenvalue`, [../design.md](../design.md)).

## Kernels as polynomials

A kernel cut at a tolerance and split at minimal rank, N_1 = N_1a(s) N_1b(theta), by singular values
(`design/factors.py`), for c = 30 (error: largest, relative to the largest value of N_1):

| tolerance of coefficients | rank | degree | error |
|---|---|---|---|
{cut}

The tolerance is one of coefficients, relative to the gain; factors that grow by e^w multiply it, by 100 at
most: where they grow more, it is taken finer by as much. With R_1 = R_2 and R_0^-1 of degree d the kernels have
degree deg Z + d in each variable and the rank of Gamma at most."""
