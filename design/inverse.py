"""Gains from the LPI's operators: P^-1 Z, exactly, through the state-space form of separable kernels.

A kernel R1(s, t) = F1(s) G1(t) for t < s, R2(s, t) = F2(s) G2(t) for t > s makes P x = y a linear ODE in the
running integrals c(s) = int_0^s G1 x, d(s) = int_s^1 G2 x with conditions at both ends (Gohberg, Goldberg,
Kaashoek, semi-separable kernels; theory, section 4). Z is carried in the same ODE, so that the gain's
kernels come out at once; R1 = R2* is not needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from design import legendre
from design.legendre import Array
from design.operators import PIOperator

ODE_TOLERANCE = 1e-12
SINGULAR = 1e-12
"""Singular values below this, relative to the largest, count as zero."""
MOST_NODES = 96
MOST_EVALUATIONS = 10_000
"""Of the ODE's right side; gains take some hundreds, a multiplier that almost vanishes takes any number."""


@dataclass(frozen=True)
class SampledKernels:
    """A 3-PI operator by samples at Gauss nodes: multiplier (q, m, N), kernels as products of factors.

    N1(s, t) = outer1(s) inner1(t) for t < s and N2(s, t) = outer2(s) inner2(t) for t > s, each factor
    smooth on the whole interval: outer (q, r, N), inner (r, m, N). `tail` is the largest relative size of
    the last Legendre coefficients: how well N nodes resolve the factors.
    """

    multiplier: Array
    outer1: Array
    inner1: Array
    outer2: Array
    inner2: Array
    tail: float


def separate(kernel: Array, tolerance: float = 1e-14) -> tuple[Array, Array]:
    """Minimal-rank factors of a polynomial kernel (q, n, ds, dt): left (q, r, ds), right (r, n, dt)."""
    q, n, ds, dt = kernel.shape
    u, values, vt = np.linalg.svd(kernel.transpose(0, 2, 1, 3).reshape(q * ds, n * dt))
    rank = int(np.count_nonzero(values > tolerance * max(values[0], 1e-300)))
    root = np.sqrt(values[:rank])
    left = (u[:, :rank] * root).reshape(q, ds, rank).transpose(0, 2, 1)
    right = (vt[:rank] * root[:, None]).reshape(rank, n, dt)
    return left, right


def solve_gain(P: PIOperator, Z: PIOperator, tolerance: float = 1e-10) -> SampledKernels:
    """The 3-PI operator P^-1 Z; the number of Gauss nodes grows until the factors are resolved.

    Raises ValueError if P is not square or Z does not map into its range, and ArithmeticError if P's
    multiplier or the boundary matrix is singular (P is then not coercive).
    """
    if P.shape_in != P.shape_out or P.shape_in.finite or Z.shape_out != P.shape_in:
        raise ValueError(
            f"P^-1 Z needs a square 3-PI operator P and Z into its range; got P {P.shape_in} -> "
            f"{P.shape_out}, Z {Z.shape_in} -> {Z.shape_out}"
        )
    count = 24
    while True:
        result = _solve_at(P, Z, count)
        if result.tail <= tolerance or count >= MOST_NODES:
            return result
        count *= 2


def _solve_at(P: PIOperator, Z: PIOperator, count: int) -> SampledKernels:
    nodes, _ = legendre.gauss(count)
    f1, g1 = separate(P.r1)
    f2, g2 = separate(P.r2)
    a1, b1 = separate(Z.r1)
    a2, b2 = separate(Z.r2)
    r1, r2, k1, k2 = g1.shape[0], g2.shape[0], b1.shape[0], b2.shape[0]
    size = r1 + r2 + k1 + k2

    def at(coefficients: Array, s: Array) -> Array:
        """(rows, columns, d) at points s: (points, rows, columns)."""
        values = coefficients @ legendre.basis(s, coefficients.shape[2]).T
        return np.asarray(np.moveaxis(values, 2, 0), dtype=np.float64)

    def system(s: Array) -> tuple[Array, Array, Array, Array]:
        """theta' = M theta + N eta, x = C theta + D eta for theta = (c, d, a, b)."""
        r0 = at(P.r0, s)
        C = np.linalg.solve(
            r0, np.concatenate([-at(f1, s), -at(f2, s), at(a1, s), at(a2, s)], axis=2)
        )
        D = np.linalg.solve(r0, at(Z.r0, s))
        G = np.concatenate([at(g1, s), -at(g2, s)], axis=1)
        zeros = np.zeros((s.size, k1 + k2, size))
        M = np.concatenate([G @ C, zeros], axis=1)
        N = np.concatenate([G @ D, at(b1, s), -at(b2, s)], axis=1)
        return M, N, np.asarray(C), np.asarray(D)

    evaluations = 0

    def rate(s: float, u: Array) -> Array:
        nonlocal evaluations
        evaluations += 1
        if evaluations > MOST_EVALUATIONS:
            raise ArithmeticError(
                f"P^-1 Z varies too fast at s = {s:.4g}: the multiplier of P is almost singular there"
            )
        M = system(np.array([s]))[0][0]
        return np.asarray(M @ u.reshape(size, size)).ravel()

    _check_multiplier(at(P.r0, np.concatenate([[0.0], nodes, [1.0]])))
    _, N, C, D = system(nodes)
    U = np.zeros((count + 1, size, size))
    if size:
        grid = np.append(nodes, 1.0)
        solution = solve_ivp(
            rate, (0.0, 1.0), np.eye(size).ravel(), "DOP853", grid, rtol=ODE_TOLERANCE, atol=1e-14
        )
        if not solution.success:
            raise ArithmeticError(f"P^-1 Z cannot be integrated along the arm: {solution.message}")
        U = solution.y.T.reshape(-1, size, size)
    ends = np.concatenate([np.arange(r1, r1 + r2), np.arange(size - k2, size)])
    boundary = U[-1][np.ix_(ends, ends)]
    if ends.size:  # relative to its rows: one by one, a matrix is as good as its neighbours
        smallest = np.linalg.svd(boundary, compute_uv=False)[-1]
        if not smallest > SINGULAR * np.linalg.norm(U[-1][ends], 2):
            raise ArithmeticError("the boundary matrix of P is singular: P is not coercive")
    project = np.zeros((size, size))
    project[ends] = np.linalg.solve(boundary, U[-1][ends])
    outer = C @ U[:-1]
    inner = np.linalg.solve(U[:-1], N)
    factors = {
        "multiplier": D,
        "outer1": outer,
        "inner1": (np.eye(size) - project) @ inner,
        "outer2": outer,
        "inner2": -project @ inner,
    }
    sampled = {key: np.moveaxis(value, 0, 2) for key, value in factors.items()}
    return SampledKernels(**sampled, tail=max(_tail(v) for v in sampled.values()))


def _check_multiplier(r0: Array) -> None:
    """ArithmeticError unless the samples (points, n, n) are invertible and so is what lies between."""
    values = np.linalg.svd(r0, compute_uv=False)
    signs = np.linalg.slogdet(r0).sign
    if not values.min() > SINGULAR * values.max() or np.any(signs != signs[0]):
        raise ArithmeticError("the multiplier of P is singular: P is not coercive")


def _tail(samples: Array) -> float:
    coefficients = np.abs(legendre.fit(samples))
    return float(
        coefficients[..., -3:].max(initial=0.0) / max(coefficients.max(initial=0.0), 1e-300)
    )
