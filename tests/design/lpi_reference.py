"""Problems of the LPI tests, and what polynomials say of them: shares no code with design.lpi.

States that meet the conditions are built with `pde_polynomials`; to be used with operators that are applied by
quadrature from their definition (`pi_reference`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial as Poly
from numpy.polynomial import legendre as plain
from pde_polynomials import Value, evaluate
from scipy import linalg

from design.lpi.inequality import Inequality, dissipated_ends
from design.lpi.rows import structure
from design.pde.convert import Pie
from design.pde.model import Pde
from design.pde.problem_file import parse_problem, read_problem_file

Array = npt.NDArray[np.float64]
Function = Callable[[Array], Array]
EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "problems"
DD, DN = ("x(0)", "x(1)"), ("x(0)", "x_s(1)")


@cache
def example_problem(start: str) -> Pde:
    """The example problem whose file name begins so."""
    (path,) = EXAMPLES.glob(f"{start}_*.toml")
    return read_problem_file(path).pde


def problem(
    equations: Mapping[str, tuple[int | str, str]],
    conditions: Sequence[str] = (),
    *,
    disturbances: Sequence[str] = (),
    controls: Sequence[str] = (),
    regulated: Sequence[str] = (),
    measured: Sequence[str] = (),
    norm: tuple[str, str] | None = None,
) -> Pde:
    """A PDE from {state: (order, right-hand side)}, by way of a problem file; a norm (of, by) instead."""

    def listed(texts: Sequence[str]) -> str:
        return "[" + ", ".join(f'"{t}"' for t in texts) + "]"

    lines = ["[states]"]
    lines += [f"{x} = {o if isinstance(o, int) else repr(o)}" for x, (o, _) in equations.items()]
    lines += [
        "[inputs]",
        f"disturbances = {listed(disturbances)}",
        f"controls = {listed(controls)}",
    ]
    if norm:
        lines += ["[norm]", f'of = ["{norm[0]}"]', f'by = ["{norm[1]}"]']
    else:
        lines += ["[equations]", *(f'{x} = "{right}"' for x, (_, right) in equations.items())]
    lines += ["[boundary]", f"conditions = {listed(conditions)}"]
    lines += ["[outputs]", f"regulated = {listed(regulated)}", f"measured = {listed(measured)}"]
    return parse_problem("\n".join(lines) + "\n", "test").pde


def heat(right: str = "x_ss + w", conditions: Sequence[str] = DN) -> Pde:
    """One heat equation from w to int(x)."""
    return problem({"x": (2, right)}, conditions, disturbances=["w"], regulated=["int(x)"])


def inequality(
    pie: Pie,
    degree: int,
    *,
    measured: bool = False,
    channels: bool = True,
    lossless: bool = False,
    with_ends: bool = True,
) -> Inequality:
    """The engine's inequality; the rows of end values may be left out where no program is solved."""
    shape = structure(pie)
    ends = dissipated_ends(pie, shape, measured) if with_ends else None
    return Inequality(
        pie, shape, degree, measured=measured, channels=channels, lossless=lossless, ends=ends
    )


def stacked(functions: Sequence[Value]) -> Function:
    """Functions and constants as one function (k,) -> (n, k)."""

    def evaluated(s: Array) -> Array:
        out = [v(s) if isinstance(v, Poly) else np.full(s.shape, v) for v in functions]
        return np.array(out).reshape(len(functions), *s.shape)

    return evaluated


def in_space(values: Sequence[Value], functions: Sequence[bool]) -> tuple[Array, Function]:
    """(numbers, functions), each in order: how `pi_reference` takes an element of R^m x L2^n."""
    pairs = list(zip(values, functions, strict=True))
    numbers = [v(0.0) if isinstance(v, Poly) else v for v, is_function in pairs if not is_function]
    return np.array(numbers, dtype=np.float64), stacked(
        [v for v, is_function in pairs if is_function]
    )


def functions_of(pde: Pde) -> list[bool]:
    """Which states are functions of s."""
    return [s.order is not None for s in pde.states]


def fundamental(pde: Pde, state: Sequence[Value]) -> tuple[Array, Function]:
    """f of a state that meets the conditions: ode states and highest derivatives."""
    highest = [
        v.deriv(s.order) if isinstance(v, Poly) and s.order else v
        for s, v in zip(pde.states, state, strict=True)
    ]
    return in_space(highest, functions_of(pde))


def admissible(pde: Pde, size: int) -> list[list[Value]]:
    """A basis of the states that meet the conditions and whose highest derivatives have degree < size."""
    zero: list[Value] = [0.0 if s.order is None else Poly([0.0]) for s in pde.states]
    units: list[list[Value]] = []
    for i, state in enumerate(pde.states):
        for degree in range(1 if state.order is None else size + state.order):
            one: Value = 1.0 if state.order is None else legendre_polynomial(degree)
            units.append([*zero[:i], one, *zero[i + 1 :]])
    rows = [[evaluate(c, x)(0.0) for x in units] for c in pde.conditions]
    free = linalg.null_space(np.array(rows), rcond=1e-10) if rows else np.eye(len(units))
    return [combined(units, mix) for mix in free.T]


def combined(states: Sequence[Sequence[Value]], factors: Array) -> list[Value]:
    """A linear combination of states."""
    return [
        sum((c * v for c, v in zip(factors, column, strict=True)), start=0.0 * column[0])
        for column in zip(*states, strict=True)
    ]


def legendre_polynomial(degree: int) -> Poly:
    """sqrt(2 k + 1) P_k(2 s - 1), orthonormal on [0, 1]."""
    series = plain.leg2poly(np.eye(degree + 1)[degree]) * np.sqrt(2.0 * degree + 1.0)
    return Poly(series)(Poly([-1.0, 2.0]))
