"""Sections 3.4.1 and 3.5.1 reproduced: LMI (16) and the LMI under (19) on random systems, against Riccati
equations and python-control.

Between the LMIs (`chapter.ode_lmi`), their references (`chapter.ode_reference`) and the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from chapter import markdown
from chapter.ode_figures import gammas
from chapter.ode_lmi import (
    PRINTED,
    Found,
    Signs,
    System,
    observer_matrix,
    random_system,
    smallest_gain,
    solve_controller,
    solve_observer,
)
from chapter.ode_reference import (
    control_norm,
    feedback_plant,
    filter_plant,
    have_control,
    hinf_norm,
    hinfsyn,
    riccati_controller,
    riccati_observer,
)
from chapter.part import Claim, Part, Tell
from chapter.rounding import significant

SIZES = (2, 3, 4, 5, 6)
HINFSYN_UP_TO = 4
"""States; beyond that `control.hinfsyn` tells a gamma that its own loop does not have, or does not come
back."""
VARIANTS = {
    "as printed": PRINTED,
    "D_11 and P B turned (w to -w)": Signs(d11=-1, pb=-1),
    "P B and C_1 turned (e to x - xh)": Signs(pb=-1, c1=-1),
    "D_11 alone turned": Signs(d11=-1),
    "P B + Z D_21 alone turned": Signs(pb=-1),
    "C_1 alone turned": Signs(c1=-1),
    "P B - Z D_21": Signs(noise=-1),
}
SINGULAR_GAMMAS = (1.0, 0.1, 0.01, 0.001)


@dataclass(frozen=True)
class Row:
    """One LMI on one system."""

    problem: str
    """"observer" or "controller"."""
    n: int
    stable: bool
    feedthrough: bool
    """Whether D_11 is not zero."""
    least: float
    """The solver's."""
    certified: float
    smallest_of_p: float
    largest_of_lmi: float
    achieved: float
    """By Hamiltonian bisection."""
    control_norm: float | None
    """By slycot's ab13dd."""
    riccati: float
    hinfsyn: tuple[float, float] | None
    """What `control.hinfsyn` tells, and the norm of the loop that it returns."""


def seed_of(n: int, *, stable: bool, feedthrough: bool) -> int:
    """The systems of the table."""
    return 100 * n + 10 * stable + feedthrough


def rows(s: System, n: int, *, stable: bool, feedthrough: bool, others: bool) -> list[Row]:
    """Both LMIs on one system; `others`: python-control is there and asked."""
    found: list[tuple[str, Found, Any, float, Any]] = []
    observer, controller = solve_observer(s), solve_controller(s)
    loop = s.error_system(observer.gain)
    plant = filter_plant(s) if stable else None
    found.append(("observer", observer, loop, riccati_observer(s), plant))
    loop = s.closed_loop(controller.gain)
    found.append(("controller", controller, loop, riccati_controller(s), feedback_plant(s)))
    return [
        Row(
            problem,
            n,
            stable,
            feedthrough,
            lmi.least,
            lmi.gamma,
            lmi.smallest_of_p,
            lmi.largest_of_lmi,
            hinf_norm(closed),
            control_norm(closed) if others else None,
            riccati,
            hinfsyn(given) if others and given is not None and n <= HINFSYN_UP_TO else None,
        )
        for problem, lmi, closed, riccati, given in found
    ]


def sign_table(s: System) -> dict[str, tuple[float, float]]:
    """By variant: the gamma that the LMI promises, and the norm of (15) with the gain that it gives."""
    out = {}
    for name, signs in VARIANTS.items():
        found = solve_observer(s, signs)
        out[name] = (found.gamma, hinf_norm(s.error_system(found.gain)))
    return out


def signs_system() -> System:
    """Three states and a D_11 that matters."""
    s = random_system(311, stable=True, n=3, feedthrough=True)
    return replace(s, D11=5.0 * s.D11)


def scalar(a: float, b1: float, c1: float, d11: float, *, d12: float = 0.0) -> System:
    """One state, one signal each; u drives it with 1, nothing is measured."""

    def number(value: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.array([[value]])

    zero = number(0.0)
    return System(
        number(a), number(b1), number(c1), number(d11), number(1.0), number(d12), zero, zero
    )


def not_necessary() -> tuple[float, float]:
    """x_t = -x + w, z = w: the error z_e = -w of any observer has norm 1. Least over P of the largest
    eigenvalue
    of (16) at gamma = 1: positive for every P > 0. Returns (norm, that eigenvalue relative to P)."""
    s = scalar(-1.0, 1.0, 0.0, 1.0)
    none = np.zeros((1, 1))
    at = [
        float(np.linalg.eigvalsh(observer_matrix(s, np.array([[p]]), none, 1.0))[-1]) / p
        for p in np.geomspace(1e-4, 1e4, 81)
    ]
    return hinf_norm(s.error_system(none)), min(at)


def not_sufficient() -> tuple[float, float]:
    """x_t = 0, nothing measured, z = 0: (16) with P = 1, Z = 0 holds for every gamma. Returns the largest
    eigenvalue at gamma = 0.001 and the rightmost eigenvalue of A + L C_2: the error stays as it is."""
    s = scalar(0.0, 0.0, 0.0, 0.0)
    none = np.zeros((1, 1))
    matrix = observer_matrix(s, np.eye(1), none, 1e-3)
    return float(np.linalg.eigvalsh(matrix)[-1]), float(np.linalg.eigvals(s.A).real.max())


def singular() -> list[tuple[float, float, float]]:
    """x_t = x + w + u, z = x (D_12 = 0): (gamma, K, norm of the loop) for smaller and smaller gamma."""
    s = scalar(1.0, 1.0, 1.0, 0.0)
    out = []
    for gamma in SINGULAR_GAMMAS:
        K = smallest_gain(s, gamma)
        out.append((gamma, float(K[0, 0]), hinf_norm(s.closed_loop(K))))
    return out


def _shown(row: Row) -> Row:
    """With as many digits as every machine gives: of eigenvalues the first, of what sb10ad has two."""
    return replace(
        row,
        **significant(
            {
                "least": row.least,
                "certified": row.certified,
                "achieved": row.achieved,
                "riccati": row.riccati,
            },
            4,
        ),
        smallest_of_p=significant(row.smallest_of_p, 1),
        largest_of_lmi=significant(row.largest_of_lmi, 1),
        control_norm=None if row.control_norm is None else significant(row.control_norm, 4),
        hinfsyn=None if row.hinfsyn is None else tuple(significant(list(row.hinfsyn), 3)),
    )


def part(tell: Tell) -> Part:
    """Everything that the chapter says of ordinary differential equations, checked."""
    others = have_control()
    table: list[Row] = []
    for n in SIZES:
        tell(f"ode: LMIs on systems of {n} states")
        for stable, feedthrough in ((True, False), (False, False), (True, True), (False, True)):
            seed = seed_of(n, stable=stable, feedthrough=feedthrough)
            s = random_system(seed, stable=stable, n=n, feedthrough=feedthrough)
            table += rows(s, n, stable=stable, feedthrough=feedthrough, others=others)
    tell("ode: signs of (16), limits of the LMIs")
    signs = sign_table(signs_system())
    necessary, sufficient, without = not_necessary(), not_sufficient(), singular()
    worst = max(abs(row.least / row.riccati - 1.0) for row in table)
    above = max(row.achieved / row.certified - 1.0 for row in table)
    figure = gammas(table, without)
    table = [_shown(row) for row in table]
    numbers = {
        "worst_against_riccati": significant(worst, 1),
        "worst_achieved_over_certified": significant(above, 1),
        "signs": {name: list(pair) for name, pair in signs.items()},
        "not_necessary": list(necessary),
        "not_sufficient": list(sufficient),
        "singular": [list(one) for one in without],
    }
    facts: dict[str, Any] = {"rows": [asdict(row) for row in table], **significant(numbers, 4)}
    wrong = {k: v for k, v in signs.items() if v[1] > v[0] * (1.0 + 1e-6)}
    claims = (
        Claim(
            "(15)",
            "error dynamics with e = xh - x",
            "right: subtract (13) from (14)",
            holds=True,
        ),
        Claim(
            "(16)",
            "LMI for the observer; C_1 in the (2, 3) block without transpose",
            f"right: rows are those of z_e. {len(table) // 2} systems, gamma equal to the Riccati "
            f"equation's to {worst:.0e}",
            holds=True,
        ),
        Claim(
            "(16), signs",
            "-D_11', -(P B + Z D_21)', +C_1",
            "only their product matters; one of them alone turned is wrong if D_11 is not zero. P B - Z D_21 "
            f"promises {wrong['P B - Z D_21'][0]:.3f} and gives {wrong['P B - Z D_21'][1]:.3f}"
            if "P B - Z D_21" in wrong
            else "",
            holds=True,
        ),
        Claim(
            '(16), "necessary and sufficient" for norm <= gamma',
            "P > 0 and <= 0",
            "the bounded real lemma needs < 0 for norm < gamma and convergence: x_t = -x + w, z = w "
            "has norm 1 and no P > 0 at gamma = 1; x_t = 0, z = 0 meets <= 0 and its error stays",
            holds=False,
        ),
        Claim(
            '(16), "H-infinity-optimal"',
            "the least gamma is attained",
            "only approached: gains of some thousand a per mille above it; take the gain a little above",
            holds=False,
        ),
        Claim(
            "LMI under (19)",
            "u = Z P^-1 x",
            "right, D_11 and D_12 included; as printed, with <= 0, it gives the norm, and stability "
            "only with < 0",
            holds=True,
        ),
        Claim(
            "(13), (19), dimensions",
            "B, C_i, D_ij, L, Z map from or to R",
            "nothing needs that: the table has three disturbances, two measurements, two controls",
            holds=False,
        ),
    )
    return Part(
        key="ode",
        title="LMIs for ordinary differential equations",
        section="3.4.1, 3.5.1",
        text=_text(facts, table),
        claims=claims,
        figures={"ode-gammas.png": figure},
        facts=facts,
    )


def _systems(rows: Sequence[Row]) -> str:
    """Table of the random systems."""
    head = (
        "",
        "n",
        "stable",
        "D_11",
        "least gamma",
        "certified",
        "min eig P",
        "max eig LMI",
        "achieved",
        "ab13dd",
        "Riccati",
        "hinfsyn tells / has",
    )
    cells = [
        (
            row.problem,
            row.n,
            "yes" if row.stable else "no",
            "yes" if row.feedthrough else "0",
            f"{row.least:.4g}",
            f"{row.certified:.4g}",
            f"{row.smallest_of_p:.0e}",
            f"{row.largest_of_lmi:.0e}",
            f"{row.achieved:.4g}",
            "-" if row.control_norm is None else f"{row.control_norm:.4g}",
            f"{row.riccati:.4g}",
            "-" if row.hinfsyn is None else f"{row.hinfsyn[0]:.3g} / {row.hinfsyn[1]:.3g}",
        )
        for row in rows
    ]
    return markdown.table(head, cells)


def _text(facts: dict[str, Any], rows: Sequence[Row]) -> str:
    signs = markdown.table(
        ("signs", "promised", "achieved"),
        [(name, f"{pair[0]:.4g}", f"{pair[1]:.4g}") for name, pair in facts["signs"].items()],
    )
    low = markdown.table(
        ("gamma", "K", "achieved"),
        [(f"{g:g}", f"{K:.2f}", f"{norm:.4f}") for g, K, norm in facts["singular"]],
    )
    norm, eigenvalue = facts["not_necessary"]
    return f"""## What was solved

(16) and the LMI under (19) in CVXPY with Clarabel, for random systems with three disturbances, two
measurements, two controls and three regulated outputs; the rightmost pole is at -0.3 or +0.5. First the least
gamma; then, a per mille above it (up to a per cent, if the numbers ask for it), the P and Z that lie deepest
inside both inequalities. The solver's status is not used: P and Z are put into the printed matrix again, and
its largest eigenvalue must be negative ("certified"). The gain's norm is then found from (15) or from (19)
with u = K x.

What it is compared with, none of which shares code with it: the game Riccati equation by `scipy` (for the
observer that of the dual system) with bisection on gamma; the norm by bisection with Hamiltonian matrices,
and by slycot's ab13dd through python-control; `control.hinfsyn` (slycot's sb10ad) on the filter problem z_e =
z - u for stable systems, and on state feedback with 1e-4 of noise on the measured state.

{_systems(rows)}

![Gammas of the LMIs against the Riccati equation, and gains without D_12](ode-gammas.png)

The largest difference of least gamma and Riccati equation is {facts["worst_against_riccati"]:.0e}; no
achieved norm is above its certified gamma (largest achieved / certified - 1:
{facts["worst_achieved_over_certified"]:.0e}).

Where sb10ad can be trusted, any causal filter does no better than an observer of the form (14), although that
has no feedthrough from y to the estimate. But sb10ad is no reference everywhere: with D_11 it can tell a
gamma that the loop that it returns does not have (last column), in trials with five states and more also
without, and for some unstable systems it does not come back. Riccati equation and LMI agree there.

## Letter by letter

(15) is right. (16) is the bounded real lemma with rows in the order (w, z_e, e): the (1, 2) block takes z_e
to w, so D_11 has a transpose; the (2, 3) block takes e to z_e, so C_1 has none. Signs: a congruence with
diag(+-1) turns two of the three off-diagonal blocks at once (w to -w, or e = x - xh), so only their product
matters, and if D_11 = 0 not even that. The sign between P B and Z D_21 is that of L in (14) and does matter.
Three states, D_11 of norm 1.2:

{signs}

With one block alone turned the promise still holds here, but for another problem: it is not the optimum. With
P B - Z D_21 the promise is false.

Under (19) the state comes first; P is now the inverse of the storage function's matrix, Z = K P. All blocks
are right.

## Necessary and sufficient

With < 0 both LMIs are equivalent to: the loop is Hurwitz and its norm is below gamma. As printed, with <= 0 and
norm <= gamma, neither direction holds:

- x_t = -x + w, z = w, nothing measured: norm {norm:.3f}, but at gamma = 1 the largest eigenvalue of (16) is
  positive for every P > 0 (at least {eigenvalue:.2e} P between 1e-4 and 1e4).
- x_t = 0, z = 0, nothing measured: P = 1, Z = 0 meet (16) for every gamma, and the error never changes.

The infimum over gamma is the same for both readings, and in general not attained: gains grow as it is
approached. Nothing optimal can therefore be built, only something a per mille worse.

## Without D_12

The LMI under (19) assumes nothing about D_12; the Riccati equation needs it to have full column rank,
and sb10ad assumes the same. For x_t = x + w + u, z = x every gamma > 0 is possible with K = -(1 + 1 /
gamma), and that is what the LMI gives with P = 1; the least gamma is 0, at an infinite gain. A user sees it
as gains that grow with every digit of the solver's tolerance: put the effort into z.

{low}
"""
