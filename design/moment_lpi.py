"""The observer LPI of the arm as a linear matrix inequality in moments, solved in three stages (theory, 3).

`design.moments` has the coordinates and the reason why they suffice. Unknown are gamma, the parts of P and
Z = C2* diag(l) + X* zeta Y, X and Y moments. With x split into its moments and the rest, which is orthogonal to
them, the inequality holds if

    the form in (z, w, moments of x, moments of the noise) is <= 0,
    per state the multiplier of the rest is <= 0,      per output [[-2 l, rho l], [rho l, gamma]] >= 0.

The three solves keep gains moderate: the plain minimum of gamma is reached by ever larger ones.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import cvxpy as cp
import numpy as np

from design.hinf import HinfProblem, HinfResult, Solution, Stages
from design.legendre import Array
from design.moments import PARITY, Moments, functionals, make_moments
from design.operators import PIOperator
from design.quadratic import lifted
from design.semidefinite import ACCEPTED, TIME_LIMITS

MARGIN = 1e-4
"""The form is at most -MARGIN |x|^2, so that rounding and the truncation of ranks leave it negative."""
LARGEST = 1e2
"""Bound of P's multiplier; P of order one is what the scales of the problem ask for."""
EIGENVALUE_TOLERANCE = 1e-6
"""Violation of a matrix inequality, relative to its largest eigenvalue, that counts as the solver's accuracy:
what it does to the gain is judged by `lpi_eigenvalue`."""


OPTIONS: dict[str, dict[str, object]] = {
    "CLARABEL": {"equilibrate_enable": False, "max_threads": 1},
}
"""The moments are orthonormal and of order one; scaling them once more ends in numerical errors. With one
thread the numbers do not depend on how many gains are designed at a time."""


COUNTS = (2, 3, 4)
"""Polynomials a state that are tried, one after the other."""


class MomentProgram:
    """The variables and constraints; `solve` may be called several times."""

    def __init__(self, problem: HinfProblem, moments: Moments) -> None:
        self.problem, self.moments = problem, moments
        k = len(moments.size)
        self.gamma, self.delta = cp.Variable(), cp.Variable()
        self.p = cp.Variable(nonneg=True)
        self.positive, self.negative = cp.Variable(nonneg=True), cp.Variable(nonneg=True)
        self.W = cp.Variable((k, k), symmetric=True)
        self.multipliers = cp.Variable(problem.C2.shape_out.functions)
        self.zeta = cp.Variable((len(moments.x_span), len(moments.y_span)))
        self.matrices = self._matrices()
        q = self._q()
        self._constraints = [0.5 * (m + m.T) >> 0 for m in self.matrices]
        self._constraints += [self._rest(q, sign) <= -MARGIN for sign in (1.0, -1.0)]
        self._constraints.append(q <= LARGEST)

    @property
    def z_norm(self) -> cp.Expression:
        """Size of Z, for the third solve."""
        return cp.norm(cp.hstack([self.multipliers, cp.vec(self.zeta, order="F")]))

    def _q(self) -> cp.Expression:
        return self.delta + self.p + self.moments.eta * (self.positive + self.negative)

    def _rest(self, q: cp.Expression, parity: float) -> cp.Expression:
        """Multiplier of velocities (parity 1) and strains (-1) in the form."""
        kappa = self.positive - self.negative
        return 2.0 * parity * kappa - (2.0 * self.problem.drag * q if parity > 0.0 else 0.0)

    def _matrices(self) -> list[cp.Expression]:
        """All that must be positive semidefinite: minus the form, P's part, and one per output."""
        mo, rho = self.moments, self.problem.rho
        q, kappa = self._q(), self.positive - self.negative
        velocity = np.diag((PARITY[mo.state] > 0.0).astype(float))
        scaled = mo.size[:, None] * mo.h
        choose = np.eye(len(self.problem.C2.r0))[mo.output]  # (r, outputs)
        levels = cp.diag(choose @ self.multipliers)
        finite = mo.x_span.T @ self.zeta @ mo.y_span
        half = (
            -self.problem.drag * q * velocity
            + kappa * np.diag(PARITY[mo.state])
            + scaled.T @ self.W @ mo.rates
            + (mo.outputs.T @ levels + finite) @ mo.outputs
        )
        state = half + half.T + MARGIN * np.eye(len(mo.state))
        disturbance = -(q * mo.B + kappa * mo.SB + (mo.B @ scaled.T) @ self.W @ scaled)
        noise = -rho * (mo.outputs.T @ levels + finite)
        nz, nw, r = len(mo.C1), len(mo.B), len(mo.output)
        form = cp.bmat(
            [
                [-self.gamma * np.eye(nz), np.zeros((nz, nw)), mo.C1, np.zeros((nz, r))],
                [np.zeros((nw, nz)), -self.gamma * np.eye(nw), disturbance, np.zeros((nw, r))],
                [mo.C1.T, disturbance.T, state, noise],
                [np.zeros((r, nz)), np.zeros((r, nw)), noise.T, -self.gamma * np.eye(r)],
            ]
        )
        D = np.diag(mo.size)
        outputs = [
            cp.bmat([[-2.0 * level, rho * level], [rho * level, self.gamma]])
            for level in self.multipliers
        ]
        return [-form, self.p * np.eye(len(D)) + D @ self.W @ D, *outputs]

    def solve(
        self, objective: cp.Expression, fixed: dict[str, float], solver: str, time_limit_s: float
    ) -> Solution:
        """Minimise with `gamma` or `delta` fixed. Never raises for a solver's failure."""
        constraints = [*self._constraints]
        constraints += [getattr(self, name) == value for name, value in fixed.items()]
        program = cp.Problem(cp.Minimize(objective), constraints)
        limit = TIME_LIMITS.get(solver)
        options = ({limit: time_limit_s} if limit else {}) | OPTIONS.get(solver, {})
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # 'may be inaccurate': judged below
            try:
                program.solve(solver=solver, **options)
                status = str(program.status)
            except cp.error.SolverError:
                status = "solver_error"
        iterations = 0
        if status in ACCEPTED and program.solver_stats is not None:
            iterations = int(program.solver_stats.num_iters or 0)
        smallest = float("-inf")
        if status in ACCEPTED and self.gamma.value is not None:
            smallest = min(_relative_smallest(np.asarray(m.value)) for m in self.matrices)
        return Solution(status, smallest, iterations, time.perf_counter() - start)

    def operators(self) -> tuple[PIOperator, PIOperator]:
        """P and Z of the last solve."""
        mo = self.moments
        q, kappa = float(self._q().value), float(self.positive.value - self.negative.value)
        h = lifted(functionals(mo.functions(mo.size[:, None] * mo.h)))
        P = PIOperator.identity(mo.S.shape_out) * q + mo.S * kappa + _squares(h, self.W.value, h)
        diagonal = PIOperator.multiplier(np.diag(self.multipliers.value)[:, :, None])
        x = lifted(functionals(mo.functions(mo.x_span)))
        y = lifted(functionals(mo.output_functions(mo.y_span)))
        Z = self.problem.C2.adjoint @ diagonal + _squares(x, self.zeta.value, y)
        return P.trimmed(), Z.trimmed()


def _squares(left: PIOperator, matrix: Array, right: PIOperator) -> PIOperator:
    return left.adjoint @ PIOperator.multiplier(np.asarray(matrix)[:, :, None]) @ right


def _relative_smallest(matrix: Array) -> float:
    values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    return float(values[0] / max(values[-1], 1e-300))


def solve_hinf(
    problem: HinfProblem,
    *,
    counts: tuple[int, ...] = COUNTS,
    stages: Stages | None = None,
    solver: str = "CLARABEL",
    time_limit_s: float = 300.0,
    progress: Callable[[str], None] = lambda _: None,
) -> HinfResult:
    """Solve the LPI in the three stages of `Stages`, with more polynomials a state until gamma is near enough.

    Returns the result with its verdict; a failed solve leaves what the solves before it gave, and if there is
    nothing the outcome is 'infeasible' or 'unreliable', never an exception.
    """
    stages = stages or Stages()
    start = time.perf_counter()
    nothing = PIOperator.zeros(problem.T.shape_out, problem.T.shape_out)
    found = (float("nan"), float("nan"), nothing, nothing)
    program: MomentProgram | None = None
    best = Solution("no moments", float("-inf"), 0, 0.0)
    sizes: tuple[int, ...] = ()

    for count in counts:
        attempt = MomentProgram(problem, make_moments(problem, count))
        first = attempt.solve(attempt.gamma, {"delta": stages.small_delta}, solver, time_limit_s)
        shapes = tuple(int(m.shape[0]) for m in attempt.matrices)
        head = f"{count} polynomials a state, matrices {shapes}"
        if not _sound(first):
            progress(f"{head}: {first.status}")
            if program is None:
                best, sizes = first, shapes
            continue
        program, best, sizes, found = attempt, first, shapes, _found(attempt)
        least = found[0]
        progress(f"{head}: smallest gamma {least:.4f}")
        if least * (1.0 + stages.slack) <= stages.near:
            break
    if program is not None:
        gamma = max(found[0] * (1.0 + stages.slack), stages.aim)
        progress(f"designing for {gamma:.4f}")
        second = program.solve(-program.delta, {"gamma": gamma}, solver, time_limit_s)
        if _sound(second):
            best, found = second, _found(program)
            fixed = {"gamma": gamma, "delta": stages.keep * found[1]}
            third = program.solve(program.z_norm, fixed, solver, time_limit_s)
            if _sound(third):
                best, found = third, _found(program)
        progress(f"delta {found[1]:.3f}")
    gamma, delta, P, Z = found
    return HinfResult(
        outcome=_verdict(best),
        gamma=gamma,
        delta=delta,
        P=P,
        Z=Z,
        solution=best,
        sizes=sizes,
        seconds=time.perf_counter() - start,
    )


def _found(program: MomentProgram) -> tuple[float, float, PIOperator, PIOperator]:
    return float(program.gamma.value), float(program.delta.value), *program.operators()


def _verdict(best: Solution) -> str:
    """What the solver's numbers, recomputed, allow to say; the gain itself is judged by lpi_eigenvalue."""
    if best.status in ("infeasible", "infeasible_inaccurate"):
        return "infeasible"
    return "certified" if _sound(best) else "unreliable"


def _sound(solution: Solution) -> bool:
    return solution.status in ACCEPTED and solution.smallest_eigenvalue >= -EIGENVALUE_TOLERANCE
