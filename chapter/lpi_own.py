"""(18) and (22) letter by letter: the chapter's states (u, u_t, w, w_t) in L2, fundamental state f = d_s^4 x.

A = sum_j A_j(s) D_j with x = T f = D_0 f, boundary conditions as printed (clamped, and second and third
derivative zero at the tip, for all four states); nondimensional (`UNIT`). Here a semidefinite solver is asked;
why no (P, Z) exists says `chapter.lpi_why`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from scipy import linalg

from chapter.constants import Constants
from chapter.lpi_solve import PATIENCE_S
from chapter.pde import Form, Setpoint, matrices
from design import legendre
from design.operators import PIOperator, Shape, vertical
from design.quadratic import FormTable, coefficient_matrix, forms, lifted, unit_rows
from design.semidefinite import ACCEPTED, orthonormal_equalities

Array = npt.NDArray[np.float64]
Right = Literal["-eps I", "-eps T*T", "0"]
"""Right side of (18)."""
RIGHTS: tuple[Right, ...] = ("-eps I", "-eps T*T", "0")

UNIT = Constants("nondimensional", 6400.0, 1.0, 1.0)
"""Length L, time L^2 sqrt(rho A / EI): EA L^2 / EI = 6400."""
BEAM = (2, 3)
"""States of the straight arm's bending alone: w, w_t."""


@dataclass(frozen=True)
class OwnPIE:
    """T f_t = A f + B w, z = C1 f, y = C2 f on n functions; all as (8), (10) and (22) say, D_ij = 0."""

    T: PIOperator
    A: PIOperator
    B: PIOperator
    C1: PIOperator
    C2: PIOperator

    @property
    def states(self) -> int:
        """Number of functions."""
        return self.T.shape_out.functions


def derivatives(states: int) -> list[PIOperator]:
    """D_j: f = d_s^4 x -> d_s^j x, j = 0..4, for x(0) = x'(0) = x''(1) = x'''(1) = 0."""
    one = PIOperator.identity(Shape(0, 1))
    up = PIOperator.zeros(Shape(0, 1), Shape(0, 1)).replace(r1=np.ones((1, 1, 1, 1)))
    down = up.replace(r1=np.zeros((1, 1, 1, 1)), r2=np.ones((1, 1, 1, 1)))
    third = down * -1.0
    second = down @ down
    scalar = [up @ (up @ second), up @ second, second, third, one]
    return [_everywhere(d, states) for d in scalar]


def own_pie(
    setpoint: Setpoint,
    form: Form,
    constants: Constants = UNIT,
    states: tuple[int, ...] = (0, 1, 2, 3),
) -> OwnPIE:
    """The chapter's PIE at a setpoint; `states` picks some of (u, u_t, w, w_t) that do not need the others.

    "printed": the matrices (5) and H_1 of (10) as printed, with -L_j where d_s^j T f has +L_j.
    """
    picked = np.ix_(states, states)
    D = derivatives(len(states))
    A = PIOperator.zeros(Shape(0, len(states)), Shape(0, len(states)))
    volterra = lower_kernels(len(states))
    for j, (matrix, d) in enumerate(zip(matrices(setpoint, constants, form), D, strict=True)):
        if form == "printed" and j < 4:
            d = d - 2.0 * volterra[j]  # noqa: PLW2901
        degree = max(p.coef.size for row in matrix for p in row)
        nodes, _ = legendre.gauss(degree)
        values = np.array([[p(nodes) for p in row] for row in matrix])[picked]
        A = A + PIOperator.multiplier(legendre.fit(values)) @ d
    load = np.zeros((4, 1, 1))
    load[3] = 1.0 / constants.mass_kg_m
    n = len(states)
    mean = PIOperator.zeros(Shape(n, 0), Shape(0, n)).replace(q1=np.eye(n)[:, :, None])
    kernel = D[0].r1  # G_1(s, theta) at s = 1
    at_tip = np.sqrt(2.0 * np.arange(kernel.shape[2]) + 1.0)
    tip = mean.replace(q1=np.einsum("i,nmij->nmj", at_tip, kernel))
    return OwnPIE(
        T=D[0],
        A=A.trimmed(),
        B=PIOperator.zeros(Shape(0, n), Shape(1, 0)).replace(q2=load[list(states)]),
        C1=mean,
        C2=vertical(tip, mean),
    )


def lower_kernels(states: int) -> list[PIOperator]:
    """f -> int_0^s L_j(s, t) f(t) dt, L_j = (s - t)^(3 - j) / (3 - j)!, j = 0..3."""
    up = PIOperator.zeros(Shape(0, 1), Shape(0, 1)).replace(r1=np.ones((1, 1, 1, 1)))
    powers = [up]
    for _ in range(3):
        powers.append(up @ powers[-1])
    return [_everywhere(p, states) for p in reversed(powers)]


def _everywhere(scalar: PIOperator, states: int) -> PIOperator:
    """The same operator on every state."""
    eye = np.eye(states)
    zero = PIOperator.zeros(Shape(0, states), Shape(0, states))
    return zero.replace(
        r0=np.einsum("qn,abi->qni", eye, scalar.r0),
        r1=np.einsum("qn,abij->qnij", eye, scalar.r1),
        r2=np.einsum("qn,abij->qnij", eye, scalar.r2),
    )


@dataclass(frozen=True)
class Tried:
    """What the solver said, and what its P and Z are worth.

    residual: largest coefficient of the equality that is left over. eigenvalue: largest one of the form of (18)
    with the asked right side, on Legendre functions, relative to |f|^2 + |z|^2 + |w|^2: positive is violated.
    on_state: the same relative to |T f|^2: what an energy estimate would need.
    """

    right: Right
    degree: int
    tolerance: float
    """Allowed norm of the residual; 0: equality."""
    status: str
    gamma: float
    residual: float
    eigenvalue: float
    on_state: float
    largest_p: float
    largest_z: float
    gram: int
    equalities: int


class OwnProgram:
    """P = I + Phi* G Phi and Z polynomial, minus the form of (18) = Psi* Q Psi, monomial-like bases.

    Phi: multipliers and kernels of total degree at most `degree` of each state; Psi the same of degree
    `degree` + `extra` of each fundamental state ("generic", the choice of toolboxes) or of x = T f ("state":
    the face on which every solution lies, as T has no multiplier; theory, 3), and the channels.
    """

    def __init__(
        self,
        pie: OwnPIE,
        degree: int,
        extra: int = 3,
        rows: Literal["generic", "state"] = "generic",
    ) -> None:
        self.pie, self.degree = pie, degree
        n, nz, nw = pie.states, pie.C1.shape_out.finite, 1
        eye = PIOperator.identity(Shape(nz + nw, n))
        f = eye.rows([], range(n))
        self.z, self.w = (lifted(eye.rows(r, [])) for r in (range(nz), range(nz, nz + nw)))
        self.state = pie.T @ f
        self.rate = pie.A @ f - pie.B @ eye.rows(range(nz, nz + nw), [])
        self.fundamental = f
        self.y = lifted(pie.C2 @ f)
        self.z_of_f = lifted(pie.C1 @ f)
        self.phi = generic_rows(n, degree)
        self.columns = PIOperator.multiplier(_powers(n, degree))
        psi = generic_rows(n, degree + extra)
        self.psi = unit_rows(
            vertical(psi @ (f if rows == "generic" else self.state), self.z, self.w)
        )
        self.sizes = (self.phi.shape_out.functions, self.psi.shape_out.functions)
        self.matrix = self._matrix()

    def _matrix(self) -> dict[str, Array]:
        """Coefficient columns by variable; all rows of the equality in the same order."""
        tables: dict[str, FormTable] = {
            "G": forms(self.phi @ self.state, self.phi @ self.rate).symmetric().upper(0.5),
            "I": forms(self.state, self.rate).trace(),
            "Z": forms(self.columns @ self.state, self.y),
            "C": forms(self.z, self.z_of_f).trace(),
            "gamma": _sum([forms(self.z, self.z).trace(), forms(self.w, self.w).trace()], -0.5),
            "-eps I": _sum([forms(a, a).trace() for a in (self.z, self.w, self.fundamental)], 0.5),
            "-eps T*T": forms(self.state, self.state).trace() * 0.5,
            "Q": forms(self.psi, self.psi).upper(0.5),
        }
        stacked = coefficient_matrix(list(tables.values()))
        out, start = {}, 0
        for name, table in tables.items():
            out[name] = stacked[:, start : start + table.count]
            start += table.count
        return out

    def solve(self, right: Right, epsilon: float, tolerance: float = 0.0) -> Tried:
        """Smallest gamma. Never raises for the solver's failure."""
        m, (k, q) = self.matrix, self.sizes
        G, Q = cp.Variable((k, k), PSD=True), cp.Variable((q, q), PSD=True)
        zeta = cp.Variable(m["Z"].shape[1])
        gamma = cp.Variable(nonneg=True)
        constant = m["I"] + m["C"] + (epsilon * m[right] if right != "0" else 0.0)
        table = np.hstack([constant, m["gamma"], m["Z"], m["G"], m["Q"]])
        unknown = cp.hstack([1.0, gamma, zeta, _upper(G), _upper(Q)])
        rest = table @ unknown
        if tolerance == 0.0:
            constraints = [orthonormal_equalities(table) @ unknown == 0.0]
        else:
            constraints = [cp.norm(rest) <= tolerance]
        program = cp.Problem(cp.Minimize(gamma), constraints)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                program.solve(solver="CLARABEL", max_threads=1, time_limit=PATIENCE_S)
                status = str(program.status)
            except cp.error.SolverError:
                status = "solver_error"
        nothing = Tried(
            right, self.degree, tolerance, status, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan,
            q, m["Q"].shape[0],
        )  # fmt: skip
        if status not in ACCEPTED:
            return nothing
        g = np.asarray(G.value)
        P = PIOperator.identity(Shape(0, self.pie.states))
        P = P + self.phi.adjoint @ PIOperator.multiplier(g[:, :, None]) @ self.phi
        Z = _z_operator(self.columns, np.asarray(zeta.value), self.pie.C2.shape_out.finite)
        f_norm, x_norm = self._eigenvalues(P, Z, float(gamma.value), right, epsilon)
        return Tried(
            right, self.degree, tolerance, status, float(gamma.value),
            float(np.abs(rest.value).max()), f_norm, x_norm,
            float(np.linalg.eigvalsh(P.discretise(16))[-1]), float(np.linalg.norm(Z.q2)),
            q, m["Q"].shape[0],
        )  # fmt: skip

    def _eigenvalues(
        self, P: PIOperator, Z: PIOperator, gamma: float, right: Right, epsilon: float
    ) -> tuple[float, float]:
        form, weight_f, weight_x = own_form(self.pie, P, Z, gamma)
        if right != "0":
            form = form + epsilon * (weight_f if right == "-eps I" else _state_only(weight_x, self))
        return (
            float(linalg.eigvalsh(form, weight_f)[-1]),
            float(linalg.eigvalsh(form, weight_x)[-1]),
        )


def own_form(
    pie: OwnPIE, P: PIOperator, Z: PIOperator, gamma: float, size: int = 12
) -> tuple[Array, Array, Array]:
    """Matrix of (18) on (z, w, Legendre functions f), and the norms |z|^2 + |w|^2 + |f|^2 and … + |T f|^2."""
    out = size + 16
    T, A = pie.T.discretise(size, out), pie.A.discretise(size, out)
    half = T.T @ (P.discretise(out) @ A + Z.discretise(1, out) @ pie.C2.discretise(size))
    w = -T.T @ (P.discretise(out) @ pie.B.discretise(1, out))
    columns = np.hstack([pie.C1.discretise(size).T, w])
    k = columns.shape[1]
    form = np.block([[-gamma * np.eye(k), columns.T], [columns, half + half.T]])
    return form, np.eye(len(form)), linalg.block_diag(np.eye(k), T.T @ T)


def _state_only(weight: Array, program: OwnProgram) -> Array:
    out = weight.copy()
    k = program.z.shape_out.functions + 1
    out[:k, :k] = 0.0
    return out


def generic_rows(states: int, degree: int) -> PIOperator:
    """phi_a x_i, phi_a int_0^s phi_b x_i and phi_a int_s^1 phi_b x_i with a + b <= degree."""
    rows = [PIOperator.multiplier(_powers(states, degree))]
    pairs = [(a, b) for a in range(degree + 1) for b in range(degree + 1 - a)]
    kernel = np.zeros((states * len(pairs), states, degree + 1, degree + 1))
    for number, (a, b) in enumerate(pairs):
        for i in range(states):
            kernel[number * states + i, i, a, b] = 1.0
    zero = PIOperator.zeros(Shape(0, len(kernel)), Shape(0, states))
    return vertical(*rows, zero.replace(r1=kernel), zero.replace(r2=kernel))


def _powers(states: int, degree: int) -> Array:
    """phi_a x_i for all i and a: (states (degree + 1), states, degree + 1)."""
    eye = np.einsum("in,ad->iand", np.eye(states), np.eye(degree + 1))
    return np.asarray(eye.reshape(-1, states, degree + 1))


def _z_operator(columns: PIOperator, zeta: Array, outputs: int) -> PIOperator:
    coefficients = np.einsum("ro,rnd->nod", zeta.reshape(-1, outputs), columns.r0)
    zero = PIOperator.zeros(Shape(0, columns.shape_in.functions), Shape(outputs, 0))
    return zero.replace(q2=coefficients)


def _upper(matrix: cp.Variable) -> cp.Expression:
    i, j = np.triu_indices(matrix.shape[0])
    return matrix[i, j]


def _sum(tables: list[FormTable], factor: float) -> FormTable:
    total = tables[0]
    for table in tables[1:]:
        total = total + table
    return total * factor
