"""What the names in a problem file's expressions stand for; filled by `problem_file`, used by `expression`."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from design.pde.model import Atom, Field, Input, Kind, Signal, StateVariable

RESERVED = {
    "s": "the place along the domain",
    "t": "time",
    "pi": "3.14159...",
    "int": "the integral over the domain",
}
"""Names that cannot be declared, and what they mean."""
_DERIVATIVE = re.compile(r"(.+)_(s+|s[1-9][0-9]?)")


def suggestion(name: str, known: Iterable[str]) -> str:
    """'; did you mean ...?' with the nearest of the known names, or nothing."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"; did you mean {near[0]}?" if near else ""


@dataclass(frozen=True)
class Names:
    """States, inputs, parameters and the domain [a, b], a < b. `problem_file` keeps the names distinct."""

    states: tuple[StateVariable, ...]
    disturbances: tuple[Signal, ...] = ()
    controls: tuple[Signal, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    domain: tuple[float, float] = (0.0, 1.0)

    @property
    def length(self) -> float:
        """Of the domain, in the unit of s."""
        return self.domain[1] - self.domain[0]

    def state(self, name: str) -> tuple[int, int] | None:
        """(state, derivative) that a name stands for: x, x_s, x_ss, x_s5; None if it is no state's."""
        places = {state.name: i for i, state in enumerate(self.states)}
        if name in places:
            return places[name], 0
        match = _DERIVATIVE.fullmatch(name)
        if match is None or match[1] not in places:
            return None
        digits = match[2][1:]
        return places[match[1]], int(digits) if digits.isdigit() else len(match[2])

    def input(self, name: str) -> tuple[Input, Signal] | None:
        """The disturbance or control of that name."""
        lists = ((Kind.DISTURBANCE, self.disturbances), (Kind.CONTROL, self.controls))
        for kind, signals in lists:
            for index, signal in enumerate(signals):
                if signal.name == name:
                    return Input(kind, index), signal
        return None

    def varies(self, atom: Atom) -> bool:
        """Whether the atom is a function of s."""
        if isinstance(atom, Field):
            return self.states[atom.state].order is not None
        if isinstance(atom, Input):
            signals = self.disturbances if atom.kind is Kind.DISTURBANCE else self.controls
            return signals[atom.index].distributed
        return False

    def known(self) -> list[str]:
        """Every name that an expression may use; derivatives last."""
        signals = (*self.disturbances, *self.controls)
        plain = [*(v.name for v in self.states), *(w.name for w in signals)]
        derivatives = [
            f"{state.name}_{'s' * j}"
            for state in self.states
            for j in range(1, (state.order or 0) + 1)
        ]
        return [*plain, *self.parameters, "s", "pi", "int", *derivatives]
