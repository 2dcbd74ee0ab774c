"""The H-infinity observer LPI, and through the adjoint system the state-feedback LPI (theory, section 3).

For x_t = A x - B w in PIE form with regulated output z = C1 x and the output y = C2 x - rho w_y to be fed
back, find P >= delta I and Z such that for all fundamental states f (x = T f), w, w_y and z

    2 <T f, P (A f - B w)> + 2 <T f, Z (C2 T f - rho w_y)> + 2 <z, C1 T f>
        - gamma (|z|^2 + |w|^2 + |w_y|^2) <= 0;

then with L = P^-1 Z the system T f_t = A f + L y, driven by (w, w_y), has |z| <= gamma |(w, w_y)|. This is
(18) with the errata of theory, section 1. The left side is a form in rows; its negative is a Gram form.

`design.moment_lpi` solves it; this module states the problem and judges a gain by the form itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from design.operators import PIOperator, Shape, vertical
from design.quadratic import lifted


@dataclass(frozen=True)
class HinfProblem:
    """One problem in observer form; the operators act on n functions of the primary state x.

    T, A: f -> x and f -> x_t; krylov: x -> A^-1 x; B: R^w -> x; C1: x -> R^z; C2: x -> outputs;
    rho: weight of the noise on the fed-back output; drag: d in <x, x_t> = -d |v|^2 + ..., v = x[:2].
    """

    T: PIOperator
    A: PIOperator
    krylov: PIOperator
    B: PIOperator
    C1: PIOperator
    C2: PIOperator
    rho: float
    drag: float


@dataclass(frozen=True)
class Solution:
    """What the last solve returned, with the evidence recomputed from its numbers."""

    status: str
    """As the solver gave it, or 'solver_error'."""
    smallest_eigenvalue: float
    """Over all matrix inequalities, relative to the largest eigenvalue of each; -inf without numbers."""
    iterations: int
    seconds: float


@dataclass(frozen=True)
class HinfResult:
    """P, Z and the evidence. `outcome` is 'certified', 'infeasible' or 'unreliable'."""

    outcome: str
    gamma: float
    delta: float
    P: PIOperator
    Z: PIOperator
    solution: Solution
    sizes: tuple[int, ...]
    """Of the matrix inequalities."""
    seconds: float


@dataclass(frozen=True)
class Stages:
    """The three solves: gamma_0 = min gamma at a small delta; then with gamma = (1 + slack) gamma_0, or `aim`
    where that is larger, the largest delta, delta_1; then at delta = keep delta_1 the smallest Z. It keeps
    gains |Z| / delta moderate: the plain minimum of gamma is reached by ever larger gains (theory, 3).
    Where (1 + slack) gamma_0 is not below `near`, more moments are taken."""

    small_delta: float = 0.05
    slack: float = 0.03
    aim: float = 0.0
    near: float = float("inf")
    keep: float = 0.85


LPI_TOLERANCE = 1e-6
"""Largest `lpi_eigenvalue` that counts as rounding (the forms are of order one)."""


class _Signals:
    """What the LPI speaks of, as operators on xi = (z, w | f, w_y)."""

    def __init__(self, problem: HinfProblem) -> None:
        n = problem.T.shape_out.functions
        nz, nw = problem.C1.shape_out.finite, problem.B.shape_in.finite
        ny = problem.C2.shape_out.functions
        eye = PIOperator.identity(Shape(nz + nw, n + ny))
        f = eye.rows([], range(n))
        w = eye.rows(range(nz, nz + nw), [])
        self.noise = eye.rows([], range(n, n + ny))
        self.z = lifted(eye.rows(range(nz), []))
        self.w = lifted(w)
        self.x = problem.T @ f
        self.x_t = problem.A @ f - problem.B @ w
        self.y = problem.C2 @ self.x - self.noise * problem.rho
        self.c1 = lifted(problem.C1 @ self.x)
        self.channels = vertical(self.z, self.w, self.noise)


def lpi_eigenvalue(
    problem: HinfProblem, P: PIOperator, gain: PIOperator, gamma: float, size: int = 16
) -> float:
    """Largest eigenvalue of the LPI's form relative to |x|^2 + |z|^2 + |w|^2 + |w_y|^2 for a GIVEN gain.

    The form is rebuilt by composition from P and Z = P gain, on Legendre functions f of degree below
    `size`; nothing of the solver's matrices enters. Not positive: gamma is certified for this very gain, also
    after its ranks were cut.
    """
    s = _Signals(problem)
    half = s.x.adjoint @ (P @ (s.x_t + gain @ s.y)) + s.z.adjoint @ s.c1
    half = half - (s.channels.adjoint @ s.channels) * (0.5 * gamma)
    matrix = half.discretise(size)
    n = problem.T.shape_out.functions * size
    finite = s.x.shape_in.finite
    weight = np.eye(len(matrix))
    T = problem.T.discretise(size, size + 24)
    weight[finite : finite + n, finite : finite + n] = T.T @ T
    return float(linalg.eigvalsh(matrix + matrix.T, weight)[-1])
