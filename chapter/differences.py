"""The independent check of the derivation: (1) itself in 60 digits along polynomial displacements.

No computer algebra: u and w are polynomials in x, every quantity of (1) is a truncated Taylor series in x whose
coefficients are decimal numbers, and the degrees in the displacement are told apart by finite differences
in the displacement's size. Shares no code with `chapter.derivation`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Context, Decimal, localcontext

DIGITS = 60
SIZE = Decimal("1e-12")
"""Of a small displacement; what the next degree leaves is SIZE^2 of the result."""
KEPT = 4
"""Taylor coefficients of u_x and w_x that (1) needs: it has four derivatives of each."""
Series = list[Decimal]
Jet = Sequence[float]
"""u_x, u_xx, u_xxx, u_xxxx at one point."""


def _product(a: Series, b: Series) -> Series:
    n = min(len(a), len(b))
    return [sum((a[j] * b[i - j] for j in range(i + 1)), Decimal(0)) for i in range(n)]


def _quotient(a: Series, b: Series) -> Series:
    found: Series = []
    for i in range(min(len(a), len(b))):
        found.append(
            (a[i] - sum((b[j] * found[i - j] for j in range(1, i + 1)), Decimal(0))) / b[0]
        )
    return found


def _root(a: Series) -> Series:
    found = [a[0].sqrt()]
    for i in range(1, len(a)):
        inner = sum((found[j] * found[i - j] for j in range(1, i)), Decimal(0))
        found.append((a[i] - inner) / (2 * found[0]))
    return found


def _rate(a: Series) -> Series:
    return [i * a[i] for i in range(1, len(a))]


def forces(
    u: Sequence[Decimal], w: Sequence[Decimal], axial: int, bending: int
) -> tuple[Decimal, Decimal]:
    """Right sides of (1) at one point, without f, from the derivatives 1 to 4 of u and w there.

    `axial` = 1, `bending` = 0 gives what stands behind EA, the reverse what stands behind EI.
    """
    p = [d / math.factorial(i) for i, d in enumerate(u)]
    q = [d / math.factorial(i) for i, d in enumerate(w)]
    p[0] += 1
    stretch = _root([a + b for a, b in zip(_product(p, p), _product(q, q), strict=True)])
    cosine, sine = _quotient(p, stretch), _quotient(q, stretch)
    # theta_x = cos theta (sin theta)_x - sin theta (cos theta)_x
    bend = [
        a - b
        for a, b in zip(_product(cosine, _rate(sine)), _product(sine, _rate(cosine)), strict=True)
    ]
    strain = [stretch[0] - 1, *stretch[1:]]
    shear = _quotient(_rate(bend), stretch)
    pull, push = _product(strain, cosine), _product(strain, sine)
    return (
        axial * pull[1] + bending * _product(shear, sine)[1],
        axial * push[1] - bending * _product(shear, cosine)[1],
    )


def _at(u: Jet, w: Jet, scale: Decimal, part: tuple[int, int]) -> tuple[Decimal, Decimal]:
    return forces(
        [scale * Decimal(v) for v in u], [scale * Decimal(v) for v in w], part[0], part[1]
    )


def _even(u: Jet, w: Jet, part: tuple[int, int]) -> tuple[Decimal, Decimal]:
    """The terms of degree 2 at a displacement, up to SIZE^2."""
    plus, minus = _at(u, w, SIZE, part), _at(u, w, -SIZE, part)
    return (
        (plus[0] + minus[0]) / (2 * SIZE**2),
        (plus[1] + minus[1]) / (2 * SIZE**2),
    )


def _odd(u: Jet, w: Jet, part: tuple[int, int]) -> tuple[Decimal, Decimal]:
    plus, minus = _at(u, w, SIZE, part), _at(u, w, -SIZE, part)
    return (plus[0] - minus[0]) / (2 * SIZE), (plus[1] - minus[1]) / (2 * SIZE)


def degree_one_and_two(u: Jet, w: Jet) -> dict[str, tuple[float, float]]:
    """Right sides (u, w) of the expansion of (1) to degree 2, split: {"EA": ..., "EI": ...}."""
    with localcontext(Context(prec=DIGITS)):
        found = {}
        for name, part in (("EA", (1, 0)), ("EI", (0, 1))):
            one, two = _odd(u, w, part), _even(u, w, part)
            found[name] = (float(one[0] + two[0]), float(one[1] + two[1]))
        return found


def product_coefficient(
    first: tuple[str, int], other: tuple[str, int]
) -> dict[str, tuple[float, float]]:
    """Factor of the monomial d^i a d^k b, as a = "u", i = 2, in both equations: {"EA": (u, w), "EI": (u, w)}.

    By polarisation: the polynomial x^i / i! has just this one derivative at x = 0.
    """
    one, two = _unit(first), _unit(other)
    both = tuple([a + b for a, b in zip(x, y, strict=True)] for x, y in zip(one, two, strict=True))
    with localcontext(Context(prec=DIGITS)):
        found = {}
        for name, part in (("EA", (1, 0)), ("EI", (0, 1))):
            s, a, b = (_even(x[0], x[1], part) for x in (both, one, two))
            half = 2 if first == other else 1
            found[name] = (
                float((s[0] - a[0] - b[0]) / half),
                float((s[1] - a[1] - b[1]) / half),
            )
        return found


def linear_coefficient(u: Jet, w: Jet, of: tuple[str, int]) -> dict[str, tuple[float, float]]:
    """Coefficient of d^i of u~ or w~ in (3) at a point of the setpoint with these derivatives.

    The degree-2 part of (1) is differentiated by polarisation, exact for a quadratic form.
    """
    unit = _unit(of)
    plus = tuple(
        [a + b for a, b in zip(x, y, strict=True)] for x, y in zip((u, w), unit, strict=True)
    )
    minus = tuple(
        [a - b for a, b in zip(x, y, strict=True)] for x, y in zip((u, w), unit, strict=True)
    )
    with localcontext(Context(prec=DIGITS)):
        found = {}
        for name, part in (("EA", (1, 0)), ("EI", (0, 1))):
            one = _odd(unit[0], unit[1], part)
            p, m = _even(plus[0], plus[1], part), _even(minus[0], minus[1], part)
            found[name] = (float(one[0] + (p[0] - m[0]) / 2), float(one[1] + (p[1] - m[1]) / 2))
        return found


def exact_linear_coefficient(u: Jet, w: Jet, of: tuple[str, int]) -> dict[str, tuple[float, float]]:
    """The same coefficient of (1) itself, nothing truncated: what (3) approximates at the setpoint."""
    unit = _unit(of)
    with localcontext(Context(prec=DIGITS)):
        found = {}
        for name, part in (("EA", (1, 0)), ("EI", (0, 1))):
            ends = []
            for size in (SIZE, -SIZE):
                moved = [
                    [Decimal(a) + size * Decimal(b) for a, b in zip(x, y, strict=True)]
                    for x, y in zip((u, w), unit, strict=True)
                ]
                ends.append(forces(moved[0], moved[1], part[0], part[1]))
            (a, b), (c, d) = ends
            found[name] = (float((a - c) / (2 * SIZE)), float((b - d) / (2 * SIZE)))
        return found


def _unit(which: tuple[str, int]) -> tuple[list[float], list[float]]:
    u, w = [0.0] * KEPT, [0.0] * KEPT
    (u if which[0] == "u" else w)[which[1] - 1] = 1.0
    return u, w
