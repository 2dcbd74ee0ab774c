"""The LMI (16) of section 3.4.1 for an error system of finitely many states, with the chapter's epsilon.

Step 2 of section 4.1 with the order of the steps turned round (first the grid, then the gain): it shows
what the grid's own observer can do, and what a large epsilon does. Independent of the inequality (18).
"""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import numpy.typing as npt

from design.channel import Channel
from design.semidefinite import ACCEPTED

Array = npt.NDArray[np.float64]

SMALLEST_P = 1e-6


@dataclass(frozen=True, eq=False)
class LmiGain:
    """L = P^-1 Z of (16), and what the closed loop e_t = (A + L C2) e - (B + L D21) w does."""

    gain: Array
    """(states, outputs)."""
    gamma: float
    """That the LMI proves."""
    achieved: float
    """H-infinity norm from (w, noise) to z; NaN if the loop is not stable."""
    decay: float
    """Of the slowest mode, positive if stable, per unit of time."""


def solve(A: Array, B: Array, C1: Array, C2: Array, noise: Array, epsilon: float) -> LmiGain | None:
    """Smallest gamma of (16) with <= -epsilon I; None if the solver finds no solution.

    e_t = A e - B w, z = C1 e, y = C2 e + noise n: A (m, m), B (m, p), C1 (q, m), C2 (r, m), noise (r,). The
    states should be scaled to energies, w, y and z to each other.
    """
    states, outputs = A.shape[0], C2.shape[0]
    inputs = np.hstack([B, np.zeros((states, outputs))])
    feedthrough = np.hstack([np.zeros((outputs, B.shape[1])), np.diag(noise)])
    P = cp.Variable((states, states), symmetric=True)
    Z = cp.Variable((states, outputs))
    gamma = cp.Variable()
    left = P @ A + Z @ C2
    drive = -(P @ inputs + Z @ feedthrough)
    size, regulated = inputs.shape[1], C1.shape[0]
    form = cp.bmat(
        [
            [-gamma * np.eye(size), np.zeros((size, regulated)), drive.T],
            [np.zeros((regulated, size)), -gamma * np.eye(regulated), C1],
            [drive, C1.T, left + left.T + epsilon * np.eye(states)],
        ]
    )
    problem = cp.Problem(cp.Minimize(gamma), [P >> SMALLEST_P * np.eye(states), form << 0])
    try:
        problem.solve(solver="CLARABEL")
    except cp.SolverError:
        return None
    if problem.status not in ACCEPTED:
        return None
    gain = np.linalg.solve(P.value, Z.value)
    loop = A + gain @ C2
    decay = -float(np.linalg.eigvals(loop).real.max())
    achieved = float("nan")
    if decay > 0.0:
        none = np.zeros((C1.shape[0], inputs.shape[1]))
        achieved = Channel(loop, inputs + gain @ feedthrough, C1, none).hinf_norm()
    return LmiGain(gain, float(gamma.value), achieved, decay)
