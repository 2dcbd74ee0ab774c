"""The exact inverse of a 4-PI operator (7) with R_1 = R_2, section 4: a finite matrix, no series, no fit.

With Q_1 = H_1 Z, Q_2 = Z' H_2' and R_1 = R_2 = Z(s)' Gamma Z(theta), P (x, y) = (f, g) is a linear equation for
x and the numbers m = int Z y (Woodbury's identity in function space):

    P x + H_1 m = f,   K H_2' x + (I + K Gamma) m = int Z R_0^-1 g,   K = int Z R_0^-1 Z',
    y = R_0^-1 (g - Z' (H_2' x + Gamma m)).

Between the definition (7) and the page; `chapter.inverse_reference` solves the same without any of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Function = Callable[[Array], Array]
"""Points (k,) to matrices (k, rows, columns)."""
Kernel = Callable[[Array, Array], Array]
"""Points s, theta (k,) each to matrices (k, rows, columns)."""

NODES = 400
"""Of the Gauss rule for K: R_0^-1 may have poles at a distance of some hundredths from [0, 1]."""


@dataclass(frozen=True)
class Parameters:
    """(7) on [0, 1] as it is written: P (m, m), Q1(s) (m, n), Q2(s) (n, m), R0(s), R1, R2(s, theta) (n, n)."""

    P: Array
    Q1: Function
    Q2: Function
    R0: Function
    R1: Kernel
    R2: Kernel


@dataclass(frozen=True)
class Separable:
    """P (m, m), H1, H2 (m, r), Z(s) (r, n), Gamma (r, r), R0(s) (n, n).

    Self-adjoint if H1 = H2 and P, Gamma, R0 are symmetric, which the formula does not need.
    """

    P: Array
    H1: Array
    H2: Array
    Gamma: Array
    Z: Function
    R0: Function

    @property
    def parameters(self) -> Parameters:
        """The same as (7)."""

        def kernel(s: Array, t: Array) -> Array:
            return np.asarray(_turned(self.Z(s)) @ self.Gamma @ self.Z(t))

        return Parameters(
            self.P,
            lambda s: np.asarray(self.H1 @ self.Z(s)),
            lambda s: np.asarray(_turned(self.Z(s)) @ self.H2.T),
            self.R0,
            kernel,
            kernel,
        )

    def inverse(
        self, R0_inverse: Function | None = None, *, exact_K: bool = False, nodes: int = NODES
    ) -> Inverse:
        """The formula; `R0_inverse` stands for R_0^-1 where given, in K too unless `exact_K`.

        Raises ArithmeticError if P is singular.
        """

        def exact(s: Array) -> Array:
            return np.asarray(np.linalg.inv(self.R0(s)))

        used = R0_inverse or exact
        s, w = gauss(nodes)
        Z = self.Z(s)
        K = np.einsum("k,kan,knm,kbm->ab", w, Z, (exact if exact_K else used)(s), Z, optimize=True)
        m, r = self.H1.shape
        matrix = np.block([[self.P, self.H1], [K @ self.H2.T, np.eye(r) + K @ self.Gamma]])
        if np.linalg.cond(matrix) > 1e12:
            raise ArithmeticError("P is singular: the formula's matrix has no inverse")
        found = np.linalg.inv(matrix)
        A, B, C, D = found[:m, :m], found[:m, m:], found[m:, :m], found[m:, m:]
        return Inverse(
            P=A,
            H1=B,
            H2=-(self.H2.T @ A + self.Gamma @ C).T,
            Gamma=-(self.H2.T @ B + self.Gamma @ D),
            Z=lambda points: np.asarray(self.Z(points) @ used(points)),
            Zt=lambda points: np.asarray(_turned(used(points) @ _turned(self.Z(points)))),
            R0=used,
        )


@dataclass(frozen=True)
class Inverse:
    """(7) again: P, Q1 = H1 Z, Q2 = Zt' H2', R0, R1 = R2 = Zt(s)' Gamma Z(theta).

    Z, Zt are the operator's times R_0^-1 from the right and from the left (the same if self-adjoint).
    """

    P: Array
    H1: Array
    H2: Array
    Gamma: Array
    Z: Function
    Zt: Function
    R0: Function

    def kernel(self, s: Array, t: Array) -> Array:
        """R1 = R2 at points s, t (k,): (k, n, n)."""
        return np.asarray(_turned(self.Zt(s)) @ self.Gamma @ self.Z(t))

    def apply(self, finite: Array, function: Function, s: Array) -> tuple[Array, Array]:
        """To columns (f (m, c), g(s) (k, n, c)): x (m, c) and y at s, (k, n, c)."""
        at, w = gauss(NODES)
        moments = np.einsum("k,krn,knc->rc", w, self.Z(at), function(at), optimize=True)
        x = self.P @ finite + self.H1 @ moments
        y = self.R0(s) @ function(s) + _turned(self.Zt(s)) @ (
            self.H2.T @ finite + self.Gamma @ moments
        )
        return np.asarray(x), np.asarray(y)


def in_letters(operator: Separable) -> tuple[Array, Array, Array]:
    """P^, H^ and Gamma^ of a self-adjoint operator in the closed form of the toolbox's routine,

        T = (I + K Gamma - K H' P^-1 H)^-1,   P^ = (I + P^-1 H T K H') P^-1,   H^ = -P^-1 H T,
        Gamma^ = (T' H' P^-1 H - Gamma) (I + K Gamma)^-1.

    Unlike `Separable.inverse` it also needs P and I + K Gamma invertible by themselves, as coercivity gives.
    """
    s, w = gauss(NODES)
    Z = operator.Z(s)
    K = np.einsum("k,kan,knm,kbm->ab", w, Z, np.linalg.inv(operator.R0(s)), Z, optimize=True)
    H, Gamma, P_inverse = operator.H1, operator.Gamma, np.linalg.inv(operator.P)
    one = np.eye(len(K))
    inner = H.T @ P_inverse @ H
    T = np.linalg.inv(one + K @ Gamma - K @ inner)
    P = (np.eye(len(P_inverse)) + P_inverse @ H @ T @ K @ H.T) @ P_inverse
    return P, -P_inverse @ H @ T, (T.T @ inner - Gamma) @ np.linalg.inv(one + K @ Gamma)


def _turned(matrices: Array) -> Array:
    return np.asarray(matrices.transpose(0, 2, 1))


@lru_cache(maxsize=16)
def gauss(count: int) -> tuple[Array, Array]:
    """Gauss nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (x + 1.0), 0.5 * w
