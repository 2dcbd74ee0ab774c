"""Checks of sections 3.1 to 3.3 beside the formulas of `chapter.conversion`: (6), (7) by quadrature, the
general
converter on the same PDE, compactness of T, what rank(B) = 4 n does not give, and two LPIs of the form (12)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial, polynomial
from scipy.integrate import quad
from scipy.linalg import eigvals
from scipy.optimize import brentq

from chapter.conversion import (
    CLAMPED_FREE,
    FREE_FREE,
    ORDER,
    Formulas,
    boundary_matrix,
    cantilever,
    taylor,
)
from chapter.pde import Matrix
from design import legendre
from design.lpi.engine import solve, stability_limit
from design.operators import PIOperator, Shape
from design.pde.convert import Pie, convert
from design.pde.model import Expression, Field, Output, Pde, Point, StateVariable
from wire.errors import UsageError

Array = npt.NDArray[np.float64]
NAMES = ("u", "u_t", "w", "w_t")


# -- (6), (7) -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plain:
    """A 4-PI operator as (7) writes it, parameters in powers of s (and theta): the reader's own notation."""

    P: Array
    Q1: Array
    """(p, n, powers)."""
    Q2: Array
    """(q, m, powers)."""
    R: tuple[Array, Array, Array]
    """R_0 (q, n, powers), R_1 and R_2 (q, n, powers of s, powers of theta)."""

    def apply(self, x: Array, y: Sequence[Polynomial], s: float) -> tuple[Array, Array]:
        """(7) with scipy's adaptive quadrature: finite part (p,) and function part (q,) at s."""
        p, n, _ = self.Q1.shape
        q = self.Q2.shape[0]

        def total(row: Sequence[Array], low: float, high: float, at: float | None) -> float:
            def integrand(t: float) -> float:
                value = 0.0
                for k, one in enumerate(row):
                    kernel = (
                        polynomial.polyval(t, one)
                        if at is None
                        else polynomial.polyval2d(at, t, one)
                    )
                    value += float(kernel) * float(y[k](t))
                return value

            return float(quad(integrand, low, high, epsabs=1e-13, epsrel=1e-13)[0])

        finite = np.array([total(self.Q1[i], 0.0, 1.0, None) for i in range(p)]) + self.P @ x
        function = np.zeros(q)
        R0, R1, R2 = self.R
        for i in range(q):
            function[i] = polynomial.polyval(s, self.Q2[i].T) @ x if len(x) else 0.0
            function[i] += sum(polynomial.polyval(s, R0[i, k]) * y[k](s) for k in range(n))
            function[i] += total(R1[i], 0.0, s, s) + total(R2[i], s, 1.0, s)
        return finite, function

    def operator(self) -> PIOperator:
        """The same in the basis of `design.operators`."""

        def one(a: Array) -> Array:
            nodes, _ = legendre.gauss(a.shape[-1])
            return legendre.fit(polynomial.polyval(nodes, np.moveaxis(a, -1, 0)))

        def two(a: Array) -> Array:
            return one(one(a).swapaxes(2, 3)).swapaxes(2, 3)

        R0, R1, R2 = self.R
        return PIOperator(self.P, one(self.Q1), one(self.Q2), one(R0), two(R1), two(R2))


def random_plain(random: np.random.Generator, out: Shape, into: Shape, powers: int = 3) -> Plain:
    """Random parameters of the dimensions that (7) asks for."""
    (p, q), (m, n) = out, into
    kernel = (q, n, powers, powers)
    return Plain(
        random.standard_normal((p, m)),
        random.standard_normal((p, n, powers)),
        random.standard_normal((q, m, powers)),
        (
            random.standard_normal((q, n, powers)),
            random.standard_normal(kernel),
            random.standard_normal(kernel),
        ),
    )


def application_error(random: np.random.Generator) -> float:
    """Largest relative difference of `PIOperator.apply` from (7) by adaptive quadrature, non-square
    operators."""
    worst = 0.0
    for out, into in ((Shape(2, 1), Shape(1, 3)), (Shape(0, 3), Shape(0, 2))):
        plain = random_plain(random, out, into)
        y = [Polynomial(random.standard_normal(4)) for _ in range(into.functions)]
        x = random.standard_normal(into.finite)
        points = np.array([0.0, 0.31, 0.77, 1.0])
        finite, function = plain.operator().apply(x, partial(_values, y), points)
        for k, s in enumerate(points):
            wanted = np.concatenate(plain.apply(x, y, float(s)))
            got = np.concatenate([finite, function[:, k]])
            size = max(float(np.abs(wanted).max()), 1.0)
            worst = max(worst, float(np.abs(got - wanted).max()) / size)
    return worst


def _values(y: Sequence[Polynomial], at: Array) -> Array:
    return np.array([one(at) for one in y])


def composition_error(random: np.random.Generator) -> float:
    """Largest relative difference of (A B) y from A (B y), each by adaptive quadrature: closed under
    composition."""
    middle = Shape(1, 2)
    a = random_plain(random, Shape(1, 1), middle)
    b = random_plain(random, middle, Shape(1, 1))
    y = [Polynomial(random.standard_normal(3))]
    x = random.standard_normal(1)
    nodes = 0.5 * (1.0 - np.cos(np.pi * np.arange(10) / 9))  # B y has degree 5 at most
    values = [b.apply(x, y, float(s)) for s in nodes]
    inner = [
        Polynomial.fit(nodes, [v[1][i] for v in values], 7, domain=[0.0, 1.0]).convert()
        for i in range(middle.functions)
    ]
    whole = (a.operator() @ b.operator()).apply(x, partial(_values, y), nodes[::3])
    worst = 0.0
    for k, s in enumerate(nodes[::3]):
        finite, function = a.apply(values[0][0], inner, float(s))
        difference = np.concatenate([whole[0] - finite, whole[1][:, k] - function])
        size = np.abs(np.concatenate([finite, function])).max()
        worst = max(worst, float(np.abs(difference).max() / size))
    return worst


def printed_shape_refused() -> str:
    """What `design.operators` says to N_1 in R^(m x n) beside N_0 in R^(n x m), as the text before (6) has
    it."""
    n, m = 2, 3
    try:
        PIOperator.zeros(Shape(0, n), Shape(0, m)).replace(r1=np.zeros((m, n, 1, 1)))
    except ValueError as error:
        return str(error)
    return ""


# -- the general converter, on (4) ----------------------------------------------------------------


def as_pde(A: Sequence[Matrix], orders: Sequence[int] = (ORDER,) * 4) -> Pde:
    """(4) with the conditions of section 2.1 for `design.pde.convert`; orders 2 have x(0) = 0, x_s(1) = 0
    only."""
    equations = []
    for i in range(len(orders)):
        terms = [
            (Field(k, j), tuple(matrix[i][k].coef.tolist()))
            for j, matrix in enumerate(A)
            for k in range(len(orders))
            if np.any(matrix[i][k].coef)
        ]
        equations.append(Expression(tuple(terms), f"row {i + 1} of (4)"))
    of_order = {ORDER: CLAMPED_FREE, 2: ((0, 0), (1, 1))}
    conditions = [
        Expression(((Point(k, j, end), (1.0,)),))
        for k, order in enumerate(orders)
        for end, j in of_order[order]
    ]
    states = [StateVariable(name, order) for name, order in zip(NAMES, orders, strict=False)]
    outputs = [Output(Expression(((Field(0), (1.0,)),)), distributed=True)]
    return Pde(tuple(states), tuple(equations), tuple(conditions), regulated=tuple(outputs))


def converter_difference(A: Sequence[Matrix], size: int = 8) -> tuple[float, float]:
    """Relative difference of T and of A of (10), corrected, from `design.pde.convert`: Galerkin matrices."""
    ours = Formulas(A, boundary_matrix(CLAMPED_FREE, len(A[0])), "corrected").operators()
    pie = convert(as_pde(A))
    found = []
    for mine, other in zip(ours, (pie.T, pie.A), strict=True):
        a, b = mine.discretise(size), other.discretise(size)
        found.append(float(np.abs(a - b).max() / np.abs(b).max()))
    return found[0], found[1]


def axial_refusal(A: Sequence[Matrix]) -> str:
    """What the converter says to two conditions for u and u_t (order 2) where (4) asks for more of u."""
    try:
        convert(as_pde(A, (2, 2, ORDER, ORDER)))
    except UsageError as error:
        return str(error)
    return ""


def axial_pde(A: Sequence[Matrix], order: int) -> Pde:
    """The rows of u and u_t of the straight arm alone, with the conditions of order 2 or the chapter's four."""
    return as_pde([tuple(row[:2] for row in matrix[:2]) for matrix in A], (order, order))


def wave_frequencies(pie: Pie, size: int) -> Array:
    """The frequencies in rad/s of the pencil A f = lambda T f of a conservative PIE, ascending, without
    zeros."""
    values = eigvals(pie.A.discretise(size), pie.T.discretise(size)).imag
    values = np.abs(values[np.isfinite(values)])
    return np.unique(np.round(values[values > 1e-9], 9))


# -- T ---------------------------------------------------------------------------------------------


def singular_values(T: PIOperator, size: int = 40) -> Array:
    """Of T, descending, on `size` Legendre functions a state."""
    return np.asarray(np.linalg.svd(T.discretise(size), compute_uv=False))


def beam_values(count: int) -> Array:
    """1 / beta_k^4 with cos(beta) cosh(beta) = -1: the eigenvalues of the cantilever's Green's function."""

    def odd(beta: float) -> float:
        return math.cos(beta) + 1.0 / math.cosh(beta)

    edges = [math.pi * k for k in range(count + 1)]
    return np.array([brentq(odd, a, b, xtol=1e-14) for a, b in pairwise(edges)]) ** -4.0


def green_error(A: Sequence[Matrix], random: np.random.Generator) -> float:
    """Largest difference of G_1, G_2 from the cantilever's Green's function times the identity."""
    formulas = Formulas(A, boundary_matrix(CLAMPED_FREE, len(A[0])), "corrected")
    worst = 0.0
    for s, theta in random.uniform(size=(40, 2)):
        kernel = formulas.G1(s, theta) if theta < s else formulas.G2(s, theta)
        wanted = float(cantilever(s, theta)) * np.eye(len(A[0]))
        worst = max(worst, float(np.abs(kernel - wanted).max()))
    return worst


def ranks(conditions: Sequence[tuple[int, int]], states: int = 4) -> tuple[int, int]:
    """Rank of B, and of B T(b), which (11) inverts."""
    B = boundary_matrix(conditions, states)
    return int(np.linalg.matrix_rank(B)), int(np.linalg.matrix_rank(B @ taylor(1.0, states)))


def rank_examples() -> dict[str, tuple[int, int]]:
    """(rank B, rank B T(b)) of the chapter's conditions and of those that hold nothing, four states."""
    return {"clamped-free": ranks(CLAMPED_FREE), "free-free": ranks(FREE_FREE)}


# -- (12) ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Volterra:
    """min x_1 so that x_1 I - V* V >= 0, (12) with N = 1: the squared norm of (V y)(s) = int_0^s y."""

    kernel_error: float
    """Of V* V as the algebra has it, from 1 - max(s, theta)."""
    certified: float
    """Square root of the least x_1 that the engine certifies."""
    just_below: float
    """Least eigenvalue of (12) at x_1 = (0.999 * 2 / pi)^2 on 40 Legendre functions: negative."""
    just_above: float
    """The same with 1.001."""


def volterra() -> Volterra:
    """The worked LPI, against its closed form 2 / pi."""
    one = PIOperator.zeros(Shape(0, 1), Shape(0, 1))
    V = one.replace(r1=np.ones((1, 1, 1, 1)))
    square = V.adjoint @ V
    s, _ = legendre.gauss(12)
    values = square.apply(np.zeros(0), lambda t: np.cos(3.0 * t)[None], s)[1][0]
    wanted = [
        quad(
            lambda t, a=a: (1.0 - max(a, t)) * math.cos(3.0 * t), 0.0, 1.0, points=[a], epsabs=1e-13
        )[0]
        for a in s
    ]
    x = StateVariable("x", 1)
    value, slope = Expression(((Field(0), (1.0,)),)), Expression(((Field(0, 1), (1.0,)),))
    pde = Pde(
        (x,), (Expression(()),), (Expression(((Point(0, 0, 0), (1.0,)),)),),
        numerator=(Output(value, distributed=True),), denominator=(Output(slope, distributed=True),),
    )  # fmt: skip
    found = solve(pde, "norm")
    if found.gamma is None:
        raise RuntimeError(f"the engine did not certify the norm of the Volterra operator: {found}")
    matrix = square.discretise(40)

    def least(factor: float) -> float:
        level = (factor * 2.0 / math.pi) ** 2
        return float(np.linalg.eigvalsh(level * np.eye(40) - matrix)[0])

    return Volterra(float(np.abs(values - wanted).max()), found.gamma, least(0.999), least(1.001))


def heat_limit() -> float:
    """The largest certified lam for which x_t = lam x + x_ss, x(0) = x(1) = 0 is stable: pi^2 in closed
    form."""
    ends = (Expression(((Point(0, 0, 0), (1.0,)),)), Expression(((Point(0, 0, 1), (1.0,)),)))

    def problem(lam: float) -> Pde:
        rate = Expression(((Field(0), (lam,)), (Field(0, 2), (1.0,))))
        return Pde((StateVariable("x", 2),), (rate,), ends)

    found = stability_limit(problem, 0.0, 20.0)
    if found.limit is None:
        raise RuntimeError(f"the engine did not certify a limit: {found.message}")
    return found.limit
