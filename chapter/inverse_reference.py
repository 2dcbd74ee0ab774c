"""P (x, y) = (f, g) by quadrature (Nystrom), for any 4-PI operator: what the formulas of section 4 are held to.

y is the polynomial through its values at Gauss nodes; the integrals from 0 to s_i and from s_i to 1 are taken
apart, each by a Gauss rule of its own, so that the edge of the kernel at s = theta costs nothing. No inverse of
R_0, no splitting of kernels and nothing of octarm's algebra enters.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from chapter.inverse_formula import Function, Parameters

Array = npt.NDArray[np.float64]


class Nystrom:
    """The matrix of an operator on its finite part and the values at `size` Gauss nodes."""

    def __init__(self, of: Parameters, size: int) -> None:
        x, w = legendre.leggauss(size)
        self.nodes, self.weights = 0.5 * (x + 1.0), 0.5 * w
        s = self.nodes
        m, n = len(of.P), of.R0(s[:1]).shape[1]
        self.finite, self.functions = m, n
        function = np.zeros((size, n, size, n))
        at = np.arange(size)
        function[at, :, at, :] = of.R0(s)
        to_series = (
            legendre.legvander(x, size - 1) * (np.arange(size) + 0.5) * w[:, None]
        ).T  # (degree, node)
        for i in range(size):
            for kernel, low, high in ((of.R1, 0.0, s[i]), (of.R2, s[i], 1.0)):
                t = low + (high - low) * s
                through = legendre.legvander(2.0 * t - 1.0, size - 1) @ to_series
                values = (
                    kernel(np.full(size, s[i]), t) * ((high - low) * self.weights)[:, None, None]
                )
                function[i] += np.einsum("aqn,aj->qjn", values, through, optimize=True)
        row = of.Q1(s) * self.weights[:, None, None]
        column = of.Q2(s)
        self.matrix = np.block(
            [
                [of.P, row.transpose(1, 0, 2).reshape(m, size * n)],
                [column.reshape(size * n, m), function.reshape(size * n, size * n)],
            ]
        )

    def solve(self, finite: Array, function: Function) -> tuple[Array, Array]:
        """For columns (f (m, c), g(s) (k, n, c)): x (m, c) and y at the nodes, (k, n, c)."""
        g = function(self.nodes)
        columns = g.shape[2]
        found = np.linalg.solve(self.matrix, np.vstack([finite, g.reshape(-1, columns)]))
        return found[: self.finite], found[self.finite :].reshape(g.shape)

    def eigenvalues(self) -> Array:
        """Of the symmetric part in R^m x L2, ascending: the operator's own if it is self-adjoint."""
        root = np.concatenate(
            [np.ones(self.finite), np.repeat(np.sqrt(self.weights), self.functions)]
        )
        scaled = root[:, None] * self.matrix / root
        return np.asarray(np.linalg.eigvalsh(0.5 * (scaled + scaled.T)))


def right_sides(finite: int, functions: int, degrees: int = 6) -> tuple[Array, Function]:
    """All unit vectors of R^m and Legendre polynomials of degree < `degrees` in every function, as columns."""
    count = finite + functions * degrees
    corner = np.zeros((finite, count))
    corner[:, :finite] = np.eye(finite)

    def function(s: Array) -> Array:
        out = np.zeros((len(s), functions, count))
        values = legendre.legvander(2.0 * s - 1.0, degrees - 1)
        for j in range(functions):
            start = finite + j * degrees
            out[:, j, start : start + degrees] = values
        return out

    return corner, function


def relative(found: tuple[Array, Array], expected: tuple[Array, Array], weights: Array) -> float:
    """|found - expected| / |expected| in R^m x L2, over all columns; functions at nodes with these weights."""

    def square(x: Array, y: Array) -> float:
        return float(np.sum(x**2) + np.einsum("k,knc->", weights, y**2))

    return float(
        np.sqrt(square(found[0] - expected[0], found[1] - expected[1]) / square(*expected))
    )
