"""Formulas (9) to (11), letter by letter and corrected, and the answer they must give, found by hand.

From the matrices of `chapter.pde` to T and A as `design.operators.PIOperator`. `by_hand` shares nothing with
them: it integrates a polynomial d_s^4 x four times from the ends where the conditions hold and differentiates
it back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from chapter.pde import Form, Matrix
from design import legendre
from design.operators import PIOperator, Shape

Array = npt.NDArray[np.float64]
Kernel = Callable[[float, float], Array]

ORDER = 4
"""Of the highest derivative in (4) and (9)."""
CLAMPED_FREE = ((0, 0), (0, 1), (1, 2), (1, 3))
"""(end, derivative) of section 2.1's conditions, the same for each of u, u_t, w, w_t."""
FREE_FREE = ((0, 2), (0, 3), (1, 2), (1, 3))
"""Conditions of rank 4 n for which B T(b) is singular: nothing holds the beam."""


def boundary_matrix(conditions: Sequence[tuple[int, int]], states: int) -> Array:
    """B of (9), (4 n, 8 n), for conditions (end, derivative) that hold for every state."""
    B = np.zeros((len(conditions), 2 * ORDER))
    for row, (end, derivative) in enumerate(conditions):
        B[row, ORDER * end + derivative] = 1.0
    return np.asarray(np.kron(B, np.eye(states)), dtype=np.float64)


def taylor(s: float, states: int) -> Array:
    """T(s) of (11), (8 n, 4 n), a = 0."""
    rows = [[float(row == column) for column in range(ORDER)] for row in range(ORDER)]
    for row in range(ORDER):
        powers = range(-row, ORDER - row)
        rows.append([s**p / factorial(p) if p >= 0 else 0.0 for p in powers])
    return np.kron(np.array(rows), np.eye(states))


def remainder(s: float, theta: float, states: int) -> Array:
    """Q(s, theta) of (11), (8 n, n)."""
    column = [0.0] * ORDER
    column += [(s - theta) ** p / factorial(p) for p in range(ORDER - 1, -1, -1)]
    return np.kron(np.array(column)[:, None], np.eye(states))


@dataclass(frozen=True, eq=False)
class Formulas:
    """(11) for one boundary matrix: every function takes numbers s, theta of [0, 1] and gives an (n, n)
    matrix."""

    A: Sequence[Matrix]
    """A_0 to A_4."""
    B: Array
    form: Form
    """Of H_1; nothing else of (10), (11) is misprinted."""

    @property
    def states(self) -> int:
        """The number n."""
        return len(self.A[0])

    def A_at(self, j: int, s: float) -> Array:
        """A_j(s)."""
        return np.array([[entry(s) for entry in row] for row in self.A[j]])

    def K(self, j: int, s: float) -> Array:
        """K_j(s) = T_{j+5}(s), (n, 4 n)."""
        return taylor(s, self.states)[(j + 4) * self.states : (j + 5) * self.states]

    def L(self, j: int, s: float, theta: float) -> Array:
        """L_j(s, theta) = Q_{j+5}(s, theta)."""
        return remainder(s, theta, self.states)[(j + 4) * self.states : (j + 5) * self.states]

    def M(self, theta: float) -> Array:
        """(B T(b))^-1 B Q(b, theta), (4 n, n)."""
        n = self.states
        right = self.B @ remainder(1.0, theta, n)
        return np.asarray(np.linalg.solve(self.B @ taylor(1.0, n), right), dtype=np.float64)

    def G1(self, s: float, theta: float) -> Array:
        """Kernel of T on the side of the root."""
        return self.G2(s, theta) + self.L(0, s, theta)

    def G2(self, s: float, theta: float) -> Array:
        """Kernel of T on the side of the tip."""
        return -self.K(0, s) @ self.M(theta)

    def H1(self, s: float, theta: float) -> Array:
        """Kernel of A on the side of the root; printed: -sum_j (A_j K_j M + L_j)."""
        out = np.zeros((self.states, self.states))
        for j in range(ORDER):
            A, KM, L = self.A_at(j, s), self.K(j, s) @ self.M(theta), self.L(j, s, theta)
            out += -(A @ KM + L) if self.form == "printed" else A @ (-KM + L)
        return out

    def H2(self, s: float, theta: float) -> Array:
        """Kernel of A on the side of the tip."""
        M = self.M(theta)
        return np.asarray(-sum(self.A_at(j, s) @ self.K(j, s) @ M for j in range(ORDER)))

    def operators(self, degree: int = 10) -> tuple[PIOperator, PIOperator]:
        """T = {0, G_1, G_2} and A = {A_4, H_1, H_2} as (10) has them; kernels of degree below `degree`,
        exactly."""
        n = self.states
        zero = PIOperator.zeros(Shape(0, n), Shape(0, n))
        fit = legendre.fit
        nodes, _ = legendre.gauss(degree)
        multiplier = fit(np.stack([self.A_at(ORDER, s) for s in nodes], axis=-1))
        return (
            zero.replace(r1=_sampled(self.G1, nodes), r2=_sampled(self.G2, nodes)),
            zero.replace(r0=multiplier, r1=_sampled(self.H1, nodes), r2=_sampled(self.H2, nodes)),
        )


def _sampled(kernel: Kernel, nodes: Array) -> Array:
    values = np.array([[kernel(s, t) for t in nodes] for s in nodes]).transpose(2, 3, 0, 1)
    by_theta = legendre.fit(values)
    return legendre.fit(by_theta.swapaxes(2, 3)).swapaxes(2, 3)


@dataclass(frozen=True)
class ByHand:
    """One random x: f = d_s^4 x, x, and the right side of (4), each (n,) polynomials."""

    f: tuple[Polynomial, ...]
    x: tuple[Polynomial, ...]
    rate: tuple[Polynomial, ...]


def by_hand(A: Sequence[Matrix], random: np.random.Generator, degree: int = 6) -> ByHand:
    """Integrate random polynomials f to x, clamped at 0 and free at 1, and put x into (4)."""
    n = len(A[0])
    derivatives = []
    for _ in range(n):
        fourth = Polynomial(random.standard_normal(degree + 1))
        third = fourth.integ(lbnd=1.0)
        second = third.integ(lbnd=1.0)
        first = second.integ(lbnd=0.0)
        derivatives.append((first.integ(lbnd=0.0), first, second, third, fourth))
    rate = []
    for i in range(n):
        total = Polynomial([0.0])
        for j, matrix in enumerate(A):
            for k in range(n):
                total = total + matrix[i][k] * derivatives[k][j]
        rate.append(total)
    return ByHand(tuple(d[-1] for d in derivatives), tuple(d[0] for d in derivatives), tuple(rate))


def errors(
    operators: tuple[PIOperator, PIOperator], hand: ByHand, points: int = 12
) -> tuple[Array, Array]:
    """Largest difference of T f from x and of A f from the right side of (4), row by row, relative to its
    size."""
    s, _ = legendre.gauss(points)

    def f(at: Array) -> Array:
        return np.array([one(at) for one in hand.f])

    found = []
    for operator, wanted in zip(operators, (hand.x, hand.rate), strict=True):
        _, got = operator.apply(np.zeros(0), f, s, nodes=24)
        values = np.array([one(s) for one in wanted])
        found.append(np.abs(got - values).max(axis=1) / np.abs(values).max(axis=1))
    return found[0], found[1]


def cantilever(s: Array, theta: Array) -> Array:
    """Green's function of x'''' = f, clamped at 0 and free at 1, from any book on beams: what each diagonal
    entry
    of G_1, G_2 must be."""
    low, high = np.minimum(s, theta), np.maximum(s, theta)
    return np.asarray(low**2 * (3.0 * high - low) / 6.0)
