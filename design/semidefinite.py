"""The semidefinite programs: Gram matrices and free numbers under linear equalities, solved by CVXPY.

The equalities are scaled and orthonormalised before a solver sees them, and whatever the solver says is
recomputed from its numbers (theory, section 3).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from design.legendre import Array

ROW_FLOOR = 1e-5
"""Rows are scaled to norm one, but never by more than 1 / ROW_FLOOR: rounding must not become an equality."""
RANK_TOLERANCE = 1e-7
"""Singular values of the scaled equalities below this (relative) are dependent rows."""
ACCEPTED = ("optimal", "optimal_inaccurate")
TIME_LIMITS = {
    "CLARABEL": "time_limit",
    "SCS": "time_limit_secs",
    "MOSEK": "",
    "COPT": "",
    "CVXOPT": "",
    "SDPA": "",
}
"""CVXPY's solvers of semidefinite programs, and the option that limits their time where there is one."""


def solvers() -> tuple[str, ...]:
    """The semidefinite solvers that are installed here."""
    return tuple(name for name in TIME_LIMITS if name in cp.installed_solvers())


@dataclass(frozen=True)
class Layout:
    """Which columns of the coefficient matrix belong to what.

    Column 0 is the constant term; then `numbers` scalars, then per Gram matrix its upper triangle in the
    order of numpy.triu_indices.
    """

    numbers: tuple[str, ...]
    free: int
    """How many free (unnamed) numbers follow the named ones, e.g. the coefficients of Z."""
    grams: tuple[tuple[str, int], ...]

    @property
    def columns(self) -> int:
        """Total number of columns."""
        return 1 + len(self.numbers) + self.free + sum(k * (k + 1) // 2 for _, k in self.grams)


@dataclass(frozen=True)
class Solution:
    """What a solver returned, with the evidence recomputed from it."""

    status: str
    numbers: dict[str, float]
    free: Array
    grams: dict[str, Array]
    residual: float
    """Largest violated coefficient equality, unscaled, relative to the largest coefficient used."""
    smallest_gram_eigenvalue: float
    """Over all Gram matrices, relative to the largest eigenvalue of each."""
    iterations: int
    seconds: float
    equalities: int


class Program:
    """Linear equalities `matrix @ (1, numbers, free, grams) = 0` with Gram matrices >= 0.

    Raises ValueError if the matrix does not have the columns of the layout.
    """

    def __init__(self, matrix: Array, layout: Layout) -> None:
        if matrix.shape[1] != layout.columns:
            raise ValueError(
                f"coefficient matrix has {matrix.shape[1]} columns, the layout needs {layout.columns}"
            )
        self.layout = layout
        self._matrix = matrix
        self._rows = orthonormal_equalities(matrix)
        self.equalities = len(self._rows)

    def _variables(
        self,
    ) -> tuple[dict[str, cp.Variable], cp.Variable, dict[str, cp.Variable], cp.Expression]:
        numbers = {name: cp.Variable(name=name) for name in self.layout.numbers}
        free = cp.Variable(self.layout.free)
        grams = {name: cp.Variable((k, k), symmetric=True) for name, k in self.layout.grams}
        columns = [*(cp.reshape(v, (1,), order="F") for v in numbers.values()), free]
        for name, k in self.layout.grams:
            i, j = np.triu_indices(k)
            columns.append(cp.vec(grams[name], order="F")[i + j * k])
        return numbers, free, grams, cp.hstack(columns)

    def solve(
        self,
        objective: Callable[[dict[str, cp.Variable], cp.Variable], cp.Expression],
        fixed: dict[str, float],
        *,
        solver: str = "CLARABEL",
        time_limit_s: float = 300.0,
    ) -> Solution:
        """Minimise `objective(numbers, free)` with some numbers fixed.

        Returns a Solution with status as the solver gave it (or 'solver_error'); its numbers are NaN when
        there is no point. Never raises for a solver's failure.
        """
        numbers, free, grams, rest = self._variables()
        constraints = [self._rows[:, 0] + self._rows[:, 1:] @ rest == 0]
        constraints += [grams[name] >> 0 for name, _ in self.layout.grams]
        constraints += [numbers[name] == value for name, value in fixed.items()]
        problem = cp.Problem(cp.Minimize(objective(numbers, free)), constraints)
        limit = TIME_LIMITS.get(solver)
        options = {limit: time_limit_s} if limit else {}
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # 'may be inaccurate': judged below
            try:
                problem.solve(solver=solver, **options)
                status = str(problem.status)
            except cp.error.SolverError:
                status = "solver_error"
        seconds = time.perf_counter() - start
        if status not in ACCEPTED or rest.value is None:
            return self._failed(status, seconds)
        values = {name: np.asarray(g.value) for name, g in grams.items()}
        return Solution(
            status=status,
            numbers={name: float(v.value) for name, v in numbers.items()},
            free=np.asarray(free.value),
            grams=values,
            residual=self._residual(np.concatenate([[1.0], rest.value])),
            smallest_gram_eigenvalue=min(_relative_smallest(g) for g in values.values()),
            iterations=int(problem.solver_stats.num_iters or 0),
            seconds=seconds,
            equalities=self.equalities,
        )

    def _residual(self, point: Array) -> float:
        violation = np.abs(self._matrix @ point)
        return float(violation.max() / np.abs(self._matrix * point).max())

    def _failed(self, status: str, seconds: float) -> Solution:
        return Solution(
            status=status,
            numbers=dict.fromkeys(self.layout.numbers, float("nan")),
            free=np.full(self.layout.free, np.nan),
            grams={name: np.full((k, k), np.nan) for name, k in self.layout.grams},
            residual=float("inf"),
            smallest_gram_eigenvalue=float("-inf"),
            iterations=0,
            seconds=seconds,
            equalities=self.equalities,
        )


def orthonormal_equalities(matrix: Array) -> Array:
    """An orthonormal basis of the matrix's row space, rows scaled first; rounding is no equality.

    The basis are the right singular vectors, largest singular value first: solvers are sensitive to more than
    the space that they span. A QR factorisation leaves a small square matrix for the SVD.
    """
    norms = np.linalg.norm(matrix, axis=1)
    scaled = matrix / np.maximum(norms, ROW_FLOOR * norms.max())[:, None]
    if len(scaled) > scaled.shape[1]:
        scaled = np.linalg.qr(scaled, mode="r")
    basis, triangle = np.linalg.qr(scaled.T)
    _, values, rotation = np.linalg.svd(triangle.T)
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[0]))
    return np.asarray(rotation[:rank] @ basis.T)


def _relative_smallest(gram: Array) -> float:
    values = np.linalg.eigvalsh(gram)
    return float(values[0] / max(values[-1], 1e-300))
