"""Tables of `chapter.lpi`: what epsilon, a decay requirement and the noise weight do to the feasible (18).

Every row is solved, inverted and put on the grid of `chapter.lpi_check`; rates and times are nondimensional.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from chapter.lpi_check import GridArm, error_channel
from chapter.lpi_gains import COUNT, NOISE, chapter_grid, chapter_pie, on_grid
from chapter.lpi_solve import Weights, feedback_problem, observer_problem, solve
from chapter.part import Tell
from design.channel import Channel, riccati_optimum

Array = npt.NDArray[np.float64]

EPSILON_ROWS = (1e-3, 0.1, 1.0, 3.0, 10.0, 30.0)
DECAY_ROWS = (0.05, 0.1, 0.2, 0.3)
NOISE_ROWS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Factors of NOISE."""
CELLS = 60
SMALLEST_EPSILON = 1e-3


@dataclass(frozen=True)
class Row:
    """One observer of setpoint 1."""

    epsilon: float
    decay_required: float
    noise: float
    """Factor of NOISE."""
    outcome: str
    gamma: float
    achieved: float
    """On CELLS cells."""
    certified_decay: float
    first_mode_decay: float
    slowest_decay: float
    settling: float
    """Time until the error from a bent arm at rest, in the energy norm, stays below 1 % of what it was."""
    gain_1: float
    """L2 norm of the column of L for y1."""
    gain_2: float
    largest_p: float


def row(weights: Weights, factor: float = 1.0) -> Row:
    """Solve and judge; numbers are NaN where the solver finds nothing."""
    found = solve(observer_problem(chapter_pie("1")), weights, COUNT)
    if found.storage is None:
        nan = float("nan")
        return Row(weights.epsilon, weights.decay, factor, found.outcome, *(nan,) * 9)
    arm = chapter_grid("1", CELLS)
    L = on_grid(arm, found.L.q2)
    loop = error_channel(arm, L, np.array(weights.noise), arm.C1)
    values = np.linalg.eigvals(loop.A)
    oscillating = values[values.imag > 0.0]
    norms = np.linalg.norm(L, axis=0)
    return Row(
        weights.epsilon,
        weights.decay,
        factor,
        found.outcome,
        found.gamma,
        loop.hinf_norm(),
        weights.decay + 0.5 * weights.epsilon / found.largest_p,
        -float(oscillating[np.argmin(np.abs(oscillating))].real),
        -float(values.real.max()),
        settling(arm, loop.A),
        float(norms[0]),
        float(norms[1]),
        found.largest_p,
    )


def settling(arm: GridArm, A: Array, share: float = 0.01, until: float = 40.0) -> float:
    """Time until |exp(A t) e0| stays below share |e0|, e0: curvature 4 (1 - s)^2 at rest. At most `until`."""
    e0 = np.where(arm.states == 3, 4.0 * (1.0 - arm.positions) ** 2, 0.0) * np.sqrt(arm.widths)
    step = 0.02
    one = linalg.expm(step * A)
    size, last, e = float(np.linalg.norm(e0)), float("inf"), e0
    for number in range(round(until / step)):
        if np.linalg.norm(e) > share * size:
            last = (number + 1) * step
        e = one @ e
    return last if last < until else float("inf")


def open_loop_settling() -> float:
    """The same without gains."""
    arm = chapter_grid("1", CELLS)
    return settling(arm, arm.A)


def epsilon_rows(tell: Tell) -> list[Row]:
    """Rows over EPSILON_ROWS, then over DECAY_ROWS."""
    asked = [Weights(NOISE, e) for e in EPSILON_ROWS]
    asked += [Weights(NOISE, SMALLEST_EPSILON, beta) for beta in DECAY_ROWS]
    rows = []
    for weights in asked:
        rows.append(row(weights))
        tell(f"epsilon {weights.epsilon:g}, decay {weights.decay:g}: gamma {rows[-1].gamma:.4f}")
    return rows


def noise_rows(tell: Tell) -> list[Row]:
    """Rows over NOISE_ROWS."""
    rows = []
    for factor in NOISE_ROWS:
        weights = Weights(tuple(factor * n for n in NOISE), SMALLEST_EPSILON)
        rows.append(row(weights, factor))
        tell(f"noise weights times {factor:g}: gamma {rows[-1].gamma:.4f}")
    return rows


@dataclass(frozen=True)
class Feedback:
    """One state feedback u = K x of setpoint 1, u a uniform load."""

    effort: float
    outcome: str
    gamma: float
    achieved: float
    optimum: float
    open_loop: float
    first_mode_decay: float
    gain: float
    gains: Array
    """(4, 1, d), K as a functional: u = <K, x>."""


def feedback(effort: float) -> Feedback:
    """(20) and (21) in the feasible form. Raises ArithmeticError if the solver finds nothing."""
    found = solve(feedback_problem(chapter_pie("1")), Weights((effort,), SMALLEST_EPSILON), 2)
    if found.storage is None:
        raise ArithmeticError(f"state feedback: {found.outcome}")
    arm, coarse = chapter_grid("1", CELLS), chapter_grid("1", 24)
    K = on_grid(arm, found.L.q2).T
    outputs = np.vstack([arm.C1, effort * K])
    loop = Channel(arm.A + arm.B @ K, arm.B, outputs, np.zeros((3, 1)))
    values = np.linalg.eigvals(loop.A)
    oscillating = values[values.imag > 0.0]
    return Feedback(
        effort,
        found.outcome,
        found.gamma,
        loop.hinf_norm(),
        riccati_optimum(coarse.A, coarse.B, coarse.C1, coarse.B, effort),
        Channel(arm.A, arm.B, arm.C1, np.zeros((2, 1))).hinf_norm(),
        -float(oscillating[np.argmin(np.abs(oscillating))].real),
        float(np.linalg.norm(K)),
        found.L.q2,
    )


def storage_needed(energy: Array, cells: tuple[int, ...]) -> list[tuple[int, float, float]]:
    """Per grid the largest int_0^inf |z|^2 from |x0| = 1, for z = N_y(0) and for z = (int v_y, int k).

    <x0, P x0> has to be at least 1 / gamma of it: where it grows with the grid no bounded P is large enough.
    """
    out = []
    for number in cells:
        arm = chapter_grid("1", number)
        A = arm.A + on_grid(arm, energy) @ arm.outputs
        values = []
        for C in (arm.root[None], arm.C1):
            X = linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
            values.append(float(np.linalg.eigvalsh(0.5 * (X + X.T))[-1]))
        out.append((number, values[0], values[1]))
    return out
