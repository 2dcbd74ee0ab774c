"""Equations (1) to (5) derived with sympy: Taylor expansion to degree 2, linearisation, state form, energy.

Everything is done in jets: u1 stands for u_x, w4 for w_xxxx, and D is the total derivative by x. The strings of
`chapter.printed` become expressions in the same symbols, so that both can be compared term by term.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import sympy as sp

from chapter import printed
from chapter.printed import Equation

Expression = Any
"""A sympy expression; sympy has no types."""
ORDERS = 9
EA, EI = sp.symbols("EA EI", positive=True)
U = sp.symbols(f"u0:{ORDERS}", real=True)
W = sp.symbols(f"w0:{ORDERS}", real=True)
UE = sp.symbols(f"ue0:{ORDERS}", real=True)
WE = sp.symbols(f"we0:{ORDERS}", real=True)
JETS: dict[Equation, tuple[Any, ...]] = {"u": U, "w": W}
SETPOINT: dict[Equation, tuple[Any, ...]] = {"u": UE, "w": WE}
EQUATIONS: tuple[Equation, ...] = ("u", "w")
STATES: tuple[Equation | None, ...] = ("u", None, "w", None)
"""Columns of (5) that carry a displacement; the others carry its velocity."""
INPUT = tuple("1" if row == 3 else "0" for row in range(4))
"""rho B_1 from (1): f is a force per length in the second equation alone, which gives x_4 = w~_t its rate."""


def total_derivative(f: Expression, times: int = 1) -> Expression:
    """D^times f by x, along the jets."""
    for _ in range(times):
        f = sum(
            sp.diff(f, jet[i]) * jet[i + 1] for jet in (U, W, UE, WE) for i in range(ORDERS - 1)
        )
    return f


D = total_derivative

STRETCH = sp.sqrt((1 + U[1]) ** 2 + W[1] ** 2)
"""1 + e of section 2.1."""
ANGLE = sp.atan(W[1] / (1 + U[1]))
COSINE, SINE = (1 + U[1]) / STRETCH, W[1] / STRETCH


@cache
def exact_flux() -> dict[Equation, Expression]:
    """What (1) takes the x-derivative of: rho u_tt = D(flux of u), rho w_tt = D(flux of w) + f."""
    e, second = STRETCH - 1, D(ANGLE, 2)
    return {
        "u": EA * e * COSINE + EI * second * SINE / STRETCH,
        "w": EA * e * SINE - EI * second * COSINE / STRETCH,
    }


@cache
def exact_energy() -> Expression:
    """Energy per length of which (1) is the Euler-Lagrange equation: EA e^2 / 2 + EI theta_x^2 / 2."""
    return EA * (STRETCH - 1) ** 2 / 2 + EI * D(ANGLE) ** 2 / 2


def truncated(f: Expression, degree: int) -> Expression:
    """Taylor polynomial of f about zero displacement, of that total degree in u, w and their derivatives."""
    size = sp.Symbol("size", positive=True)
    scaled = f.subs({a: size * a for jet in (U, W) for a in jet}, simultaneous=True)
    terms = 0
    for order in range(degree + 1):
        terms += scaled.subs(size, 0) / sp.factorial(order)
        scaled = sp.diff(scaled, size)
    return sp.expand(terms)


@cache
def second() -> dict[Equation, Expression]:
    """Right sides of (2) as (1) gives them, all terms right of rho u_tt and rho w_tt, without f."""
    return {q: sp.expand(D(truncated(flux, 2))) for q, flux in exact_flux().items()}


@cache
def printed_second() -> dict[Equation, Expression]:
    """Right sides of (2) as printed, in the same arrangement."""
    return {
        q: sp.expand(sum(read(t) for t in printed.SECOND[q]) - read(printed.SECOND_LEFT[q]))
        for q in EQUATIONS
    }


def read(text: str) -> Expression:
    """A string of `chapter.printed` as an expression."""
    names = {str(a): a for jet in (U, W, UE, WE) for a in jet}
    return sp.sympify(text, locals={**names, "EA": EA, "EI": EI, "D": D})


def linearised(
    right: Mapping[Equation, Expression],
) -> dict[Equation, dict[tuple[Equation, int], Expression]]:
    """Coefficients of the deviations' derivatives at (u_e, w_e), the terms of first degree in epsilon (2.2)."""
    epsilon = sp.Symbol("epsilon")
    moved = {JETS[q][i]: SETPOINT[q][i] + epsilon * JETS[q][i] for q in EQUATIONS for i in range(9)}
    found: dict[Equation, dict[tuple[Equation, int], Expression]] = {}
    for row, f in right.items():
        first = sp.expand(sp.diff(f.subs(moved, simultaneous=True), epsilon).subs(epsilon, 0))
        parts = {(q, i): first.coeff(JETS[q][i]) for q in EQUATIONS for i in range(ORDERS)}
        found[row] = {key: value for key, value in parts.items() if value != 0}
        rest = first - sum(c * JETS[q][i] for (q, i), c in found[row].items())
        if sp.expand(rest) != 0:
            raise ArithmeticError(f"equation {row}: not linear in the deviations: {rest}")
    return found


@cache
def third() -> dict[Equation, dict[tuple[Equation, int], Expression]]:
    """(3) as (1) gives it."""
    return linearised(second())


def printed_third() -> dict[Equation, dict[tuple[Equation, int], Expression]]:
    """(3) as printed."""
    return {q: {k: read(t) for k, t in row.items()} for q, row in printed.THIRD.items()}


def state_form(
    coefficients: Mapping[Equation, Mapping[tuple[Equation, int], Expression]],
) -> tuple[Any, ...]:
    """(A_0, ..., A_4) of (4) times rho where (5) has 1 / rho, sympy matrices 4 x 4."""
    found = []
    for order in range(5):
        matrix = sp.zeros(4, 4)
        if order == 0:
            matrix[0, 1] = matrix[2, 3] = 1
        for row, equation in ((1, "u"), (3, "w")):
            for column, displacement in enumerate(STATES):
                if displacement is not None:
                    matrix[row, column] = coefficients[equation].get((displacement, order), 0)  # type: ignore[index]
        found.append(matrix)
    return tuple(found)


def printed_state_form() -> tuple[Any, ...]:
    """The matrices of (5) as printed, in the same arrangement."""
    return tuple(sp.Matrix(4, 4, [read(t) for row in rows for t in row]) for rows in printed.FIFTH)


@dataclass(frozen=True)
class Term:
    """One coefficient, printed beside derived."""

    where: str
    """As "w: u2 w3" for (2), "w: D^3 u" for (3), "A_3[4,1]" for (5); rows and columns from 1."""
    printed: str
    follows: str
    """For (3) and (5): what the chapter's own preceding equation gives; for (2): as derived."""
    derived: str

    @property
    def right(self) -> bool:
        """Whether the printed coefficient is what (1) gives."""
        return self.printed == self.derived


def compare_second() -> tuple[Term, ...]:
    """Every monomial that (2) has, printed or derived."""
    terms = []
    for q in EQUATIONS:
        ours, theirs = (sp.Poly(f[q], *U[1:5], *W[1:5]) for f in (second(), printed_second()))
        for powers in sorted({*ours.monoms(), *theirs.monoms()}, key=lambda m: (sum(m), m)):
            name = " ".join(
                str(a) for a, n in zip((*U[1:5], *W[1:5]), powers, strict=True) for _ in range(n)
            )
            a, b = theirs.coeff_monomial(powers), ours.coeff_monomial(powers)
            terms.append(Term(f"{q}: {name}", text(a), text(b), text(b)))
    return tuple(terms)


def compare_third() -> tuple[Term, ...]:
    """Every coefficient of (3), beside what the printed and the derived (2) give."""
    theirs, own, ours = printed_third(), linearised(printed_second()), third()
    terms = []
    for q in EQUATIONS:
        for key in sorted({*theirs[q], *own[q], *ours[q]}):
            a, b, c = (text(f[q].get(key, sp.Integer(0))) for f in (theirs, own, ours))
            terms.append(Term(f"{q}: D^{key[1]} {key[0]}", a, b, c))
    return tuple(terms)


def compare_fifth() -> tuple[Term, ...]:
    """Every entry of (5), beside what the printed (3) and the derivation give; zeros of all three left out."""
    theirs, own, ours = printed_state_form(), state_form(printed_third()), state_form(third())
    terms = []
    for order, matrices in enumerate(zip(theirs, own, ours, strict=True)):
        for i in range(4):
            for k in range(4):
                a, b, c = (text(m[i, k]) for m in matrices)
                if {a, b, c} != {"0"}:
                    terms.append(Term(f"A_{order}[{i + 1},{k + 1}]", a, b, c))
    for i, (entry, ours_i) in enumerate(zip(printed.INPUT, INPUT, strict=True)):
        if (entry, ours_i) != ("0", "0"):
            terms.append(Term(f"B_1[{i + 1}]", entry, ours_i, ours_i))
    return tuple(terms)


def text(expression: Expression) -> str:
    """A coefficient in the chapter's words, terms in one order: "EA w_e'' + 2 EI w_e''''"."""
    expression = sp.expand(expression)
    parts = []
    for term in sorted(expression.as_ordered_terms(), key=_place):
        factor, rest = term.as_coeff_Mul()
        names = [_name(a) for a in sorted(rest.as_ordered_factors(), key=str) if a != 1]
        size = "" if abs(factor) == 1 and names else f"{abs(factor)} "
        parts.append(("- " if factor < 0 else "+ ") + (size + " ".join(names)).strip())
    joined = " ".join(parts)
    return joined.removeprefix("+ ") if joined.startswith("+") else joined.replace("- ", "-", 1)


def _place(term: Expression) -> tuple[int, int, str]:
    symbols = {str(a) for a in term.free_symbols}
    orders = [int(s[-1]) for s in symbols if s[-1].isdigit()]
    return (0 if "EA" in symbols else 1, max(orders, default=0), str(term))


def _name(symbol: Expression) -> str:
    name = str(symbol)
    if name[-1].isdigit():
        base = name[:-1].replace("e", "_e")
        return base + "'" * int(name[-1])
    return name


def euler(density: Expression) -> dict[Equation, Expression]:
    """Minus the variational derivative of int density dx: the force per length that the energy makes.

    For densities in u_x, w_x, u_xx, w_xx.
    """
    return {q: D(sp.diff(density, JETS[q][1]) - D(sp.diff(density, JETS[q][2]))) for q in EQUATIONS}


def tip_conditions(density: Expression) -> dict[str, Expression]:
    """What the variation leaves at an end: factors of delta u, delta w ("force") and delta u_x, delta w_x."""
    found: dict[str, Expression] = {}
    for q in EQUATIONS:
        found[f"force {q}"] = sp.diff(density, JETS[q][1]) - D(sp.diff(density, JETS[q][2]))
        found[f"couple {q}"] = sp.diff(density, JETS[q][2])
    return found


def vanishes(expression: Expression) -> bool:
    """Whether an expression with powers of 1 + e is zero, by a rational parametrisation of 1 + u_x and w_x.

    1 + u_x = g (1 - m^2) / (1 + m^2), w_x = 2 g m / (1 + m^2) with g, m > 0 makes 1 + e = g, and everything
    rational; an analytic function that vanishes for all such g and m vanishes.
    """
    g, m = sp.symbols("g m", positive=True)
    on_circle = {U[1]: g * (1 - m**2) / (1 + m**2) - 1, W[1]: 2 * g * m / (1 + m**2)}

    def is_root(a: Expression) -> bool:
        return bool(a.is_Pow and a.exp.is_Rational and not a.exp.is_Integer)

    def rooted(a: Expression) -> Expression:
        return sp.sqrt(sp.factor(a.base)) ** (2 * a.exp)

    return bool(sp.cancel(sp.together(expression.subs(on_circle).replace(is_root, rooted))) == 0)


def is_gradient(right: Mapping[Equation, Expression]) -> bool:
    """Whether the forces come from any energy: their linearisation is formally self-adjoint (Helmholtz)."""
    rows = linearised(right)
    for p in EQUATIONS:
        for q in EQUATIONS:
            # adjoint of sum_j c_j D^j: sum_j (-D)^j (c_j .), expanded by Leibniz
            adjoint = {j: sp.Integer(0) for j in range(ORDERS)}
            for (name, j), c in rows[q].items():
                if name == p:
                    for i in range(j + 1):
                        adjoint[i] += (-1) ** j * sp.binomial(j, i) * D(c, j - i)
            for j in range(ORDERS):
                if sp.expand(adjoint[j] - rows[p].get((q, j), 0)) != 0:
                    return False
    return True
