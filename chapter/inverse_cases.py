"""Operators on which section 4's words about P^-1 are tried, and their inverses by every way there is.

Between `chapter.inverse_formula`, `design.inverse` (what octarm does), `chapter.inverse_reference` and the
page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from chapter.inverse_formula import Function, Parameters, Separable
from chapter.inverse_reference import Nystrom, relative, right_sides
from design import legendre
from design.factors import factorise
from design.inverse import separate, solve_gain
from design.lpi.gains import gain_operator
from design.operators import PIOperator, Shape

Array = npt.NDArray[np.float64]

BEST = 12
SERIES_TERMS = 19
"""Of iterated integrals, where the series is cut off."""


# -- R_1 = R_2 ------------------------------------------------------------------------------------


def rational(*, self_adjoint: bool = True, sign: float = 1.0, seed: int = 5) -> Separable:
    """Two numbers and two functions; R_0 a full matrix with its nearest complex singularity 0.28 from [0, 1].

    sign -1 turns Gamma: then P is indefinite, but has an inverse.
    """
    random = np.random.default_rng(seed)
    m, n, powers = 2, 2, 3
    r = n * powers
    root = random.normal(size=(r, r))
    H1, H2 = 0.3 * random.normal(size=(2, m, r))
    P = np.array([[3.0, 0.5], [0.5, 4.0]])
    Gamma = 0.3 * sign * root @ root.T

    def R0(s: Array) -> Array:
        off = 0.3 * s
        diagonal = 0.3 + 2.0 * (s - 0.4) ** 2, 1.0 + s
        lower = off if self_adjoint else -off
        entries = np.array([[diagonal[0], off], [lower, diagonal[1]]], dtype=np.float64)
        return np.asarray(np.moveaxis(entries, 2, 0))

    if not self_adjoint:
        P, Gamma = P + np.array([[0.0, 1.0], [-1.0, 0.0]]), root
    return Separable(P, H1, H1 if self_adjoint else H2, Gamma, powers_of(n, powers), R0)


def powers_of(n: int, powers: int) -> Function:
    """Z(s) = I_n (x) (1, s, ..): (k, n powers, n)."""

    def Z(s: Array) -> Array:
        values = s[:, None] ** np.arange(powers)
        stacked = np.einsum("kd,ab->kadb", values, np.eye(n))
        return np.asarray(stacked.reshape(len(s), n * powers, n))

    return Z


def formula_error(operator: Separable, size: int = 40) -> float:
    """Of the formula against quadrature, relative, on all polynomials of degree < 6."""
    rule = Nystrom(operator.parameters, size)
    f, g = right_sides(rule.finite, rule.functions)
    found = operator.inverse().apply(f, g, rule.nodes)
    return relative(found, rule.solve(f, g), rule.weights)


def octarm_error(of: Parameters, degree: int, size: int = 40) -> tuple[float, float]:
    """Of octarm's P^-1 (`design.lpi.gains`, the ODE of `design.inverse`) against quadrature, its fit's tail.

    degree: of P's polynomials in each variable.
    """
    rule = Nystrom(of, size)
    f, g = right_sides(rule.finite, rule.functions)
    P = operator_of(of, degree)
    inverse, tail = gain_operator(P, PIOperator.identity(P.shape_in))
    return relative(applied(inverse, f, g, rule.nodes), rule.solve(f, g), rule.weights), tail


def applied(
    operator: PIOperator, finite: Array, function: Function, s: Array
) -> tuple[Array, Array]:
    """To columns, as `Inverse.apply`."""
    columns = [
        operator.apply(finite[:, j], lambda t, j=j: function(t)[:, :, j].T, s)  # type: ignore[misc]
        for j in range(finite.shape[1])
    ]
    x = np.array([one for one, _ in columns]).T
    return x.reshape(len(x), finite.shape[1]), np.moveaxis(
        np.array([y for _, y in columns]), (0, 2), (2, 0)
    )


def operator_of(of: Parameters, degree: int) -> PIOperator:
    """In octarm's basis, from samples; exact for polynomials of this degree in each variable."""
    nodes, _ = legendre.gauss(degree + 1)
    s, t = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
    shape = Shape(len(of.P), of.R0(nodes).shape[1])

    def fitted(samples: Array) -> Array:
        return legendre.fit(np.moveaxis(samples, 0, 2))

    def kernel(samples: Array) -> Array:
        q, n = samples.shape[1:]
        grid = np.moveaxis(samples, 0, 2).reshape(q, n, degree + 1, degree + 1)
        return legendre.fit(legendre.fit(grid).swapaxes(2, 3)).swapaxes(2, 3)

    return PIOperator.zeros(shape, shape).replace(
        p=of.P,
        q1=fitted(of.Q1(nodes)),
        q2=fitted(of.Q2(nodes)),
        r0=fitted(of.R0(nodes)),
        r1=kernel(of.R1(s, t)),
        r2=kernel(of.R2(s, t)),
    )


# -- R_1 != R_2 -----------------------------------------------------------------------------------


def membrane(c: float) -> Parameters:
    """x + c int min(s, theta) x: R_1 = c theta, R_2 = c s, self-adjoint and >= I for c >= 0.

    u = int min x solves -u'' + c u = y, u(0) = u'(1) = 0: see `membrane_kernel`.
    """
    return Parameters(
        np.zeros((0, 0)),
        lambda s: np.zeros((len(s), 0, 1)),
        lambda s: np.zeros((len(s), 1, 0)),
        lambda s: np.ones((len(s), 1, 1)),
        lambda _, t: c * t[:, None, None],
        lambda s, _: c * s[:, None, None],
    )


def membrane_kernel(c: float, s: Array, t: Array) -> Array:
    """The kernel of its inverse, in closed form: hyperbolic, no polynomial. R_0^ is 1."""
    w = np.sqrt(c)
    low, high = np.minimum(s, t), np.maximum(s, t)
    return np.asarray(-w * np.sinh(w * low) * np.cosh(w * (1.0 - high)) / np.cosh(w))


def of_one_kernel(P: PIOperator, kernel: Array) -> Separable:
    """P with the same kernel (n, n, ds, dt) on both sides of the diagonal: what the formula can be given."""
    (m, n), size = P.shape_in, max(kernel.shape[2:])
    Gamma = np.zeros((n, size, n, size))
    Gamma[:, : kernel.shape[2], :, : kernel.shape[3]] = kernel.transpose(0, 2, 1, 3)
    none = np.zeros((m, n * size))

    def Z(s: Array) -> Array:
        values = legendre.basis(s, size)
        stacked = np.einsum("kd,ab->kadb", values, np.eye(n))
        return np.asarray(stacked.reshape(len(s), n * size, n))

    def R0(s: Array) -> Array:
        return np.asarray(np.moveaxis(P.r0 @ legendre.basis(s, P.r0.shape[2]).T, 2, 0))

    return Separable(P.p, none, none, Gamma.reshape(n * size, n * size), Z, R0)


def one_kernels(P: PIOperator, size: int = BEST) -> dict[str, Array]:
    """What to take for it: R_1 on both sides, the mean, and the L2-best polynomial of degree < `size`."""
    width = max(*P.r1.shape[2:], *P.r2.shape[2:])
    r1, r2 = (
        np.pad(k, ((0, 0), (0, 0), (0, width - k.shape[2]), (0, width - k.shape[3])))
        for k in (P.r1, P.r2)
    )
    return {
        "R_1 on both sides": r1,
        "mean of R_1 and R_2": 0.5 * (r1 + r2),
        f"best of degree {size - 1}": best_kernel(P, size),
    }


def best_kernel(P: PIOperator, size: int) -> Array:
    """The projection of the kernel, with its edge, on polynomials of degree < `size` in each variable."""
    n = P.shape_in.functions
    matrix = P.replace(r0=np.zeros((n, n, 1))).discretise(size)[
        P.shape_in.finite :, P.shape_in.finite :
    ]
    return matrix.reshape(n, size, n, size).transpose(0, 2, 1, 3)


def best_kernel_errors(P: PIOperator, sizes: Sequence[int], fine: int = 160) -> list[float]:
    """Of P^-1 with the best kernel of degree < size, in the spectral norm, relative; R_0 = 1, scalar."""
    exact = np.linalg.inv(P.discretise(fine))
    out = []
    for size in sizes:
        matrix = np.eye(fine)
        matrix[:size, :size] += best_kernel(P, size)[0, 0]
        out.append(
            float(np.linalg.norm(np.linalg.inv(matrix) - exact, 2) / np.linalg.norm(exact, 2))
        )
    return out


@dataclass(frozen=True)
class OneKernel:
    """Errors of x = P^-1 y for the membrane, relative, on polynomials y of degree < 6, by way."""

    c: float
    condition: float
    """1 + 4 c / pi^2: of P."""
    quadrature: float
    """Against the closed form, which nothing else is compared with."""
    octarm: float
    """P^-1 as an operator, its kernels polynomials. NaN: refused."""
    octarm_functions: float
    """P^-1 y alone, without kernels."""
    series: float
    one: dict[str, float]


def one_kernel(c: float) -> OneKernel:
    """Every way to the inverse of the membrane's operator."""
    of = membrane(c)
    P = operator_of(of, 1)
    s, w = legendre.gauss(60)
    finite, y = right_sides(0, 1)
    none = np.zeros((0, 0))

    def closed(a: Array, b: Array) -> Array:
        return membrane_kernel(c, a, b)[:, None, None]

    # the closed form's integrals split at the edge, by the rule's own matrix
    applied_closed = Nystrom(Parameters(none, of.Q1, of.Q2, of.R0, closed, closed), 60).matrix
    x = (np.zeros((0, y(s).shape[2])), (applied_closed @ y(s)[:, 0]).reshape(y(s).shape))
    try:
        inverse, _ = gain_operator(P, PIOperator.identity(Shape(0, 1)))
        octarm = relative(applied(inverse, finite, y, s), x, w)
    except ArithmeticError:
        octarm = float("nan")
    coefficients = legendre.fit(np.moveaxis(y(legendre.gauss(6)[0]), 0, 2))
    column = PIOperator.zeros(Shape(0, 1), Shape(coefficients.shape[1], 0))
    given, _ = gain_operator(P, column.replace(q2=coefficients))
    functions = np.moveaxis(given.q2 @ legendre.basis(s, given.q2.shape[2]).T, 2, 0)
    return OneKernel(
        c,
        1.0 + 4.0 * c / np.pi**2,
        relative(Nystrom(of, 60).solve(finite, y), x, w),
        octarm,
        relative((x[0], functions), x, w),
        relative((x[0], series(P, SERIES_TERMS, y, s, w)), x, w),
        {
            name: relative(of_one_kernel(P, kernel).inverse().apply(finite, y, s), x, w)
            for name, kernel in one_kernels(P).items()
        },
    )


def series(P: PIOperator, terms: int, y: Function, s: Array, w: Array) -> Array:
    """P^-1 y at the Gauss nodes s (weights w) with the transition matrix U' = M U, U(0) = I and its inverse as
    sums of `terms` iterated integrals (Picard's series, cut off); R_0 = 1, scalar, kernels of rank one each."""
    f1, g1 = separate(P.r1)
    f2, g2 = separate(P.r2)

    def at(a: Array) -> Array:
        return np.asarray(a[0, 0] @ legendre.basis(s, a.shape[2]).T)

    C = -np.stack([at(f1), at(f2)], axis=1)
    B = np.stack([at(g1), -at(g2)], axis=1)
    M = B[:, :, None] * C[:, None, :]
    ends = np.zeros((len(s) + 1, len(s)))  # integrals from 0 to the nodes and to 1
    size = len(s)
    primitive = legendre.integration(size, size + 1)
    transform = legendre.basis(s, size).T * w
    ends[:] = legendre.basis(np.append(s, 1.0), size + 1) @ (primitive.T @ transform)
    U, V = (np.broadcast_to(np.eye(2), (size + 1, 2, 2)).copy() for _ in range(2))
    last_u, last_v = U[:-1], V[:-1]
    for _ in range(terms):
        step_u = np.einsum("ij,jab->iab", ends, M @ last_u)
        step_v = np.einsum("ij,jab->iab", ends, -last_v @ M)
        U, V, last_u, last_v = U + step_u, V + step_v, step_u[:-1], step_v[:-1]
    project = np.array([[0.0, 0.0], [U[-1, 1, 0] / U[-1, 1, 1], 1.0]])
    inner = np.einsum("kab,kb,kc->kac", V[:-1], B, y(s)[:, 0])
    low = np.einsum("ij,jac->iac", ends, np.eye(2) @ inner)
    below, whole = low[:-1], low[-1]
    sums = (np.eye(2) - project) @ below - project @ (whole - below)
    return np.asarray(y(s) + np.einsum("ka,kab,kbc->kc", C, U[:-1], sums)[:, None])


@dataclass(frozen=True)
class Polynomials:
    """The membrane's inverse in polynomial factors cut at a tolerance."""

    tolerance: float
    rank: int
    degree: int
    error: float
    """Of N_1 against the closed form, largest, relative to its largest."""


def polynomials(c: float, tolerance: float) -> Polynomials:
    """Factors N_1a(s) N_1b(theta) at minimal rank, as octarm stores gains."""
    gain = solve_gain(operator_of(membrane(c), 1), PIOperator.identity(Shape(0, 1)))
    factors, _ = factorise(gain, 1e-9, tolerance)
    i, j = np.tril_indices(60)
    s = np.linspace(0.0, 1.0, 60)
    left = factors.n1a[0] @ legendre.basis(s, factors.n1a.shape[2]).T
    right = factors.n1b[:, 0] @ legendre.basis(s, factors.n1b.shape[2]).T
    found = np.einsum("rk,rk->k", left[:, i], right[:, j])
    exact = membrane_kernel(c, s[i], s[j])
    degree = max(factors.n1a.shape[2], factors.n1b.shape[2]) - 1
    error = float(np.abs(found - exact).max() / np.abs(exact).max())
    return Polynomials(tolerance, factors.ranks[0], degree, error)
