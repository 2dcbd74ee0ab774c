"""Arithmetic of polynomials in s as tuples of coefficients, for the reader of problem files.

Coefficients are those of 1, s, s^2, ..., without trailing zeros; () is zero. Overflow gives infinities, which
the caller looks for.
"""

from __future__ import annotations

from collections.abc import Sequence
from sys import float_info

from design.pde.model import Polynomial

CANCELLED = 4.0 * float_info.epsilon
"""A sum this small against its terms is rounding, and taken as zero."""


def trimmed(coefficients: Sequence[float]) -> Polynomial:
    """Without trailing zeros."""
    size = len(coefficients)
    while size and coefficients[size - 1] == 0.0:
        size -= 1
    return tuple(coefficients[:size])


def add(left: Polynomial, right: Polynomial) -> Polynomial:
    """Sum; coefficients that cancel up to rounding become exactly zero, so that terms vanish as on paper."""
    size = max(len(left), len(right))
    pairs = zip(
        left + (0.0,) * (size - len(left)), right + (0.0,) * (size - len(right)), strict=True
    )
    return trimmed(
        [0.0 if abs(a + b) < CANCELLED * max(abs(a), abs(b)) else a + b for a, b in pairs]
    )


def multiply(left: Polynomial, right: Polynomial) -> Polynomial:
    """Product."""
    if not left or not right:
        return ()
    out = [0.0] * (len(left) + len(right) - 1)
    for i, a in enumerate(left):
        for j, b in enumerate(right):
            out[i + j] += a * b
    return trimmed(out)


def power(base: Polynomial, exponent: int) -> Polynomial:
    """base to a power of at least 0; base^0 = 1."""
    out: Polynomial = (1.0,)
    for _ in range(exponent):
        out = multiply(out, base)
    return out


def integral(coefficients: Polynomial) -> float:
    """int_0^1 of the polynomial."""
    return sum(c / (j + 1) for j, c in enumerate(coefficients))
