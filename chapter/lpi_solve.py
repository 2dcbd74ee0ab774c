"""(18) in its feasible form for the chapter's outputs: a small matrix inequality, gains and their certificate.

Between the arm's partial integral equation (`design.arm_pie`, energy states) and `chapter.lpi_gains`. The error
of the observer obeys x_t = A f - B w + L (y - D21 n) with x = T f and the outputs

    y1 = <c, x>, tip displacement along y: bounded on the energy states;
    y2 = N_y(0) = -int g_y ds, mean of the fundamental state (its w-part; the root shear): not bounded on x.

P = q I + kappa S + H* W H as in `design.moments`, with one more functional among H than there: the momentum
m = int v_y ds. Its rate m_t = -N_y(0) - d m + ... has the boundary term that y2 measures, so that the column of
Z for y2 has to be Z2 = H* W b (b picks m): then N_y(0) drops out of the inequality and everything that is left
is bounded on x. For any other Z2 a term <x, .> N_y(0) remains that nothing dominates (theory, 3).
State feedback is the same program for the adjoint system, without y2.

    2 <x, P x_t> + 2 <x, Z1 (y1 - r1 n1)> + 2 <x, Z2 (y2 - r2 n2)> + 2 <z, C1 x>
        + eps |x|^2 + 2 beta <x, P x> <= gamma (|z|^2 + |w|^2 + |n|^2)
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from scipy import linalg

from design.arm_pie import ArmPIE, functional
from design.lpi.gains import gain_operator
from design.moments import (
    MARGIN_OF_ETA,
    PARITY,
    assembled,
    coordinates_in,
    dual,
    functionals,
    monomials,
    orthonormal,
    span_basis,
)
from design.operators import PIOperator, Shape
from design.quadratic import lifted
from design.semidefinite import ACCEPTED

Array = npt.NDArray[np.float64]

LARGEST_Q = 1e3
SMALLEST_DELTA = 1e-2
"""P >= SMALLEST_DELTA I: a nearly singular P reaches gammas a little smaller with gains without bound."""
TOLERANCE = 1e-6
"""Largest eigenvalue of the form, relative to |x|^2 and the channels, that counts as rounding."""
PATIENCE_S = 1800.0
"""For a program that takes seconds: on the wall clock, so that a busy machine must not come near it."""
KEEP = 0.7
"""Share of the largest delta that the third solve keeps."""


@dataclass(frozen=True)
class Posed:
    """x = T f, x_t = A f - B w (4 functions), z = C1 x, y = (<bounded, x>, and N_y(0) if `root`).

    krylov: x -> A^-1 x; bounded: (outputs, 4, d) coefficients.
    """

    T: PIOperator
    A: PIOperator
    krylov: PIOperator
    B: PIOperator
    C1: PIOperator
    bounded: Array
    root: bool
    drag: float

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return len(self.bounded) + int(self.root)


def observer_problem(pie: ArmPIE) -> Posed:
    """The chapter's y; z = (int v_y, int k), whose rate is the mean of the fundamental state (chapter.lpi)."""
    return Posed(
        T=pie.T,
        A=pie.A,
        krylov=pie.inverse(),
        B=functional("v_y").adjoint,
        C1=functional("v_y", "k"),
        bounded=tip_functional(pie),
        root=True,
        drag=pie.drag,
    )


def feedback_problem(pie: ArmPIE) -> Posed:
    """u = K x, one uniform load u beside the disturbance (20), z = (int v_y, int k, effort u).

    It is the observer of the adjoint system from B2* x = int v_y with the disturbance C1* (theory, 3).
    """
    load = functional("v_y")
    return Posed(
        T=pie.T_adjoint,
        A=pie.A_adjoint,
        krylov=pie.inverse(adjoint=True),
        B=functional("v_y", "k").adjoint,
        C1=load,
        bounded=np.asarray(load.q1),
        root=False,
        drag=pie.drag,
    )


@dataclass(frozen=True)
class Weights:
    """What is asked: noise weights of the outputs, eps of -eps T*T, and the decay rate beta of +2 beta T*PT."""

    noise: tuple[float, ...]
    epsilon: float
    decay: float = 0.0


@dataclass(frozen=True)
class Storage:
    """P = q I + kappa S + H* W H, in the functionals H of `coordinates`."""

    q: float
    kappa: float
    W: Array

    def operator(self, at: Coordinates) -> PIOperator:
        """P, 4 -> 4 functions."""
        rows = lifted(functionals(at.h))
        square = rows.adjoint @ PIOperator.multiplier(self.W[:, :, None]) @ rows
        return (PIOperator.identity(Shape(0, 4)) * self.q + at.S * self.kappa + square).trimmed()


@dataclass(frozen=True)
class Outcome:
    """P (`storage`), L = P^-1 Z (a column of 4 functions per output) and the evidence, all nondimensional.

    eigenvalue: largest one of the form, rebuilt from P and L (`form_eigenvalue`); status: the solver's word.
    """

    outcome: str
    status: str
    gamma: float
    storage: Storage | None
    L: PIOperator
    eigenvalue: float
    smallest_p: float
    largest_p: float


@dataclass(frozen=True)
class Coordinates:
    """Everything finite in the inequality, in coordinates of one orthonormal basis (m of them) of functions.

    H (k, m), rates (k, m): <H, x>_t = rates x - H B w - b N_y(0), b picks the last, the momentum; state (m,):
    which of the four states a coordinate is of.
    """

    state: npt.NDArray[np.int64]
    functions: Array
    H: Array
    rates: Array
    B: Array
    SB: Array
    C1: Array
    bounded: Array
    span: Array
    S: PIOperator
    eta: float
    h: Array


def tip_functional(pie: ArmPIE) -> Array:
    """c with y1 = <c, x>: displacement of the tip along y, coefficients (1, 4, d)."""
    kernel = pie.virtual.r1[1]  # of v_y; (2, ds, dt)
    at_tip = np.sqrt(2.0 * np.arange(kernel.shape[1]) + 1.0)
    rows = np.einsum("i,nij->nj", at_tip, kernel)
    out = np.zeros((1, 4, rows.shape[1]))
    out[0, 2:] = rows / np.array([pie.alpha, 1.0])[:, None]
    return out


def coordinates(posed: Posed, count: int) -> Coordinates:
    """With `count` Legendre polynomials a state in H, and with the root's force the momentum."""
    krylov = posed.krylov
    phi = monomials(4, count)
    bounded = dual(phi, krylov)
    size = np.linalg.norm(bounded.reshape(len(bounded), -1), axis=1)
    phi, bounded = phi / size[:, None, None], bounded / size[:, None, None]
    h, rates = bounded, phi
    if posed.root:
        momentum = functional("v_y").q1
        h, rates = _stacked(h, momentum), _stacked(rates, -posed.drag * momentum)
    work = PIOperator.multiplier(np.diag(PARITY)[:, :, None]) @ krylov
    S = (work + work.adjoint) * 0.5
    B, SB = (np.moveaxis(a.q2, 1, 0) for a in (posed.B, S @ posed.B))
    needed = (h, rates, B, SB, posed.C1.q1, posed.bounded)
    bases = [span_basis([f[:, i] for f in needed]) for i in range(4)]

    def of(functions: Array) -> Array:
        return coordinates_in(functions, bases)

    return Coordinates(
        state=np.repeat(np.arange(4), [len(b) for b in bases]),
        functions=assembled(np.eye(sum(map(len, bases))), bases),
        H=of(h),
        rates=of(rates),
        B=of(B),
        SB=of(SB),
        C1=of(posed.C1.q1),
        bounded=of(posed.bounded),
        span=orthonormal(np.concatenate([of(f) for f in (h, phi, posed.bounded, SB)])),
        S=S,
        eta=MARGIN_OF_ETA * float(np.abs(np.linalg.eigvalsh(S.discretise(32))).max()),
        h=h,
    )


class Program:
    """The matrix inequality; `solve` may be called several times."""

    def __init__(self, posed: Posed, at: Coordinates, weights: Weights) -> None:
        self.posed, self.at, self.weights = posed, at, weights
        k = len(at.H)
        self.gamma, self.delta = cp.Variable(), cp.Variable()
        self.p, self.positive, self.negative = (cp.Variable(nonneg=True) for _ in range(3))
        self.W = cp.Variable((k, k), symmetric=True)
        self.zeta = cp.Variable((len(at.span), len(posed.bounded)))
        self.matrices = self._matrices()
        kappa = self.positive - self.negative
        lost = 2.0 * weights.decay * self.upper
        self.constraints = [0.5 * (m + m.T) >> 0 for m in self.matrices]
        self.constraints += [
            2.0 * kappa - 2.0 * posed.drag * self.q + lost <= -weights.epsilon,
            -2.0 * kappa + lost <= -weights.epsilon,
            self.q <= LARGEST_Q,
        ]

    @property
    def q(self) -> cp.Expression:
        """Multiplier of P."""
        return self.delta + self.p + self.at.eta * (self.positive + self.negative)

    @property
    def upper(self) -> cp.Expression:
        """P <= upper I + H* W H."""
        return self.q + self.at.eta * (self.positive + self.negative)

    @property
    def z_columns(self) -> cp.Expression:
        """Coordinates (m, outputs) of the columns of Z."""
        first = self.at.span.T @ self.zeta
        return cp.hstack([first, self.at.H.T @ self.W[:, -1:]]) if self.posed.root else first

    def _matrices(self) -> list[cp.Expression]:
        at, weights = self.at, self.weights
        q, kappa = self.q, self.positive - self.negative
        m = len(at.state)
        velocity = np.diag((PARITY[at.state] > 0.0).astype(float))
        HW = at.H.T @ self.W
        half = (
            -self.posed.drag * q * velocity
            + kappa * np.diag(PARITY[at.state])
            + HW @ at.rates
            + (at.span.T @ self.zeta) @ at.bounded
        )
        state = half + half.T + weights.epsilon * np.eye(m)
        if weights.decay:
            state = state + 2.0 * weights.decay * (self.upper * np.eye(m) + HW @ at.H)
        disturbance = -(q * at.B + kappa * at.SB + (at.B @ at.H.T) @ self.W @ at.H)
        noise = -self.z_columns @ np.diag(weights.noise)
        channels = len(at.C1) + len(at.B) + self.posed.outputs
        rows = cp.vstack([at.C1, disturbance, noise.T])
        form = cp.bmat([[-self.gamma * np.eye(channels), rows], [rows.T, state]])
        Q = orthonormal(at.H)
        M = at.H @ Q.T
        return [-form, self.p * np.eye(len(Q)) + M.T @ self.W @ M]

    def solve(self, objective: cp.Expression, fixed: list[cp.Constraint]) -> str:
        """The solver's status; never raises for its failure."""
        program = cp.Problem(cp.Minimize(objective), [*self.constraints, *fixed])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                program.solve(
                    solver="CLARABEL",
                    equilibrate_enable=False,
                    max_threads=1,
                    time_limit=PATIENCE_S,
                )
            except cp.error.SolverError:
                return "solver_error"
        return str(program.status)

    def found(self) -> tuple[Storage, PIOperator]:
        """P and Z (outputs -> 4 functions) of the last solve."""
        at = self.at
        P = Storage(
            float(self.q.value),
            float(self.positive.value - self.negative.value),
            np.asarray(self.W.value),
        )
        columns = np.einsum("mo,mnd->ond", at.span.T @ self.zeta.value, at.functions)
        if self.posed.root:
            columns = _stacked(columns, np.einsum("k,knd->nd", P.W[:, -1], at.h)[None])
        Z = PIOperator.zeros(Shape(0, 4), Shape(self.posed.outputs, 0))
        return P, Z.replace(q2=columns.transpose(1, 0, 2))


def solve(
    posed: Posed,
    weights: Weights,
    count: int = 3,
    slack: float = 0.05,
    gamma: float | None = None,
) -> Outcome:
    """Smallest gamma, then at (1 + slack) gamma (or at `gamma`) the smallest |Z| / delta by two more solves."""
    at = coordinates(posed, count)
    program = Program(posed, at, weights)
    small = [program.delta == SMALLEST_DELTA]
    status = program.solve(program.gamma, small)
    if status not in ACCEPTED:
        verdict = "infeasible" if status.startswith("infeasible") else "unreliable"
        none = PIOperator.zeros(Shape(0, 4), Shape(posed.outputs, 0))
        return Outcome(verdict, status, np.nan, None, none, np.nan, np.nan, np.nan)
    value = float(program.gamma.value)
    storage, Z = program.found()
    target = max(value * (1.0 + slack), gamma or 0.0)
    second = program.solve(-program.delta, [program.gamma == target])
    if second in ACCEPTED:
        (storage, Z), value, status = program.found(), target, second
        delta = KEEP * float(program.delta.value)
        third = program.solve(
            cp.norm(program.z_columns, "fro"), [program.gamma == target, program.delta == delta]
        )
        if third in ACCEPTED:
            (storage, Z), value, status = program.found(), target, third
    P = storage.operator(at)
    L, _ = gain_operator(P, Z)
    return judged(posed, weights, storage, P, L, value, status)


def judged(
    posed: Posed,
    weights: Weights,
    storage: Storage,
    P: PIOperator,
    L: PIOperator,
    gamma: float,
    status: str,
) -> Outcome:
    """The verdict on P and L, recomputed without the solver's matrices."""
    values = np.linalg.eigvalsh(P.discretise(24))
    eigenvalue = form_eigenvalue(posed, weights, P, L, gamma)
    good = eigenvalue <= TOLERANCE and values[0] > 0.0
    return Outcome(
        "certified" if good else "unreliable", status, gamma, storage, L, eigenvalue,
        float(values[0]), float(values[-1]),
    )  # fmt: skip


def form_eigenvalue(
    posed: Posed, weights: Weights, P: PIOperator, L: PIOperator, gamma: float, size: int = 16
) -> float:
    """Largest eigenvalue of the form of (18), rebuilt by composition on Legendre functions f of degree < size.

    Relative to |T f|^2 + the channels'. Nothing of the solver's matrices enters: y2 is -int g, applied to f.
    """
    T, A = posed.T, posed.A
    n = 4 * size
    out = size + 24
    Tm, Am, Pm = T.discretise(size, out), A.discretise(size, out), P.discretise(out)
    Lm = L.discretise(1, out)
    y = (functionals(posed.bounded) @ T).discretise(size)
    if posed.root:
        force = np.zeros((1, n))
        force[0, 3 * size] = -1.0  # int of the second component of g, the constant's coefficient
        y = np.vstack([y, force])
    z = (posed.C1 @ T).discretise(size)
    load = posed.B.discretise(1, out)
    lhs = Tm.T @ Pm
    state = lhs @ (Am + Lm @ y)
    state = state + state.T + weights.epsilon * Tm.T @ Tm + 2.0 * weights.decay * lhs @ Tm
    columns = np.hstack([z.T, -lhs @ load, -lhs @ Lm @ np.diag(weights.noise)])
    k = columns.shape[1]
    form = np.block([[-gamma * np.eye(k), columns.T], [columns, state]])
    weight = linalg.block_diag(np.eye(k), Tm.T @ Tm)
    return float(linalg.eigvalsh(0.5 * (form + form.T), weight)[-1])


def _stacked(one: Array, two: Array) -> Array:
    width = max(one.shape[2], two.shape[2])
    return np.concatenate(
        [np.pad(a, ((0, 0), (0, 0), (0, width - a.shape[2]))) for a in (one, two)]
    )
