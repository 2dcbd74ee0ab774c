"""The straight arm by the modes of a clamped-free beam: shares no code with the design or the grids.

Nondimensional, transverse part only (the axial part of a straight arm sees no transverse load). With
velocity sum a_j phi_j and curvature sum b_j phi_j'' / beta_j^2, both sets orthonormal in L2,
    a_j' = -beta_j^2 b_j - d a_j + <phi_j, f>,    b_j' = beta_j^2 a_j.
States are ordered (a, b).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg
from scipy.optimize import brentq, minimize_scalar

Array = npt.NDArray[np.float64]


def root(j: int) -> float:
    """beta_j: cos(b) cosh(b) = -1, solved as cos(b) = -1 / cosh(b)."""
    middle = (j + 0.5) * np.pi
    return float(brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), middle - 0.6, middle + 0.6))


def shapes(j: int, s: Array) -> tuple[Array, Array]:
    """phi_j and phi_j'' / beta_j^2, each with L2 norm one; stable for all j."""
    b = root(j)
    grow = (np.sin(b) - np.cos(b) - np.exp(-b)) / (np.sinh(b) + np.sin(b))  # 1 - sigma
    sigma = 1.0 - grow
    outer = 0.5 * (grow * np.exp(b * s) + (1.0 + sigma) * np.exp(-b * s))
    inner = np.cos(b * s) - sigma * np.sin(b * s)
    return np.asarray(outer - inner), np.asarray(outer + inner)


@dataclass(frozen=True)
class Beam:
    """x_t = A x + B w with z = C x, the mean velocity and the mean curvature."""

    A: Array
    B: Array
    C: Array


def beam(modes: int, drag: float) -> Beam:
    """The uniform transverse load w and z = int (v_y, k) ds."""
    x, w = np.polynomial.legendre.leggauss(8 * modes + 20)
    s, w = 0.5 * (x + 1.0), 0.5 * w
    frequencies = np.array([root(j) ** 2 for j in range(modes)])
    pairs = [shapes(j, s) for j in range(modes)]
    mean_v = np.array([w @ v for v, _ in pairs])
    mean_k = np.array([w @ k for _, k in pairs])
    zero = np.zeros(modes)
    W = np.diag(frequencies)
    return Beam(
        A=np.block([[-drag * np.eye(modes), -W], [W, np.zeros((modes, modes))]]),
        B=np.concatenate([mean_v, zero])[:, None],
        C=np.stack([np.concatenate([mean_v, zero]), np.concatenate([zero, mean_k])]),
    )


def response(A: Array, B: Array, C: Array, D: Array | None, omega: float) -> float:
    """Largest singular value of C (i omega - A)^-1 B + D."""
    G = C @ np.linalg.solve(1j * omega * np.eye(len(A)) - A, B.astype(complex))
    return float(np.linalg.norm(G if D is None else G + D, 2))


def norm(A: Array, B: Array, C: Array, D: Array | None = None) -> float:
    """H-infinity norm by a dense sweep around every eigenfrequency and a local search; A is stable."""
    values = np.linalg.eigvals(A)
    centres = np.unique(np.abs(values.imag).round(9))
    widths = np.abs(values.real).max() + 0.1
    sweep = np.unique(
        np.concatenate(
            [np.geomspace(1e-3, 1e3, 200), *(c + widths * np.linspace(-2, 2, 41) for c in centres)]
        )
    )
    sweep = np.concatenate([[0.0], sweep[sweep > 0.0]])
    gains = np.array([response(A, B, C, D, w) for w in sweep])
    top = int(np.argmax(gains))
    low, high = sweep[max(top - 1, 0)], sweep[min(top + 1, len(sweep) - 1)]
    found = minimize_scalar(
        lambda w: -response(A, B, C, D, w), bounds=(low, high), method="bounded"
    )
    return max(float(gains[top]), -float(found.fun))


def state_feedback_optimum(A: Array, B1: Array, C1: Array, B2: Array, effort: float) -> float:
    """Smallest gamma for z = (C1 x, effort u), from SciPy's Riccati solver, by bisection."""
    n, m1, m2 = len(A), B1.shape[1], B2.shape[1]

    def reachable(gamma: float) -> bool:
        weight = np.diag([-(gamma**2)] * m1 + [effort**2] * m2)
        try:
            X = linalg.solve_continuous_are(A, np.hstack([B1, B2]), C1.T @ C1, weight)
        except np.linalg.LinAlgError:
            return False
        closed = A + (B1 @ B1.T / gamma**2 - B2 @ B2.T / effort**2) @ X
        stable = np.linalg.eigvals(closed).real.max() < -1e-7  # at the optimum it is on the axis
        return bool(stable and np.linalg.eigvalsh(X)[0] > -1e-9 * n)

    low, high = 1e-4, 10.0
    while high - low > 1e-6 * high:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if reachable(float(middle)) else (middle, high)
    return float(high)


def observer_optimum(model: Beam, noise: float) -> float:
    """The dual problem: y = (v_y, k) at every point with noise of weight `noise`."""
    return state_feedback_optimum(model.A.T, model.C.T, model.B.T, np.eye(len(model.A)), noise)


def controller_optimum(model: Beam, effort: float) -> float:
    """u = f_y, a load of any shape."""
    modes = len(model.A) // 2
    force = np.vstack([np.eye(modes), np.zeros((modes, modes))])
    return state_feedback_optimum(model.A, model.B, model.C, force, effort)
