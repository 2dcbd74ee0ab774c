"""The claims of sections 3.4 to 4.1 that `chapter.lpi` looks at, one by one, and what became of each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from chapter.lpi_gains import EPSILONS, NOISE
from chapter.part import Claim

if TYPE_CHECKING:
    from chapter.lpi_find import Found


def claims(found: Found) -> tuple[Claim, ...]:
    """What the chapter says and what became of it."""
    from chapter.lpi_find import kept

    beam = found.conditions[-1]
    null = next(iter(found.null.values()))
    packet = found.packets["corrected"][-1]
    rows = [r for r in found.rows if r.decay_required == 0.0]
    right, derived = (
        kept(found.matrices["(21) as printed"]),
        kept(found.matrices["(21) as derived"]),
    )
    order = kept(found.matrices["(18) as printed, without -eps I"])
    return (
        Claim(
            "(18), right side",
            "<= -epsilon I",
            f"<= -epsilon T*T or <= 0: T is compact, along phi_{null.n[-1]} the form is {null.form[-1]:.0e}",
            holds=False,
        ),
        Claim(
            "(18), order of T and adjoints, C_1 without star",
            "(PA + ZC2)*T + T*(PA + ZC2), -(PB + ZD21)*T, C_1",
            f"right: on matrices the promise is kept in {order[0]} of {order[1]} random plants",
            holds=True,
        ),
        Claim(
            "(18) for states (w, w_t) in L2",
            "P coercive and bounded",
            f"infeasible: {len(found.conditions)} beam modes need cond(P) >= {beam[1]:.0f} = omega^2",
            holds=False,
        ),
        Claim(
            "(18) with C_1 of (22)",
            "z = mean of d_s^4 x",
            "infeasible for every gamma: not bounded by |T f|; the mean of x, its integral over time, is",
            holds=False,
        ),
        Claim(
            "(18) at curved setpoints",
            "feasible",
            f"waves of k = {packet.wave_number:g} grow at {packet.growth:.1e} and are seen by no output",
            holds=False,
        ),
        Claim(
            "(22), C_1 and C_2",
            "P{0, I, I} and P{0, C_2, C_2} with C_2 = [G_1(L, .); I]",
            "the mean of f and x(L), checked by integration; they are 4 and 8 numbers, not the 1 and 2 of 4.1",
            holds=True,
        ),
        Claim(
            "(22), D_ij = 0",
            "no noise",
            f"singular; weights {NOISE} on (y1, y2) are used",
            holds=False,
        ),
        Claim(
            "(22), y2 as a measurement",
            "any Z",
            "unbounded on x: its column of Z must be P's image of the momentum, then (18) closes",
            holds=False,
        ),
        Claim(
            "(21), row of C1",
            "P C1* + Z* D12*",
            f"(C1 P + D12 Z) T*: on matrices the promise is kept in {right[0]} of {right[1]} plants as "
            f"printed, in {derived[0]} of {derived[1]} as derived",
            holds=False,
        ),
        Claim(
            "(21), D11* and B1",
            "-gamma I, D11*, ... ; -gamma I, B1",
            "D11 and B1*: rows are the regulated output's, then the disturbance's",
            holds=False,
        ),
        Claim(
            "(21), last block",
            "T (AP + B2 Z)* and its adjoint",
            "right",
            holds=True,
        ),
        Claim(
            "3.5.2, u = Z P^-1 x",
            "state feedback",
            "it acts on the fundamental state, here d_s^4 of the state",
            holds=False,
        ),
        Claim(
            "4.1, large epsilon",
            "the observer converges faster",
            f"promised decay {rows[0].certified_decay:.4f} -> {rows[-1].certified_decay:.4f}, but the "
            f"first mode's is {rows[0].first_mode_decay:.2f} -> {rows[-1].first_mode_decay:.2f}, "
            f"settling {rows[0].settling:.2f} -> {rows[-1].settling:.2f}",
            holds=False,
        ),
        Claim(
            "4.1, large epsilon",
            "higher H-infinity norm, high gains",
            f"gamma {rows[0].gamma:.3f} -> {rows[-1].gamma:.3f}, achieved {rows[0].achieved:.3f} -> "
            f"{rows[-1].achieved:.3f}; |L1| {rows[0].gain_1:.1f} -> {rows[-1].gain_1:.1f}, |L2| "
            f"{rows[0].gain_2:.1f} -> {rows[-1].gain_2:.1f}",
            holds=True,
        ),
        Claim(
            "4.1, an observer for each setpoint",
            "by (18)",
            "in the feasible form: certified "
            + ", ".join(
                f"{g.gamma:.4f}" for g in found.gains if math.isclose(g.epsilon, EPSILONS[1])
            )
            + ", open loop "
            + ", ".join(
                f"{g.open_loop:.2f}" for g in found.gains if math.isclose(g.epsilon, EPSILONS[1])
            ),
            holds=True,
        ),
    )
