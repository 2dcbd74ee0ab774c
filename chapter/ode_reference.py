"""References for the LMIs of section 3 that share nothing with them: Riccati equations, norms, python-control.

All that is shared with `chapter.ode_lmi` are the matrices of the systems.
"""

from __future__ import annotations

import importlib.util
import io
import math
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_continuous_are

from chapter.ode_lmi import System

Array = npt.NDArray[np.float64]
StateSpace = tuple[Array, Array, Array, Array]

BISECTION = 1e-7
"""Relative width at which bisections end."""
PATIENCE_S = 30
"""Of processor time: sb10ad takes milliseconds, or for ever. On the wall clock a busy machine would decide."""
SENSOR_NOISE = 1e-4
"""For `control.hinfsyn`, which wants every measurement noisy, the state is measured with this much noise."""


def hinf_norm(system: StateSpace) -> float:
    """Least gamma for which the Hamiltonian matrix has no imaginary eigenvalue (Boyd, Balakrishnan, Kabamba);
    infinite if an eigenvalue of A is not in the open left half plane."""
    A, B, C, D = system
    if np.linalg.eigvals(A).real.max() >= 0.0:
        return math.inf
    low = max(float(np.linalg.norm(D, 2)), *(_gain(system, w) for w in _frequencies(A)), 1e-12)

    def below(gamma: float) -> bool:
        R = gamma**2 * np.eye(D.shape[1]) - D.T @ D
        S = np.eye(len(D)) + D @ np.linalg.solve(R, D.T)
        F = A + B @ np.linalg.solve(R, D.T @ C)
        H = np.block([[F, B @ np.linalg.solve(R, B.T)], [-C.T @ S @ C, -F.T]])
        values = np.linalg.eigvals(H)
        # Those on the axis are no frequencies of gain gamma if the gain there, read off directly, is smaller.
        close = values[np.abs(values.real) < 1e-5 * max(1.0, float(np.abs(values).max()))]
        return not any(_gain(system, abs(v.imag)) >= gamma * (1.0 - 1e-9) for v in close)

    return _bisect(below, low * (1.0 + 1e-9))


def sweep_norm(system: StateSpace, points: int = 4000) -> float:
    """Largest gain over a logarithmic grid of frequencies: a lower bound that nothing can argue with."""
    grid = np.concatenate([[0.0], np.geomspace(1e-4, 1e4, points)])
    return max(_gain(system, w) for w in grid)


def _gain(system: StateSpace, frequency: float) -> float:
    A, B, C, D = system
    at = C @ np.linalg.solve(1j * frequency * np.eye(len(A)) - A, B) + D
    return float(np.linalg.norm(at, 2))


def _frequencies(A: Array) -> list[float]:
    return [0.0, *np.abs(np.linalg.eigvals(A)).tolist()]


def _bisect(below: Callable[[float], bool], low: float) -> float:
    """The number above `low` from which on `below` is true."""
    high = 2.0 * low
    while not below(high):
        low, high = high, 2.0 * high
        if high > 1e12:
            return math.inf
    while high - low > BISECTION * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if below(middle) else (middle, high)
    return high


def riccati_controller(s: System) -> float:
    """Least gamma of state feedback: above it the game Riccati equation has a stabilising X >= 0.

    D_11 is first moved into the other matrices, which leaves every closed loop's own Riccati equation as it is:
    with R = gamma^2 - D_11' D_11 the loop has norm below gamma if and only if that of (A + B_1 R^-1 D_11' C_1,
    B_1 R^-1/2, (1 + D_11 R^-1 D_11')^1/2 C_1) has norm below 1. (Left where it is, it would make the equation
    that of feedback of x and w.) Raises LinAlgError if D_12 has not full column rank.
    """
    n, nw, nu = len(s.A), s.B1.shape[1], s.B2.shape[1]
    if np.linalg.matrix_rank(s.D12) < nu:
        raise np.linalg.LinAlgError("D_12 has not full column rank: there is no Riccati equation")

    def below(gamma: float) -> bool:
        R = gamma**2 * np.eye(nw) - s.D11.T @ s.D11
        if np.linalg.eigvalsh(R)[0] <= 0.0:
            return False
        moved = np.linalg.solve(R, s.D11.T)
        S = np.eye(len(s.C1)) + s.D11 @ moved
        A, B2 = s.A + s.B1 @ moved @ s.C1, s.B2 + s.B1 @ moved @ s.D12
        B = np.hstack([s.B1, B2])
        weight = np.block([[-R, np.zeros((nw, nu))], [np.zeros((nu, nw)), s.D12.T @ S @ s.D12]])
        cross = np.hstack([np.zeros((n, nw)), s.C1.T @ S @ s.D12])
        try:
            X = solve_continuous_are(A, B, s.C1.T @ S @ s.C1, weight, s=cross)
        except (np.linalg.LinAlgError, ValueError):
            return False
        F = -np.linalg.solve(weight, B.T @ X + cross.T)
        terms = A.T @ X, X @ A, s.C1.T @ S @ s.C1, (X @ B + cross) @ F
        # With eigenvalues of the Hamiltonian pencil on the axis an X may still come back: it solves nothing.
        solves = np.abs(sum(terms)).max() < 1e-6 * max(float(np.abs(t).max()) for t in terms)
        return bool(
            solves
            and np.linalg.eigvalsh(0.5 * (X + X.T))[0] > -1e-8 * float(np.abs(X).max())
            and np.linalg.eigvals(A + B @ F).real.max() < -1e-9
        )

    return _bisect(below, max(1e-3, float(np.linalg.norm(s.D11, 2))))


def riccati_observer(s: System) -> float:
    """The same of the observer, by the dual system."""
    return riccati_controller(s.transposed)


def have_control() -> bool:
    """Whether python-control and slycot are installed (the extra `baselines`)."""
    return all(importlib.util.find_spec(name) for name in ("control", "slycot"))


def control_norm(system: StateSpace) -> float:
    """The norm by `control.linfnorm`, that is slycot's ab13dd."""
    import control

    return float(control.linfnorm(control.ss(*system))[0])


Plant = tuple[StateSpace, int, int]
"""Matrices, number of measurements, number of controls; both last among outputs and inputs."""


def feedback_plant(s: System) -> Plant:
    """Feedback of y = x + `SENSOR_NOISE` v, whose least gamma is at least that of state feedback, and close to
    it."""
    n, nw, nu = len(s.A), s.B1.shape[1], s.B2.shape[1]
    nz = len(s.C1)
    D = np.block(
        [
            [s.D11, np.zeros((nz, n)), s.D12],
            [np.zeros((n, nw)), SENSOR_NOISE * np.eye(n), np.zeros((n, nu))],
        ]
    )
    B = np.hstack([s.B1, np.zeros((n, n)), s.B2])
    return (s.A, B, np.vstack([s.C1, np.eye(n)]), D), n, nu


def filter_plant(s: System) -> Plant:
    """Any causal filter for z from y: u is the estimate, z_e = z - u. It stabilises nothing, so A must be
    stable: sb10ad does not come back otherwise."""
    nz, ny = len(s.C1), len(s.C2)
    D = np.block([[s.D11, -np.eye(nz)], [s.D21, np.zeros((ny, nz))]])
    B = np.hstack([s.B1, np.zeros((len(s.A), nz))])
    return (s.A, B, np.vstack([s.C1, s.C2]), D), ny, nz


def hinfsyn(plant: Plant) -> tuple[float, float] | None:
    """By `control.hinfsyn` in a process of its own: the gamma that it tells, and the norm of the loop that it
    returns; None if it does not come back, or fails."""
    (A, B, C, D), measured, controls = plant
    data = io.BytesIO()
    np.savez(data, A=A, B=B, C=C, D=D, sizes=np.array([measured, controls]))
    command = [sys.executable, "-m", "chapter.ode_reference"]
    try:
        done = subprocess.run(
            command,
            input=data.getvalue(),
            capture_output=True,
            cwd=Path(__file__).resolve().parents[1],
            check=True,
        )
    except subprocess.CalledProcessError:
        return None
    gamma, norm = done.stdout.split()[-2:]
    return float(gamma), float(norm)


def _answer() -> None:
    """The child: read the plant, answer, exit."""
    resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE_S, PATIENCE_S))
    import control

    given = np.load(io.BytesIO(sys.stdin.buffer.read()))
    measured, controls = (int(size) for size in given["sizes"])
    plant = control.ss(*(given[key] for key in "ABCD"))
    _, loop, gamma, _ = control.hinfsyn(plant, measured, controls)
    print(float(gamma), float(control.linfnorm(loop)[0]))


if __name__ == "__main__":
    _answer()
