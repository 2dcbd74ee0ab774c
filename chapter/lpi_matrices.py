"""(18) and (21) on matrices: T is an invertible matrix, so that every block can be tried.

T x_t = A x + B1 w + B2 u, z = C1 x + D12 u, y = C2 x + D21 w. The printed inequalities and the derived ones are
minimised in gamma, and the closed loop's norm, computed from matrices alone, says which of them certify.
Derivation of (21): V = <T* x, P T* x> for the dual system T* x_t = (A + B2 K)* x + (C1 + D12 K)* w,
z = B1* x, with Z = K P:

    V_t = 2 <x, T (A P + B2 Z)* x> + 2 <x, T (C1 P + D12 Z)* w>,

so that T stands in the block of C1 as well, and B1 without T.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import cvxpy as cp
import numpy as np
import numpy.typing as npt

from design.channel import Channel, state_feedback_optimum
from design.semidefinite import ACCEPTED

Array = npt.NDArray[np.float64]
Reading = Literal["printed", "derived"]
SMALLEST_P = 1e-3


@dataclass(frozen=True)
class Plant:
    """Matrices of (20) with one disturbance, one regulated output, one input and one measured output."""

    T: Array
    A: Array
    B1: Array
    B2: Array
    C1: Array
    D12: Array
    C2: Array
    D21: Array

    def explicit(self) -> tuple[Array, Array, Array]:
        """A, B1, B2 of x_t = ..."""
        solved: Array = np.asarray(
            np.linalg.solve(self.T, np.hstack([self.A, self.B1, self.B2])), np.float64
        )
        n = len(self.A)
        return solved[:, :n], solved[:, n : n + 1], solved[:, n + 1 :]


@dataclass(frozen=True)
class Compared:
    """One plant: what the inequality promises, what the loop does, and the best of all gains."""

    status: str
    gamma: float
    norm: float
    optimum: float

    @property
    def kept(self) -> bool:
        """Whether the promise holds, to 0.1 %."""
        return self.norm <= self.gamma * (1.0 + 1e-3)


def random_plant(seed: int, states: int = 3, size: float = 1.0) -> Plant:
    """Entries normal, T well conditioned and `size` times an almost orthogonal matrix."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(states, states)))[0]
    return Plant(
        T=size * (turn + 0.3 * rng.normal(size=(states, states))),
        A=rng.normal(size=(states, states)),
        B1=rng.normal(size=(states, 1)),
        B2=rng.normal(size=(states, 1)),
        C1=rng.normal(size=(1, states)),
        D12=np.array([[0.5]]),
        C2=rng.normal(size=(1, states)),
        D21=np.array([[0.5]]),
    )


def state_feedback(plant: Plant, reading: Reading) -> Compared:
    """(21): u = Z P^-1 x by the printed or the derived inequality.

    Printed, P C1* + Z* D12* is a column where the block is a row; it is read as its adjoint.
    """
    n = len(plant.A)
    P, Z = cp.Variable((n, n), symmetric=True), cp.Variable((1, n))
    gamma = cp.Variable()
    cross = plant.C1 @ P + plant.D12 @ Z
    if reading == "derived":
        cross = cross @ plant.T.T
    block = plant.T @ (plant.A @ P + plant.B2 @ Z).T
    form = cp.bmat(
        [
            [-gamma * np.eye(1), np.zeros((1, 1)), cross],
            [np.zeros((1, 1)), -gamma * np.eye(1), plant.B1.T],
            [cross.T, plant.B1, block + block.T],
        ]
    )
    status = _minimise(gamma, [P >> SMALLEST_P * np.eye(n), 0.5 * (form + form.T) << 0])
    if status not in ACCEPTED:
        return Compared(status, np.nan, np.nan, np.nan)
    K = np.linalg.solve(P.value, np.asarray(Z.value).T).T
    A, B1, B2 = plant.explicit()
    C, D = plant.C1 + plant.D12 @ K, np.zeros((1, 1))
    optimum = state_feedback_optimum(A, B1, B2, plant.C1, D, plant.D12)
    return Compared(status, float(gamma.value), Channel(A + B2 @ K, B1, C, D).hinf_norm(), optimum)


def observer(
    plant: Plant, order: Literal["printed", "T on the other side"] = "printed"
) -> Compared:
    """(18) without -eps I: L = P^-1 Z. The other order, T where T* stands, is there to be refused."""
    n = len(plant.A)
    P, Z = cp.Variable((n, n), symmetric=True), cp.Variable((n, 1))
    gamma = cp.Variable()
    T = plant.T if order == "printed" else plant.T.T
    block = T.T @ (P @ plant.A + Z @ plant.C2)
    cross = -(P @ plant.B1 + Z @ plant.D21).T @ T
    form = cp.bmat(
        [
            [-gamma * np.eye(1), np.zeros((1, 1)), cross],
            [np.zeros((1, 1)), -gamma * np.eye(1), plant.C1],
            [cross.T, plant.C1.T, block + block.T],
        ]
    )
    status = _minimise(gamma, [P >> SMALLEST_P * np.eye(n), 0.5 * (form + form.T) << 0])
    if status not in ACCEPTED:
        return Compared(status, np.nan, np.nan, np.nan)
    L = np.linalg.solve(P.value, np.asarray(Z.value))
    A = np.asarray(np.linalg.solve(plant.T, plant.A + L @ plant.C2), np.float64)
    B = np.asarray(-np.linalg.solve(plant.T, plant.B1 + L @ plant.D21), np.float64)
    zero = np.zeros((1, 1))
    norm = Channel(A, B, plant.C1, zero).hinf_norm()
    A0, B1, _ = plant.explicit()
    optimum = state_feedback_optimum(A0.T, plant.C1.T, plant.C2.T, B1.T, zero, plant.D21.T)
    return Compared(status, float(gamma.value), norm, optimum)


def _minimise(gamma: cp.Variable, constraints: list[cp.Constraint]) -> str:
    program = cp.Problem(cp.Minimize(gamma), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            program.solve(solver="CLARABEL", max_threads=1)
        except cp.error.SolverError:
            return "solver_error"
    return str(program.status)
