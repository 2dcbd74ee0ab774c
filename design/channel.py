"""Linear systems as matrices: H-infinity norms, and the best value that any gain could reach.

Shared by the two verifications: of the arm's gains on finite differences, of a PDE's in Legendre functions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import linalg
from scipy.optimize import minimize_scalar

Array = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

_ON_THE_AXIS = 1e-12
"""Real parts below this share of the largest eigenvalue are rounding: such a mode does not decay."""
PEAKS = 5
"""Local maxima of the sweep that are refined, the highest ones."""
FREQUENCIES = np.concatenate([[0.0], np.geomspace(1e-2, 1e3, 120)])


@dataclass(frozen=True)
class Channel:
    """x_t = A x + B w, z = C x + D w, nondimensional and in coordinates where norms are Euclidean."""

    A: Array
    B: Array
    C: Array
    D: Array

    @cached_property
    def _schur(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Triangular T, and input and output matrix in its coordinates: a frequency costs one sweep."""
        T, Q = linalg.schur(self.A.astype(np.complex128), output="complex")
        return T, Q.conj().T @ self.B, self.C @ Q

    def norm_at(self, omega: float) -> float:
        """Largest singular value of the transfer function at i omega."""
        if not self.D.size:
            return 0.0
        T, B, C = self._schur
        shifted = 1j * omega * np.eye(len(T)) - T
        if len(C) < B.shape[1]:  # from the side that has fewer signals
            left = linalg.solve_triangular(shifted, C.T, trans="T", check_finite=False)
            response = left.T @ B + self.D
        else:
            response = C @ linalg.solve_triangular(shifted, B, check_finite=False) + self.D
        return float(np.linalg.norm(response, 2))

    def hinf_norm(self) -> float:
        """H-infinity norm by a sweep over frequencies and a refinement at the highest peaks.

        The sweep visits the frequency of every eigenvalue and the flanks of its resonance, so that no
        peak is too narrow for it. Infinite unless all modes of A decay: the sweep would otherwise return
        a finite number.
        """
        if self.decay() <= 0.0:
            return float("inf")
        poles = np.diag(self._schur[0])
        resonances = [np.abs(poles.imag) + k * np.abs(poles.real) for k in (-1.0, 0.0, 1.0)]
        sweep = np.unique(np.concatenate([FREQUENCIES, *resonances]).clip(0.0))
        sweep = sweep[np.append(True, np.diff(sweep) > 1e-8 * sweep[1:])]  # equal but for rounding
        values = np.array([self.norm_at(w) for w in sweep])
        padded = np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]))
        best = float(values.max())
        for k in peaks[np.argsort(values[peaks])[-PEAKS:]]:
            low, high = sweep[max(k - 1, 0)], sweep[min(k + 1, len(sweep) - 1)]
            found = minimize_scalar(
                lambda w: -self.norm_at(w),
                bounds=(low, high),
                method="bounded",
                options={"xatol": 1e-6 * high},
            )
            best = max(best, -float(found.fun))
        return best

    def decay(self, fastest: float = float("inf")) -> float:
        """Minus the largest real part of the eigenvalues of A up to `fastest` in modulus.

        Zero where it is no more than rounding; infinite if no mode is that slow.
        """
        values = np.diag(self._schur[0])
        seen = values[np.abs(values) <= fastest]
        slowest = -float(seen.real.max(initial=-np.inf))
        return slowest if abs(slowest) > _ON_THE_AXIS * np.abs(values).max() else 0.0


def riccati_optimum(
    A: Array, B1: Array, C1: Array, B2: Array, effort: float, tolerance: float = 1e-4
) -> float:
    """Infimum of gamma for x_t = A x + B1 w + B2 u, z = (C1 x, effort u); see `state_feedback_optimum`."""
    n, controls = B2.shape
    C = np.vstack([C1, np.zeros((controls, n))])
    D12 = np.vstack([np.zeros((len(C1), controls)), effort * np.eye(controls)])
    return state_feedback_optimum(
        A, B1, B2, C, np.zeros((len(C), B1.shape[1])), D12, tolerance=tolerance
    )


def state_feedback_optimum(
    A: Array, B1: Array, B2: Array, C1: Array, D11: Array, D12: Array, tolerance: float = 1e-4
) -> float:
    """Infimum over u = K x of the norm from w to z, by bisection to a relative tolerance.

    x_t = A x + B1 w + B2 u, z = C1 x + D11 w + D12 u. A gamma is reachable iff the game Riccati equation
    has a stabilising X >= 0. Infinite above 1e6, zero below 1e-9. Raises ValueError unless D12 has full
    column rank.
    """
    if np.linalg.matrix_rank(D12) < D12.shape[1]:
        raise ValueError(
            "a Riccati equation needs a cost on every control: D12 of full column rank"
        )
    problem = _Game(A, B1, B2, C1, D11, D12)
    floor = float(np.linalg.norm(D11, 2)) if D11.size else 0.0  # which no control changes
    low, high = 0.0, 1.0
    while not _reachable(problem, floor + high):
        low, high = high, 2.0 * high
        if high > 1e6:
            return float("inf")
    while high - low > tolerance * (floor + high):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _reachable(problem, floor + middle) else (middle, high)
        if floor + high < 1e-9:
            return 0.0
    return floor + high


@dataclass(frozen=True)
class _Game:
    A: Array
    B1: Array
    B2: Array
    C1: Array
    D11: Array
    D12: Array

    def reduced(self, gamma: float) -> tuple[Array, Array, Array, Array]:
        """A, drive, force, cost of the Riccati equation A' X + X A + X (drive - force) X + cost = 0.

        D11 is absorbed by a change of w and z that keeps "norm below gamma", then D12' C1 by completing
        the square in u.
        """
        D = self.D11
        share = np.linalg.solve(
            gamma**2 * np.eye(D.shape[1]) - D.T @ D, np.vstack([self.B1, D]).T
        ).T
        drive, weight = share[: len(self.A)], np.eye(len(D)) + share[len(self.A) :] @ D.T
        A = self.A + drive @ D.T @ self.C1
        B2 = self.B2 + drive @ D.T @ self.D12
        state, control = weight @ self.C1, weight @ self.D12
        feedback, force = np.split(
            np.linalg.solve(self.D12.T @ control, np.hstack([control.T @ self.C1, B2.T])),
            [len(A)], axis=1,
        )  # fmt: skip
        cost = self.C1.T @ state - state.T @ self.D12 @ feedback
        return A - B2 @ feedback, drive @ self.B1.T, B2 @ force, cost


def _reachable(problem: _Game, gamma: float) -> bool:
    A, drive, force, cost = problem.reduced(gamma)
    n = len(A)
    size = np.linalg.norm(drive) + np.linalg.norm(force)
    scale = np.sqrt(np.linalg.norm(cost) / size) if size > 0.0 and np.any(cost) else 1.0
    # the solution is scaled so that the blocks are of one size
    hamiltonian = np.block([[A, scale * (drive - force)], [-cost / scale, -A.T]])
    values = np.linalg.eigvals(hamiltonian)
    if np.min(np.abs(values.real)) < _ON_THE_AXIS * np.max(np.abs(values)):
        return False
    _, vectors, stable = linalg.schur(hamiltonian, output="real", sort="lhp")
    if stable != n:
        return False
    upper, lower = vectors[:n, :n], vectors[n:, :n]
    if np.linalg.cond(upper) > 1e14:
        return False
    solution = np.linalg.solve(upper.T, lower.T).T
    eigenvalues = np.linalg.eigvalsh(0.5 * (solution + solution.T))
    return bool(eigenvalues[0] >= -1e-8 * max(abs(eigenvalues[-1]), 1e-300))
