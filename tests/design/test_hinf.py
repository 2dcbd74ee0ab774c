"""The H-infinity LPI on the straight arm, judged by beam modes and by the form's definition."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import pytest
from beam_modes import Beam, beam, controller_optimum, norm, observer_optimum, shapes
from pi_reference import finite_part, function_part, inner, polynomial, values

from design.arm_pie import arm_pie
from design.factors import factorise
from design.gain_problem import Role, controller_problem, observer_problem
from design.hinf import (
    LPI_TOLERANCE,
    HinfProblem,
    HinfResult,
    lpi_eigenvalue,
)
from design.inverse import solve_gain
from design.moment_lpi import solve_hinf
from design.operators import PIOperator

Array = npt.NDArray[np.float64]
ALPHA, DRAG, WEIGHT, MODES = 80.0, 0.7, 0.1, 10
NOTHING = np.zeros(0)


def problem(role: Role, drag: float = DRAG, weight: float = WEIGHT) -> HinfProblem:
    pie = arm_pie(np.ones(1), np.zeros(1), ALPHA, drag)
    return (observer_problem if role == "observer" else controller_problem)(pie, weight)


@dataclass(frozen=True)
class Design:
    role: Role
    problem: HinfProblem
    result: HinfResult
    gain: PIOperator
    """P^-1 Z: the observer's L, or the adjoint of the controller's K."""

    @cached_property
    def modal_gain(self) -> Array:
        """The gain between the beam's modes, (2 MODES, 2 MODES) or (2 MODES, MODES)."""
        size = 50
        x, w = np.polynomial.legendre.leggauss(200)
        s, w = 0.5 * (x + 1.0), 0.5 * w
        basis = values(s, size) * w[:, None]
        pairs = [shapes(j, s) for j in range(MODES)]
        velocity = basis.T @ np.array([v for v, _ in pairs]).T
        curvature = basis.T @ np.array([k for _, k in pairs]).T
        matrix = self.gain.discretise(size).reshape(4, size, -1, size)
        rows = [(1, velocity), (3, curvature)]
        columns = [velocity, curvature] if self.role == "observer" else [velocity]
        blocks = [[p.T @ matrix[i, :, j] @ q for j, q in enumerate(columns)] for i, p in rows]
        return np.block(blocks)

    def closed_loop(self, sign: float = 1.0) -> tuple[Array, Array, Array]:
        """A, B, C of the observer's error or of the controlled arm, in beam modes."""
        model = beam(MODES, DRAG)
        if self.role == "observer":
            L = sign * self.modal_gain
            return model.A + L, np.hstack([-model.B, -WEIGHT * L]), model.C
        K = sign * self.modal_gain.T
        force = np.vstack([np.eye(MODES), np.zeros((MODES, MODES))])
        return model.A + force @ K, model.B, np.vstack([model.C, WEIGHT * K])

    @cached_property
    def achieved(self) -> float:
        return norm(*self.closed_loop())

    @cached_property
    def optimum(self) -> float:
        model: Beam = beam(MODES, DRAG)
        return (observer_optimum if self.role == "observer" else controller_optimum)(model, WEIGHT)


@pytest.fixture(scope="module", params=["observer", "controller"])
def design(request: pytest.FixtureRequest) -> Design:
    role: Role = request.param
    lpi = problem(role)
    result = solve_hinf(lpi, counts=(2,))
    factors, _ = factorise(solve_gain(result.P, result.Z), 1e-12)
    return Design(role, lpi, result, factors.operator())


def test_certified_near_the_optimum(design: Design) -> None:
    result = design.result
    assert result.outcome == "certified"
    assert result.solution.status == "optimal"
    assert design.optimum == pytest.approx(0.0784, abs=3e-4)
    assert design.optimum < result.gamma < 1.12 * design.optimum


def test_closed_loop_in_beam_modes(design: Design) -> None:
    A, _, _ = design.closed_loop()
    model = beam(MODES, DRAG)
    open_loop = norm(model.A, model.B, model.C)
    assert open_loop == pytest.approx(1.24, abs=1e-2)
    assert np.linalg.eigvals(A).real.max() < -0.05
    assert design.optimum <= design.achieved <= design.result.gamma
    assert design.achieved < 1.1 * design.optimum


def test_bound_with_the_gain_put_in(design: Design) -> None:
    result = design.result
    assert lpi_eigenvalue(design.problem, result.P, design.gain, result.gamma) <= LPI_TOLERANCE


def test_no_bound_below_the_achieved_norm(design: Design) -> None:
    """The same inequality with a gamma that is impossible for this gain: the check must fail."""
    P = design.result.P
    wrong = lpi_eigenvalue(design.problem, P, design.gain, 0.6 * design.achieved)
    assert wrong > 1e3 * LPI_TOLERANCE


def test_gain_of_the_wrong_sign_is_noticed(design: Design) -> None:
    P, gamma = design.result.P, design.result.gamma
    assert lpi_eigenvalue(design.problem, P, -design.gain, gamma) > 1.0
    A, _, _ = design.closed_loop(sign=-1.0)
    assert np.linalg.eigvals(A).real.max() > 0.0


def test_gain_of_zero_is_noticed(design: Design) -> None:
    P, gamma = design.result.P, design.result.gamma
    assert lpi_eigenvalue(design.problem, P, design.gain * 0.0, gamma) > 1e3 * LPI_TOLERANCE


def test_lyapunov_operator_is_coercive_and_self_adjoint(design: Design) -> None:
    matrix = design.result.P.discretise(24)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    assert design.result.delta > 0.05
    assert np.linalg.eigvalsh(matrix)[0] >= design.result.delta * (1.0 - 1e-4)


def test_gain_belongs_to_p_and_z(design: Design) -> None:
    left = (design.result.P @ design.gain).discretise(16)
    right = design.result.Z.discretise(16)
    np.testing.assert_allclose(left, right, atol=1e-7 * np.abs(right).max())


def form(design: Design, gamma: float, draw: np.random.Generator) -> tuple[float, float]:
    """The LPI's left side and |x|^2 + |z|^2 + |w|^2 + |w_y|^2, from the operators' definitions."""
    lpi, P, L = design.problem, design.result.P, design.gain
    nz, nw = lpi.C1.shape_out.finite, lpi.B.shape_in.finite
    f = polynomial(draw.normal(size=(4, 5)))
    noise = polynomial(draw.normal(size=(lpi.C2.shape_out.functions, 4)) * 0.3)
    z, w = draw.normal(size=nz), draw.normal(size=nw)
    x = function_part(lpi.T, NOTHING, f)
    drive = function_part(lpi.B, w, polynomial(np.zeros((0, 1))))
    open_loop = function_part(lpi.A, NOTHING, f)
    sensed = function_part(lpi.C2, NOTHING, x)

    def innovation(s: Array) -> Array:
        return sensed(s) - lpi.rho * noise(s)

    fed_back = function_part(L, NOTHING, innovation)

    def rate(s: Array) -> Array:
        return open_loop(s) - drive(s) + fed_back(s)

    # P is self-adjoint: <x, P rate> = <P x, rate> needs the costly kernels once only
    power = inner(NOTHING, function_part(P, NOTHING, x), NOTHING, rate)
    channels = float(z @ z + w @ w) + inner(NOTHING, noise, NOTHING, noise)
    supply = float(z @ finite_part(lpi.C1, NOTHING, x))
    size = inner(NOTHING, x, NOTHING, x) + channels
    return 2.0 * power + 2.0 * supply - gamma * channels, size


def test_eigenvalue_bounds_the_form_everywhere(design: Design) -> None:
    draw = np.random.default_rng(11)
    gamma = design.result.gamma
    largest = lpi_eigenvalue(design.problem, design.result.P, design.gain, gamma)
    opposite = replace(design, gain=-design.gain)
    bound = lpi_eigenvalue(design.problem, design.result.P, -design.gain, gamma)
    positive = 0
    for _ in range(2):
        value, size = form(design, gamma, draw)
        assert value <= (largest + 1e-9) * size
        value, size = form(opposite, gamma, draw)
        assert value <= bound * size
        positive += value > 0.0
    assert positive > 0  # the form with the wrong gain is seen to be positive, too
