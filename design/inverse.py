"""Gains from the LPI's operators: P^-1 Z, exactly, through the state-space form of separable kernels.

A kernel R1(s, t) = F1(s) G1(t) for t < s, R2(s, t) = F2(s) G2(t) for t > s makes P x = y a linear ODE in the
running integrals c(s) = int_0^s G1 x, d(s) = int_s^1 G2 x with conditions at both ends (Gohberg, Goldberg,
Kaashoek, semi-separable kernels; theory, section 4). Z is carried in the same ODE, so that the gain's
kernels come out at once; R1 = R2* is not needed.

Its solutions grow and decay along the arm, the faster the larger the kernels are against the multiplier, and
no shooting from one end to the other keeps both. So it is integrated from node to node, and two bases are
carried by QR: the solutions that meet the conditions at the left end, to the right, and those that meet the
conditions at the right end, to the left. N1 and N2 are what jumps between them (the Green function of a
boundary-value problem with a dichotomy; Ascher, Mattheij, Russell, Numerical Solution of Boundary Value
Problems for ODEs, chapter 6), so each has no more factors than conditions at its end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from design import legendre
from design.legendre import Array
from design.operators import PIOperator

EPSILON = float(np.finfo(np.float64).eps)
ODE_TOLERANCE = 1e-12
SINGULAR = 1e-12
"""Singular values below this, relative to the largest, count as zero."""
MOST_NODES = 96
UNRESOLVED = 1e-4
"""A tail above this is no gain."""
ORDINARY = 100.0
"""Growth below this needs no finer tolerances; that of the arm's gains is near 1."""
NOISE = 3.0
"""A tail of this many roundings is rounding: more nodes do not make it smaller."""
STEEPEST = 1e4
"""Condition of a step between points: rounding times this is what a step may lose."""
MOST_PIECES = 128
"""Between two nodes, before P is given up."""
MOST_ENTRIES = 2_000_000
"""Of all steps: the integrator holds some 16 times as many, a quarter of a gigabyte."""
ALMOST = 1e-3
"""Relative size of a multiplier to be named as the cause."""
MOST_EVALUATIONS = 2_000
"""Of the ODE's right side; gains take some dozens, a multiplier that almost vanishes takes any number."""
OUT_OF_REACH = (
    "P^-1 Z has kernels that grow too much along the arm: P's are large against its multiplier"
)


@dataclass(frozen=True)
class SampledKernels:
    """A 3-PI operator by samples at Gauss nodes: multiplier (q, m, N), kernels as products of factors.

    N1(s, t) = outer1(s) inner1(t) for t < s and N2(s, t) = outer2(s) inner2(t) for t > s, each factor
    smooth on the whole interval: outer (q, r, N), inner (r, m, N). `tail` says how well N polynomials stand
    for the factors: the last Legendre coefficients, and the rounding of all, times the other factor, relative
    to the gain. `growth` is the largest value of outer(s) inner(t) for any s and t, relative to the gain: by
    it an error of a polynomial that is small against the largest value of a factor is larger in the gain.
    """

    multiplier: Array
    outer1: Array
    inner1: Array
    outer2: Array
    inner2: Array
    tail: float
    growth: float = 1.0

    @property
    def finer(self) -> float:
        """What tolerances relative to the largest product are to be divided by, 1 for ordinary gains."""
        return max(1.0, self.growth / ORDINARY)


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

    Raises ValueError if P is not square, Z does not map into its range or either has a finite part, and
    ArithmeticError if P's multiplier or the boundary matrix is singular (P is then not coercive), or if
    polynomial factors cannot hold the gain: products of factors that grow along the whole arm are as good as
    rounding times growth.
    """
    system = _system(P, Z)
    count = 24
    while True:
        result, rounding = _solve_at(system, count)
        if not NOISE * rounding <= UNRESOLVED:
            raise ArithmeticError(
                f"{OUT_OF_REACH}. Polynomial factors would be off by {NOISE * rounding:.1e} of P^-1 Z by "
                f"rounding alone; at most {UNRESOLVED:g} is taken"
            )
        if result.tail <= max(tolerance, NOISE * rounding) or count >= MOST_NODES:
            _check_tail(result.tail, count)
            return result
        count *= 2


def solve_columns(P: PIOperator, columns: Array, tolerance: float = 1e-10) -> tuple[Array, float]:
    """P^-1 on functions with coefficients (n, m, d): coefficients (n, m, count), relative size of the last.

    As `solve_gain` on a multiplier and constants, but only functions are represented, no kernel: kernels of P
    as large as one likes do no harm as long as polynomials resolve what comes out. Raises as `solve_gain`.
    """
    system = _system(P, PIOperator.multiplier(columns))
    count = 24
    while True:
        samples, tail = _columns_at(system, count)
        if tail <= tolerance or count >= MOST_NODES:
            _check_tail(tail, count)
            return legendre.interpolate(samples), tail
        count *= 2


def _system(P: PIOperator, Z: PIOperator) -> _System:
    """ValueError if P^-1 Z is none of 3-PI operators."""
    if (
        P.shape_in != P.shape_out
        or P.shape_in.finite
        or Z.shape_out != P.shape_in
        or Z.shape_in.finite
    ):
        raise ValueError(
            f"P^-1 Z needs a square 3-PI operator P and a 3-PI operator Z into its range; got P "
            f"{P.shape_in} -> {P.shape_out}, Z {Z.shape_in} -> {Z.shape_out}"
        )
    return _System.of(P, Z)


def _check_tail(tail: float, count: int) -> None:
    if not tail <= UNRESOLVED:
        raise ArithmeticError(
            f"P^-1 Z varies too fast along the arm for {count} polynomials: they are off by {tail:.1e} of it; "
            f"at most {UNRESOLVED:g} is taken"
        )


@dataclass(frozen=True)
class _System:
    """theta' = M theta + N eta, x = C theta + D eta for theta = (c, d, a, b); c, d of P, a, b of Z.

    c and a are zero at 0, d and b at 1.
    """

    r0: Array
    read: tuple[Array, ...]
    """F1, F2 of P, then of Z: from theta into P x = Z eta."""
    collect: tuple[Array, ...]
    """G1, G2 of P, then of Z: what the running integrals integrate."""
    z0: Array

    @classmethod
    def of(cls, P: PIOperator, Z: PIOperator) -> _System:
        f1, g1 = separate(P.r1)
        f2, g2 = separate(P.r2)
        a1, b1 = separate(Z.r1)
        a2, b2 = separate(Z.r2)
        return cls(P.r0, (-f1, -f2, a1, a2), (g1, -g2, b1, -b2), Z.r0)

    @property
    def ranks(self) -> tuple[int, ...]:
        return tuple(len(g) for g in self.collect)

    def homogeneous(self, s: Array) -> tuple[Array, Array]:
        """M and C at points s, (points, rows, columns)."""
        read = np.concatenate([_at(f, s) for f in self.read], axis=2)
        C = np.linalg.solve(_at(self.r0, s), read)
        rates = np.concatenate([_at(g, s) for g in self.collect[:2]], axis=1) @ C
        constant = np.zeros((s.size, sum(self.ranks[2:]), C.shape[2]))
        return np.concatenate([rates, constant], axis=1), np.asarray(C)

    def driven(self, s: Array) -> tuple[Array, Array]:
        """N and D at points s."""
        D = np.linalg.solve(_at(self.r0, s), _at(self.z0, s))
        g1, g2, b1, b2 = (_at(g, s) for g in self.collect)
        return np.concatenate([g1 @ D, g2 @ D, b1, b2], axis=1), np.asarray(D)


def _at(coefficients: Array, s: Array) -> Array:
    """(rows, columns, d) at points s: (points, rows, columns)."""
    values = coefficients @ legendre.basis(s, coefficients.shape[2]).T
    return np.asarray(np.moveaxis(values, 2, 0), dtype=np.float64)


@dataclass(frozen=True)
class _Decoupled:
    """Solutions at points s_0 = 0 < .. < s_K = 1, taken apart by the end whose conditions they meet.

    Q (K + 1, size, size): orthonormal bases of those that meet the conditions at 1, then of those at 0. From
    s_k to s_k+1 a solution without input goes by theta = Q (beta, alpha), beta_k = fall_k beta_k+1 and
    alpha_k+1 = rise_k alpha_k, fall and rise triangular. `rounding`: what the steps lose.
    """

    Q: Array
    fall: Array
    rise: Array
    forced: Array
    """(K, size, m): theta(s_k+1) from theta(s_k) = 0 under the constant inputs, the unit vectors."""
    nodes: npt.NDArray[np.int_]
    """Which of the points are the Gauss nodes."""
    rounding: float


def _decoupled(system: _System, nodes: Array, *, forced: bool) -> _Decoupled:
    """At 0, the nodes, 1 and as many points between as the steps need to lose no digits.

    ArithmeticError if P's multiplier is singular or there is a solution that meets all conditions.
    """
    points = np.concatenate([[0.0], nodes, [1.0]])
    _check_multiplier(_at(system.r0, points))
    pieces = 1
    r1, r2, k1, k2 = system.ranks
    size = r1 + r2 + k1 + k2
    while True:
        steps = _transitions(system, points, forced=forced)
        T = steps[:, :, :size]
        condition = float(np.linalg.cond(T).max()) if size else 1.0
        if condition <= STEEPEST:
            break
        if pieces >= MOST_PIECES or 2 * steps.size > MOST_ENTRIES:
            raise ArithmeticError(OUT_OF_REACH)
        points = np.insert(points, range(1, points.size), 0.5 * (points[1:] + points[:-1]))
        pieces *= 2
    unit = np.eye(size)
    left = np.r_[:r1, r1 + r2 : r1 + r2 + k1]  # c, a: zero at 0, free at 1
    right = np.r_[r1 : r1 + r2, r1 + r2 + k1 : size]
    fallen, fall = _carried(_inverses(T[::-1]), unit[:, left])
    risen, rise = _carried(T, unit[:, right])
    Q = np.concatenate([fallen[::-1], risen], axis=2)
    if not np.linalg.svd(Q, compute_uv=False).min(initial=1.0) > SINGULAR:
        raise ArithmeticError("the boundary matrix of P is singular: P is not coercive")
    at = pieces * np.arange(1, nodes.size + 1)
    return _Decoupled(Q, fall[::-1], rise, steps[:, :, size:], at, EPSILON * condition)


def _transitions(system: _System, points: Array, *, forced: bool) -> Array:
    """theta(s_k+1) from the unit vectors at s_k (and from zero under unit inputs), all k side by side."""
    size, low, step = sum(system.ranks), points[:-1], np.diff(points)
    start = np.eye(size, size + forced * system.z0.shape[1])
    start = np.tile(start, (low.size, 1, 1))
    evaluations = 0

    def rate(u: float, flat: Array) -> Array:
        nonlocal evaluations
        s = low + u * step
        M, _ = system.homogeneous(s)
        evaluations += 1
        if evaluations > MOST_EVALUATIONS:
            raise _too_fast(system, s, M)
        out = M @ flat.reshape(start.shape)
        if forced:
            out[:, :, size:] += system.driven(s)[0]
        return np.asarray(step[:, None, None] * out).ravel()

    if not start.size:
        return start
    solution = solve_ivp(
        rate, (0.0, 1.0), start.ravel(), "DOP853", [1.0], rtol=ODE_TOLERANCE, atol=1e-14
    )
    if not solution.success:
        raise ArithmeticError(f"P^-1 Z cannot be integrated along the arm: {solution.message}")
    return np.asarray(solution.y[:, 0].reshape(start.shape))


def _too_fast(system: _System, s: Array, M: Array) -> ArithmeticError:
    fastest = int(np.argmax(np.abs(M).max(axis=(1, 2))))
    multiplier = np.linalg.svd(_at(system.r0, s), compute_uv=False)
    if multiplier[fastest, -1] < ALMOST * multiplier.max():
        why = "the multiplier of P is almost singular there"
    else:
        why = "P's kernels are large against its multiplier"
    return ArithmeticError(f"P^-1 Z varies too fast at s = {s[fastest]:.4g}: {why}")


def _carried(steps: Array, start: Array) -> tuple[Array, Array]:
    """Q_0 = start and T_k Q_k = Q_k+1 R_k for all steps T: Q (K + 1, size, r) orthonormal, R (K, r, r)."""
    size, rank = start.shape
    Q, R = np.zeros((len(steps) + 1, size, rank)), np.zeros((len(steps), rank, rank))
    Q[0] = start
    for k, step in enumerate(steps):
        Q[k + 1], R[k] = np.linalg.qr(step @ Q[k])
    return Q, R


def _solve_at(system: _System, count: int) -> tuple[SampledKernels, float]:
    """The gain at `count` Gauss nodes, and what rounding costs if its factors become polynomials."""
    nodes, _ = legendre.gauss(count)
    found = _decoupled(system, nodes, forced=False)
    _, C = system.homogeneous(nodes)
    N, D = system.driven(nodes)
    Q, rank = found.Q[found.nodes], found.fall.shape[1]
    jump = np.linalg.solve(Q, N)
    # each column falls at its own rate from where it starts as a unit vector: its inverse keeps its digits
    falling = _products(_inverses(found.fall))[found.nodes - 1]
    rising = _products(_inverses(found.rise[::-1]))[::-1][found.nodes]
    try:
        first = _balanced(C @ Q[:, :, :rank] @ falling, np.linalg.solve(falling, jump[:, :rank]))
        second = _balanced(C @ Q[:, :, rank:] @ rising, -np.linalg.solve(rising, jump[:, rank:]))
    except np.linalg.LinAlgError:  # beyond the range of numbers
        raise ArithmeticError(OUT_OF_REACH) from None
    multiplier = np.moveaxis(D, 0, 2)
    size, growth = _sizes(multiplier, first, second)
    lost = [_lost(*pair) for pair in (first, second)]
    rounding = max(r for _, r in lost) / size + found.rounding
    tail = max(float(_last(multiplier).max(initial=0.0)), *(t for t, _ in lost)) / size
    return SampledKernels(multiplier, *first, *second, tail + rounding, growth / size), rounding


def _inverses(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _products(triangles: Array) -> Array:
    """T_k .. T_0 for all k."""
    out = np.array(triangles, dtype=np.float64)
    for k in range(1, len(out)):
        out[k] = triangles[k] @ out[k - 1]
    return out


def _columns_at(system: _System, count: int) -> tuple[Array, float]:
    """P^-1 on the functions of Z's multiplier, sampled, and their tail.

    Inputs enter interval by interval, split by Q: beta is summed from 0, alpha from 1, neither grows.
    """
    nodes, _ = legendre.gauss(count)
    found = _decoupled(system, nodes, forced=True)
    rank, m = found.fall.shape[1], found.forced.shape[2]
    enter = np.linalg.solve(found.Q[1:], found.forced)
    theta = np.zeros((len(enter) + 1, enter.shape[1], m))
    for k in range(len(enter)):
        theta[k + 1, :rank] = np.linalg.solve(found.fall[k], theta[k, :rank]) + enter[k, :rank]
    for k in reversed(range(len(enter))):
        late = theta[k + 1, rank:] - enter[k, rank:]
        theta[k, rank:] = np.linalg.solve(found.rise[k], late)
    _, C = system.homogeneous(nodes)
    _, D = system.driven(nodes)
    samples = np.moveaxis(D + C @ (found.Q @ theta)[found.nodes], 0, 2)
    size = max(float(np.abs(samples).max(initial=0.0)), 1e-300)
    return samples, float(_last(samples).max(initial=0.0)) / size + found.rounding


def _balanced(outer: Array, inner: Array) -> tuple[Array, Array]:
    """Samples (N, q, r), (N, r, m) as (q, r, N), (r, m, N), the two sides of every product of one size."""
    outer, inner = np.moveaxis(outer, 0, 2), np.moveaxis(inner, 0, 2)
    sizes = np.abs(outer).max(axis=(0, 2), initial=0.0), np.abs(inner).max(axis=(1, 2), initial=0.0)
    present = (sizes[0] > 0.0) & (sizes[1] > 0.0)
    ratio = np.sqrt(np.where(present, sizes[1], 1.0) / np.where(present, sizes[0], 1.0))
    return outer * ratio[:, None], inner / ratio[:, None, None]


def _check_multiplier(r0: Array) -> None:
    """ArithmeticError unless the samples (points, n, n) are invertible and so is what lies between."""
    values = np.linalg.svd(r0, compute_uv=False)
    signs = np.linalg.slogdet(r0).sign
    if not values.min() > SINGULAR * values.max() or np.any(signs != signs[0]):
        raise ArithmeticError("the multiplier of P is singular: P is not coercive")


def _sizes(
    multiplier: Array, first: tuple[Array, Array], second: tuple[Array, Array]
) -> tuple[float, float]:
    """Largest value of the gain, kernels where they apply; of the products of factors anywhere."""
    everywhere = [np.abs(np.einsum("qra,rmb->qmab", *pair)) for pair in (first, second)]
    size = float(np.abs(multiplier).max(initial=1e-300))
    inside = [np.tril(everywhere[0]), np.triu(everywhere[1])]
    size = max(size, *(float(x.max(initial=0.0)) for x in inside))
    return size, max(size, *(float(x.max(initial=0.0)) for x in everywhere))


def _lost(outer: Array, inner: Array) -> tuple[float, float]:
    """What polynomials cost the products: by the last coefficients of either factor, by rounding of all."""
    largest = np.abs(outer).max(axis=2), np.abs(inner).max(axis=2)
    tail = _last(outer) @ largest[1] + largest[0] @ _last(inner)
    product = largest[0] @ largest[1]
    rounding = 2.0 * EPSILON * product
    return float(tail.max(initial=0.0)), float(rounding.max(initial=0.0))


def _last(samples: Array) -> Array:
    return np.asarray(np.abs(legendre.interpolate(samples)[..., -3:]).max(axis=-1))
