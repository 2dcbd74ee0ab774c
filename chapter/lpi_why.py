"""Why (18) has no solution for the chapter's own states and outputs: explicit functions f and numbers.

Four reasons, each enough by itself, each for EVERY bounded P and Z:
(a) T is compact: along Legendre functions, which go weakly to zero, the form goes to zero, not below -eps;
(b) P coercive on (w, w_t) would have to be larger than any bound on the high modes of the beam;
(c) C1 of (22), the mean of f, is not bounded by |T f|: along f that gather at the root the form tends to
    2 <z, 1> - gamma |z|^2, whose supremum is 1 / gamma;
(d) at a curved setpoint waves grow at rates without bound, so that nothing at all can be certified.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.optimize import brentq

from chapter.lpi_own import UNIT, OwnPIE
from chapter.pde import Form, Setpoint, matrices
from design import legendre
from design.operators import PIOperator

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Along:
    """Values along one sequence f_n; nondimensional."""

    n: tuple[int, ...]
    state: tuple[float, ...]
    """|T f_n|."""
    form: tuple[float, ...]
    """2 <T f_n, (P A + Z C2) f_n>."""
    bound: tuple[float, ...]
    """2 |T f_n| (|A f_n| + |C2 f_n|): times the larger of |P| and |Z| it bounds the form, for all P and Z."""
    mean: tuple[float, ...]
    """|C1 f_n|."""


def along(pie: OwnPIE, P: PIOperator, Z: PIOperator, numbers: tuple[int, ...], f: Array) -> Along:
    """The values of `Along` for functions f (numbers, states, d) in the orthonormal basis."""
    size = f.shape[2]
    out = size + 16
    flat = f.reshape(len(f), -1)
    x = flat @ pie.T.discretise(size, out).T
    rate, y = flat @ pie.A.discretise(size, out).T, flat @ pie.C2.discretise(size).T
    weighted = rate @ P.discretise(out).T + y @ Z.discretise(1, out).T
    state, sizes, outputs, mean = (
        np.linalg.norm(a, axis=1) for a in (x, rate, y, flat @ pie.C1.discretise(size).T)
    )
    values = (
        state, 2.0 * np.sum(x * weighted, axis=1), 2.0 * state * (sizes + outputs), mean,
    )  # fmt: skip
    return Along(numbers, *(tuple(map(float, v)) for v in values))


def legendre_sequence(states: int, numbers: tuple[int, ...]) -> Array:
    """f_n = phi_n in every state, of norm one: orthonormal, so weakly null. Shape (numbers, states, d)."""
    out = np.zeros((len(numbers), states, max(numbers) + 1))
    for row, n in enumerate(numbers):
        out[row, :, n] = 1.0 / np.sqrt(states)
    return out


def root_sequence(states: int, numbers: tuple[int, ...], state: int) -> Array:
    """f_n = (n + 1) (1 - s)^n in one state: mean one, gathers at the root. Shape (numbers, states, d)."""
    size = max(numbers) + 1
    nodes, _ = legendre.gauss(size)
    out = np.zeros((len(numbers), states, size))
    for row, n in enumerate(numbers):
        out[row, state] = legendre.fit((n + 1.0) * (1.0 - nodes) ** n)
    return out


def beam_roots(count: int) -> Array:
    """beta_k of the clamped-free beam, cos b cosh b = -1; frequencies are beta^2."""
    return np.array(
        [brentq(_characteristic, (k + 0.5) * np.pi - 1.0, (k + 0.5) * np.pi + 1.0) for k in range(count)]
    )  # fmt: skip


def _characteristic(beta: float) -> float:
    return float(np.cos(beta) + 1.0 / np.cosh(beta))


def beam_mode(beta: float, s: Array) -> Array:
    """phi of norm one, clamped at 0 and free at 1; phi'''' = beta^4 phi.

    Written with decaying exponentials, so that nothing large cancels.
    """
    sigma = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))
    growing = 0.5 * (1.0 - sigma) * np.exp(beta * s) + 0.5 * (1.0 + sigma) * np.exp(-beta * s)
    return np.asarray(growing - np.cos(beta * s) + sigma * np.sin(beta * s))


def least_condition(modes: int, outputs: str = "both") -> float:
    """Smallest cond(P) for which the form is <= 0 on the first modes of the straight beam, with any Z.

    States (a_k, b_k) of w and w_t; outputs: y of (22) (tip and mean of f, of w and of w_t) or "none".
    P between I and c I; c is minimised by a semidefinite program in numbers, no operators.
    """
    beta = beam_roots(modes)
    omega2 = beta**4
    zero, eye = np.zeros((modes, modes)), np.eye(modes)
    A = np.block([[zero, eye], [-np.diag(omega2), zero]])
    third, tip = _ends(beta)
    rows = [np.concatenate([r, 0 * r]) for r in (tip, third)]
    rows += [np.concatenate([0 * r, r]) for r in (tip, third)]
    C = np.array(rows)
    C = C / np.linalg.norm(C, axis=1)[:, None]
    P = cp.Variable((2 * modes, 2 * modes), symmetric=True)
    c, Z = cp.Variable(), cp.Variable((2 * modes, len(C)))
    half = P @ A + (Z @ C if outputs == "both" else 0.0)
    identity = np.eye(2 * modes)
    # scaled by the frequencies: the inequality's own size
    scale = np.diag(np.concatenate([1.0 / beta**2, np.ones(modes)]))
    form = scale @ (half + half.T) @ scale
    program = cp.Problem(
        cp.Minimize(c), [P >> identity, P << c * identity, 0.5 * (form + form.T) << 0]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        program.solve(solver="CLARABEL", max_threads=1)
    return float(c.value)


def _ends(beta: Array) -> tuple[Array, Array]:
    """phi'''(0), minus the mean of phi'''', and phi(1) of the modes."""
    sigma = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))
    third = beta**3 * (-2.0 * sigma)
    tip = np.array([float(beam_mode(b, np.array([1.0]))[0]) for b in beta])
    return third, tip


@dataclass(frozen=True)
class Packet:
    """One growing wave packet at a curved setpoint, see `packet`."""

    wave_number: float
    growth: float
    """Re sigma of the local symbol, per unit of time."""
    form: float
    """2 Re <x, x_t> / |x|^2, the form of P = I."""
    residual: float
    """|x_t - sigma x| / (|sigma| |x|): for P between 1 and M the form is positive once this is below 1 / M."""
    outputs: float
    """Largest of the outputs (22) over |x|: zero but for rounding, whatever Z is."""


def packet(
    setpoint: Setpoint, form: Form, wave_number: float, place: float = 0.5, states: int = 4
) -> Packet:
    """x = r exp(-(s - place)^2 / (2 width^2) + i k s), r and sigma an eigenpair of sum_j A_j(place) (i k)^j.

    width ~ k^-1/2: narrow beside the arm, wide beside the wave. x and its derivatives vanish at both ends to
    rounding, so f = d_s^4 x meets the boundary conditions and the outputs (22) are zero: no Z helps.
    """
    A = matrices(setpoint, UNIT, form)
    local = np.array([[[p(place) for p in row] for row in matrix] for matrix in A])
    symbol = np.einsum("jab,j->ab", local, (1j * wave_number) ** np.arange(5))
    values, vectors = np.linalg.eig(symbol)
    best = int(np.argmax(values.real))
    sigma, r = complex(values[best]), vectors[:, best]
    width = 0.3 / np.sqrt(wave_number)
    s = np.linspace(0.0, 1.0, int(max(4000.0, 40.0 * wave_number)))
    from_place = s - place
    envelope = np.exp(-0.5 * (from_place / width) ** 2 + 1j * wave_number * s)
    slope = Polynomial([1j * wave_number, -1.0 / width**2])
    factor, derivatives = Polynomial([1.0 + 0.0j]), []
    for _ in range(5):
        derivatives.append(factor(from_place) * envelope)
        factor = factor.deriv() + slope * factor
    rate = np.zeros((states, s.size), dtype=np.complex128)
    for matrix, derivative in zip(A, derivatives, strict=True):
        for a, row in enumerate(matrix):
            for b, entry in enumerate(row):
                rate[a] += entry(s) * r[b] * derivative
    x = r[:, None] * derivatives[0]
    norm = float(np.linalg.norm(x))
    return Packet(
        wave_number,
        sigma.real,
        float(2.0 * np.vdot(x, rate).real) / norm**2,
        float(np.linalg.norm(rate - sigma * x)) / (abs(sigma) * norm),
        float(max(abs(derivatives[0][-1]), *(abs(d[0] - d[-1]) for d in derivatives[:4]))),
    )


def leading_eigenvalue(slope: float) -> float:
    """Positive eigenvalue of [[0, c], [c, -1]]: waves of wave number k grow at its square root times k^2."""
    return float(0.5 * (np.sqrt(1.0 + 4.0 * slope**2) - 1.0))
