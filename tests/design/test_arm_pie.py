"""The arm's PIE: identities at rounding, closed forms of the straight arm, and the grid model when curved."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import Legendre
from pi_reference import distance, function_part, inner, polynomial, size_of, values
from scipy.integrate import quad
from scipy.optimize import brentq

from deploy.grid import make_grid
from deploy.model import make_model
from design.arm_pie import ArmPIE, arm_pie, functional, selection
from design.operators import PIOperator, Shape
from design.setpoint import CHAPTER_SHAPES, from_shape
from wire.artefact import Arm

Array = npt.NDArray[np.float64]
S = np.array([0.0, 0.13, 0.4, 0.77, 1.0])
NOTHING = np.zeros(0)
ALPHA, DRAG = 80.0, 0.7

CASES = [
    pytest.param(
        size, alpha, drag, id=f"frame of degree {size - 1}, alpha {alpha:g}, drag {drag:g}"
    )
    for size, alpha, drag in ((1, 80.0, 0.7), (4, 80.0, 0.0), (6, 3.0, 1.3))
]


def random_arm(size: int, alpha: float, drag: float) -> ArmPIE:
    """Frames of random polynomials: neither orthonormal nor of one length."""
    rng = np.random.default_rng(size)
    return arm_pie(rng.normal(size=size), rng.normal(size=size), alpha, drag)


def random_states(arm: ArmPIE) -> tuple[Array, Array]:
    rng = np.random.default_rng(round(10 * arm.alpha))
    return rng.normal(size=(4, 5)), rng.normal(size=(4, 3))


def act(operator: PIOperator, coefficients: Array, s: Array = S) -> Array:
    """Values of (operator f)(s), evaluated from the definition; shape (outputs, len(s))."""
    return function_part(operator, NOTHING, polynomial(coefficients))(s)


def pairing(left: PIOperator, f: Array, right: PIOperator, g: Array) -> float:
    """<left f, right g>."""
    x = function_part(left, NOTHING, polynomial(f))
    y = function_part(right, NOTHING, polynomial(g))
    return inner(NOTHING, x, NOTHING, y)


# Identities of theory, section 2, for every polynomial frame


@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_conservative_part_is_skew_adjoint(size: int, alpha: float, drag: float) -> None:
    arm = random_arm(size, alpha, drag)
    f, g = random_states(arm)
    left = pairing(arm.T, f, arm.conservative, g)
    right = pairing(arm.conservative, f, arm.T, g)
    assert abs(left) > 1e-3
    assert left == pytest.approx(-right, rel=1e-11)
    power = arm.T.adjoint @ arm.conservative
    nothing = PIOperator.zeros(power.shape_out, power.shape_in)
    assert distance(power + power.adjoint, nothing) <= 1e-13 * size_of(power)


@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_energy_falls_by_the_drag_alone(size: int, alpha: float, drag: float) -> None:
    arm = random_arm(size, alpha, drag)
    f, _ = random_states(arm)
    velocity = selection("v_x", "v_y") @ arm.T
    half_rate = pairing(arm.T, f, arm.A, f)
    assert half_rate == pytest.approx(-drag * pairing(velocity, f, velocity, f), abs=1e-10)


@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_virtual_work(size: int, alpha: float, drag: float) -> None:
    # r = K(e / alpha, k): d<v, r>/dt = <v_t, r> + <v, r_t> = |v|^2 - |(e, k)|^2 - d <v, r>
    arm = random_arm(size, alpha, drag)
    f, _ = random_states(arm)
    compliance = PIOperator.multiplier(np.diag([1.0 / alpha, 1.0])[:, :, None])
    strains = selection("e", "k")
    velocities = selection("v_x", "v_y")
    displacement = arm.virtual @ compliance @ strains
    v, r = velocities @ arm.T, displacement @ arm.T
    v_t, r_t = velocities @ arm.A, displacement @ arm.A
    assert distance(r_t, v) <= 1e-13 * size_of(v)  # dr/dt = v exactly
    rate = pairing(v_t, f, r, f) + pairing(v, f, r_t, f)
    kinetic = pairing(v, f, v, f)
    elastic = pairing(strains @ arm.T, f, strains @ arm.T, f)
    work = drag * pairing(v, f, r, f)
    scale = kinetic + elastic + abs(work)
    assert rate == pytest.approx(kinetic - elastic - work, abs=1e-12 * scale)


@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_adjoint_dynamics_in_the_same_t(size: int, alpha: float, drag: float) -> None:
    arm = random_arm(size, alpha, drag)
    f, g = random_states(arm)
    forward = pairing(arm.A, f, arm.T, g)
    assert forward == pytest.approx(pairing(arm.T, f, arm.A_adjoint, g), rel=1e-11)
    left, right = arm.A.adjoint @ arm.T, arm.T.adjoint @ arm.A_adjoint
    assert distance(left, right) <= 1e-13 * size_of(left)
    if drag > 0.0:
        assert abs(forward + pairing(arm.T, f, arm.A, g)) > 1e-6  # A itself is not skew


# T and the boundary conditions


@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_states_satisfy_the_boundary_conditions(size: int, alpha: float, drag: float) -> None:
    arm = random_arm(size, alpha, drag)
    f, _ = random_states(arm)
    ends = act(arm.T, f, np.array([0.0, 1.0]))
    np.testing.assert_allclose(ends[:2, 0], 0.0, atol=1e-13)  # v(0) = 0
    np.testing.assert_allclose(ends[2:, 1], 0.0, atol=1e-13)  # N.t(1) = 0, k(1) = 0
    assert np.all(np.abs(ends[:2, 1]) > 1e-6)
    assert np.all(np.abs(ends[2:, 0]) > 1e-6)


def slopes(function: Array, order: int = 1) -> list[Legendre]:
    """Derivatives of the functions (n, 40) sampled at Gauss points, by numpy's Legendre series."""
    x, w = np.polynomial.legendre.leggauss(40)
    scale = 2.0 * np.arange(40) + 1.0
    projected = (function * w) @ np.polynomial.legendre.legvander(x, 39) * scale / 2.0
    return [Legendre(c[:25], domain=[0.0, 1.0]).deriv(order) for c in projected]


GAUSS_40 = 0.5 * (np.polynomial.legendre.leggauss(40)[0] + 1.0)


@pytest.mark.parametrize(("name", "degree"), [("1", 3), ("2", 5)])
def test_fundamental_state_is_made_of_the_derivatives_of_the_state(name: str, degree: int) -> None:
    """f = (alpha t.v', (n.v')', N'), seen from v', t.N and k' by differentiation."""
    setpoint = from_shape(name, CHAPTER_SHAPES[name])
    cosine, sine = setpoint.frame(degree)
    arm = arm_pie(cosine, sine, ALPHA, DRAG)
    rng = np.random.default_rng(7)
    f = rng.normal(size=(4, 4))
    x = act(arm.T, f, GAUSS_40)
    p, q, g_x, g_y = polynomial(f)(S)
    basis = values(S, degree + 1)
    tangent = np.stack([basis @ cosine, basis @ sine])
    normal = np.stack([-tangent[1], tangent[0]])
    v_rate = np.stack([d(S) for d in slopes(x[:2])])
    # v' = t p / alpha + n w with the rotation rate w = int_0^s q
    rotation = np.array([quad(lambda z: polynomial(f)(np.array([z]))[1, 0], 0.0, s)[0] for s in S])
    np.testing.assert_allclose(v_rate, tangent * p / ALPHA + normal * rotation, atol=1e-11)
    assert np.max(np.abs(q)) > 0.1
    # alpha e = t.N and k' = -n.N with N = -int_s^1 g
    force = np.array([
        [-quad(lambda z, i=i: polynomial(f)(np.array([z]))[i, 0], s, 1.0)[0] for s in S]
        for i in (2, 3)
    ])  # fmt: skip
    strain = act(arm.T, f)[2]
    np.testing.assert_allclose(ALPHA * strain, np.sum(tangent * force, axis=0), atol=1e-11)
    (bending_slope,) = slopes(x[3:])
    np.testing.assert_allclose(bending_slope(S), -np.sum(normal * force, axis=0), atol=1e-11)
    assert np.max(np.abs([g_x, g_y])) > 0.1


@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_dynamics_are_a_permutation_and_drag(size: int, alpha: float, drag: float) -> None:
    arm = random_arm(size, alpha, drag)
    f, _ = random_states(arm)
    p, q, g_x, g_y = polynomial(f)(S)
    state = act(arm.T, f)
    expected = np.stack([g_x - drag * state[0], g_y - drag * state[1], p, q])
    np.testing.assert_allclose(act(arm.A, f), expected, atol=1e-12)


# The Krylov operator


@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_inverse_of_the_dynamics(size: int, alpha: float, drag: float, adjoint: bool) -> None:
    """y = inverse x has y = T f_y with A f_y = x; f_y is written out by hand."""
    arm = random_arm(size, alpha, drag)
    x, _ = random_states(arm)
    sign = -1.0 if adjoint else 1.0
    # +-(g, p, q) - d (v, 0) = x
    rates = sign * x[2:]
    f_y = np.concatenate([rates, np.zeros((2, x.shape[1]))])

    def fundamental(s: Array) -> Array:
        velocity = act(arm.T, f_y, s)[:2]  # v depends on the strain rates alone
        force_slope = sign * (polynomial(x)(s)[:2] + drag * velocity)
        return np.concatenate([polynomial(rates)(s), force_slope])

    dynamics = arm.A_adjoint if adjoint else arm.A
    produced = function_part(dynamics, NOTHING, fundamental)(S)
    np.testing.assert_allclose(produced, polynomial(x)(S), atol=1e-11)  # f_y is right
    expected = function_part(arm.T, NOTHING, fundamental)(S)
    np.testing.assert_allclose(act(arm.inverse(adjoint=adjoint), x), expected, atol=1e-11)


@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize(("size", "alpha", "drag"), CASES)
def test_krylov_rows_differentiate_to_the_state(
    size: int, alpha: float, drag: float, adjoint: bool
) -> None:
    """y_t = inverse A f = T f = x along the dynamics."""
    arm = random_arm(size, alpha, drag)
    rate = arm.inverse(adjoint=adjoint) @ (arm.A_adjoint if adjoint else arm.A)
    assert distance(rate, arm.T) <= 1e-13 * size_of(arm.T, arm.A)


def test_inverses_of_the_two_dynamics_are_each_others_adjoint() -> None:
    arm = random_arm(4, 80.0, 0.7)
    assert distance(arm.inverse().adjoint, arm.inverse(adjoint=True)) <= 1e-14 * size_of(arm.T)


# Eigenvalues


def eigenvalues(arm: ArmPIE, size: int) -> Array:
    """Upper half of the spectrum of lambda T f = A f, by growing magnitude."""
    inverse = np.linalg.solve(arm.A.discretise(size), arm.T.discretise(size))
    found = 1.0 / np.linalg.eigvals(inverse)
    found = found[found.imag > 1e-6]
    return np.asarray(found[np.argsort(np.abs(found))])


def clamped_free(count: int) -> Array:
    """Roots of cos(b) cosh(b) = -1."""
    return np.array([
        brentq(lambda b: math.cos(b) + 1.0 / math.cosh(b), k * math.pi, (k + 1) * math.pi, xtol=1e-14)
        for k in range(count)
    ])  # fmt: skip


@pytest.mark.parametrize("drag", [0.0, 0.7])
def test_straight_arm_has_the_closed_form_modes(drag: float) -> None:
    roots = clamped_free(5)
    np.testing.assert_allclose(roots[:3], [1.8751041, 4.6940911, 7.8547574], atol=5e-8)
    alpha = 80.0
    arm = arm_pie(np.array([1.0]), np.array([0.0]), alpha, drag)
    undamped = np.sort(np.concatenate([roots**2, alpha * math.pi * np.array([0.5, 1.5])]))[:6]
    expected = -0.5 * drag + 1j * np.sqrt(undamped**2 - 0.25 * drag**2)
    found = eigenvalues(arm, 24)[:6]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    axial = alpha * math.pi / 2.0
    assert np.min(np.abs(np.abs(found) - axial)) < 1e-9 * axial


def test_modes_do_not_depend_on_the_direction_of_the_straight_arm() -> None:
    straight = eigenvalues(arm_pie(np.array([1.0]), np.array([0.0]), ALPHA, DRAG), 16)
    turned = eigenvalues(
        arm_pie(np.array([math.cos(1.0)]), np.array([math.sin(1.0)]), ALPHA, DRAG), 16
    )
    np.testing.assert_allclose(turned[:6], straight[:6], rtol=1e-10)


RADIUS_M, LENGTH_M, YOUNG_PA, DENSITY_KG_PER_M3 = 0.03, 1.2, 6000.0, 1050.0
"""alpha = L sqrt(EA / EI) = 2 L / r = 80."""


def grid_eigenvalues(curvature: Legendre, nodes: int) -> Array:
    """Upper half spectrum of the staggered-grid model in deploy/, in units of 1 / tau."""
    area = math.pi * RADIUS_M**2
    bending = YOUNG_PA * 0.25 * math.pi * RADIUS_M**4
    tau_s = LENGTH_M**2 * math.sqrt(DENSITY_KG_PER_M3 * area / bending)
    arm = Arm(
        name="test arm",
        length_m=LENGTH_M,
        radius_m=RADIUS_M,
        youngs_modulus_pa=YOUNG_PA,
        density_kg_per_m3=DENSITY_KG_PER_M3,
        drag_per_s=DRAG / tau_s,
    )
    per_m = [float(c) / LENGTH_M for c in curvature.coef]
    model = make_model(arm, per_m, make_grid(LENGTH_M, nodes, "equispaced"))
    found = np.linalg.eigvals(model.A) * tau_s
    found = found[found.imag > 1e-6]
    return np.asarray(found[np.argsort(np.abs(found))])


@pytest.mark.parametrize("name", ["1", "2"])
def test_curved_arm_is_the_limit_of_the_grid_model(name: str) -> None:
    """The grid's error falls by 4 at each refinement, and extrapolation to no grid meets the PIE.

    What is left after two Richardson steps is less than the second step itself for the first three
    modes; the fourth of setpoint 1 turns into the axial one nearby and is still coarse at 20 nodes.
    The frame is of degree 14, so that its error does not show.
    """
    setpoint = from_shape(name, CHAPTER_SHAPES[name])
    assert setpoint.frame_error(14) < 1e-6
    modes = 4
    exact = eigenvalues(arm_pie(*setpoint.frame(14), ALPHA, DRAG), 18)[:modes]
    scale = np.sqrt(2.0 * np.arange(setpoint.curvature.size) + 1.0)
    curvature = Legendre(setpoint.curvature * scale, domain=[0.0, 1.0])
    coarse, middle, fine = (grid_eigenvalues(curvature, n)[:modes] for n in (20, 40, 80))

    order = np.log2(
        np.abs(np.array([coarse - exact, middle - exact]) / [middle - exact, fine - exact])
    )
    np.testing.assert_allclose(order[0], 2.0, atol=0.07)
    np.testing.assert_allclose(order[1], 2.0, atol=0.02)

    once_middle, once_fine = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
    twice = (16 * once_fine - once_middle) / 15
    error = np.abs(twice - exact) / np.abs(exact)
    last_correction = np.abs(twice - once_fine) / np.abs(exact)
    assert np.all(error[:3] <= last_correction[:3])
    assert np.all(error <= [1e-8, 1e-7, 1e-6, 1e-5])
    straight = eigenvalues(arm_pie(np.array([1.0]), np.array([0.0]), ALPHA, DRAG), 18)[:modes]
    assert np.all(np.abs(straight - exact) > 100 * np.abs(twice - exact))  # curvature matters


def test_low_frame_degrees_come_close_enough_for_design() -> None:
    setpoint = from_shape("2", CHAPTER_SHAPES["2"])
    exact = eigenvalues(arm_pie(*setpoint.frame(14), ALPHA, DRAG), 18)[:3]
    errors = [
        np.max(np.abs(eigenvalues(arm_pie(*setpoint.frame(k), ALPHA, DRAG), 18)[:3] / exact - 1.0))
        for k in (1, 3, 5, 8)
    ]
    assert errors[0] > errors[1] > errors[2] > errors[3]
    assert errors[2] < 5e-3
    assert errors[3] < 5e-4


# Rows of the state


def test_selection_and_functional_pick_states_by_name() -> None:
    x = np.random.default_rng(1).normal(size=(4, 3))
    np.testing.assert_allclose(act(selection("k", "v_y"), x), polynomial(x)(S)[[3, 1]], atol=1e-14)
    means, _ = functional("v_x", "e").apply(NOTHING, polynomial(x), S)
    np.testing.assert_allclose(means, x[[0, 2], 0], atol=1e-14)  # phi_0 = 1, the rest has mean 0
    assert functional("k").shape_out == Shape(1, 0)


def test_unknown_states_are_refused() -> None:
    for pick in (selection, functional):
        with pytest.raises(ValueError, match=r"unknown state 'w'.*'v_x', 'v_y', 'e', 'k'"):
            pick("v_x", "w")


def test_frames_of_differing_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="lengths 3 and 2"):
        arm_pie(np.zeros(3), np.zeros(2), ALPHA, DRAG)
