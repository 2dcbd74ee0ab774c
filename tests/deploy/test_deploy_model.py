"""The linear model on the grid against closed forms, virtual work and a spectral Ritz method."""

import math

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from deploy_artefacts import ARM, CURVED, STRAIGHT
from numpy.polynomial import legendre
from scipy.linalg import eigh

from deploy.grid import SegmentGrid, make_grid
from deploy.model import GridModel, make_model, tangent_angle

Array = npt.NDArray[np.float64]
UNEVEN = [0.0, 0.2, 0.33, 0.6, 0.71, 1.0, 1.25]


def frequencies(model: GridModel) -> Array:
    """Positive frequencies of A0 in rad/s, ascending."""
    values = np.linalg.eigvals(model.A0)
    return np.sort(values.imag[values.imag > 0.0])


@pytest.mark.parametrize("shape", [STRAIGHT, CURVED])
@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev", UNEVEN])
def test_conservative_part_is_skew_in_the_energy(
    shape: list[float], spacing: str | list[float]
) -> None:
    model = make_model(ARM, shape, make_grid(ARM.length_m, 6, spacing))
    weighted = model.energy_weights.ravel()[:, None] * model.A0
    assert np.max(np.abs(weighted + weighted.T)) <= 1e-13 * np.max(np.abs(weighted))
    assert np.max(np.abs(np.linalg.eigvals(model.A0).real)) < 1e-11 * np.max(np.abs(model.A0))


def test_drag_acts_on_velocities_only_and_load_on_transverse_velocity() -> None:
    model = make_model(ARM, CURVED, make_grid(ARM.length_m, 3, "equispaced"))
    np.testing.assert_allclose(
        np.diag(model.A - model.A0), -ARM.drag_per_s * np.tile([1.0, 1.0, 0.0, 0.0], 3)
    )
    expected = np.zeros((3, 4, 3))
    expected[[0, 1, 2], 1, [0, 1, 2]] = 1.0 / (1050.0 * math.pi * 0.03**2)
    np.testing.assert_allclose(model.B, expected.reshape(12, 3), rtol=1e-14)


@pytest.mark.parametrize("spacing", ["equispaced", UNEVEN])
def test_kelvin_voigt_damping_takes_the_energy_of_the_strain_rates(
    spacing: str | list[float],
) -> None:
    """It is the strain energy of the velocities, times 2 tau, and acts on velocities only."""
    tau = 0.4
    grid = make_grid(ARM.length_m, 6, spacing)
    damped = make_model(msgspec.structs.replace(ARM, kelvin_voigt_s=tau), CURVED, grid)
    plain = make_model(ARM, CURVED, grid)
    added = (damped.A - plain.A).reshape(6, 4, 6, 4)
    assert not added[:, 2:].any() and not added[:, :, :, 2:].any()
    np.testing.assert_array_equal(damped.A0, plain.A0)
    x = np.random.default_rng(5).standard_normal((6, 4))
    power = 2.0 * np.sum(damped.energy_weights * x * np.einsum("icjd,jd->ic", added, x))
    angle = tangent_angle(CURVED, grid.centres_m, ARM.length_m)
    assert power == pytest.approx(-2.0 * tau * strain_energy(grid, angle, x[:, :2]), rel=1e-12)
    weighted = damped.energy_weights.ravel()[:, None] * (damped.A - plain.A)
    np.testing.assert_allclose(weighted, weighted.T, atol=1e-13 * np.abs(weighted).max())


def test_normal_actuators_push_across_the_setpoint() -> None:
    grid = make_grid(ARM.length_m, 5, "chebyshev")
    model = make_model(msgspec.structs.replace(ARM, actuator="normal"), CURVED, grid)
    plain = make_model(ARM, CURVED, grid)
    np.testing.assert_array_equal(model.transverse, plain.B)
    np.testing.assert_array_equal(model.A, plain.A)
    angle = tangent_angle(CURVED, grid.faces_m[1:], ARM.length_m)
    assert np.ptp(angle) > 0.3
    push = ARM.mass_per_length_kg_per_m * model.B.reshape(5, 4, 5)
    for i in range(5):
        expected = np.zeros((5, 4))
        expected[i, :2] = -math.sin(angle[i]), math.cos(angle[i])
        np.testing.assert_allclose(push[:, :, i], expected, atol=1e-14)


def strain_energy(grid: SegmentGrid, angle: Array, displacement: Array) -> float:
    """Energy of small displacements (n, 2) of the outer faces, segment by segment."""
    energy, rotation_before, half_before = 0.0, 0.0, 0.0
    place = np.zeros(2)
    for i, width in enumerate(np.diff(grid.faces_m)):
        slope = (displacement[i] - place) / width
        place = displacement[i]
        c, s = math.cos(angle[i]), math.sin(angle[i])
        stretch, rotation = c * slope[0] + s * slope[1], -s * slope[0] + c * slope[1]
        lever = half_before + 0.5 * width
        bend = (rotation - rotation_before) / lever
        energy += 0.5 * ARM.axial_stiffness_n * stretch**2 * width
        energy += 0.5 * ARM.bending_stiffness_n_m2 * bend**2 * lever
        rotation_before, half_before = rotation, 0.5 * width
    return energy


def test_forces_do_virtual_work() -> None:
    """Mass times acceleration is minus the gradient of the strain energy, here by differences."""
    grid = make_grid(ARM.length_m, 6, UNEVEN)
    model = make_model(ARM, CURVED, grid)
    angle = tangent_angle(CURVED, grid.centres_m, ARM.length_m)
    n = grid.nodes
    displacement = np.random.default_rng(3).standard_normal((n, 2))
    blocks = model.A0.reshape(n, 4, n, 4)
    state = np.zeros((n, 4))
    state[:, 2:] = np.einsum("isjc,jc->is", blocks[:, 2:, :, :2], displacement)
    acceleration = np.einsum("icjs,js->ic", blocks[:, :2], state)
    faces = grid.faces_m
    dual = np.append(0.5 * (faces[2:] - faces[:-2]), 0.5 * (faces[-1] - faces[-2]))
    force = ARM.mass_per_length_kg_per_m * dual[:, None] * acceleration
    for i in range(n):
        for component in range(2):
            push = np.zeros((n, 2))
            push[i, component] = 0.1  # the energy is quadratic: central differences are exact
            ahead = strain_energy(grid, angle, displacement + push)
            behind = strain_energy(grid, angle, displacement - push)
            assert force[i, component] == pytest.approx(-(ahead - behind) / 0.2, rel=1e-9)


def test_tangent_angle_is_the_integral_of_the_curvature() -> None:
    s = np.linspace(0.0, ARM.length_m, 7)
    nodes, weights = legendre.leggauss(20)
    by_quadrature = [
        0.5 * end * weights @ legendre.legval(end * (nodes + 1.0) / ARM.length_m - 1.0, CURVED)
        for end in s
    ]
    np.testing.assert_allclose(tangent_angle(CURVED, s, ARM.length_m), by_quadrature, atol=1e-14)


def straight_frequencies() -> tuple[Array, Array]:
    """Four bending and two axial frequencies of a clamped-free uniform beam, textbook values."""
    roots = np.array([1.875104068711961, 4.694091132974175, 7.854757438237613, 10.995540734875467])
    length = ARM.length_m
    speed = math.sqrt(ARM.bending_stiffness_n_m2 / ARM.mass_per_length_kg_per_m)
    wave = math.sqrt(ARM.axial_stiffness_n / ARM.mass_per_length_kg_per_m)
    bending = roots**2 * speed / length**2
    return bending, np.array([0.5, 1.5]) * math.pi * wave / length


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
def test_straight_frequencies_converge_at_second_order(spacing: str) -> None:
    bending, axial = straight_frequencies()
    errors = []
    for n in (20, 40):
        model = make_model(ARM, STRAIGHT, make_grid(ARM.length_m, n, spacing))
        blocks = model.A0.reshape(n, 4, n, 4)
        found = []
        for keep, exact in (([1, 3], bending[:3]), ([0, 2], axial)):
            part = blocks[:, keep][:, :, :, keep].reshape(2 * n, 2 * n)
            values = np.linalg.eigvals(part)
            ascending = np.sort(values.imag[values.imag > 0.0])[: len(exact)]
            found.append(np.abs(ascending / exact - 1.0))
        errors.append(np.concatenate(found))
    assert np.max(errors[1]) < 0.02
    orders = np.log2(errors[0] / errors[1])
    np.testing.assert_allclose(orders, 2.0, atol=0.15)


def ritz_frequencies(shape: list[float], count: int, degree: int = 18) -> Array:
    """Frequencies of the continuous curved arm, theory section 2, by a spectral Ritz method.

    Displacement r = int t p + int (int n) q with p = t.r', q = (n.r')' polynomials: no boundary
    condition is left, stiffness is diagonal, the mass matrix is done by Gauss quadrature.
    """
    length = ARM.length_m
    nodes, weights = legendre.leggauss(48)

    def angle(s: Array) -> Array:
        return np.asarray(
            legendre.legval(2.0 * s / length - 1.0, legendre.legint(shape, lbnd=-1.0))
            * (0.5 * length)
        )

    def normal_integral(s: Array) -> Array:
        inner = 0.5 * s[..., None] * (nodes + 1.0)
        theta = angle(inner)
        half = 0.5 * s
        return np.stack([half * (-np.sin(theta) @ weights), half * (np.cos(theta) @ weights)])

    s = 0.5 * length * (nodes + 1.0)
    z = 0.5 * s[:, None] * (nodes + 1.0)
    theta = angle(z)
    basis = legendre.legvander(2.0 * z / length - 1.0, degree)
    tangent = np.stack([np.cos(theta), np.sin(theta)])
    arm = normal_integral(s)[:, :, None] - normal_integral(z)
    shapes = np.concatenate(
        [
            np.einsum("csz,szj,z,s->csj", kernel, basis, weights, 0.5 * s)
            for kernel in (tangent, arm)
        ],
        axis=2,
    )
    mass = ARM.mass_per_length_kg_per_m * np.einsum(
        "csi,csj,s->ij", shapes, shapes, 0.5 * length * weights
    )
    norms = length / (2.0 * np.arange(degree + 1) + 1.0)
    stiffness = np.concatenate([ARM.axial_stiffness_n * norms, ARM.bending_stiffness_n_m2 * norms])
    scale = 1.0 / np.sqrt(stiffness)
    slowness = eigh(scale[:, None] * mass * scale, eigvals_only=True)
    return np.asarray(1.0 / np.sqrt(slowness[::-1][:count]))


def test_ritz_reference_is_right_for_the_straight_arm() -> None:
    bending, axial = straight_frequencies()
    expected = np.sort(np.concatenate([bending, axial]))[:5]
    np.testing.assert_allclose(ritz_frequencies(STRAIGHT, 5), expected, rtol=1e-9)


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
def test_curved_frequencies_converge_at_second_order(spacing: str) -> None:
    exact = ritz_frequencies(CURVED, 5)
    errors = [
        np.abs(
            frequencies(make_model(ARM, CURVED, make_grid(ARM.length_m, n, spacing)))[:5] / exact
            - 1.0
        )
        for n in (24, 48)
    ]
    assert np.max(errors[1]) < 0.02
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.25)
