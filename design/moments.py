"""The arm's LPI in moments of the state: the coordinates in which it is a small matrix inequality.

P is taken as an operator that is scalar but for finitely many moments,

    P = q I + kappa S + h W h*,   q = delta + p + eta |kappa|,   p I + W >= 0,

with S the symmetric part of J A^-1 (J = diag(1, 1, -1, -1): virtual work, by which strains dissipate), eta its
norm, and h = A^-* phi for the first Legendre polynomials phi of every state. These h are vectors of polynomials
in the domain of A*, so every term of the inequality (`design.hinf`) is bounded on the state itself and needs
finitely many functionals of it besides multipliers:

    2 <x, x_t> = -2 d |v|^2 - 2 <x, B w>  (and less, with Kelvin-Voigt damping),
    2 <x, S x_t> = 2 |v|^2 - 2 |e, k|^2 - 2 <x, S B w>,      <h, x>_t = <phi, x> - <h, B w>,

for A* J A^-1 = J and A* h = phi. No boundary term appears and no kernel has to be matched, so frames of any
degree, i.e. any bent arm, cost the same; and with more moments such P come as close to any P as one likes.
Source: chapter (18), errata of theory, section 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from design.hinf import HinfProblem
from design.legendre import Array
from design.operators import PIOperator, Shape

ROUNDING = 1e-9
"""Polynomials and directions smaller than this share of the largest are rounding."""
SHORTEST = 1e-6
"""Directions of h shorter than this share of the longest are left out."""
PARITY = np.array([1.0, 1.0, -1.0, -1.0])
"""J: velocities +1, strains -1."""
MARGIN_OF_ETA = 1.02
EXTRA_OUTPUTS = 4
"""Moments of an output beyond `count`, where the output is more than a single state."""


@dataclass(frozen=True)
class Moments:
    """Coordinates: m moments of x, each of one state and one orthonormal polynomial; r of the outputs.

    state (m,): the state that a moment is of. h, rates (k, m): <h, x> for k orthonormal h, and what they
    differentiate to, size <h, x>_t = rates x; size (k,): how long h is for polynomials phi of length one.
    B, SB (w, m); C1 (z, m); outputs (r, m): the moments of C2 x; output (r,): which output each is of.
    x_span (p, m), y_span (s, r): what the part of Z that is no multiplier maps to and from.
    """

    bases: tuple[Array, ...]
    output_bases: tuple[Array, ...]
    state: Array
    output: Array
    h: Array
    rates: Array
    size: Array
    B: Array
    SB: Array
    C1: Array
    outputs: Array
    x_span: Array
    y_span: Array
    S: PIOperator
    eta: float

    def functions(self, moments: Array) -> Array:
        """Rows of coordinates (k, m) as vectors of polynomials (k, 4, d)."""
        return assembled(moments, self.bases)

    def output_functions(self, moments: Array) -> Array:
        """Rows of coordinates (k, r) as vectors of polynomials of the outputs (k, outputs, d)."""
        return assembled(moments, self.output_bases)


def make_moments(problem: HinfProblem, count: int) -> Moments:
    """Moments with `count` polynomials a state. Raises ValueError for count < 1."""
    if count < 1:
        raise ValueError(f"moments: expected at least 1 polynomial a state, got {count}")
    n = problem.T.shape_out.functions
    phi = monomials(n, count)
    raw = dual(phi, problem.krylov)
    left, values, _ = np.linalg.svd(raw.reshape(len(raw), -1), full_matrices=False)
    keep = values > SHORTEST * values[0]
    size = values[keep]
    h = np.einsum("ab,acd->bcd", left[:, keep], raw) / size[:, None, None]
    rates = np.einsum("ab,acd->bcd", left[:, keep], phi)
    work = PIOperator.multiplier(np.diag(PARITY)[:, :, None]) @ problem.krylov
    S = (work + work.adjoint) * 0.5
    B, SB = (np.moveaxis(a.q2, 1, 0) for a in (problem.B, S @ problem.B))
    C1 = problem.C1.q1
    needed = [h, SB, phi, B, C1]
    selected = _selected(problem.C2)
    outputs = problem.C2.shape_out.functions
    if selected is None:
        seen = dual(monomials(outputs, count + EXTRA_OUTPUTS), problem.C2)
        bases = tuple(span_basis([f[:, i] for f in (*needed, seen)]) for i in range(n))
        output_bases: tuple[Array, ...] = (np.eye(count + EXTRA_OUTPUTS),) * outputs
    else:
        bases = tuple(span_basis([f[:, i] for f in needed]) for i in range(n))
        output_bases = tuple(bases[i] for i in selected)

    def coordinates(functions: Array) -> Array:
        return coordinates_in(functions, bases)

    places = np.cumsum([0, *map(len, output_bases)])
    test = assembled(np.eye(places[-1]), output_bases)
    of_h = coordinates_in(dual(h, problem.C2.adjoint), output_bases)
    first = coordinates_in(monomials(outputs, count), output_bases)
    return Moments(
        bases=bases,
        output_bases=output_bases,
        state=np.repeat(np.arange(n), list(map(len, bases))),
        output=np.repeat(np.arange(outputs), list(map(len, output_bases))),
        h=coordinates(h),
        rates=coordinates(rates),
        size=size,
        B=coordinates(B),
        SB=coordinates(SB),
        C1=coordinates(C1),
        outputs=coordinates(dual(test, problem.C2)),
        x_span=orthonormal(np.concatenate([coordinates(f) for f in (h, phi, SB)])),
        y_span=orthonormal(np.concatenate([of_h, first])),
        S=S,
        eta=MARGIN_OF_ETA * float(np.abs(np.linalg.eigvalsh(S.discretise(32))).max()),
    )


def functionals(functions: Array) -> PIOperator:
    """x -> the numbers <f_k, x>, from vectors of polynomials (k, n, d)."""
    k, n, _ = functions.shape
    return PIOperator.zeros(Shape(k, 0), Shape(0, n)).replace(q1=functions)


def dual(functions: Array, operator: PIOperator) -> Array:
    """operator* f for vectors of polynomials f (k, n, d)."""
    return np.asarray((functionals(functions) @ operator).q1)


def _selected(C2: PIOperator) -> tuple[int, ...] | None:
    """The states that C2 picks; None if its outputs are mixtures of states, such as n.v."""
    constant = not np.any(C2.r0[:, :, 1:]) and not np.any(C2.r1) and not np.any(C2.r2)
    places = np.argmax(C2.r0[:, :, 0], axis=1)
    picks = np.array_equal(C2.r0[:, :, 0], np.eye(C2.r0.shape[1])[places])
    return tuple(map(int, places)) if constant and picks else None


def monomials(n: int, count: int) -> Array:
    """phi_j of state i for all i and j < count: (n count, n, count)."""
    return np.asarray(np.einsum("ab,cd->acbd", np.eye(n), np.eye(count)).reshape(-1, n, count))


def assembled(moments: Array, bases: Sequence[Array]) -> Array:
    """Functions (k, n, d) from their coordinates (k, sum of basis sizes); the inverse of `coordinates_in`."""
    width = max(b.shape[1] for b in bases)
    out = np.zeros((len(moments), len(bases), width))
    start = 0
    for i, basis in enumerate(bases):
        out[:, i, : basis.shape[1]] = moments[:, start : start + len(basis)] @ basis
        start += len(basis)
    return out


def coordinates_in(functions: Array, bases: Sequence[Array]) -> Array:
    """Inner products with all basis functions: (k, sum of basis sizes)."""
    parts = []
    for i, basis in enumerate(bases):
        width = min(functions.shape[2], basis.shape[1])
        parts.append(functions[:, i, :width] @ basis[:, :width].T)
    return np.concatenate(parts, axis=1)


def span_basis(parts: Sequence[Array]) -> Array:
    """Orthonormal basis (r, d) of the span of scalar polynomials given as rows."""
    width = max(p.shape[1] for p in parts)
    rows = np.concatenate([np.pad(p, ((0, 0), (0, width - p.shape[1]))) for p in parts])
    norms = np.linalg.norm(rows, axis=1)
    keep = norms > ROUNDING * norms.max()
    return orthonormal(rows[keep] / norms[keep][:, None])


def orthonormal(rows: Array) -> Array:
    """Orthonormal basis of the span of rows."""
    _, values, right = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(right[values > ROUNDING * values[0]])
