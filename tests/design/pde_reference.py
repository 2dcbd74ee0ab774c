"""Expressions of problem files where states and inputs are given polynomials, by numpy.polynomial only.

`Sample` holds the polynomials in the file's own coordinate s; `value` takes an expression of the model, which
lives on [0, 1], where states keep their values and distributed signals are multiplied by sqrt(b - a).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from design.pde.model import Expression, Field, Input, InputIntegral, Integral, Kind, Point

Quantity = Polynomial | float


@dataclass(frozen=True)
class Sample:
    """States and inputs, in the order of the problem; polynomials in s, or numbers."""

    domain: tuple[float, float]
    states: tuple[Quantity, ...]
    disturbances: tuple[Quantity, ...] = ()
    controls: tuple[Quantity, ...] = ()

    @property
    def length(self) -> float:
        return self.domain[1] - self.domain[0]

    def on_unit(self, quantity: Quantity) -> Polynomial:
        """As a function of sigma, s = a + l sigma."""
        if isinstance(quantity, Polynomial):
            return quantity(Polynomial([self.domain[0], self.length]))
        return Polynomial([quantity])

    def input(self, kind: Kind, index: int) -> Polynomial:
        quantity = (self.disturbances if kind is Kind.DISTURBANCE else self.controls)[index]
        scale = math.sqrt(self.length) if isinstance(quantity, Polynomial) else 1.0
        return self.on_unit(quantity) * scale


def integral(function: Polynomial, low: float = 0.0, high: float = 1.0) -> float:
    primitive = function.integ()
    return float(primitive(high) - primitive(low))


def value(expression: Expression, sample: Sample) -> tuple[Polynomial, float]:
    """The expression as a polynomial on [0, 1], and the size of its largest term there."""
    total, size = Polynomial([0.0]), 0.0
    for atom, coefficient in expression.terms:
        match atom:
            case Field(state, derivative):
                factor = sample.on_unit(sample.states[state]).deriv(derivative)
            case Point(state, derivative, end):
                at = sample.on_unit(sample.states[state]).deriv(derivative)(float(end))
                factor = Polynomial([at])
            case Integral(state, derivative, weight):
                function = sample.on_unit(sample.states[state]).deriv(derivative)
                factor = Polynomial([integral(Polynomial(weight) * function)])
            case Input(kind, index):
                factor = sample.input(kind, index)
            case InputIntegral(kind, index, weight):
                factor = Polynomial([integral(Polynomial(weight) * sample.input(kind, index))])
        term = Polynomial(coefficient) * factor
        total = total + term
        size = max(size, float(np.abs(term.coef).sum()))
    return total, size


def distance(left: Polynomial, right: Polynomial) -> float:
    """Largest difference on [0, 1]."""
    points = np.linspace(0.0, 1.0, 23)
    return float(np.abs(left(points) - right(points)).max())
