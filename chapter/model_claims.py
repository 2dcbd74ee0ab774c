"""The claims of sections 2.1 and 2.2, one by one, and what became of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from chapter.part import Claim


def claims(facts: Mapping[str, Any]) -> tuple[Claim, ...]:
    """Claims in the order of the chapter; numbers from the part's facts."""
    right, wrong = facts["material"]["corrected"], facts["material"]["printed"]
    above, below = facts["growing_above_per_m"], facts["growing_below_per_m"]
    slopes = {n: v["slope"] for n, v in facts["steepest"].items()}
    ritz = facts["ritz_growth_per_s"]
    needs = [v for n, v in facts["needs"].items() if not n.endswith("x to 1")]
    energy = facts["energy"]
    return (
        Claim(
            "2.1, first display",
            "second equation: rho w_tt + d/dx(J theta_tt cos theta/(1+e)) on the right",
            "minus: with + J the inertia rho - J k^2 is negative for short waves. The first equation's + is "
            "right",
            False,
        ),
        Claim(
            "2.1, J",
            '"rotational moment of inertia about axial direction"',
            "the cross-section turns about the normal of the plane: J = density times I, per length",
            False,
        ),
        Claim(
            "(1)",
            "exact planar beam, J = 0",
            "the first display with J = 0; the Euler-Lagrange equation of EA e^2/2 + EI theta_x^2/2",
            energy["(1) is the Euler-Lagrange equation of EA e^2/2 + EI theta_x^2/2"],
        ),
        Claim(
            "2.1, 4.1: rho",
            "rho = 1.1e3 kg/m3 is the mass per unit length",
            f"rho A = {right['mass_kg_m']:.3g} kg/m, {right['mass_ratio']:.0f} times less: first bending "
            f"period "
            f"{right['first_period_s']:.0f} s, not {wrong['first_period_s']:.0f} s",
            False,
        ),
        Claim("(2), u", "EA w_x w_xx + EI(w_xx w_xxx + w_x w_xxxx)", "follows from (1)", True),
        Claim(
            "(2), w",
            "EI(u_xx w_xx + u_x w_xxx) + EI d^3(u_x w_x)",
            "EI(u_xx w_xxx + u_x w_xxxx) + EI d^3(u_x w_x): four coefficients; the printed term lacks a 1/m",
            False,
        ),
        Claim(
            "(2), energy",
            "an elastic arm without damping",
            "no energy makes the printed (2), its linearisation is not self-adjoint; the derived one has "
            "that of (1)"
            " to degree 3",
            energy["(2) printed has an energy"],
        ),
        Claim(
            "2.1, boundary conditions",
            "four conditions on u: u_tt(0), u_x,tt(0), u_xx,tt(L), u_xxx,tt(L) = 0",
            "(1) takes three an end: u = w = theta = 0 and N_x = N_y = theta_x = 0; straight: two for u, "
            "four for w. "
            "u = u_x = 0 at the root of a straight arm leaves u = 0 only",
            False,
        ),
        Claim(
            "2.1, boundary conditions",
            "of the accelerations",
            "of the displacements: a function linear in time at the clamp satisfies the printed ones, "
            "and any shape at rest",
            False,
        ),
        Claim(
            "2.1, boundary conditions",
            '"fixed at one end and free at the other"',
            "u_xx = u_xxx = w_xx = w_xxx = 0 leaves the tip forces EA(u_x + w_x^2/2) and EA u_x w_x",
            False,
        ),
        Claim(
            "2.1, function space",
            "u, w in W^{2,4}",
            "W^{4,2} in the usual order (derivatives, exponent): four derivatives in L2",
            False,
        ),
        Claim(
            "2.2, method",
            "Jacobian linearisation cannot be used for a PDE; epsilon-expansion can",
            "the expansion is the directional derivative, that is the Jacobian's; it is right, the "
            "distinction is not",
            False,
        ),
        Claim(
            "Fig. 2 as setpoints",
            "u_e = 0, w_e satisfies (2) and the boundary conditions",
            "no: axial load up to "
            + ", ".join(f"{v['axial_n_m']:.3g}" for v in needs)
            + " N/m and a tip force of "
            + ", ".join(f"{v['tip_axial_n']:.3g}" for v in needs)
            + " N are missing where the arclength is 1 m; w_e'' is not zero at the tip",
            False,
        ),
        Claim(
            "(3), w: D^3 w",
            "EI u_e' + 3 EI u_e'''",
            "4 EI u_e''. The printed (2) would give EI u_e' + 3 EI u_e'', which is what (5) prints",
            False,
        ),
        Claim(
            "(3), w: D u, D^2 u, D^2 w, D^4 w",
            "follow from the printed (2)",
            "inherit its misprint: EA w_e'' + 2 EI w_e'''', EA w_e' + 4 EI w_e''', EA u_e' + 3 EI u_e''', "
            "-EI + 2 EI u_e'",
            False,
        ),
        Claim(
            "(3), f",
            "the f of (2)",
            "the deviation from the load that holds the setpoint, f_e = EI w_e'''' at u_e = 0",
            False,
        ),
        Claim("(3), u", "five coefficients", "follow from (1)", True),
        Claim(
            "(5), straight arm",
            "u_e = w_e = 0",
            "beam and wave equation: all misprints vanish",
            True,
        ),
        Claim(
            "(5), A_1[2,3]",
            "0",
            "(EA w_e'' + EI w_e'''')/rho, the term of (3) that was forgotten; at u_e = 0 the only error of "
            "the size of EA",
            False,
        ),
        Claim("(5), A_0, B_1, rows 1 to 3 of A_2 to A_4", "as printed", "follow from (1)", True),
        Claim(
            "(5), row 4",
            "A_1[4,1], A_2[4,1], A_2[4,3], A_3[4,3], A_4[4,3]",
            "five entries carry the misprint of (2)",
            False,
        ),
        Claim(
            "(5) at a bend, short waves",
            "a model to design on",
            "ill-posed: growth proportional to k^2 above k = "
            + ", ".join(f"{above[n]:.0f}" for n in above)
            + "/m at the steepest points (slopes "
            + ", ".join(f"{slopes[n]:.2f}" for n in above)
            + "). Never below sqrt(EA/EI) = 80/m, so sqrt(EA/EI)/slope holds for small slopes only",
            False,
        ),
        Claim(
            "(5) at a bend, long waves",
            "describes the arm near the setpoint",
            "waves below k = "
            + ", ".join(f"{below[n]:.0f}" for n in below)
            + "/m grow too, on any grid: degree 2 drops the stiffness EA w_e'^2. Two shapes already grow at "
            + ", ".join(f"{by['cubic'][0]:.3g}" for by in ritz.values())
            + "/s on the whole arm (the last three unstretched); (1) has no growth at any of them",
            False,
        ),
    )
