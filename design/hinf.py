"""The H-infinity observer LPI, and through the adjoint system the state-feedback LPI (theory, section 3).

For x_t = A x - B w in PIE form with regulated output z = C1 x and the output y = C2 x - rho w_y to be fed
back, find P >= delta I and Z such that for all fundamental states f (x = T f), w, w_y and z

    2 <T f, P (A f - B w)> + 2 <T f, Z (C2 T f - rho w_y)> + 2 <z, C1 T f>
        - gamma (|z|^2 + |w|^2 + |w_y|^2) <= 0;

then with L = P^-1 Z the system T f_t = A f + L y, driven by (w, w_y), has |z| <= gamma |(w, w_y)|. This is
(18) with the errata of theory, section 1. The left side is a form in rows; its negative is a Gram form.

Three choices make the program small and strictly feasible:
- rows are built from x, y = A^-1 x, A^-2 x, ...: their derivatives along the dynamics are rows again;
- of the last Krylov level the inequality has the velocity half only: nothing makes the other half decay;
- the finite-dimensional disturbance enters with every profile that the products produce.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy import linalg

from design.operators import PIOperator, Shape, vertical
from design.quadratic import (
    FormTable,
    coefficient_matrix,
    forms,
    function_span,
    lifted,
    unit_rows,
    weighted,
)
from design.semidefinite import ACCEPTED, Layout, Program, Solution


@dataclass(frozen=True)
class HinfProblem:
    """One problem in observer form; the operators act on n functions of the primary state x.

    T, A: f -> x and f -> x_t; krylov: x -> A^-1 x; B: R^w -> x; C1: x -> R^z; C2: x -> outputs;
    rho: weight of the noise on the fed-back output; rates: functions of f that the dynamics dissipate
    and that are no functions of x (Kelvin-Voigt damping), None if there are none; multiples: largest degree
    of the polynomials that multiply z and the velocities in the inequality, above 0 where the coefficients
    of C2 vary along s: z is then seen through C2 only by weights that vary as well.
    """

    T: PIOperator
    A: PIOperator
    krylov: PIOperator
    B: PIOperator
    C1: PIOperator
    C2: PIOperator
    rho: float
    rates: PIOperator | None = None
    multiples: int = 0


@dataclass(frozen=True)
class HinfResult:
    """P, Z and the evidence. `outcome` is 'certified', 'infeasible' or 'unreliable'."""

    outcome: str
    gamma: float
    delta: float
    P: PIOperator
    Z: PIOperator
    solution: Solution
    gram_sizes: tuple[int, ...]
    seconds: float


@dataclass(frozen=True)
class Stages:
    """The three solves: gamma_0 = min gamma at a small delta; then with gamma = (1 + slack) gamma_0 the
    largest delta, delta_1; then at delta = keep delta_1 the smallest Z. It keeps gains |Z| / delta moderate:
    the plain minimum of gamma is reached by ever larger gains (theory, section 3)."""

    small_delta: float = 0.05
    slack: float = 0.45
    keep: float = 0.85


LPI_TOLERANCE = 1e-6
"""Largest `lpi_eigenvalue` that counts as rounding (the forms are of order one)."""
RESIDUAL_TOLERANCE = 1e-6
EIGENVALUE_TOLERANCE = 1e-5


class _Signals:
    """What the LPI speaks of, as operators on xi = (z, w | f, w_y)."""

    def __init__(self, problem: HinfProblem) -> None:
        n = problem.T.shape_out.functions
        nz, nw = problem.C1.shape_out.finite, problem.B.shape_in.finite
        ny = problem.C2.shape_out.functions
        eye = PIOperator.identity(Shape(nz + nw, n + ny))
        f = eye.rows([], range(n))
        w = eye.rows(range(nz, nz + nw), [])
        self.rates = None if problem.rates is None else problem.rates @ f
        self.noise = eye.rows([], range(n, n + ny))
        self.z = lifted(eye.rows(range(nz), []))
        self.w = lifted(w)
        self.x = problem.T @ f
        self.x_t = problem.A @ f - problem.B @ w
        self.y = problem.C2 @ self.x - self.noise * problem.rho
        self.c1 = lifted(problem.C1 @ self.x)
        self.channels = vertical(self.z, self.w, self.noise)


class _Rows:
    """The rows of the Gram forms: of P and of Z on the state, of the inequality on xi."""

    def __init__(self, problem: HinfProblem, signals: _Signals, level: int) -> None:
        n = problem.T.shape_out.functions
        state = PIOperator.identity(Shape(0, n))
        ladder, profiles = [state], []
        for _ in range(level):
            ladder.append(problem.krylov @ ladder[-1])
            profiles.append(ladder[-1] @ problem.B)
        profiles.append(problem.krylov @ profiles[-1] if profiles else problem.B)
        half = range(n // 2)
        self.lyapunov = vertical(state, *(unit_rows(r) for r in ladder[1:]))
        self.gain = vertical(
            *(unit_rows(r) for r in ladder[:-1]),
            unit_rows(ladder[-1].rows([], half) if level else state),
        )
        more: list[PIOperator] = []
        if problem.multiples:
            self.gain = vertical(self.gain, unit_rows(problem.C2))
            velocity = signals.x.rows([], half)
            weights = np.eye(problem.multiples + 1)
            for j in range(1, problem.multiples + 1):
                more += [weighted(row, weights[j, : j + 1]) for row in (signals.z, velocity)]
        columns = [c for p in profiles for row in p.q2 for c in row if np.any(c)]
        integrals = PIOperator.zeros(Shape(n, 0), Shape(0, n)).replace(q1=np.eye(n)[:, :, None])
        self.inequality = vertical(
            signals.z,
            *(weighted(signals.w, profile) for profile in function_span(columns)),
            lifted(integrals @ signals.x),
            self.gain @ signals.x,
            *(() if signals.rates is None else (signals.rates,)),
            *more,
            signals.noise,
        )


def _tables(signals: _Signals, rows: _Rows) -> tuple[list[FormTable], Layout]:
    """Columns (constant, gamma, delta, Z, Gram of P, Gram of the inequality)."""
    x, x_t = signals.x, signals.x_t
    constant = forms(signals.z, signals.c1).trace()
    gamma = forms(signals.channels, signals.channels).trace() * -0.5
    delta = forms(x, x_t).trace()
    z = forms(rows.gain @ x, signals.y)
    lyapunov = forms(rows.lyapunov @ x, rows.lyapunov @ x_t).symmetric().upper(0.5)
    inequality = forms(rows.inequality, rows.inequality).upper(0.5)
    layout = Layout(
        numbers=("gamma", "delta"),
        free=z.p.shape[0] * z.p.shape[1],
        grams=(
            ("P", rows.lyapunov.shape_out.functions),
            ("inequality", rows.inequality.shape_out.functions),
        ),
    )
    return [constant, gamma, delta, z, lyapunov, inequality], layout


def solve_hinf(
    problem: HinfProblem,
    *,
    level: int = 2,
    stages: Stages | None = None,
    solver: str = "CLARABEL",
    time_limit_s: float = 300.0,
    progress: Callable[[str], None] = lambda _: None,
) -> HinfResult:
    """Solve the LPI with Krylov rows up to `level`, in the three stages of `Stages`.

    Returns the result with its verdict; a failed solve gives outcome 'infeasible' or 'unreliable', never
    an exception.
    """
    stages = stages or Stages()
    start = time.perf_counter()
    signals = _Signals(problem)
    rows = _Rows(problem, signals, level)
    tables, layout = _tables(signals, rows)
    program = Program(coefficient_matrix(tables), layout)
    sizes = tuple(k for _, k in layout.grams)
    progress(f"{program.equalities} equalities, Gram matrices {sizes}")

    def run(
        objective: Callable[[dict[str, cp.Variable], cp.Variable], cp.Expression], **fixed: float
    ) -> Solution:
        return program.solve(objective, fixed, solver=solver, time_limit_s=time_limit_s)

    first = run(lambda numbers, _: numbers["gamma"], delta=stages.small_delta)
    best = first
    if first.status in ACCEPTED:
        gamma = first.numbers["gamma"] * (1.0 + stages.slack)
        progress(f"smallest gamma {first.numbers['gamma']:.4f}, designing for {gamma:.4f}")
        second = run(lambda numbers, _: -numbers["delta"], gamma=gamma)
        if second.status in ACCEPTED:
            best = second
            delta = stages.keep * second.numbers["delta"]
            third = run(lambda _, free: cp.norm(free), gamma=gamma, delta=delta)
            best = third if third.status in ACCEPTED else second
        progress(f"delta {best.numbers['delta']:.3f}, |Z| {np.linalg.norm(best.free):.2f}")
    P, Z = _operators(problem, rows, best)
    return HinfResult(
        outcome=_verdict(best),
        gamma=best.numbers["gamma"],
        delta=best.numbers["delta"],
        P=P,
        Z=Z,
        solution=best,
        gram_sizes=sizes,
        seconds=time.perf_counter() - start,
    )


def _operators(
    problem: HinfProblem, rows: _Rows, solution: Solution
) -> tuple[PIOperator, PIOperator]:
    """P = delta I + Psi* G Psi and Z = Chi* zeta as PI operators."""
    n = problem.T.shape_out.functions
    gram = PIOperator.multiplier(solution.grams["P"][:, :, None])
    P = PIOperator.identity(Shape(0, n)) * solution.numbers["delta"]
    P = P + rows.lyapunov.adjoint @ gram @ rows.lyapunov
    zeta = solution.free.reshape(rows.gain.shape_out.functions, -1)
    Z = rows.gain.adjoint @ PIOperator.multiplier(zeta[:, :, None])
    return P, Z


def lpi_eigenvalue(
    problem: HinfProblem, P: PIOperator, gain: PIOperator, gamma: float, size: int = 16
) -> float:
    """Largest eigenvalue of the LPI's form relative to |x|^2 + |z|^2 + |w|^2 + |w_y|^2 for a GIVEN gain.

    The form is rebuilt by composition from P and Z = P gain, on Legendre functions f of degree below
    `size`; it does not use the Gram matrices. Not positive: gamma is certified for this very gain, also
    after its ranks were cut.
    """
    s = _Signals(problem)
    half = s.x.adjoint @ (P @ (s.x_t + gain @ s.y)) + s.z.adjoint @ s.c1
    half = half - (s.channels.adjoint @ s.channels) * (0.5 * gamma)
    matrix = half.discretise(size)
    n = problem.T.shape_out.functions * size
    finite = s.x.shape_in.finite
    weight = np.eye(len(matrix))
    T = problem.T.discretise(size, size + 12)
    weight[finite : finite + n, finite : finite + n] = T.T @ T
    return float(linalg.eigvalsh(matrix + matrix.T, weight)[-1])


def _verdict(solution: Solution) -> str:
    """What the solver's numbers, recomputed, allow to say; the gain itself is judged by lpi_eigenvalue."""
    if solution.status in ("infeasible", "infeasible_inaccurate"):
        return "infeasible"
    sound = (
        solution.status in ACCEPTED
        and solution.residual <= RESIDUAL_TOLERANCE
        and solution.smallest_gram_eigenvalue >= -EIGENVALUE_TOLERANCE
    )
    return "certified" if sound else "unreliable"
