"""The arm's PIE with Kelvin-Voigt damping and with a normal force: identities, closed forms, the grid model."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from beam_modes import beam, observer_optimum
from numpy.polynomial import Legendre
from pi_reference import distance, function_part, inner, polynomial, size_of
from scipy.optimize import brentq

from deploy.grid import make_grid
from deploy.model import make_model
from design.arm_pie import ArmPIE, arm_pie, selection
from design.gain_problem import controller_problem, observer_problem
from design.moment_lpi import solve_hinf
from design.operators import PIOperator
from design.setpoint import CHAPTER_SHAPES, from_shape
from wire.artefact import Arm

Array = npt.NDArray[np.float64]
S = np.array([0.0, 0.13, 0.4, 0.77, 1.0])
NOTHING = np.zeros(0)
ALPHA, DRAG, TAU = 80.0, 0.7, 0.006
CASES = [(1, 80.0, 0.7, 0.01), (4, 80.0, 0.0, 0.3), (6, 3.0, 1.3, 2.0)]


def random_arm(size: int, alpha: float, drag: float, tau: float) -> ArmPIE:
    rng = np.random.default_rng(size)
    return arm_pie(rng.normal(size=size), rng.normal(size=size), alpha, drag, tau)


def act(operator: PIOperator, coefficients: Array, s: Array = S) -> Array:
    return function_part(operator, NOTHING, polynomial(coefficients))(s)


def pairing(left: PIOperator, f: Array, right: PIOperator, g: Array) -> float:
    x = function_part(left, NOTHING, polynomial(f))
    y = function_part(right, NOTHING, polynomial(g))
    return inner(NOTHING, x, NOTHING, y)


@pytest.mark.parametrize("case", CASES)
def test_energy_falls_by_drag_and_by_the_strain_rates(
    case: tuple[int, float, float, float],
) -> None:
    arm = random_arm(*case)
    f = np.random.default_rng(2).normal(size=(4, 5))
    velocity = selection("v_x", "v_y") @ arm.T
    lost = arm.drag * pairing(velocity, f, velocity, f) + arm.retardation * float(
        np.sum(f[:2] ** 2)
    )
    assert pairing(arm.T, f, arm.A, f) == pytest.approx(-lost, rel=1e-11)


@pytest.mark.parametrize("case", CASES)
def test_the_adjoint_system_has_its_own_t(case: tuple[int, float, float, float]) -> None:
    """<A f, T_adj g> = <T f, A_adj g> for all f, g; with the arm's own T it fails."""
    arm = random_arm(*case)
    left, right = arm.A.adjoint @ arm.T_adjoint, arm.T.adjoint @ arm.A_adjoint
    assert distance(left, right) <= 1e-13 * size_of(left)
    rng = np.random.default_rng(3)
    f, g = rng.normal(size=(4, 5)), rng.normal(size=(4, 3))
    forward = pairing(arm.A, f, arm.T_adjoint, g)
    assert forward == pytest.approx(pairing(arm.T, f, arm.A_adjoint, g), rel=1e-10)
    assert abs(forward - pairing(arm.A, f, arm.T, g)) > 1e-3


@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_inverse_of_the_dynamics(case: tuple[int, float, float, float], adjoint: bool) -> None:
    """y = inverse x has y = T f and A f = x, with f written out by hand."""
    arm = random_arm(*case)
    T, A = (arm.T_adjoint, arm.A_adjoint) if adjoint else (arm.T, arm.A)
    sign = -1.0 if adjoint else 1.0
    x = np.random.default_rng(4).normal(size=(4, 4))
    rates = sign * x[2:]
    only_rates = np.concatenate([rates, np.zeros((2, x.shape[1]))])

    def fundamental(s: Array) -> Array:
        velocity = act(T, only_rates, s)[:2]
        force_slope = sign * (polynomial(x)(s)[:2] + arm.drag * velocity)
        return np.concatenate([polynomial(rates)(s), force_slope])

    found = function_part(A, NOTHING, fundamental)(S)
    np.testing.assert_allclose(found, polynomial(x)(S), atol=1e-11)
    expected = function_part(T, NOTHING, fundamental)(S)
    np.testing.assert_allclose(act(arm.inverse(adjoint=adjoint), x), expected, atol=1e-11)
    assert distance(arm.inverse(adjoint=adjoint) @ A, T) <= 1e-13 * size_of(T, A)


def test_inverses_of_the_two_dynamics_are_each_others_adjoint() -> None:
    arm = random_arm(*CASES[1])
    assert distance(arm.inverse().adjoint, arm.inverse(adjoint=True)) <= 1e-14 * size_of(arm.T)


def test_without_retardation_nothing_is_added() -> None:
    arm = random_arm(4, 80.0, 0.7, 0.0)
    assert arm.T is arm.T_adjoint is arm.elastic
    assert not arm.T.r0.any()
    with pytest.raises(ValueError, match="retardation"):
        random_arm(4, 80.0, 0.7, -1e-3)


def eigenvalues(T: PIOperator, A: PIOperator, size: int) -> Array:
    """Spectrum of lambda T f = A f by growing magnitude, conjugates once."""
    found = 1.0 / np.linalg.eigvals(np.linalg.solve(A.discretise(size), T.discretise(size)))
    found = found[found.imag > 1e-6]
    return np.asarray(found[np.argsort(np.abs(found))])


def test_straight_arm_has_the_closed_form_modes() -> None:
    """lambda^2 + (d + tau w^2) lambda + w^2 = 0 for the textbook frequencies w, axial ones included."""
    roots = [
        brentq(
            lambda b: math.cos(b) + 1.0 / math.cosh(b), k * math.pi, (k + 1) * math.pi, xtol=1e-14
        )
        for k in range(5)
    ]
    w = np.sort(np.append(np.array(roots) ** 2, ALPHA * math.pi * 0.5))
    damping = DRAG + TAU * w**2
    expected = -0.5 * damping + 1j * np.sqrt(w**2 - 0.25 * damping**2)
    arm = arm_pie(np.array([1.0]), np.array([0.0]), ALPHA, DRAG, TAU)
    for T, A in ((arm.T, arm.A), (arm.T_adjoint, arm.A_adjoint)):
        found = eigenvalues(T, A, 24)[: w.size]
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_curved_arm_is_the_limit_of_the_grid_model() -> None:
    setpoint = from_shape("2", CHAPTER_SHAPES["2"])
    pie = arm_pie(*setpoint.frame(14), ALPHA, DRAG, TAU)
    exact = eigenvalues(pie.T, pie.A, 18)[:3]
    radius, length, young, density = 0.03, 1.2, 6000.0, 1050.0  # alpha = 2 L / r = 80
    unit_s = length**2 * math.sqrt(density * 4.0 / (young * radius**2))
    arm = Arm("test", length, radius, young, density, DRAG / unit_s, TAU * unit_s)
    scale = np.sqrt(2.0 * np.arange(setpoint.curvature.size) + 1.0)
    curvature = setpoint.curvature * scale / length

    def on_grid(nodes: int) -> Array:
        model = make_model(arm, list(curvature), make_grid(length, nodes, "equispaced"))
        found = np.linalg.eigvals(model.A) * unit_s
        found = found[found.imag > 1e-6]
        return np.asarray(found[np.argsort(np.abs(found))][:3])

    coarse, middle, fine = (on_grid(n) for n in (12, 24, 48))
    order = np.log2(np.abs(coarse - exact) / np.abs(middle - exact))
    np.testing.assert_allclose(order, 2.0, atol=0.15)
    once = (4.0 * middle - coarse) / 3.0, (4.0 * fine - middle) / 3.0
    twice = (16.0 * once[1] - once[0]) / 15.0
    np.testing.assert_allclose(twice, exact, rtol=3e-5)
    plain = arm_pie(*setpoint.frame(14), ALPHA, DRAG)
    undamped = eigenvalues(plain.T, plain.A, 18)[:3]
    assert np.all(np.abs(undamped - exact) > 100.0 * np.abs(twice - exact))


def test_command_of_a_normal_force_is_the_normal_velocity() -> None:
    setpoint = from_shape("2", CHAPTER_SHAPES["2"])
    arm = arm_pie(*setpoint.frame(8), ALPHA, DRAG)
    x = np.random.default_rng(5).normal(size=(4, 3))
    theta = Legendre(
        setpoint.angle * np.sqrt(2.0 * np.arange(setpoint.angle.size) + 1.0), domain=[0.0, 1.0]
    )(S)
    v_x, v_y = polynomial(x)(S)[:2]
    expected = -np.sin(theta) * v_x + np.cos(theta) * v_y
    np.testing.assert_allclose(act(arm.command("normal"), x)[0], expected, atol=1e-3)
    np.testing.assert_allclose(act(arm.command("transverse"), x)[0], v_y, atol=1e-14)
    with pytest.raises(ValueError, match="'transverse', 'normal'"):
        arm.command("axial")


def test_an_observer_of_the_damped_arm_is_certified_above_the_optimum() -> None:
    """The optimum from beam modes, each with tau w^2 of damping."""
    modes = 10
    pie = arm_pie(np.ones(1), np.zeros(1), ALPHA, DRAG, TAU)
    problem = observer_problem(pie, 0.1)
    result = solve_hinf(problem, counts=(1,))
    assert result.outcome == "certified"
    plain = beam(modes, DRAG)
    A = plain.A.copy()
    A[:modes, :modes] -= TAU * np.diag(np.diag(plain.A[modes:, :modes]) ** 2)
    optimum = observer_optimum(replace(plain, A=A), 0.1)
    assert optimum < result.gamma < 2.0 * optimum


def test_problems_carry_the_options_of_the_arm() -> None:
    setpoint = from_shape("2", CHAPTER_SHAPES["2"])
    pie = arm_pie(*setpoint.frame(5), ALPHA, DRAG, TAU)
    strain_only = observer_problem(pie, 0.1, ["k"])
    assert strain_only.C2.shape_out.functions == 1
    controller = controller_problem(pie, 0.1, "normal")
    assert distance(controller.T, pie.T_adjoint) == 0.0
    assert distance(controller.C2, pie.command("normal")) == 0.0
    assert strain_only.drag == controller.drag == DRAG
