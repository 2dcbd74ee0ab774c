"""Section 4's formula for u_i, letter by letter and corrected, and the exact integral it stands for.

From a controller's factors (`wire.artefact.OperatorFactors`) to the numbers that nodes hold, the sums c_i and
d_i that they pass on, and the commands. Nothing here knows a process; `chapter.section4_run` lets real ones
do it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from wire.artefact import OperatorFactors, PolynomialMatrix

Array = npt.NDArray[np.float64]
State = Callable[[Array], Array]
"""Arclengths in m (k,) to states (k, components)."""


class Rule(StrEnum):
    """Where the nodes are, what a node's own state counts, and how long its piece is."""

    DISPLAY = "display"
    """The first formula of section 4: s_i = i ds, ds = L / (n + 1), i = 0 .. n; K_1 acts on j <= i, K_2 on j
    > i."""
    TRANSFER = "transfer"
    """The last formula: the same nodes, but c_i sums j < i and d_{i+1} sums j > i: nobody counts j = i."""
    MIDPOINT = "midpoint"
    """Corrected: s_i = (i + 1/2) ds, ds = L / N for N nodes; half of the node's own piece on either side."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """What N nodes hold: each its own places and factors."""

    places_m: Array
    """(N,)."""
    length_m: float
    """The ds."""
    K0: Array
    """(N, outputs, inputs)."""
    K1a: Array
    """(N, outputs, rank)."""
    K1b: Array
    K2a: Array
    K2b: Array
    own: tuple[float, float]
    """How much of ds the own state counts under K_1 and under K_2."""

    @property
    def count(self) -> int:
        """The number N."""
        return len(self.places_m)

    def own_matrix(self, i: int) -> Array:
        """What node i multiplies its own state with."""
        first, second = (part * self.length_m for part in self.own)
        return np.asarray(
            self.K0[i] + first * self.K1a[i] @ self.K1b[i] + second * self.K2a[i] @ self.K2b[i]
        )

    def sweep(self, x: Array) -> tuple[Array, Array, Array, int]:
        """Commands (N, outputs), c_i (N, rank), d_{i+1} (N, rank) for states (N, inputs), and how many
        transfers
        that took: a sum for every neighbour on the way."""
        c = np.zeros((self.count, self.K1b.shape[1]))
        d = np.zeros((self.count, self.K2b.shape[1]))
        transfers = 0
        for i in range(self.count - 1):
            c[i + 1] = c[i] + self.K1b[i] @ x[i]
            transfers += 1
        for i in range(self.count - 1, 0, -1):
            d[i - 1] = d[i] + self.K2b[i] @ x[i]
            transfers += 1
        u = np.stack(
            [
                self.own_matrix(i) @ x[i]
                + self.length_m * (self.K1a[i] @ c[i] + self.K2a[i] @ d[i])
                for i in range(self.count)
            ]
        )
        return u, c, d, transfers


def nodes(factors: OperatorFactors, length_m: float, count: int, rule: Rule) -> Nodes:
    """Factors at the places of `count` nodes (n + 1 of them in the chapter's numbering)."""
    step = length_m / count
    places: Array = step * (np.arange(count, dtype=np.float64) + 0.5 * (rule is Rule.MIDPOINT))
    own = {Rule.DISPLAY: (1.0, 0.0), Rule.TRANSFER: (0.0, 0.0), Rule.MIDPOINT: (0.5, 0.5)}[rule]
    return Nodes(
        places_m=places,
        length_m=step,
        K0=factors.n0(places, length_m),
        K1a=factors.n1a(places, length_m),
        K1b=factors.n1b(places, length_m),
        K2a=factors.n2a(places, length_m),
        K2b=factors.n2b(places, length_m),
        own=own,
    )


def pairs(factors: OperatorFactors, length_m: float, count: int, rule: Rule) -> Array:
    """The same without sums that travel: u_i = sum over j of [i, :, j, :] x_j, (N, outputs, N, inputs).

    Kernels K_1(s_i, s_j), K_2(s_i, s_j) pair by pair from the coefficients. Shares nothing with `Nodes` but
    the rule.
    """
    step = length_m / count
    s = [(i + 0.5 * (rule is Rule.MIDPOINT)) * step for i in range(count)]
    outputs, inputs = factors.n0.array.shape[:2]
    out = np.zeros((count, outputs, count, inputs))
    for i in range(count):
        out[i, :, i] = _at(factors.n0, s[i], length_m)
        for j in range(count):
            below = _at(factors.n1a, s[i], length_m) @ _at(factors.n1b, s[j], length_m)
            above = _at(factors.n2a, s[i], length_m) @ _at(factors.n2b, s[j], length_m)
            if i == j:
                kernel = {
                    Rule.DISPLAY: below,
                    Rule.TRANSFER: 0.0 * below,
                    Rule.MIDPOINT: 0.5 * (below + above),
                }[rule]
            else:
                kernel = below if j < i else above
            out[i, :, j] += step * kernel
    return out


def _at(matrix: PolynomialMatrix, s_m: float, length_m: float) -> Array:
    series = matrix.array
    degrees = series.shape[2]
    values = legendre.legvander(np.array([2.0 * s_m / length_m - 1.0]), degrees - 1)[0]
    return np.asarray(series @ values, dtype=np.float64)


def exact(
    factors: OperatorFactors, length_m: float, x: State, places_m: Array, points: int = 60
) -> Array:
    """(K x)(s) at the places by Gauss quadrature on either side, (N, outputs)."""
    nodes_, weights = legendre.leggauss(points)
    out = []
    for s in places_m:
        here = np.array([s])
        value = factors.n0(here, length_m)[0] @ x(here)[0]
        for a, b, low, high in (
            (factors.n1a, factors.n1b, 0.0, s),
            (factors.n2a, factors.n2b, s, length_m),
        ):
            t = 0.5 * (low + high) + 0.5 * (high - low) * nodes_
            inner = np.einsum("krm,km,k->r", b(t, length_m), x(t), weights)
            value = value + 0.5 * (high - low) * a(here, length_m)[0] @ inner
        out.append(value)
    return np.stack(out)


def columns(factors: OperatorFactors, inputs: list[int]) -> OperatorFactors:
    """The same operator on some of its inputs."""

    def some(matrix: PolynomialMatrix) -> PolynomialMatrix:
        return PolynomialMatrix.from_array(matrix.array[:, inputs])

    return OperatorFactors(
        some(factors.n0), factors.n1a, some(factors.n1b), factors.n2a, some(factors.n2b)
    )


def wave(s_m: Array) -> Array:
    """A smooth state (v_x, v_y, e, k) for the refinement, of comparable components."""
    return np.stack(
        [np.sin(3.0 * s_m), np.exp(-s_m), 0.01 * np.cos(5.0 * s_m), 1.0 + np.sin(2.0 * s_m)], axis=1
    )


def refinement(
    factors: OperatorFactors, length_m: float, counts: tuple[int, ...]
) -> dict[str, list[float]]:
    """Largest error of the commands against the exact integral, relative to the largest command, by rule."""
    out: dict[str, list[float]] = {}
    for rule in Rule:
        found = []
        for count in counts:
            hold = nodes(factors, length_m, count, rule)
            wanted = exact(factors, length_m, wave, hold.places_m)
            got = hold.sweep(wave(hold.places_m))[0]
            found.append(float(np.abs(got - wanted).max() / np.abs(wanted).max()))
        out[str(rule)] = found
    return out
