"""Affine expressions with polynomial coefficients: what `expression` computes with while it reads a text."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from design.pde import polynomial
from design.pde.model import Atom, Field, Input, InputIntegral, Integral, Polynomial

MAX_DEGREE = 50
"""Of a coefficient: beyond it powers of s are no usable basis."""

_WEIGHTED = (Integral, InputIntegral)


class NotLinearError(ValueError):
    """An operation that leaves the affine expressions; the message continues "<term> ..."."""


@dataclass(frozen=True)
class Linear:
    """constant(s) + sum of coefficient(s) times atom, without zero terms.

    varies: s occurs outside of an integral, though it may have cancelled. NotLinearError if a coefficient
    or weight is not finite or has too high a degree.
    """

    constant: Polynomial = ()
    terms: dict[Atom, Polynomial] = field(default_factory=dict)
    varies: bool = False

    def __post_init__(self) -> None:
        weights = [atom.weight for atom in self.terms if isinstance(atom, _WEIGHTED)]
        for coefficient in (self.constant, *self.terms.values(), *weights):
            if not all(math.isfinite(c) for c in coefficient):
                raise NotLinearError("is not finite: its coefficients overflow")
            if len(coefficient) > MAX_DEGREE + 1:
                degree = len(coefficient) - 1
                raise NotLinearError(f"has degree {degree} in s, more than {MAX_DEGREE}")
        terms = {
            atom: trimmed for atom, c in self.terms.items() if (trimmed := polynomial.trimmed(c))
        }
        object.__setattr__(self, "constant", polynomial.trimmed(self.constant))
        object.__setattr__(self, "terms", terms)

    @classmethod
    def number(cls, value: float) -> Linear:
        """A number."""
        return cls((value,))

    def __add__(self, other: Linear) -> Linear:
        """Sum."""
        terms = dict(self.terms)
        for atom, coefficient in other.terms.items():
            terms[atom] = polynomial.add(terms.get(atom, ()), coefficient)
        constant = polynomial.add(self.constant, other.constant)
        return Linear(constant, terms, self.varies or other.varies)

    def __neg__(self) -> Linear:
        return self * Linear.number(-1.0)

    def __sub__(self, other: Linear) -> Linear:
        return self + (-other)

    def __mul__(self, other: Linear) -> Linear:
        """Product; NotLinearError if both factors have atoms."""
        if self.terms and other.terms:
            raise NotLinearError(
                "is not linear: a product of two states or inputs; linearise the problem first"
            )
        left, right = (other, self) if other.terms else (self, other)
        terms = {a: polynomial.multiply(c, right.constant) for a, c in left.terms.items()}
        constant = polynomial.multiply(left.constant, right.constant)
        return Linear(constant, terms, self.varies or other.varies)

    def __truediv__(self, other: Linear) -> Linear:
        """Quotient; NotLinearError unless the divisor is a number other than zero."""
        divisor = other.value_of("divides by something that is not a number")
        if divisor == 0.0:
            raise NotLinearError("divides by zero")
        terms = {a: tuple(x / divisor for x in c) for a, c in self.terms.items()}
        return Linear(tuple(x / divisor for x in self.constant), terms, self.varies)

    def __pow__(self, other: Linear) -> Linear:
        """Power: of numbers wherever it is real, of polynomials with exponents 0, 1, 2, ..."""
        exponent = other.value_of("has an exponent that is not a number")
        if self.terms:
            if exponent == 1.0:
                return self
            raise NotLinearError("is not linear: a power of a state or input")
        if self.varies:
            degree = max(1, len(self.constant) - 1) * exponent
            if not (exponent.is_integer() and 0.0 <= degree <= MAX_DEGREE):
                raise NotLinearError(
                    f"is no polynomial in s of degree {MAX_DEGREE} or less: exponents are 0, 1, 2, ..."
                )
            return Linear(polynomial.power(self.constant, int(exponent)), {}, True)
        try:
            result = self.value_of("") ** exponent
        except ZeroDivisionError:
            raise NotLinearError("divides by zero") from None
        except OverflowError:
            result = math.inf
        if isinstance(result, complex):
            raise NotLinearError("is not a real number")
        return Linear.number(float(result))

    def value_of(self, message: str) -> float:
        """The number that this is; NotLinearError if it holds s, a state or an input."""
        if self.terms or self.varies:
            raise NotLinearError(f"{message}; coefficients are polynomials in s")
        return self.constant[0] if self.constant else 0.0

    def integral(self, varies: Callable[[Atom], bool], length: float) -> Linear:
        """length times int_0^1: atoms that vary become integrals, all others are multiplied by a number."""
        total = Linear.number(length * polynomial.integral(self.constant))
        for atom, coefficient in self.terms.items():
            weight = polynomial.multiply(coefficient, (length,))
            term: tuple[Atom, Polynomial]
            if isinstance(atom, Field) and varies(atom):
                term = Integral(atom.state, atom.derivative, weight), (1.0,)
            elif isinstance(atom, Input) and varies(atom):
                term = InputIntegral(atom.kind, atom.index, weight), (1.0,)
            else:
                term = atom, (polynomial.integral(weight),)
            total = total + Linear((), dict([term]))
        return total

    def merged(self) -> Linear:
        """With the integrals of constant coefficient joined for each state and derivative, and each input.

        Their coefficient is then 1, unless another term has the same integral.
        """
        out: dict[Atom, Polynomial] = {}
        weights: dict[Integral | InputIntegral, Polynomial] = {}
        for atom, coefficient in self.terms.items():
            if isinstance(atom, _WEIGHTED) and len(coefficient) == 1:
                key = _reweighted(atom, ())
                weight = polynomial.multiply(atom.weight, coefficient)
                weights[key] = polynomial.add(weights.get(key, ()), weight)
            else:
                out[atom] = coefficient
        for key, weight in weights.items():
            if weight:
                atom = _reweighted(key, weight)
                out[atom] = polynomial.add(out.get(atom, ()), (1.0,))
        return Linear(self.constant, out, self.varies)


def _reweighted(atom: Integral | InputIntegral, weight: Polynomial) -> Integral | InputIntegral:
    if isinstance(atom, Integral):
        return Integral(atom.state, atom.derivative, weight)
    return InputIntegral(atom.kind, atom.index, weight)
