"""The arm's inequality in moments: identities, coordinates, and the form against its definition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import legendre as plain
from pi_reference import distance, size_of, values

from design.arm_pie import arm_pie
from design.gain_problem import Role, controller_problem, observer_problem
from design.hinf import HinfProblem, _Signals
from design.moment_lpi import MARGIN, MomentProgram
from design.moments import PARITY, Moments, dual, functionals, make_moments
from design.operators import PIOperator

Array = npt.NDArray[np.float64]
ALPHA, DRAG, TAU, WEIGHT = 80.0, 0.7, 0.02, 0.3
J = PIOperator.multiplier(np.diag([1.0, 1.0, -1.0, -1.0])[:, :, None])
V = PIOperator.multiplier(np.diag([1.0, 1.0, 0.0, 0.0])[:, :, None])
NODES, WEIGHTS = plain.leggauss(40)
S, DS = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS


@dataclass(frozen=True)
class Case:
    role: Role
    options: str = ""
    """A sensor set for an observer, the actuator for a controller."""
    tau: float = 0.0

    def problem(self) -> HinfProblem:
        """An arm whose frame is no frame: the identities hold for any pair of polynomials."""
        rng = np.random.default_rng(1)
        pie = arm_pie(rng.normal(size=4), rng.normal(size=4), ALPHA, DRAG, self.tau)
        if self.role == "observer":
            return observer_problem(pie, WEIGHT, self.options.split() or ["v_y", "k"])
        return controller_problem(pie, WEIGHT, self.options or "transverse")


PLAIN = [
    Case("observer"),
    Case("controller"),
    Case("observer", tau=TAU),
    Case("controller", tau=TAU),
]
CASES = [*PLAIN, Case("observer", "k"), Case("controller", "normal")]


@pytest.fixture(params=PLAIN, ids=str)
def problem(request: pytest.FixtureRequest) -> HinfProblem:
    return cast(Case, request.param).problem()


# The identities, by composition of PI operators: their parameters are unique


def test_virtual_work_turns_strains_into_dissipation(problem: HinfProblem) -> None:
    """2 <x, S x_t> = 2 |v|^2 - 2 |s|^2 for x = T f, x_t = A f."""
    S_ = make_moments(problem, 1).S
    power = problem.T.adjoint @ S_ @ problem.A
    expected = problem.T.adjoint @ J @ problem.T * 2.0
    assert distance(power + power.adjoint, expected) <= 1e-13 * size_of(problem.T)
    assert distance(S_, S_.adjoint) == 0.0


def test_adjoint_of_the_dynamics_is_similar_to_them(problem: HinfProblem) -> None:
    """A* J A^-1 = J, in fundamental states: <A f, J K x> = <T f, J x>."""
    left = problem.A.adjoint @ J @ problem.krylov
    assert distance(left, problem.T.adjoint @ J) <= 1e-13 * size_of(problem.T)


def test_energy_falls_at_least_by_drag(problem: HinfProblem) -> None:
    power = problem.T.adjoint @ (problem.A + V @ problem.T * problem.drag)
    matrix = power.discretise(12)
    assert np.linalg.eigvalsh(matrix + matrix.T)[-1] <= 1e-12


def test_moments_of_h_differentiate_to_moments_of_polynomials(problem: HinfProblem) -> None:
    phi = np.random.default_rng(2).normal(size=(3, 4, 5))
    left = functionals(dual(phi, problem.krylov)) @ problem.A
    assert distance(left, functionals(phi) @ problem.T) <= 1e-13 * size_of(problem.T)
    mo = make_moments(problem, 2)
    h = functionals(mo.functions(mo.size[:, None] * mo.h)) @ problem.A
    rates = functionals(mo.functions(mo.rates)) @ problem.T
    assert distance(h, rates) <= 1e-12 * size_of(problem.T)
    np.testing.assert_allclose(mo.h @ mo.h.T, np.eye(len(mo.h)), atol=1e-10)
    assert 1 < len(mo.h) <= 8


def test_bound_of_s(problem: HinfProblem) -> None:
    """On twice as many polynomials S does not exceed eta, and eta is no more than it must be."""
    mo = make_moments(problem, 1)
    largest = np.abs(np.linalg.eigvalsh(mo.S.discretise(64))).max()
    assert largest <= mo.eta <= 1.05 * largest


def test_no_moments() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        make_moments(PLAIN[0].problem(), 0)


# Coordinates


def sampled(coefficients: Array) -> Array:
    """Vectors of polynomials (..., d) on the Gauss nodes (..., k)."""
    return np.asarray(coefficients @ values(S, coefficients.shape[-1]).T)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_coordinates_are_moments(case: Case) -> None:
    """Of a random x: the numbers in rows are the integrals that they stand for."""
    problem = case.problem()
    mo = make_moments(problem, 2)
    x = np.random.default_rng(3).normal(size=(4, 9))
    on_nodes = sampled(x)
    basis = mo.functions(np.eye(len(mo.state)))
    moments = np.einsum("ink,nk,k->i", sampled(basis), on_nodes, DS)
    gram = np.einsum("ink,jnk,k->ij", sampled(basis), sampled(basis), DS)
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-10)
    for i, row in enumerate(basis):
        assert not np.delete(row, int(mo.state[i]), axis=0).any()
    np.testing.assert_allclose(mo.C1 @ moments, problem.C1.discretise(9) @ x.ravel(), atol=1e-9)
    np.testing.assert_allclose(
        mo.B @ moments, problem.B.adjoint.discretise(9) @ x.ravel(), atol=1e-9
    )
    SB = (mo.S @ problem.B).adjoint.discretise(9)
    np.testing.assert_allclose(mo.SB @ moments, SB @ x.ravel(), atol=1e-9)
    y = (problem.C2.discretise(9, 20) @ x.ravel()).reshape(-1, 20)
    seen = mo.output_functions(np.eye(len(mo.output)))
    expected = np.einsum("rok,ok,k->r", sampled(seen), sampled(y), DS)
    np.testing.assert_allclose(mo.outputs @ moments, expected, atol=1e-9)


# The whole form


def random_program(problem: HinfProblem, moments: Moments) -> MomentProgram:
    """All variables at random, but W such that p I + W is just positive semidefinite."""
    rng = np.random.default_rng(4)
    program = MomentProgram(problem, moments)
    k = len(moments.size)
    W = rng.normal(size=(k, k))
    W = W + W.T
    D = np.diag(moments.size)
    program.gamma.value, program.delta.value = 0.6, 0.3
    program.p.value = -np.linalg.eigvalsh(D @ W @ D)[0]
    program.positive.value, program.negative.value = 0.4, 0.1
    program.W.value = W
    program.multipliers.value = -rng.uniform(0.5, 2.0, size=program.multipliers.shape)
    program.zeta.value = rng.normal(size=program.zeta.shape)
    return program


@pytest.mark.parametrize("case", CASES, ids=str)
def test_matrix_and_rest_are_the_form_of_the_inequality(case: Case) -> None:
    """On random f, w, z and noise, whose moments leave a rest; Kelvin-Voigt damping takes away some more."""
    problem = case.problem()
    mo = make_moments(problem, 1)
    program = random_program(problem, mo)
    P, Z = program.operators()
    gamma = float(program.gamma.value)
    s = _Signals(problem)
    half = s.x.adjoint @ (P @ s.x_t + Z @ s.y) + s.z.adjoint @ s.c1
    half = half - (s.channels.adjoint @ s.channels) * (0.5 * gamma)
    rng = np.random.default_rng(5)
    n = 6
    z, w = rng.normal(size=len(mo.C1)), rng.normal(size=len(mo.B))
    f, noise = rng.normal(size=(4, n)), rng.normal(size=(problem.C2.shape_out.functions, n))
    everything = np.concatenate([z, w, f.ravel(), noise.ravel()])
    definition = 2.0 * everything @ half.discretise(n) @ everything

    x = sampled((problem.T.discretise(n, 24) @ f.ravel()).reshape(4, 24))
    y = (problem.C2 @ problem.T).discretise(n, 30) @ f.ravel()
    on_nodes = sampled(y.reshape(len(noise), 30)), sampled(noise)
    basis, seen = (
        sampled(g)
        for g in (mo.functions(np.eye(len(mo.state))), mo.output_functions(np.eye(len(mo.output))))
    )
    of_x = np.einsum("ink,nk,k->i", basis, x, DS)
    of_y, of_noise = (np.einsum("rok,ok,k->r", seen, u, DS) for u in on_nodes)
    vector = np.concatenate([z, w, of_x, of_noise])
    found = -vector @ program.matrices[0].value @ vector - MARGIN * of_x @ of_x
    rest = x - np.einsum("i,ink->nk", of_x, basis)
    q = program._q()
    for state, parity in enumerate(PARITY):
        multiplier = float(program._rest(q, parity).value)
        found += multiplier * float(rest[state] ** 2 @ DS)
    remains = [
        u - np.einsum("r,rok->ok", m, seen) for u, m in zip(on_nodes, (of_y, of_noise), strict=True)
    ]
    for output, matrix in enumerate(program.matrices[2:]):
        pair = np.stack([r[output] for r in remains])
        found -= float(np.sum(matrix.value * (pair * DS @ pair.T)))
    assert max(float(r**2 @ DS) for r in remains[1]) > 1e-3  # the noise has a rest
    found -= 2.0 * case.tau * float(q.value) * float(np.sum(f[:2] ** 2))
    assert found == pytest.approx(definition, rel=1e-9)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_p_is_at_least_delta(case: Case) -> None:
    problem = case.problem()
    program = random_program(problem, make_moments(problem, 2))
    assert np.linalg.eigvalsh(program.matrices[1].value)[0] == pytest.approx(0.0, abs=1e-9)
    P, Z = program.operators()
    matrix = P.discretise(24)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-11 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[0] >= 0.3 - 1e-9
    assert Z.shape_in == problem.C2.shape_out
