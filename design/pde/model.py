"""A linear 1-D PDE, coupled with ODEs, as data: what a problem file says and what a PIE is made from.

Everything here lives on [0, 1]: the reader has already mapped the domain of the file onto it. Polynomials
are coefficients in powers of s, lowest first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

Polynomial = tuple[float, ...]
"""Coefficients of 1, s, s^2, ... on [0, 1]."""


class Kind(Enum):
    """What drives the system from outside."""

    DISTURBANCE = "disturbance"
    CONTROL = "control"


@dataclass(frozen=True)
class Field:
    """The derivative of a state at s: d^j x_i / ds^j; an ode state has j = 0 and does not depend on s."""

    state: int
    derivative: int = 0


@dataclass(frozen=True)
class Point:
    """The derivative of a state at an end of the domain, 0 or 1: d^j x_i / ds^j (end)."""

    state: int
    derivative: int
    end: int


@dataclass(frozen=True)
class Integral:
    """int_0^1 weight(s) d^j x_i / ds^j ds."""

    state: int
    derivative: int
    weight: Polynomial


@dataclass(frozen=True)
class Input:
    """A disturbance or control, by its place in the PDE's list; distributed ones are taken at s."""

    kind: Kind
    index: int


@dataclass(frozen=True)
class InputIntegral:
    """int_0^1 weight(s) w(s) ds of a distributed disturbance or control."""

    kind: Kind
    index: int
    weight: Polynomial


Atom = Field | Point | Integral | Input | InputIntegral


@dataclass(frozen=True)
class Expression:
    """A linear expression: sum of coefficient(s) times atom; no atom occurs twice."""

    terms: tuple[tuple[Atom, Polynomial], ...]
    text: str = ""
    """As the user wrote it, for messages."""


@dataclass(frozen=True)
class StateVariable:
    """order: of the highest spatial derivative that exists in L2; None for a finite-dimensional state."""

    name: str
    order: int | None


@dataclass(frozen=True)
class Signal:
    """A disturbance or control: a number, or a function of s."""

    name: str
    distributed: bool


@dataclass(frozen=True)
class Output:
    """A regulated or measured output: a number (then no term depends on s), or a function of s."""

    expression: Expression
    distributed: bool


@dataclass(frozen=True)
class Pde:
    """x_t = equations, conditions = 0, with inputs and outputs.

    equations: one per state, in the order of `states`. conditions: scalar expressions in Point, Integral and
    ode states. numerator, denominator: the two lists of the task `norm`, the smallest c with
    |numerator| <= c |denominator| for every x that meets the conditions.
    """

    states: tuple[StateVariable, ...]
    equations: tuple[Expression, ...]
    conditions: tuple[Expression, ...] = ()
    disturbances: tuple[Signal, ...] = ()
    controls: tuple[Signal, ...] = ()
    regulated: tuple[Output, ...] = ()
    measured: tuple[Output, ...] = ()
    numerator: tuple[Output, ...] = ()
    denominator: tuple[Output, ...] = ()
    name: str = ""
    domain: tuple[float, float] = (0.0, 1.0)
    """Of the file; only for messages and for showing results."""
    parameters: dict[str, float] = field(default_factory=dict)
