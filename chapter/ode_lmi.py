"""LMI (16) and the LMI under (19), letter by letter with the signs as choices, solved and then judged by
numbers.

From matrices of (13) or (19) to gamma, the gain and what is left of the inequalities at the numbers that came
back: a solver's status proves nothing here, eigenvalues do.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SLACKS = (1e-3, 3e-3, 1e-2)
"""The gain is taken at so much more than the least gamma, where the inequality has an interior: the first at
which
the numbers prove it."""
LEAST_SCALE = 1e-3
"""Of a least gamma that is zero."""
LEAST_P = 1e-9
"""P >= LEAST_P I stands for P > 0 while gamma is minimised."""


@dataclass(frozen=True, eq=False)
class System:
    """x_t = A x + B1 w + B2 u, z = C1 x + D11 w + D12 u, y = C2 x + D21 w: (13) has no u, (19) no y."""

    A: Array
    B1: Array
    C1: Array
    D11: Array
    B2: Array
    D12: Array
    C2: Array
    D21: Array

    @property
    def transposed(self) -> System:
        """The dual system: state feedback of one is the observer of the other."""
        return System(
            self.A.T, self.C1.T, self.B1.T, self.D11.T, self.C2.T, self.D21.T, self.B2.T, self.D12.T
        )

    def error_system(self, L: Array) -> tuple[Array, Array, Array, Array]:
        """(15): from w to z_e."""
        return self.A + L @ self.C2, -(self.B1 + L @ self.D21), self.C1, -self.D11

    def closed_loop(self, K: Array) -> tuple[Array, Array, Array, Array]:
        """(19) with u = K x: from w to z."""
        return self.A + self.B2 @ K, self.B1, self.C1 + self.D12 @ K, self.D11


@dataclass(frozen=True)
class Signs:
    """The signs of (16), +1 as printed; `noise` is that of Z D_21 beside P B."""

    d11: int = 1
    pb: int = 1
    c1: int = 1
    noise: int = 1


PRINTED = Signs()


@dataclass(frozen=True, eq=False)
class Found:
    """What one LMI gave. All of it is recomputed from P and Z except `least` and `status`."""

    least: float
    """The solver's least gamma."""
    gamma: float
    """A little above: what P and Z certify."""
    gain: Array
    """L or K."""
    P: Array
    smallest_of_p: float
    """Least eigenvalue of P; must be positive."""
    largest_of_lmi: float
    """Largest eigenvalue of the matrix at `gamma`; must be negative."""
    status: str

    @property
    def certified(self) -> bool:
        """Whether the numbers are a proof, up to rounding."""
        return self.smallest_of_p > 0.0 and self.largest_of_lmi < 0.0


def observer_matrix(s: System, P: Array, Z: Array, gamma: float, signs: Signs = PRINTED) -> Array:
    """The matrix of (16) for numbers P (n, n), Z (n, outputs)."""
    nz, nw = s.D11.shape
    PB = signs.pb * (P @ s.B1 + signs.noise * Z @ s.D21)
    main = P @ s.A + Z @ s.C2
    return np.block(
        [
            [-gamma * np.eye(nw), -signs.d11 * s.D11.T, -PB.T],
            [-signs.d11 * s.D11, -gamma * np.eye(nz), signs.c1 * s.C1],
            [-PB, signs.c1 * s.C1.T, main.T + main],
        ]
    )


def controller_matrix(s: System, P: Array, Z: Array, gamma: float) -> Array:
    """The matrix under (19) for numbers P (n, n), Z (controls, n)."""
    nz, nw = s.D11.shape
    main = s.A @ P + s.B2 @ Z
    right = P @ s.C1.T + Z.T @ s.D12.T
    return np.block(
        [
            [main + main.T, s.B1, right],
            [s.B1.T, -gamma * np.eye(nw), s.D11.T],
            [right.T, s.D11, -gamma * np.eye(nz)],
        ]
    )


def solve_observer(s: System, signs: Signs = PRINTED) -> Found:
    """Minimise gamma in (16); L = P^-1 Z. Raises RuntimeError if the solver has no numbers."""
    nz, nw = s.D11.shape
    n = len(s.A)
    P, Z = cp.Variable((n, n), symmetric=True), cp.Variable((n, len(s.C2)))
    gamma = cp.Variable(nonneg=True)
    PB = signs.pb * (P @ s.B1 + signs.noise * (Z @ s.D21))
    main = P @ s.A + Z @ s.C2
    matrix = cp.bmat(
        [
            [-gamma * np.eye(nw), -signs.d11 * s.D11.T, -PB.T],
            [-signs.d11 * s.D11, -gamma * np.eye(nz), signs.c1 * s.C1],
            [-PB, signs.c1 * s.C1.T, main.T + main],
        ]
    )

    def judge(p: Array, z: Array, level: float) -> tuple[Array, Array]:
        return observer_matrix(s, p, z, level, signs), np.asarray(
            np.linalg.solve(p, z), dtype=np.float64
        )

    return _solve(matrix, P, Z, gamma, judge)


def solve_controller(s: System) -> Found:
    """Minimise gamma in the LMI under (19); K = Z P^-1. Raises RuntimeError if the solver has no numbers."""
    nz, nw = s.D11.shape
    n = len(s.A)
    P, Z = cp.Variable((n, n), symmetric=True), cp.Variable((s.B2.shape[1], n))
    gamma = cp.Variable(nonneg=True)
    main = s.A @ P + s.B2 @ Z
    right = P @ s.C1.T + Z.T @ s.D12.T
    matrix = cp.bmat(
        [
            [main + main.T, s.B1, right],
            [s.B1.T, -gamma * np.eye(nw), s.D11.T],
            [right.T, s.D11, -gamma * np.eye(nz)],
        ]
    )

    def judge(p: Array, z: Array, level: float) -> tuple[Array, Array]:
        return controller_matrix(s, p, z, level), np.asarray(
            np.linalg.solve(p, z.T).T, dtype=np.float64
        )

    return _solve(matrix, P, Z, gamma, judge)


def _solve(
    matrix: cp.Expression,
    P: cp.Variable,
    Z: cp.Variable,
    gamma: cp.Variable,
    judge: Callable[[Array, Array, float], tuple[Array, Array]],
) -> Found:
    """First the least gamma, then, a little above it, the numbers that are deepest inside.

    `judge` gives the matrix of numbers and the gain; a level at which its eigenvalues prove nothing is raised.
    """
    n = P.shape[0]
    symmetric = 0.5 * (matrix + matrix.T)
    first = cp.Problem(cp.Minimize(gamma), [P >> LEAST_P * np.eye(n), symmetric << 0])
    _numbers_of(first)
    if gamma.value is None:
        raise RuntimeError(f"the solver has no numbers: {first.status}")
    least = float(gamma.value)
    depth = cp.Variable()
    for slack in SLACKS:
        level = least + slack * max(least, LEAST_SCALE)
        inside = [
            P >> depth * np.eye(n),
            symmetric << -depth * np.eye(matrix.shape[0]),
            gamma == level,
            depth <= 1.0,
        ]
        second = cp.Problem(cp.Maximize(depth), inside)
        _numbers_of(second)
        if P.value is None or Z.value is None:
            continue
        p = 0.5 * (P.value + P.value.T)
        numbers, gain = judge(p, np.asarray(Z.value), level)
        found = Found(
            least,
            level,
            gain,
            p,
            float(np.linalg.eigvalsh(p)[0]),
            float(np.linalg.eigvalsh(numbers)[-1]),
            str(second.status),
        )
        if found.certified:
            return found
    raise RuntimeError(f"no certified numbers up to {SLACKS[-1]:g} above gamma = {least:g}")


def smallest_gain(s: System, gamma: float) -> Array:
    """K of least norm for which P = I meets the LMI under (19) at `gamma`."""
    n = len(s.A)
    Z = cp.Variable((s.B2.shape[1], n))
    nz, nw = s.D11.shape
    main, right = s.A + s.B2 @ Z, s.C1.T + Z.T @ s.D12.T
    matrix = cp.bmat(
        [
            [main + main.T, s.B1, right],
            [s.B1.T, -gamma * np.eye(nw), s.D11.T],
            [right.T, s.D11, -gamma * np.eye(nz)],
        ]
    )
    problem = cp.Problem(cp.Minimize(cp.norm(Z, "fro")), [0.5 * (matrix + matrix.T) << 0])
    _numbers_of(problem)
    if Z.value is None:
        raise RuntimeError(f"no gain at gamma = {gamma:g} with P = I: {problem.status}")
    return np.asarray(Z.value)


def _numbers_of(problem: cp.Problem) -> None:
    """Solve; what the solver thinks of it does not matter, the numbers are judged."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        with contextlib.suppress(cp.SolverError):
            problem.solve(solver=cp.CLARABEL)


def random_system(seed: int, *, stable: bool, n: int, feedthrough: bool) -> System:
    """Random numbers with D_12, D_21 of full rank; the rightmost pole is at -0.3, or at +0.5 if not
    `stable`."""
    random = np.random.default_rng(seed)
    nw, nz, nu, ny = 3, 3, 2, 2

    def some(rows: int, columns: int) -> Array:
        return random.standard_normal((rows, columns))

    A = some(n, n)
    A += ((-0.3 if stable else 0.5) - float(np.linalg.eigvals(A).real.max())) * np.eye(n)
    D11 = 0.1 * some(nz, nw) if feedthrough else np.zeros((nz, nw))
    return System(
        A, some(n, nw), some(nz, n), D11, some(n, nu), some(nz, nu), some(ny, n), some(ny, nw)
    )
