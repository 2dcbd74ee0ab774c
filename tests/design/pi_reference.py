"""Operators evaluated point by point from their definition (7): shares no code with the algebra.

Kernels are evaluated with numpy.polynomial.legendre and integrated with Gauss rules on [0, s] and
[s, 1], so that only the storage convention (orthonormal coefficients) is taken from `design`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st
from numpy.polynomial import legendre as plain

from design.operators import PIOperator, Shape

Array = npt.NDArray[np.float64]
Function = Callable[[Array], Array]
PARAMETERS = ("p", "q1", "q2", "r0", "r1", "r2")
GAUSS_X, GAUSS_W = plain.leggauss(24)
POINTS = np.array([0.0, 0.07, 0.31, 0.5, 0.83, 1.0])


def values(s: Array, size: int) -> Array:
    """phi_j(s) = sqrt(2j + 1) P_j(2s - 1), shape (*s.shape, size)."""
    unit = np.eye(size) * np.sqrt(2.0 * np.arange(size) + 1.0)
    return np.asarray(np.moveaxis(plain.legval(2.0 * s - 1.0, unit), 0, -1))


def at(coefficients: Array, s: Array) -> Array:
    """A matrix polynomial (q, n, d) at points (k,): shape (k, q, n)."""
    return np.asarray(np.einsum("qni,ki->kqn", coefficients, values(s, coefficients.shape[2])))


def kernel_at(coefficients: Array, s: Array, t: Array) -> Array:
    """A kernel (q, n, ds, dt) at pairs of points s, t of one shape: (*shape, q, n)."""
    left = values(s, coefficients.shape[2])
    right = values(t, coefficients.shape[3])
    return np.asarray(np.einsum("qnij,...i,...j->...qn", coefficients, left, right, optimize=True))


def polynomial(coefficients: Array) -> Function:
    """The function with coefficients (n, d): maps points (k,) to values (n, k)."""

    def evaluate(s: Array) -> Array:
        return np.asarray(coefficients @ values(s, coefficients.shape[1]).T)

    return evaluate


def rule(low: Array, high: Array) -> tuple[Array, Array]:
    """Gauss points and weights on the intervals [low_k, high_k], each (k, 24)."""
    half = 0.5 * (high - low)[:, None]
    return low[:, None] + half * (GAUSS_X + 1.0), half * GAUSS_W


def finite_part(a: PIOperator, x: Array, y: Function) -> Array:
    """P x + int_0^1 Q1 y."""
    t, w = rule(np.zeros(1), np.ones(1))
    return np.asarray(a.p @ x + np.einsum("kpn,nk,k->p", at(a.q1, t[0]), y(t[0]), w[0]))


def function_part(a: PIOperator, x: Array, y: Function) -> Function:
    """s -> Q2(s) x + R0(s) y(s) + int_0^s R1(s,t) y(t) dt + int_s^1 R2(s,t) y(t) dt."""

    def evaluate(s: Array) -> Array:
        out = np.einsum("kqm,m->qk", at(a.q2, s), x)
        out = out + np.einsum("kqn,nk->qk", at(a.r0, s), y(s))
        for kernel, low, high in ((a.r1, np.zeros_like(s), s), (a.r2, s, np.ones_like(s))):
            t, w = rule(low, high)
            inside = y(t.ravel()).reshape(-1, *t.shape)
            k = kernel_at(kernel, np.broadcast_to(s[:, None], t.shape), t)
            out = out + np.einsum("kaqn,nka,ka->qk", k, inside, w, optimize=True)
        return np.asarray(out)

    return evaluate


def inner(x: Array, y: Function, u: Array, v: Function) -> float:
    """<(x, y), (u, v)> in R^m x L2^n."""
    t, w = rule(np.zeros(1), np.ones(1))
    return float(x @ u + np.sum(y(t[0]) * v(t[0]) * w[0]))


def distance(a: PIOperator, b: PIOperator) -> float:
    """Largest difference between the parameters, which are unique to an operator."""
    assert (a.shape_out, a.shape_in) == (b.shape_out, b.shape_in)
    worst = 0.0
    for key in PARAMETERS:
        left, right = getattr(a, key), getattr(b, key)
        pads = [
            (max(j - i, 0), max(i - j, 0)) for i, j in zip(left.shape, right.shape, strict=True)
        ]
        wide = np.pad(left, [(0, k) for k, _ in pads]) - np.pad(right, [(0, k) for _, k in pads])
        worst = max(worst, float(np.max(np.abs(wide), initial=0.0)))
    return worst


def size_of(*operators: PIOperator) -> float:
    """Scale for tolerances: product of the largest parameters."""
    out = 1.0
    for a in operators:
        out *= 1.0 + max(float(np.max(np.abs(getattr(a, k)), initial=0.0)) for k in PARAMETERS)
    return out


def random_operator(rng: np.random.Generator, out: Shape, into: Shape) -> PIOperator:
    """All parameters present, each of its own random degree (up to 3)."""

    def draw(*shape: int, degrees: int) -> Array:
        return rng.uniform(-1.0, 1.0, (*shape, *rng.integers(1, 5, degrees)))

    return PIOperator(
        p=draw(out.finite, into.finite, degrees=0),
        q1=draw(out.finite, into.functions, degrees=1),
        q2=draw(out.functions, into.finite, degrees=1),
        r0=draw(out.functions, into.functions, degrees=1),
        r1=draw(out.functions, into.functions, degrees=2),
        r2=draw(out.functions, into.functions, degrees=2),
    )


@dataclass(frozen=True)
class Chain:
    """Operators that can be composed, first to last, and vectors of the spaces between them.

    `operators[i]` maps space i + 1 to space i.
    """

    spaces: tuple[Shape, ...]
    operators: tuple[PIOperator, ...]
    twins: tuple[PIOperator, ...]
    """Other operators between the same spaces."""
    vectors: tuple[tuple[Array, Function], ...]
    others: tuple[tuple[Array, Function], ...]


THREE_PI = st.builds(Shape, st.just(0), st.integers(1, 3))
FOUR_PI = st.builds(Shape, st.integers(1, 2), st.integers(1, 2))
EMPTY_PARTS = st.builds(Shape, st.integers(0, 2), st.integers(0, 1))
SPACES = st.one_of(THREE_PI, FOUR_PI, EMPTY_PARTS)


@st.composite
def chains(draw: st.DrawFn, length: int) -> Chain:
    """`length` operators between 3-PI, 4-PI, finite and empty spaces of differing sizes."""
    spaces = tuple(draw(SPACES) for _ in range(length + 1))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def vector(shape: Shape) -> tuple[Array, Function]:
        coefficients = rng.uniform(-1.0, 1.0, (shape.functions, int(rng.integers(1, 5))))
        return rng.uniform(-1.0, 1.0, shape.finite), polynomial(coefficients)

    pairs = list(pairwise(spaces))
    return Chain(
        spaces=spaces,
        operators=tuple(random_operator(rng, out, into) for out, into in pairs),
        twins=tuple(random_operator(rng, out, into) for out, into in pairs),
        vectors=tuple(vector(s) for s in spaces),
        others=tuple(vector(s) for s in spaces),
    )
