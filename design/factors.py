"""Polynomial factors of a gain: N0, N1a, N1b, N2a, N2b at minimal rank, the form that segments evaluate.

A kernel N(s, t) is split as N_a(s) N_b(t) by the singular values of its coefficient matrix in the orthonormal
basis (theory, section 4); directions below a stated share of the gain are dropped, which is what makes the
messages short. What is dropped is reported, and the gain is verified after the truncation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design import legendre
from design.inverse import SampledKernels
from design.legendre import Array
from design.operators import PIOperator, Shape

ROUNDING = 2e-15
"""Directions of a kernel below this, relative to the largest, are rounding whatever the tolerance."""


@dataclass(frozen=True)
class GainFactors:
    """A 3-PI operator by factors, coefficients in the orthonormal basis on [0, 1], nondimensional.

    n0 (q, m, d); n1a (q, r1, d); n1b (r1, m, d); n2a (q, r2, d); n2b (r2, m, d).
    """

    n0: Array
    n1a: Array
    n1b: Array
    n2a: Array
    n2b: Array

    @property
    def ranks(self) -> tuple[int, int]:
        """Ranks of the two sums, forward (r1) and backward (r2)."""
        return self.n1b.shape[0], self.n2b.shape[0]

    @property
    def adjoint(self) -> GainFactors:
        """The adjoint operator: the sums change direction."""
        return GainFactors(
            n0=self.n0.transpose(1, 0, 2),
            n1a=self.n2b.transpose(1, 0, 2),
            n1b=self.n2a.transpose(1, 0, 2),
            n2a=self.n1b.transpose(1, 0, 2),
            n2b=self.n1a.transpose(1, 0, 2),
        )

    def operator(self) -> PIOperator:
        """The same operator as a PIOperator."""
        q, m = self.n0.shape[:2]
        zero = PIOperator.zeros(Shape(0, q), Shape(0, m))
        return zero.replace(
            r0=self.n0,
            r1=np.einsum("qri,rmj->qmij", self.n1a, self.n1b),
            r2=np.einsum("qri,rmj->qmij", self.n2a, self.n2b),
        )

    def norm(self, size: int = 40) -> float:
        """L2-induced norm on Legendre functions of degree below `size`."""
        return float(np.linalg.norm(self.operator().discretise(size), 2))


def factorise(
    gain: SampledKernels, rank_tolerance: float, fit_tolerance: float = 1e-9
) -> tuple[GainFactors, float]:
    """Factors of minimal rank; returns them and the share of the gain that was dropped.

    rank_tolerance: directions of a kernel smaller than this times the gain's size are dropped, where the
    size is the largest L2 norm of an entry of the multiplier or singular value of a kernel. The share is
    their root sum of squares over the whole square: it bounds the operator norm of what was dropped. Of
    kernels that grow along the arm the square is much larger than the gain: there the size is less by as much
    (`SampledKernels.finer`).
    fit_tolerance: the same for polynomial coefficients.
    """
    n0 = legendre.interpolate(gain.multiplier)
    kernels = [(gain.outer1, gain.inner1), (gain.outer2, gain.inner2)]
    split = [
        _split(legendre.interpolate(outer), legendre.interpolate(inner)) for outer, inner in kernels
    ]
    largest = max(
        float(np.linalg.norm(n0, axis=2).max()), *(float(v.max(initial=0.0)) for _, v, _ in split)
    )
    level = largest / gain.finer
    floor = ROUNDING * largest
    dropped = 0.0
    parts: list[Array] = []
    for left, values, right in split:
        keep = int(np.count_nonzero(values > max(rank_tolerance * level, floor)))
        dropped += float(np.sum((values[keep:] / max(level, 1e-300)) ** 2))
        root = np.sqrt(values[:keep])
        cut = fit_tolerance * np.sqrt(level / gain.finer)
        parts.append(legendre.trim(left[:, :keep] * root[None, :, None], (2,), cut))
        parts.append(legendre.trim(right[:keep] * root[:, None, None], (2,), cut))
    n0 = legendre.trim(n0, (2,), fit_tolerance * level)
    return GainFactors(n0, *parts), float(np.sqrt(dropped))


def _split(outer: Array, inner: Array) -> tuple[Array, Array, Array]:
    """SVD of the product outer(s) inner(t), given by coefficients (q, r, d) and (r, m, d)."""
    q, r, d = outer.shape
    m = inner.shape[1]
    left, a = np.linalg.qr(outer.transpose(0, 2, 1).reshape(q * d, r))
    right, b = np.linalg.qr(inner.transpose(1, 2, 0).reshape(m * d, r))
    u, values, vt = np.linalg.svd(a @ b.T)
    u, vt = u[:, : values.size], vt[: values.size]
    outer_factors = (left @ u).reshape(q, d, -1).transpose(0, 2, 1)
    inner_factors = (vt @ right.T).reshape(-1, m, d)
    return outer_factors, values, inner_factors
