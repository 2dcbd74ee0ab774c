"""The inequality judged by polynomials: the form from the PDE itself, and bounds against closed forms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from lpi_reference import (
    DD,
    Function,
    admissible,
    example_problem,
    functions_of,
    heat,
    in_space,
    inequality,
    legendre_polynomial,
    problem,
    stacked,
)
from numpy.polynomial import Polynomial as Poly
from numpy.polynomial import legendre as plain
from pde_polynomials import Value, evaluate
from pi_reference import finite_part, function_part, inner, random_operator
from scipy import linalg

from design.lpi.inequality import Certificate, Inequality
from design.lpi.scaling import scaled
from design.lpi.sdp import Point
from design.operators import PIOperator, Shape
from design.pde.convert import convert
from design.pde.model import Expression, Output, Pde

Array = npt.NDArray[np.float64]
Element = tuple[Array, Function]
"""Of R^m x L2^n."""
X, W = plain.leggauss(24)
NODES, WEIGHTS = 0.5 * (X + 1.0), 0.5 * W


@dataclass(frozen=True)
class Moment:
    """One choice of state and disturbances, and what the equations make of it."""

    x: Element
    x_t: Element
    w: Element
    z: Element
    y: Element


def moment(pde: Pde, state: Sequence[Value], signals: Sequence[Value]) -> Moment:
    """With x_t = A x - B1 w, z = C1 x - D11 w, y = C2 x - D21 w, the signs of the inequality."""
    negative = [-1.0 * v for v in signals]

    def of(outputs: Sequence[Output]) -> Element:
        values = [evaluate(o.expression, state, negative) for o in outputs]
        return in_space(values, [o.distributed for o in outputs])

    return Moment(
        x=in_space(state, functions_of(pde)),
        x_t=in_space([evaluate(e, state, negative) for e in pde.equations], functions_of(pde)),
        w=in_space(signals, [s.distributed for s in pde.disturbances]),
        z=of(pde.regulated),
        y=of(pde.measured),
    )


def vector(element: Element) -> Array:
    """Inner products of elements are those of their vectors."""
    number, function = element
    return np.concatenate([number, (function(NODES) * np.sqrt(WEIGHTS)).ravel()])


def dense(operator: PIOperator, degree: int = 10) -> Array:
    """The operator on vectors of elements whose functions have degree < `degree`, by quadrature."""
    m, n = operator.shape_in
    pairs = []
    zeros: list[Value] = [*[0.0] * m, *[Poly([0.0])] * n]
    for k in range(m + n):
        for one in [1.0] if k < m else [legendre_polynomial(d) for d in range(degree)]:
            unit = in_space([*zeros[:k], one, *zeros[k + 1 :]], [False] * m + [True] * n)
            image = finite_part(operator, *unit), function_part(operator, *unit)
            pairs.append((vector(image), vector(unit)))
    images, units = zip(*pairs, strict=True)
    return np.asarray(np.array(images).T @ np.array(units))


def derivative(function: Value, order: int) -> Value:
    return function.deriv(order) if isinstance(function, Poly) else 0.0


class Section:
    """All states whose highest derivatives have degree < size, all w and z of degree < size: dense matrices."""

    def __init__(self, pde: Pde, size: int, levels: Sequence[tuple[int, int]]) -> None:
        """levels: (state, derivative) whose squares the margin is measured in, with all ode states'."""
        states = admissible(pde, size)
        at_rest: list[Value] = [0.0 * v for v in states[0]]
        quiet: list[Value] = [Poly([0.0]) if s.distributed else 0.0 for s in pde.disturbances]
        units = [legendre_polynomial(k) for k in range(size)]
        signals = [
            [*quiet[:i], one, *quiet[i + 1 :]]
            for i, signal in enumerate(pde.disturbances)
            for one in (units if signal.distributed else [1.0])
        ]
        moments = [moment(pde, x, quiet) for x in states] + [
            moment(pde, at_rest, w) for w in signals
        ]
        self.count = len(states)
        self.x, self.x_t, self.y = (
            np.array([vector(getattr(m, name)) for m in moments]) for name in ("x", "x_t", "y")
        )
        # outputs against unit vectors: numbers first, then polynomials of degree < size
        basis = np.array([p(NODES) for p in units]) * WEIGHTS
        self.z = np.array([np.append(m.z[0], m.z[1](NODES) @ basis.T) for m in moments]).T
        squares = [
            np.array([stacked([derivative(x[i], j)])(NODES)[0] for x in states]) * np.sqrt(WEIGHTS)
            for i, j in levels
        ]
        flat = np.concatenate([*squares, np.array([m.x[0] for m in moments[: self.count]])], axis=1)
        self.weight = flat @ flat.T
        functions = functions_of(pde)
        zeros: list[Value] = [0.0] * len(functions)
        self.units = np.array(
            [
                vector(in_space([*zeros[:i], one, *zeros[i + 1 :]], functions))
                for i, is_function in enumerate(functions)
                for one in (units if is_function else units[:1])
            ]
        )

    def judge(self, P: PIOperator, Z: PIOperator | None) -> Certificate:
        """The section's gamma, margin and coercivity."""
        of_P = dense(P)
        power = self.x_t @ of_P.T
        if Z is not None:
            power = power + self.y @ dense(Z).T
        half = self.x @ power.T
        form = half + half.T
        state, cross = form[: self.count, : self.count], form[self.count :, : self.count]
        largest = float(linalg.eigh(state, self.weight, eigvals_only=True)[-1])
        coercive = self.units @ of_P @ self.units.T
        gamma = math.nan
        if largest < 0.0 and len(cross):
            both = np.vstack([self.z[:, : self.count], cross])
            corner = self.z[:, self.count :]
            channel = np.block(
                [
                    [np.zeros((len(corner), len(corner))), corner],
                    [corner.T, form[self.count :, self.count :]],
                ]
            )
            reduced = channel - both @ np.linalg.solve(state, both.T)
            gamma = float(np.linalg.eigvalsh(reduced)[-1])
        smallest = float(np.linalg.eigvalsh(0.5 * (coercive + coercive.T))[0])
        return Certificate(P, Z, gamma, -largest, smallest, math.nan)


HEAT = problem(
    {"x": (2, "(1 + s/2)*x_ss - x + s*w1 + w2")},
    ("x(0)", "x_s(1) + x(1)"),
    disturbances=["w1", "w2(s)", "w3"],
    regulated=["int(x) + 0.3*w1", "x + 0.1*w2"],
    measured=["x(1) + w3", "int(s*x)"],
)
LUMPED = problem(
    {"X": ("ode", "-2*X + x(1) + w"), "x": (2, "x_ss - 3*x")},
    ("x(0)", "x_s(1) + x(1) - X/4"),
    disturbances=["w"],
    regulated=["X", "int(x)"],
    measured=["X + w"],
)
WAVE = problem(
    {"v": (1, "e_s - v + w"), "e": (1, "v_s - e/2")},
    ("v(0)", "e(1) + v(1)/2"),
    disturbances=["w(s)", "noise(s)"],
    regulated=["v(1)"],
    measured=["e + noise"],
)
CASES = {
    "heat": (HEAT, [(0, 1), (0, 0)]),
    "heat with ode": (LUMPED, [(1, 1), (1, 0)]),
    "wave": (WAVE, [(0, 0), (1, 0)]),
}


def near_identity(pde: Pde, seed: int) -> tuple[PIOperator, PIOperator]:
    """P = 2 + small and a small Z, all their parameters random."""
    rng = np.random.default_rng(seed)
    pie = convert(pde)
    space, outputs = pie.T.shape_in, pie.C2.shape_out
    half = random_operator(rng, space, space)
    P = PIOperator.identity(space) * 2.0 + (half + half.adjoint) * 0.02
    return P, random_operator(rng, space, outputs) * 0.02


def judge_of(pde: Pde, *, measured: bool = False, channels: bool = True) -> Inequality:
    """Whose certificates depend on nothing but P, Z and the PDE."""
    return inequality(convert(pde), 1, measured=measured, channels=channels, with_ends=False)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("kind", ["gain", "observer", "stability"])
def test_certificate_is_what_the_equations_say(name: str, kind: str) -> None:
    """Random P and Z: gamma, margin and coercivity of two sections, by polynomials."""
    pde, levels = CASES[name]
    P, Z = near_identity(pde, 3)
    measured = kind == "observer"
    lpi = judge_of(pde, measured=measured, channels=kind != "stability")
    of_pde = (
        replace(pde, disturbances=(), regulated=(), measured=()) if kind == "stability" else pde
    )
    sizes = (4, 6)
    found = lpi.certificate(P, Z if measured else None, sections=sizes)
    if kind == "stability":
        equations = tuple(without_inputs(e) for e in pde.equations)
        of_pde = replace(of_pde, equations=equations)
    small, large = (
        Section(of_pde, size, levels).judge(P, Z if measured else None) for size in sizes
    )
    assert found.coercivity == pytest.approx(min(small.coercivity, large.coercivity), rel=1e-9)
    assert found.margin == pytest.approx(min(small.margin, large.margin), rel=1e-7)
    assert found.margin > 0.0
    if kind == "stability":
        assert math.isnan(found.gamma)
        expected = abs(large.margin - small.margin) / large.margin
    else:
        assert found.gamma == pytest.approx(max(small.gamma, large.gamma), rel=1e-8)
        assert small.gamma < large.gamma
        expected = (large.gamma - small.gamma) / large.gamma
    assert found.change == pytest.approx(expected, rel=1e-5)


def without_inputs(expression: Expression) -> Expression:
    kept = tuple(
        t for t in expression.terms if type(t[0]).__name__ not in ("Input", "InputIntegral")
    )
    return replace(expression, terms=kept)


@pytest.mark.parametrize("name", CASES)
def test_gain_counts(name: str) -> None:
    """Z enters with its sign: with -Z the figures are others."""
    pde, levels = CASES[name]
    P, Z = near_identity(pde, 4)
    lpi = judge_of(pde, measured=True)
    figures = [lpi.certificate(P, Z * sign, sections=(4, 5)) for sign in (1.0, -1.0, 0.0)]
    assert len({round(f.gamma, 9) for f in figures}) == 3
    opposite = Section(pde, 5, levels).judge(P, -Z)
    assert figures[1].gamma == pytest.approx(opposite.gamma, rel=1e-8)
    alone = judge_of(pde).certificate(P, None, sections=(4, 5))
    assert alone.gamma == pytest.approx(figures[2].gamma, rel=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_no_certificate_without_a_positive_operator(name: str) -> None:
    pde, _ = CASES[name]
    lpi = judge_of(pde)
    minus = PIOperator.identity(convert(pde).T.shape_in) * -1.0
    found = lpi.certificate(minus, None)
    assert found.coercivity == pytest.approx(-1.0, rel=1e-12)
    assert found.margin < 0.0
    assert math.isnan(found.gamma)
    nothing = lpi.certificate(minus * 0.0, None)
    assert nothing.margin == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(nothing.gamma) or nothing.coercivity == pytest.approx(0.0, abs=1e-12)


def test_no_certificate_for_an_unstable_plant() -> None:
    """x_t = x_ss + 12 x: the identity, and 1 + small, are no certificates though they are positive."""
    pde = heat("x_ss + 12*x + w", DD)
    lpi = judge_of(pde)
    for P in (PIOperator.identity(Shape(0, 1)), near_identity(pde, 8)[0]):
        found = lpi.certificate(P, None)
        assert found.coercivity > 0.5
        assert found.margin < 0.0
        assert math.isnan(found.gamma)


@pytest.mark.parametrize("scale", [0.02, 0.1, 0.5, 2.0, 10.0])
def test_no_bound_below_the_gain(scale: float) -> None:
    """G22, gain 5/24, where many P are certificates: gamma is never less, however P is scaled."""
    lpi = judge_of(example_problem("g22"))
    rng = np.random.default_rng(1)
    bounds = []
    for _ in range(6):
        half = random_operator(rng, Shape(0, 1), Shape(0, 1))
        P = (PIOperator.identity(Shape(0, 1)) + (half + half.adjoint) * 0.05) * scale
        found = lpi.certificate(P, None)
        bounds.append(found.gamma)
    assert any(map(math.isfinite, bounds))
    assert all(math.isnan(b) or b > 5.0 / 24.0 for b in bounds)


def solved(pde: Pde, degree: int, *, measured: bool = False) -> tuple[Point, Certificate, float]:
    """Point, certificate and certified gamma of one degree, as the engine does it."""
    scale = scaled(convert(pde))
    lpi = inequality(scale.pie, degree, measured=measured)
    point = lpi.program.solve({"gamma": 1.0}, {"delta": 1e-3, "epsilon": 1e-6})
    found = lpi.certificate(*lpi.operators(point))
    return point, found, found.gamma * scale.gamma


@pytest.mark.parametrize(
    ("name", "degree", "gain"), [("g22", 1, 5.0 / 24.0), ("g20", 2, 0.5)], ids=["G22", "G20"]
)
def test_closed_forms(name: str, degree: int, gain: float) -> None:
    point, found, gamma = solved(example_problem(name), degree)
    assert gain * (1.0 - 1e-6) <= gamma <= 1.0001 * gain
    assert found.gamma == pytest.approx(point.numbers["gamma"], rel=1e-3)
    assert found.margin > 0.0
    assert found.coercivity > 0.9e-3


@settings(max_examples=4, deadline=None)
@given(
    a=st.floats(0.3, 3.0), growth=st.floats(-2.0, 0.9), size=st.floats(0.05, 20.0, exclude_min=True)
)
@example(a=1.0, growth=0.0, size=1.0)
@example(a=0.5, growth=0.95, size=4.0)
def test_heat_equations(a: float, growth: float, size: float) -> None:
    """x_t = a x_ss + lam x + b w, x(0) = x_s(1) = 0, z = int x: self-adjoint, so the peak is at frequency 0.

    lam is a share `growth` of the limit a (pi/2)^2. The gain is b (tan(k)/k - 1)/lam, k^2 = lam/a.
    """
    lam = growth * a * math.pi**2 / 4.0
    k = math.sqrt(abs(lam) / a)
    if k < 1e-2:  # tan(k) = k + k^3/3 + 2 k^5/15, and lam = +- a k^2
        gain = size / a * (1.0 / 3.0 + 2.0 / 15.0 * lam / a)
    else:
        gain = size * (math.tan(k) if lam > 0.0 else math.tanh(k)) / k / lam - size / lam
    _, found, gamma = solved(heat(f"{a!r}*x_ss + ({lam!r})*x + {size!r}*w"), 2)
    assert found.margin > 0.0
    assert gain * (1.0 - 1e-6) <= gamma <= 1.01 * gain


@pytest.mark.parametrize("name", ["heat with ode", "wave"])
def test_operators_of_a_point(name: str) -> None:
    """<x, P x> = delta |x|^2 + <R x, G R x> + <M x, (s G1 + (1 - s) G2) M x>, and Z by its own."""
    pde, _ = CASES[name]
    lpi = judge_of(pde, measured=True)
    rng = np.random.default_rng(6)
    multiples = lpi.rows.lyapunov_multiples
    assert multiples is not None
    counts = {"P": lpi.rows.lyapunov.shape_out.functions}
    counts |= dict.fromkeys(("P s", "P 1-s"), multiples.shape_out.functions)
    halves = {key: rng.normal(size=(k, k)) for key, k in counts.items()}
    grams = {key: h @ h.T for key, h in halves.items()}
    free = rng.normal(size=lpi.gain_rows.shape_out.functions * sum(lpi.pie.C2.shape_out))
    point = Point("optimal", {"delta": 0.3}, free, grams, 0.0, 0.0, 1, 0.0, 0.0)
    P, Z = lpi.operators(point)
    assert Z is not None
    doubled = lpi.operators(replace(point, free=2.0 * free))[1]
    assert doubled is not None

    m, n = P.shape_in
    values: list[Value] = [*rng.normal(size=m), *(Poly(rng.normal(size=4)) for _ in range(n))]
    x = in_space(values, [False] * m + [True] * n)
    image = finite_part(P, *x), function_part(P, *x)
    rows, few = (function_part(r, *x)(NODES) for r in (lpi.rows.lyapunov, multiples))
    expected = 0.3 * inner(*x, *x) + np.einsum("ia,ij,ja,a->", rows, grams["P"], rows, WEIGHTS)
    for key, weight in (("P s", NODES), ("P 1-s", 1.0 - NODES)):
        expected += np.einsum("ia,ij,ja,a,a->", few, grams[key], few, weight, WEIGHTS)
    assert inner(*x, *image) == pytest.approx(float(expected), rel=1e-10)

    p, q = Z.shape_in
    values = [*rng.normal(size=p), *(Poly(rng.normal(size=3)) for _ in range(q))]
    y = in_space(values, [False] * p + [True] * q)
    once, twice = (inner(*x, finite_part(a, *y), function_part(a, *y)) for a in (Z, doubled))
    lifted = np.concatenate([y[1](NODES), np.repeat(y[0][:, None], NODES.size, axis=1)])
    rows = function_part(lpi.gain_rows, *x)(NODES)
    zeta = free.reshape(len(rows), -1)
    assert once == pytest.approx(
        float(np.einsum("ia,ij,ja,a->", rows, zeta, lifted, WEIGHTS)), rel=1e-10
    )
    assert twice == pytest.approx(2.0 * once, rel=1e-12)


def test_conserved_form() -> None:
    """S13: a form that the motion keeps, <x, P A x> = 0 on every state, not only a non-increasing one."""
    pde = example_problem("s13")
    lpi = inequality(convert(pde), 1, channels=False, lossless=True)
    point = lpi.program.solve({}, {"delta": 1.0, "epsilon": 0.0})
    P, _ = lpi.operators(point)
    found = lpi.certificate(P, None)
    assert found.coercivity > 0.999
    of_P = dense(P)
    for state in admissible(pde, 4):
        now = moment(pde, state, [])
        energy = float(vector(now.x) @ of_P @ vector(now.x))
        power = float(vector(now.x) @ of_P @ vector(now.x_t))
        assert energy > 0.0
        rate = np.linalg.norm(vector(now.x)) * np.linalg.norm(of_P @ vector(now.x_t))
        assert abs(power) < 1e-9 * rate
