"""The example problems: what they say on polynomials, against their equations written out by hand."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from numpy.polynomial import Polynomial
from pde_reference import Quantity, Sample, distance, integral, value

from design.pde.model import Expression, Output
from design.pde.problem_file import Bisection, Task, read_problem_file

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "problems"
S = Polynomial([0.0, 1.0])
P = Polynomial([0.3, -1.1, 0.7, 0.4, -0.2])
Q = Polynomial([-0.6, 0.5, 1.3, -0.8, 0.1])
R = Polynomial([0.2, 0.9, -0.4])
K = Polynomial([1.2, -0.3, 0.0, 0.6])
F = Polynomial([0.5, 0.4, -1.0])
w1, w2, u1, X1 = 1.7, -0.45, 0.85, 2.3
BEAM = [-0.1 * Q.deriv(2) - 0.1 * P, P.deriv(2)]
CLAMPED_FREE = [P(0), P.deriv()(0), Q(1), Q.deriv()(1)]
DD, DN = [P(0), P(1)], [P(0), P.deriv()(1)]
PP = P.deriv(2)


@dataclass(frozen=True)
class Example:
    """What an example says of P (first state), Q, R, K (the others); X1 (ode), w1, w2, F and u1 (inputs)."""

    task: Task
    equations: list[Quantity]
    conditions: list[float]
    regulated: list[Quantity] = field(default_factory=list)
    measured: list[Quantity] = field(default_factory=list)
    orders: tuple[int | None, ...] = (2,)
    disturbances: tuple[Quantity, ...] = ()
    controls: tuple[Quantity, ...] = ()
    norm: tuple[Quantity, ...] = ()
    bisect: tuple[str, float, float] | None = None
    domain: tuple[float, float] = (0.0, 1.0)


W: dict[str, Any] = {"disturbances": (w1,)}
WW: dict[str, Any] = {"disturbances": (w1, w2)}
U: dict[str, Any] = {"disturbances": (w1,), "controls": (u1,)}
RING = (0.0, 2.0 * math.pi)


def stability(*equations: Quantity, **more: Any) -> Example:
    return Example(Task.STABILITY, list(equations), **more)


EXAMPLES = {
    "s1_dirichlet": stability(PP + 4 * P, conditions=DD, bisect=("lam", 0, 20)),
    "s2_mixed": stability(PP + P, conditions=DN, bisect=("lam", 0, 10)),
    "s3_variable": stability(
        (S**3 - S**2 + 2) * PP
        + (3 * S**2 - 2 * S) * P.deriv()
        + (-0.5 * S**3 + 1.3 * S**2 - 1.5 * S + 0.7 + 2) * P,
        conditions=DN,
        bisect=("lam", 0, 10),
    ),
    "s13_beam": stability(-0.1 * Q.deriv(2), P.deriv(2), conditions=CLAMPED_FREE, orders=(2, 2)),
    "o1_volterra": Example(Task.NORM, [0.0], [P(0)], orders=(1,), norm=(P, P.deriv())),
    "o2_poincare": Example(Task.NORM, [0.0], DD, norm=(P, P.deriv())),
    "g20_transport": Example(Task.GAIN, [-P.deriv() + w1], [P(0)], [integral(P)], orders=(1,), **W),
    "g22_heat": Example(Task.GAIN, [PP + S * w1], DN, [integral(P)], **W),
    "g24_critical": Example(
        Task.GAIN, [PP + 0.99 * math.pi**2 * P + w1], DD, [integral(P)], **W
    ),
    "g29_beam": Example(
        Task.GAIN, [BEAM[0] + w1, BEAM[1]], CLAMPED_FREE, [integral(P)], orders=(2, 2), **W
    ),
    "n1_unstable": Example(
        Task.OBSERVER, [PP + 4 * P + w1], DN, [integral(P)], [P(1) + w2], **WW
    ),
    "n2_heat": Example(Task.OBSERVER, [PP + w1], DN, [integral(P)], [P(1) + w2], **WW),
    "n6_beam": Example(
        Task.OBSERVER,
        [BEAM[0] + w1, BEAM[1]],
        CLAMPED_FREE,
        [integral(P)],
        [P(1) + w2],
        orders=(2, 2),
        **WW,
    ),
    "c29_unstable": Example(
        Task.CONTROLLER, [10 * P + PP + (S - S**2) * (u1 + w1)], DD, [integral(P), u1], **U
    ),
    "nc1b_profiles": Example(
        Task.CONTROLLER, [PP + 5 * P + S * (2 - S) * w1 + S * u1], DN, [integral(P), u1], **U
    ),
    "nc3_beam": Example(
        Task.CONTROLLER,
        [BEAM[0] + S**2 * (w1 + u1), BEAM[1]],
        CLAMPED_FREE,
        [integral(P), u1],
        orders=(2, 2),
        **U,
    ),
    "nc4_uniform": Example(
        Task.CONTROLLER,
        [BEAM[0] + w1 + S * u1, BEAM[1]],
        CLAMPED_FREE,
        [integral(P), u1],
        orders=(2, 2),
        **U,
    ),
    "heat_insulated": stability(PP - integral(P), conditions=[P.deriv()(0), P.deriv()(1)]),
    "heat_lumped_mass": Example(
        Task.GAIN,
        [0.5 * PP, -0.5 * P.deriv()(2) + w1],
        [P(0), P(2) - X1],
        [X1],
        orders=(2, None),
        domain=(0, 2),
        **W,
    ),
    "transport_ring": Example(
        Task.GAIN,
        [-P.deriv() - 0.5 * P + F],
        [P(0) - P(2 * math.pi)],
        [P],
        orders=(1,),
        disturbances=(F,),
        domain=RING,
    ),
    "reaction_diffusion": stability(
        PP + P - 2 * Q,
        10 * Q.deriv(2) + 2 * P - Q,
        conditions=[P(-1), P(1), Q(-1), Q(1)],
        orders=(2, 2),
        bisect=("r", 0, 10),
        domain=(-1, 1),
    ),
    "wave_damper": Example(
        Task.GAIN,
        [Q.deriv() + w1, P.deriv()],
        [P(0), Q(1) + 0.5 * P(1)],
        [P(1)],
        orders=(1, 1),
        **W,
    ),
    "timoshenko": Example(
        Task.OBSERVER,
        [
            10 * R.deriv() - 0.2 * P + F,
            K.deriv() + 10 * R - 0.2 * Q,
            P.deriv() - Q,
            Q.deriv(),
        ],
        [P(0), Q(0), R(1), K(1)],
        [integral(P), integral(S * Q)],
        [K + 0.1 * (F + 1), P(1) + 0.1 * w2],
        orders=(1, 1, 1, 1),
        disturbances=(F, F + 1, w2),
    ),
}  # fmt: skip


def test_every_example_is_known_here() -> None:
    assert {path.stem for path in FOLDER.iterdir()} == set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_says_its_equations(name: str) -> None:
    example, problem = EXAMPLES[name], read_problem_file(FOLDER / f"{name}.toml")
    pde = problem.pde
    states = tuple(
        X1 if order is None else function
        for order, function in zip(example.orders, (P, Q, R, K), strict=False)
    )
    sample = Sample(example.domain, states, example.disturbances, example.controls)
    assert problem.task is example.task
    assert problem.bisect == (example.bisect and Bisection(*example.bisect))
    assert tuple(state.order for state in pde.states) == example.orders
    assert pde.domain == pytest.approx(example.domain)
    for signals, quantities in (
        (pde.disturbances, example.disturbances),
        (pde.controls, example.controls),
    ):
        assert [x.distributed for x in signals] == [isinstance(q, Polynomial) for q in quantities]

    def compare(expressions: list[Expression], expected: list[Quantity]) -> None:
        assert len(expressions) == len(expected)
        for expression, quantity in zip(expressions, expected, strict=True):
            got, size = value(expression, sample)
            assert distance(got, sample.on_unit(quantity)) <= 1e-12 * (1.0 + size), expression.text

    def compare_outputs(outputs: tuple[Output, ...], expected: list[Quantity]) -> None:
        functions = [isinstance(quantity, Polynomial) for quantity in expected]
        assert [output.distributed for output in outputs] == functions
        scaled = [
            q * math.sqrt(sample.length) if isinstance(q, Polynomial) else q for q in expected
        ]
        compare([output.expression for output in outputs], scaled)

    compare(list(pde.equations), example.equations)
    compare(list(pde.conditions), list(example.conditions))
    compare_outputs(pde.regulated, example.regulated)
    compare_outputs(pde.measured, example.measured)
    compare_outputs(pde.numerator + pde.denominator, list(example.norm))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_example_tells_what_it_is(path: Path) -> None:
    lines = path.read_text().splitlines()
    header = [line for line in lines if line.startswith("#")]
    assert lines[: len(header)] == header
    assert any(line.startswith("# Task: ") for line in header)
    first = path.stem.split("_")[0]
    if first == "nc1b" or first[-1].isdigit():
        name = tomllib.loads(path.read_text())["name"]
        assert name.lower() == first
        assert any(f"Theory, section 7, {name}." in line for line in header)
