"""Prose and tables of the page of `chapter.lpi`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from chapter.lpi_gains import DRAG, NOISE
from chapter.lpi_own import RIGHTS
from chapter.markdown import table

if TYPE_CHECKING:
    from chapter.lpi_find import Found
    from chapter.lpi_own import Tried


def _number(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}g}" if math.isfinite(value) else "-"


def _said(tried: Tried) -> str:
    return (
        f"{tried.status}, gamma {tried.gamma:.4f}" if math.isfinite(tried.gamma) else tried.status
    )


def text(found: Found) -> str:
    """The page below its title."""
    return "\n\n".join(
        [
            _posed(found),
            _gains(found),
            _epsilon(found),
            _own(found),
            _why(found),
            _matrices(found),
            _controller(found),
        ]
    )


def _posed(found: Found) -> str:
    storage = table(
        ("cells", "z = N_y(0)", "z = (int v_y, int k)"),
        [(str(n), _number(a), _number(b)) for n, a, b in found.storage],
    )
    return f"""\
All quantities are nondimensional (length L, time tau = L^2 sqrt(rho / EI): 37.5 s, or 846 s with the printed
rho) unless a unit is given. The arm has the drag of examples/chapter_arm.toml (damping ratio 0.1, d =
{DRAG:.3f}); the chapter's has none.

## (18) for the outputs (22), posed so that it has a solution

States are the energy states (v_x, v_y, e, k), x = T f, fundamental state f = (alpha t.v', (n.v')', g), g =
N'. Of the chapter's outputs

- y1 = w(L) is an integral of e and k along the arm: bounded on x;
- y2 = int d_s^4 w ds = -w'''(0) is the root's shear: N_y(0) = -int g_y ds. It is bounded on f, **not on x**;
- z is y2 once more.

As z it has no certificate: <x, P x> has to be at least int |z|^2 dt / gamma from every x, and that grows with
every mode. On grids of the observed arm (setpoint 1, epsilon = 1), the largest int |z|^2 dt from |x0| = 1:

{storage}

What is bounded is its integral over time. The dynamics permute f, A f = (g, alpha p, q) - d (v, 0), so that
the mean of the fundamental state is the rate of the mean of x, up to drag and load: m_t = -N_y(0) - d m + w
with m = int v_y. So z = (int v_y, int k) is certified, and the gain to N_y(0) itself is measured on a grid
(up to frequency 300).

As measurement y2 can be kept as it is. With m among the functionals of P = q I + kappa S + H* W H, the
derivative of <x, P x> contains -2 <x, H* W b> N_y(0), b the place of m. The column of Z for y2 is therefore
**not free**: with Z2 = H* W b the unbounded term drops out, with any other it stays and nothing dominates it.
Z1 is free.

D_21 = 0 in (22) makes the problem singular: gains grow without bound as gamma falls. The noise weights are
{NOISE} on (y1, y2), a tenth of what a unit load does to them. With smaller ones (setpoint 1, count of moments
unchanged):

""" + table(
        ("noise weights times", "gamma certified", "achieved", "norm of L1", "norm of L2"),
        [
            (
                f"{r.noise:g}", _number(r.gamma), _number(r.achieved), _number(r.gain_1),
                _number(r.gain_2),
            )
            for r in found.noises
        ],
    )  # fmt: skip


def _gains(found: Found) -> str:
    rows = [
        (
            g.setpoint, f"{g.epsilon:g}", f"{g.gamma:.4f}", f"{g.achieved:.4f}", f"{g.optimum:.4f}",
            f"{g.open_loop:.3f}", f"{g.root_force:.2f} / {g.root_force_open_loop:.1f}",
            f"{g.first_mode_decay:.2f}", f"{g.undamped_abscissa:.4f}",
        )
        for g in found.gains
    ]  # fmt: skip
    return f"""\
## Gains

    xh_t = A xh + L (C xh - y),   L = P^-1 Z: two columns of four functions of s

Certified: the form of (18), rebuilt by composition from the stored P and L on Legendre functions, has largest
eigenvalue {found.rechecked:.0e} (nothing of the solver's matrices enters). Solved once more, the programs of
setpoint 1 give the stored gamma to {found.again:.0e}. Achieved and optimum (Riccati)
come from staggered differences with the exact angle, refined. Root force: gain from load and noise to the
error of N_y(0), with and without observer. First mode: its decay (half the drag, {0.5 * DRAG:.2f}, without
observer). Undamped: largest real part below frequency 300 if the arm had no drag: negative, although the
certificate needs the drag.

""" + table(
        ("setpoint", "epsilon", "certified", "achieved", "optimum", "open loop", "root force", "first mode",
         "undamped"),
        rows,
    ) + """

![](lpi-gains.png)

At setpoint 3 the tip moves along x and y1 tells little: the first mode stays as it was."""  # fmt: skip


def _epsilon(found: Found) -> str:
    rows = [
        (
            f"{r.epsilon:g}", f"{r.decay_required:g}", f"{r.gamma:.4f}", f"{r.achieved:.4f}",
            f"{r.certified_decay:.4f}", f"{r.first_mode_decay:.2f}", f"{r.slowest_decay:.4f}",
            _number(r.settling), f"{r.gain_1:.1f}", f"{r.gain_2:.1f}", _number(r.largest_p),
        )
        for r in found.rows
    ]  # fmt: skip
    return """\
## Epsilon (section 4.1, last paragraph)

-epsilon T*T promises the decay epsilon / (2 |P|). A larger epsilon raises P with it, so that the promise has
a ceiling; 2 beta T*PT asks for a rate directly. Setpoint 1; settling is the time until the energy norm of the
error of a bent arm at rest stays below 1 % (without observer """ + _number(found.settling) + """):

""" + table(
        ("epsilon", "beta", "certified", "achieved", "certified decay", "first mode", "slowest", "settling",
         "L1", "L2", "|P|"),
        rows,
    ) + """

![](lpi-epsilon.png)

The norm rises with epsilon, as the chapter says, and |L1| a little. The observer does not become faster: what
rises is the promise (each row: least gamma + 5 %, then the least |Z| / delta). The slowest modes are axial,
which the root's shear does not see, and very high ones: they stay at half the drag."""  # fmt: skip


def _own(found: Found) -> str:
    rows = [[name, *(_said(t) for t in tried)] for name, tried in found.solved.items()]
    relaxed = [
        (f"{t.tolerance:g}", t.status, _number(t.gamma), _number(t.eigenvalue), _number(t.on_state))
        for t in found.relaxed
    ]
    return """\
## (18) and (22) letter by letter

States (u, u_t, w, w_t) in L2, f = d_s^4 x, boundary conditions as printed, P = I + Phi* G Phi, Z polynomial,
D_ij = 0, Clarabel. "Generic rows" writes the inequality in multipliers and kernels of f as toolboxes do; the
others in rows of x = T f, on which every solution lies, as T has no multiplier. The first line is a system
with a solution (x_t = -x + w, z = mean of x, norm 1): there -epsilon I fails too, the other two find gamma = 1.

""" + table(("system", *RIGHTS), rows) + """

A toolbox that accepts residuals does return an observer. If the equalities may be violated by a residual,
gamma goes as one over it: no limit (straight beam, right side 0). Violation: largest eigenvalue of the form
relative to |f|^2, and relative to |T f|^2, the norm that counts.

""" + table(("residual", "status", "gamma", "violation / |f|^2", "violation / |T f|^2"), relaxed)  # fmt: skip


def _why(found: Found) -> str:
    null = table(
        ("n", *(f"{name}" for name in found.null)),
        [
            (str(n), *(_number(a.form[k]) for a in found.null.values()))
            for k, n in enumerate(next(iter(found.null.values())).n)
        ],
    )
    root = table(
        ("n", "|T f_n|", *(f"bound, {name}" for name in found.root), "C1 f_n"),
        [
            (
                str(n),
                _number(next(iter(found.root.values())).state[k]),
                *(_number(a.bound[k]) for a in found.root.values()),
                _number(next(iter(found.root.values())).mean[k]),
            )
            for k, n in enumerate(next(iter(found.root.values())).n)
        ],
    )
    conditions = table(
        ("modes", "omega_n^2", "least cond(P), no outputs", "with y of (22), any Z"),
        [
            (str(k + 1), _number(a, 6), _number(b, 6), _number(c))
            for k, (a, b, c) in enumerate(found.conditions)
        ],
    )
    packets = table(
        ("k", "growth, printed", "form, printed", "growth, corrected", "form, corrected", "1 / residual"),
        [
            (
                f"{p.wave_number:g}", _number(p.growth), _number(p.form), _number(c.growth),
                _number(c.form), _number(1.0 / c.residual),
            )
            for p, c in zip(found.packets["printed"], found.packets["corrected"], strict=True)
        ],
    )  # fmt: skip
    return f"""\
## Why it has no solution

Four reasons, each enough, each for every bounded P and Z.

![](lpi-why.png)

**(a) -epsilon I.** T is compact. Along the Legendre functions f_n = phi_n, |f_n| = 1, weakly null,
|form| <= 2 |PA + Z C2| |T f_n| -> 0, and 0 is not below -epsilon. The form for P = I, Z = 0:

{null}

-epsilon T*T goes to zero as fast and is no contradiction.

**(b) P coercive on (w, w_t).** Along a beam mode x = (a, b) phi moves to (b, -omega^2 a) phi. The form is <=
0 for all a, b only if <phi, P_12 phi> = 0 and <phi, P_11 phi> = omega^2 <phi, P_22 phi>: with P_22 >= delta
no bound of P_11 holds. The outputs add phi'''(0) <Z, phi>, of order beta^3, which can weigh beta^3.5 in this
balance: less than omega^2 = beta^4. A program in numbers, with Z free and unbounded, agrees:

{conditions}

In energy states the same modes have <x, x_t> = 0 with P = I.

**(c) C1 of (22).** f_n = (n + 1)(1 - s)^n in w has mean one and |T f_n| -> 0 so fast that the rest of the form
vanishes: with z = 1 / gamma what is left is -gamma z^2 + 2 z = 1 / gamma > 0. Bound: 2 |T f_n| (|A f_n| + |C2
f_n|), to be multiplied by the larger of |P| and |Z|; it falls as n^(-3/2).

{root}

**(d) Curved setpoints.** Wave packets x = r exp(-(s - 1/2)^2 / 2 width^2 + i k s), width 0.3 k^-1/2, r the
eigenvector of the local symbol with the largest growth; they vanish at both ends, so y = 0 and z = 0 and no Z
helps. x_t = growth x + a residual that falls relative to it: for 1 <= P <= M the form is positive as soon as
M < 1 / residual. Setpoint 1, P = I:

{packets}"""


def _matrices(found: Found) -> str:
    from chapter.lpi_find import kept

    rows = [(name, f"{kept(c)[0]} of {kept(c)[1]}") for name, c in found.matrices.items()]
    return """\
## (18) and (21) on matrices

T an invertible matrix, random plants of order 3; gamma is minimised and the norm of the closed loop computed
from the matrices. "Kept": the norm is not above gamma.

""" + table(("inequality", "promises kept"), rows) + """

(18): the order of T and of the adjoints is right, and C_1 stands without a star as the row of z; only
-epsilon I is wrong. (21): with V = <T*x, P T*x> for the dual system, V_t = 2 <x, T (AP + B2 Z)* x> + 2 <x, T
(C1 P + D12 Z)* w>. The last block is printed right. The row of C1 lacks T and a star, (C1 P + D12 Z) T*; D11
and B1 have their stars exchanged (rows are sorted w, z of the dual), which only shows if z and w differ in
size. And K = Z P^-1 acts on f: for the arm on d_s^4 of the state, no measurement. The dual of a clamped arm
under a uniform load has the trap of theory, 3.
"""  # fmt: skip


def _controller(found: Found) -> str:
    rows = [
        (
            f"{c.effort:g}", f"{c.gamma:.4f}", f"{c.achieved:.4f}", f"{c.optimum:.4f}",
            f"{c.open_loop:.3f}", f"{c.first_mode_decay:.2f}", _number(c.gain),
        )
        for c in found.controllers
    ]  # fmt: skip
    return """\
## A controller (20)

u = K x, a uniform load u beside the disturbance, z = (int v_y, int k, effort u), setpoint 1. In energy states
the adjoint system has the same T, so the controller is the observer of the adjoint system from B2* x = int v_y,
K = L*: it acts on x, no derivative is taken. The chapter's z, the mean of f, has no certificate here either
(above). `octarm design` does the same with a force on every segment.

""" + table(
        ("effort", "certified", "achieved", "optimum", "open loop", "first mode", "norm of K"), rows
    )
