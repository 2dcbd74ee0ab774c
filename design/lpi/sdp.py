"""The semidefinite programs of the LPI engine, in the form that interior-point solvers like best.

A program is: Gram matrices G_i >= 0 and numbers under linear equalities, `matrix @ (1, numbers, free, G) = 0`.
It has few equalities and large Gram matrices, so CVXPY is given its Lagrangian dual, a linear matrix
inequality in as many variables as there are equalities; the Gram matrices come back as dual values. That is
20 times faster than the direct form and survives where the direct form fails in its first iteration (figures
in docs/lpi.md). Three further measures, each needed by some problem of the suite:

- equalities are scaled and orthonormalised, and the free numbers eliminated, by orthogonal matrices;
- a Gram diagonal that the equalities alone force to zero takes its row out (linear facial reduction);
- the traces are bounded, so that the dual has an interior as well.

What comes back is moved onto the equalities by least squares; everything after that is judged from the
operators, not from the solver's word.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import cvxpy as cp
import numpy as np

from design.legendre import Array
from design.semidefinite import ACCEPTED, TIME_LIMITS, Layout, orthonormal_equalities

_REDUCED = {"reduced_tol_gap_abs": 1e-1, "reduced_tol_gap_rel": 1e-1}
"""Clarabel's last point counts as found within these, also where it ends in a numerical error."""
_FORCED = 1e-8
"""A coordinate whose unit vector is this close to the row space is fixed by the equalities."""


@dataclass(frozen=True)
class Point:
    """A point on the equalities, with what the solver said and took. NaN everywhere if there is none."""

    status: str
    numbers: dict[str, float]
    free: Array
    grams: dict[str, Array]
    residual: float
    smallest_eigenvalue: float
    """Over all Gram matrices, relative to the largest eigenvalue of them all."""
    iterations: int
    modelling_s: float
    solver_s: float

    @property
    def found(self) -> bool:
        """Whether there are numbers to judge."""
        return bool(self.status in ACCEPTED and np.isfinite(self.residual))


class GramProgram:
    """`matrix @ (1, numbers, free, upper triangles of the Gram matrices) = 0`, Gram matrices >= 0.

    Raises ValueError if the matrix does not have the columns of the layout.
    """

    def __init__(self, matrix: Array, layout: Layout) -> None:
        if matrix.shape[1] != layout.columns:
            raise ValueError(
                f"coefficient matrix has {matrix.shape[1]} columns, the layout needs {layout.columns}"
            )
        self.layout = layout
        self._matrix = matrix
        self.kept = {name: np.arange(size) for name, size in layout.grams}
        self._rows = orthonormal_equalities(matrix)
        while self._drop_forced_rows():
            self._rows = orthonormal_equalities(matrix[:, self._columns()])

    @property
    def equalities(self) -> int:
        """Independent equalities."""
        return len(self._rows)

    @property
    def gram_sizes(self) -> tuple[int, ...]:
        """After facial reduction."""
        return tuple(len(self.kept[name]) for name, _ in self.layout.grams)

    def _head(self) -> int:
        return 1 + len(self.layout.numbers) + self.layout.free

    def _columns(self) -> Array:
        """Places of the remaining columns in the original matrix."""
        places = [np.arange(self._head())]
        start = self._head()
        for name, size in self.layout.grams:
            i, j = np.triu_indices(size)
            there = np.isin(i, self.kept[name]) & np.isin(j, self.kept[name])
            places.append(start + np.flatnonzero(there))
            start += i.size
        return np.concatenate(places)

    def _drop_forced_rows(self) -> bool:
        """Rows whose square the equalities alone force to zero; equal squares are forced together."""
        leverage = np.sum(self._rows**2, axis=0)
        dropped = False
        start = self._head()
        for name, _ in self.layout.grams:
            i, j = np.triu_indices(len(self.kept[name]))
            squares = start + np.flatnonzero(i == j)
            start += i.size
            columns = self._rows[:, squares]
            difference = np.abs(columns[:, :, None] - columns[:, None]).max(axis=0, initial=0.0)
            multiplicity = np.count_nonzero(difference < _FORCED, axis=1)
            free = multiplicity * leverage[squares] < 1.0 - _FORCED
            dropped |= not bool(free.all())
            self.kept[name] = self.kept[name][free]
        return dropped

    def solve(
        self,
        cost: dict[str, float],
        fixed: dict[str, float],
        *,
        positive: tuple[str, ...] = (),
        trace: float = 100.0,
        solver: str = "CLARABEL",
        time_limit_s: float = 60.0,
        dump: Path | None = None,
    ) -> Point:
        """Minimise sum of cost[name] * number with some numbers fixed, some >= 0, traces together <= `trace`.

        Never raises for a solver's failure: the status says so.
        """
        start = time.perf_counter()
        model = _DualModel(self, cost, fixed, positive, trace)
        if dump is not None:
            dump.write_text(model.sdpa(), encoding="ascii")
        status, iterations, solver_s = model.solve(solver, time_limit_s)
        modelling = time.perf_counter() - start - solver_s
        point = self._failed(status)
        if status in ACCEPTED:
            point = self._on_equalities(model.primal(point), tuple(fixed))
        return replace(point, iterations=iterations, modelling_s=modelling, solver_s=solver_s)

    def blocks(self) -> list[Array]:
        """Per Gram matrix the symmetric coefficient matrices of all equalities: (equalities, k, k)."""
        out = []
        start = self._head()
        for size in self.gram_sizes:
            i, j = np.triu_indices(size)
            half = 0.5 * self._rows[:, start : start + i.size]
            start += i.size
            block = np.zeros((self.equalities, size, size))
            block[:, i, j] = half
            block[:, j, i] += half
            out.append(block)
        return out

    def column(self, index: int) -> Array:
        """Coefficients of the constant (0), of a number or of a free variable."""
        return np.asarray(self._rows[:, index])

    def _on_equalities(self, point: Point, fixed: tuple[str, ...]) -> Point:
        """The nearest point on the equalities (off-diagonals count twice); constant and fixed stay."""
        head = [1.0, *point.numbers.values(), *point.free]
        triangles = [
            point.grams[name][np.triu_indices(len(point.grams[name]))]
            for name, _ in self.layout.grams
        ]
        x = np.concatenate([head, *triangles])
        scale = np.concatenate(
            [np.ones(self._head())]
            + [np.where(np.equal(*np.triu_indices(k)), 1.0, np.sqrt(0.5)) for k in self.gram_sizes]
        )
        moving = np.ones(x.size, bool)
        moving[0] = False
        moving[[1 + self.layout.numbers.index(name) for name in fixed]] = False
        system = self._rows[:, moving] * scale[moving]
        for _ in range(2):
            step = np.linalg.lstsq(system, -self._rows @ x, rcond=1e-12)[0]
            x[moving] += scale[moving] * step
        numbers = dict(zip(self.layout.numbers, map(float, x[1:]), strict=False))
        grams = {}
        start = self._head()
        smallest, largest = 0.0, 1e-300
        for (name, size), kept in zip(self.layout.grams, self.kept.values(), strict=True):
            i, j = np.triu_indices(len(kept))
            gram = np.zeros((len(kept), len(kept)))
            gram[i, j] = gram[j, i] = x[start : start + i.size]
            start += i.size
            if len(kept):
                values = np.linalg.eigvalsh(gram)
                smallest = min(smallest, float(values[0]))
                largest = max(largest, float(values[-1]))
            full = np.zeros((size, size))
            full[np.ix_(kept, kept)] = gram
            grams[name] = full
        columns = self._matrix[:, self._columns()]
        terms = np.abs(columns * x)
        residual = float(np.abs(columns @ x).max() / max(terms.max(), 1e-300))
        free = x[1 + len(numbers) : self._head()]
        return replace(
            point,
            numbers=numbers,
            free=free,
            grams=grams,
            residual=residual,
            smallest_eigenvalue=smallest / largest,
        )

    def _failed(self, status: str) -> Point:
        return Point(
            status=status,
            numbers=dict.fromkeys(self.layout.numbers, float("nan")),
            free=np.full(self.layout.free, np.nan),
            grams={name: np.full((k, k), np.nan) for name, k in self.layout.grams},
            residual=float("inf"),
            smallest_eigenvalue=float("-inf"),
            iterations=0,
            modelling_s=0.0,
            solver_s=0.0,
        )


class _DualModel:
    """max b.l over l with S_i(l) = sum_e l_e A_ei + l_tr I >= 0, c + F.l = 0, p + N.l >= 0.

    The equations for the free numbers are solved beforehand: l = l0 + basis m.
    """

    def __init__(
        self,
        program: GramProgram,
        cost: dict[str, float],
        fixed: dict[str, float],
        positive: tuple[str, ...],
        trace: float,
    ) -> None:
        self.program = program
        self._fixed = fixed
        layout = program.layout
        names = [n for n in layout.numbers if n not in fixed]
        self._free_names = [n for n in names if n not in positive]
        self._positive_names = [n for n in names if n in positive]
        index = {n: 1 + k for k, n in enumerate(layout.numbers)}
        b = program.column(0) + sum(
            (value * program.column(index[n]) for n, value in fixed.items()),
            np.zeros(program.equalities),
        )
        start = 1 + len(layout.numbers)
        free = np.array([program.column(start + k) for k in range(layout.free)])
        free = free.reshape(layout.free, program.equalities)
        left, values, right = np.linalg.svd(free.T, full_matrices=False)
        keep = values > 1e-9 * max(values[0], 1e-300) if values.size else np.zeros(0, bool)
        self._to_free = right[keep].T / values[keep]
        numbers = np.array([program.column(index[n]) for n in self._free_names])
        F = np.concatenate([numbers.reshape(-1, program.equalities), left[:, keep].T]).T
        c = np.array([cost.get(n, 0.0) for n in self._free_names] + [0.0] * int(keep.sum()))
        # one more equality, for the traces: sum of traces + slack = trace, in units of `trace`
        self._b = np.append(b, -1.0)
        self._F = np.vstack([F, np.zeros(F.shape[1])])
        positives = np.array([program.column(index[n]) for n in self._positive_names])
        self._N = np.hstack(
            [positives.reshape(-1, program.equalities), np.zeros((len(self._positive_names), 1))]
        )
        self._N = np.vstack([self._N, np.eye(1, program.equalities + 1, program.equalities)])
        self._p = np.array([cost.get(n, 0.0) for n in self._positive_names] + [0.0])
        self._blocks = [
            np.concatenate([block, np.eye(block.shape[1])[None] / trace])
            for block in program.blocks()
        ]
        q, r = np.linalg.qr(self._F, mode="complete")
        left, values, right = np.linalg.svd(self._F)
        rank = int(np.count_nonzero(values > 1e-9 * values.max(initial=0.0)))
        if rank < len(c):
            q, r = left, values[:, None] * right[: values.size]
        self._l0 = -q[:, :rank] @ np.linalg.lstsq(r[:rank].T, c, rcond=None)[0]
        self._basis = q[:, rank:]
        # with a remainder, the cost falls along numbers that no equality holds
        remainder = np.linalg.norm(self._F.T @ self._l0 + c)
        self._unbounded = bool(remainder > 1e-9 * np.linalg.norm(c))
        self._lmis = [
            (
                np.einsum("ekl,em->mkl", block, self._basis, optimize=True),
                np.einsum("ekl,e->kl", block, self._l0),
            )
            for block in self._blocks
            if block.shape[1]
        ]

    def solve(self, solver: str, time_limit_s: float) -> tuple[str, int, float]:
        """Status, iterations and seconds of the solver itself."""
        if self._unbounded:
            return "unbounded", 0, 0.0
        m = cp.Variable(self._basis.shape[1])
        self._sign = (self._N @ self._basis) @ m + (self._N @ self._l0 + self._p) >= 0
        self._psd = []
        for slopes, offset in self._lmis:
            k = len(offset)
            expression = cp.reshape(slopes.reshape(-1, k * k).T @ m, (k, k), order="F") + offset
            self._psd.append((expression + expression.T) / 2 >> 0)
        problem = cp.Problem(cp.Minimize(-(self._b @ self._basis) @ m), [self._sign, *self._psd])
        limit = TIME_LIMITS.get(solver)
        options = {limit: time_limit_s} if limit else {}
        if solver == "CLARABEL":
            options |= {"accept_unknown": True, **_REDUCED}  # judged by the operators afterwards
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # 'may be inaccurate': likewise
            try:
                problem.solve(solver=solver, **options)
                status = str(problem.status)
            except cp.error.SolverError:
                return "solver_error", 0, 0.0
        stats = problem.solver_stats
        if status in ACCEPTED and self._sign.dual_value is None:
            status = "solver_error"
        # infeasible and unbounded change places in the dual
        exchange = {"infeasible": "unbounded", "unbounded": "infeasible"}
        head, _, tail = status.partition("_")
        status = "_".join(filter(None, (exchange.get(head, head), tail)))
        return status, int(stats.num_iters or 0), float(stats.solve_time or 0.0)

    def primal(self, point: Point) -> Point:
        """`point` with the program's own variables, from the dual values."""
        grams: dict[str, Array] = {}
        blocks = iter(zip(self._psd, self._blocks_present(), strict=True))
        slack = np.asarray(self._sign.dual_value)
        rest = self._b + self._N.T @ slack
        for (name, _), size in zip(self.program.layout.grams, self.program.gram_sizes, strict=True):
            if not size:
                grams[name] = np.zeros((0, 0))
                continue
            constraint, block = next(blocks)
            value = np.asarray(constraint.dual_value)
            grams[name] = 0.5 * (value + value.T)
            rest = rest + np.einsum("ekl,kl->e", block, grams[name])
        free = np.linalg.lstsq(self._F, -rest, rcond=None)[0]
        named = dict(zip(self._free_names, free, strict=False))
        named |= dict(zip(self._positive_names, slack, strict=False))
        named |= self._fixed
        return replace(
            point,
            numbers={n: float(named[n]) for n in self.program.layout.numbers},
            free=self._to_free @ free[len(self._free_names) :],
            grams=grams,
        )

    def _blocks_present(self) -> list[Array]:
        return [b for b in self._blocks if b.shape[1]]

    def sdpa(self) -> str:
        """The program in the SDPA sparse format: min c.m, sum m_k F_k - F_0 >= 0, signs as a diagonal block."""
        signs = self._N @ self._basis
        offset = self._N @ self._l0 + self._p
        sizes = [str(len(o)) for _, o in self._lmis] + [str(-len(offset))]
        cost = -(self._b @ self._basis)
        lines = [
            str(cost.size),
            str(len(sizes)),
            " ".join(sizes),
            " ".join(f"{c:.17g}" for c in cost),
        ]
        for number, (slopes, constant) in enumerate(self._lmis, start=1):
            for k, matrix in enumerate([-constant, *slopes]):
                symmetric = 0.5 * (matrix + matrix.T)
                lines += [
                    f"{k} {number} {i + 1} {j + 1} {symmetric[i, j]:.17g}"
                    for i, j in zip(*np.nonzero(np.triu(symmetric)), strict=True)
                ]
        last = len(sizes)
        for k, diagonal in enumerate([-offset, *signs.T]):
            lines += [
                f"{k} {last} {i + 1} {i + 1} {diagonal[i]:.17g}" for i in np.flatnonzero(diagonal)
            ]
        return "\n".join(lines) + "\n"
