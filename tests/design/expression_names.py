"""The names that the tests of expressions use, and short ways to read a text with them."""

from __future__ import annotations

from design.pde.expression import Reading, Role, read_expression
from design.pde.model import Atom, Input, Kind, Signal, StateVariable
from design.pde.model import Polynomial as Coefficients
from design.pde.names import Names

STATES = (
    StateVariable("x", 3),
    StateVariable("y", 1),
    StateVariable("q", 0),
    StateVariable("X", None),
)
W, V, U, G = (
    Input(Kind.DISTURBANCE, 0),
    Input(Kind.DISTURBANCE, 1),
    Input(Kind.CONTROL, 0),
    Input(Kind.CONTROL, 1),
)


def names(domain: tuple[float, float] = (0.0, 1.0), **parameters: float) -> Names:
    return Names(
        states=STATES,
        disturbances=(Signal("w", False), Signal("v", True)),
        controls=(Signal("u", False), Signal("g", True)),
        parameters={"lam": 4.0, "zero": 0.0, "huge": 1e300} | parameters,
        domain=domain,
    )


def read(text: str, role: Role = Role.OUTPUT, where: Names | None = None) -> Reading:
    return read_expression(text, where or names(), "file: key", role)


def terms(text: str, role: Role = Role.EQUATION) -> dict[Atom, Coefficients]:
    return dict(read(text, role).expression.terms)
