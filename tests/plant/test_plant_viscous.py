"""Kelvin-Voigt damping and follower loads of the plant against potentials by differences and closed forms."""

import math

import msgspec
import numpy as np
import pytest
from plant_arms import CHAPTER_ARM, THICK_ARM, Array, damped, stiffnesses
from scipy.integrate import solve_bvp

from plant.elastic import ElasticForce
from plant.grid import Grid
from plant.initial import InitialShape
from plant.model import ArmPlant, PlantParameters, highest_frequency_rad_per_s
from plant.viscous import ViscousStep
from wire.artefact import Arm

CELLS, TAU = 9, 0.37
TWO = (0.0, 0.5, 1.0)
ROOT = 1.8751040687119611


def with_damping(arm: Arm, tau: float, drag: float = 0.0) -> Arm:
    return msgspec.structs.replace(arm, kelvin_voigt_s=tau, drag_per_s=drag)


def following(arm: Arm) -> Arm:
    return msgspec.structs.replace(arm, actuator="normal")


def _shape_and_velocity(seed: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    step = THICK_ARM.length_m / CELLS
    angles = 3.0 * step * np.arange(1, CELLS + 1) + random.uniform(-0.3, 0.3, CELLS)
    edges = step * random.uniform(0.8, 1.2, CELLS) * np.exp(1j * angles)
    position = np.concatenate([[0.0], np.cumsum(edges)])
    velocity = random.standard_normal(CELLS) + 1j * random.standard_normal(CELLS)
    return position, velocity


def _strains(position: np.ndarray) -> tuple[Array, Array]:
    """Stretch of the cells and turn at the nodes, in loops."""
    step = THICK_ARM.length_m / CELLS
    stretch, turn, before = [], [], 0.0
    for j in range(CELLS):
        edge = position[j + 1] - position[j]
        stretch.append(abs(edge) / step - 1.0)
        angle = math.atan2(edge.imag, edge.real)
        turn.append(angle - before)
        before = angle
    return np.array(stretch), np.array(turn)


def _potential(position: np.ndarray, velocity: np.ndarray) -> float:
    """R = tau/2 (sum EA ds e_t^2 + sum EI / length (turn_t)^2), the rates by central differences."""
    EA, EI, _ = stiffnesses(THICK_ARM)
    step, small = THICK_ARM.length_m / CELLS, 1e-6
    moved = np.concatenate([[0.0], velocity]) * small
    ahead, behind = _strains(position + moved), _strains(position - moved)
    stretch, turn = ((a - b) / (2.0 * small) for a, b in zip(ahead, behind, strict=True))
    lengths = np.full(CELLS, step)
    lengths[0] *= 0.5
    return 0.5 * TAU * float(EA * step * np.sum(stretch**2) + EI * np.sum(turn**2 / lengths))


def _step() -> ViscousStep:
    EA, EI, mass = stiffnesses(THICK_ARM)
    return ViscousStep(Grid(CELLS, THICK_ARM.length_m), EA, EI, mass, TAU)


def test_dissipated_power_is_twice_the_rayleigh_potential() -> None:
    position, velocity = _shape_and_velocity(1)
    inner_mass = stiffnesses(THICK_ARM)[2] * THICK_ARM.length_m / CELLS
    force = inner_mass * _step().rate(np.diff(position), velocity)
    power = float(np.sum((velocity.conj() * force).real))
    assert power == pytest.approx(2.0 * _potential(position, velocity), rel=1e-7)


def test_force_is_the_gradient_of_the_potential_by_the_velocities() -> None:
    """The potential is quadratic in the velocities: central differences of any size are exact."""
    position, velocity = _shape_and_velocity(2)
    inner_mass = stiffnesses(THICK_ARM)[2] * THICK_ARM.length_m / CELLS
    force = inner_mass * _step().rate(np.diff(position), velocity)
    tolerance = 1e-7 * np.max(np.abs(force))
    for node in range(CELLS):
        for direction in (1.0, 1j):
            push = np.zeros(CELLS, dtype=complex)
            push[node] = direction
            ends = _potential(position, velocity + push), _potential(position, velocity - push)
            component = (force[node] * np.conj(direction)).real
            assert component == pytest.approx(0.5 * (ends[0] - ends[1]), abs=tolerance)


def test_a_step_takes_out_the_power_of_the_mean_velocity() -> None:
    position, velocity = _shape_and_velocity(3)
    edges, reach = np.diff(position), 0.8
    after = _step().apply(edges, velocity, velocity.copy(), reach)
    weights = np.full(CELLS, THICK_ARM.length_m / CELLS)
    weights[-1] *= 0.5
    mass = stiffnesses(THICK_ARM)[2] * weights
    lost = 0.5 * float(np.sum(mass * (np.abs(velocity) ** 2 - np.abs(after) ** 2)))
    mean = 0.5 * (velocity + after)
    assert lost == pytest.approx(reach * 2.0 * _potential(position, mean), rel=1e-7)
    assert not np.allclose(after, velocity, rtol=0.1)


def test_broken_numbers_go_through() -> None:
    position, velocity = _shape_and_velocity(4)
    velocity[3] = np.nan
    assert np.isnan(_step().apply(np.diff(position), velocity, velocity, 0.1)).any()
    position[4] = np.inf
    with np.errstate(invalid="ignore"):
        assert np.isnan(_step().apply(np.diff(position), velocity, velocity, 0.1)).all()


def _first_mode(s_m: Array) -> Array:
    """Curvature of the clamped-free beam's first mode, small; length 1 m."""
    ratio = (np.cosh(ROOT) + np.cos(ROOT)) / (np.sinh(ROOT) + np.sin(ROOT))
    x = ROOT * s_m
    return np.asarray(1e-5 * (np.cosh(x) + np.cos(x) - ratio * (np.sinh(x) + np.sin(x))))


@pytest.mark.parametrize("tau", [1.0, 30.0])
def test_first_mode_decays_as_the_kelvin_voigt_beam(tau: float) -> None:
    """q_tt + tau w^2 q_t + w^2 q = 0 with the beam's w, below and above critical damping."""
    arm = with_damping(CHAPTER_ARM, tau)
    _, EI, mass = stiffnesses(arm)
    w = ROOT**2 * math.sqrt(EI / mass)
    fast, slow = np.roots([1.0, tau * w**2, w**2])
    plant = ArmPlant(PlantParameters(arm, TWO, 0.5, InitialShape(_first_mode), cells=24))
    first, worst = plant.tip()[1], 0.0
    for tick in range(1, 101):
        plant.advance(np.zeros(2), tick - 1)
        t = 0.5 * tick
        exact = (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)
        worst = max(worst, abs(plant.tip()[1] / first - exact.real))
    assert worst < 0.01


def test_overdamped_roughness_creeps_at_the_retardation_time() -> None:
    """Modes far above 1 / tau forget their strain as exp(-t / tau), whatever the substep."""
    tau = 0.8
    rough = np.where(np.arange(24) // 2 % 2 == 0, 1e-3, -1e-3)
    arm = with_damping(CHAPTER_ARM, tau)
    parameters = PlantParameters(arm, TWO, 0.2, InitialShape(lambda _: rough), cells=24)
    plant = ArmPlant(parameters)
    plain = PlantParameters(CHAPTER_ARM, TWO, 0.2, InitialShape(lambda _: rough), cells=24)
    assert plant.substeps() == ArmPlant(plain).substeps()  # tau does not limit the substep
    bending = [plant.energy()[2]]
    for tick in range(8):
        plant.advance(np.zeros(2), tick)
        bending.append(plant.energy()[2])
    rate = -np.diff(np.log(bending)) / 0.2
    np.testing.assert_allclose(rate[1:], 2.0 / tau, rtol=0.15)
    assert plant.energy()[0] < 1e-2 * bending[0]


def test_the_limit_of_the_substep_is_the_elastic_one_for_strong_damping() -> None:
    """Just below the limit, and with damping thousands of times beyond an explicit step's."""
    arm = with_damping(CHAPTER_ARM, 5.0)
    rough = InitialShape(lambda s: np.where(np.arange(s.size) // 2 % 2 == 0, 0.3, -0.3))
    parameters = PlantParameters(arm, TWO, 0.5, rough, cells=60, cfl_safety=0.95)
    plant = ArmPlant(parameters)
    w = highest_frequency_rad_per_s(arm, parameters.grid)
    assert 0.5 / plant.substeps() > 1000.0 * 2.0 / (5.0 * w**2)
    totals = [sum(plant.energy())]
    for tick in range(12):
        plant.advance(np.zeros(2), tick)
        totals.append(sum(plant.energy()))
    assert np.all(np.diff(totals) < 0.0)


def test_clamp_balances_momentum_with_damping_too() -> None:
    """Rate of the momentum by differences of the motion, over a tick short against everything."""
    arm = with_damping(THICK_ARM, 0.05, 0.0)
    tick = 2e-5
    plant = ArmPlant(
        PlantParameters(arm, (0.0, 0.35, 0.7), tick, InitialShape(lambda s: 2.0 - s), cells=16)
    )
    mass = stiffnesses(arm)[2] * np.append(np.full(15, 0.7 / 16), 0.5 * 0.7 / 16)
    momenta, forces = [], []
    for k in range(60):
        plant.advance(np.zeros(2), k)
        velocity = plant.state[32:].reshape(16, 2)
        position = plant.shape()[1:]
        turn = position[:, 0] * velocity[:, 1] - position[:, 1] * velocity[:, 0]
        momenta.append([*(mass @ velocity), mass @ turn])
        forces.append(plant.clamp_reaction())
    rate = (np.array(momenta[50]) - momenta[48]) / (2.0 * tick)
    np.testing.assert_allclose(rate, forces[49], rtol=2e-3, atol=2e-3 * np.abs(forces[49]).max())


# Loads along the normal


def _follower_reference(arm: Arm, faces: Array, command: Array, points: Array) -> Array:
    """x, y, angle, curvature, strain at `points`: extensible elastica under loads across it.

    In the material frame: N_t' = k N_n, N_n' = -k N_t - f, EI k' = -(1 + e) N_n, e = N_t / EA.
    """
    EA, EI, _ = stiffnesses(arm)

    def slopes(s: Array, z: Array) -> Array:
        _, _, a, k, tension, shear = z
        stretch = 1.0 + tension / EA
        load = np.interp(s, faces[1:], command)
        return np.array([
            stretch * np.cos(a), stretch * np.sin(a), k,
            -stretch * shear / EI, k * shear, -k * tension - load,
        ])  # fmt: skip

    def ends(root: Array, tip: Array) -> Array:
        return np.array([root[0], root[1], root[2], tip[3], tip[4], tip[5]])

    mesh = np.unique(np.concatenate([faces, np.linspace(0.0, arm.length_m, 101)]))
    guess = np.zeros((6, mesh.size))
    guess[0] = mesh
    found = solve_bvp(slopes, ends, mesh, guess, tol=1e-8, max_nodes=20000)
    assert found.success
    z = found.sol(points)
    return np.vstack([z[:4], z[4] / EA])


FACES = np.array([0.0, 0.11, 0.24, 0.5, 0.61, 0.7])


def test_large_deflection_under_normal_loads_converges_to_the_elastica() -> None:
    """Tip angle beyond 90 degrees, where no load along y could bend it to."""
    command = 1.7 * np.array([3.0, 5.0, 9.0, 14.0, 6.0])
    _, EI, mass = stiffnesses(THICK_ARM)
    first = 3.516 * np.sqrt(EI / mass) / THICK_ARM.length_m**2
    arm = following(damped(THICK_ARM, 2.0 * first))
    expected = _follower_reference(THICK_ARM, FACES, command, FACES[1:])
    assert np.degrees(expected[2, -1]) > 95.0
    errors = []
    for cells in (20, 40):
        plant = ArmPlant(PlantParameters(arm, tuple(FACES), 1.0 / first, cells=cells))
        for tick in range(40):
            plant.advance(command * min(1.0, 0.1 * (tick + 1)), tick)
        assert plant.energy()[0] < 1e-12 * sum(plant.energy())
        errors.append(np.max(np.abs(plant.shape_at(FACES[1:]) - expected[:2].T)))
    assert 1.6 < np.log2(errors[0] / errors[1]) < 2.4
    assert errors[1] < 2e-3 * THICK_ARM.length_m


def test_normals_stand_across_the_mean_direction_of_the_edges() -> None:
    position, _ = _shape_and_velocity(5)
    EA, EI, _ = stiffnesses(THICK_ARM)
    force = ElasticForce(Grid(CELLS, THICK_ARM.length_m), EA, EI)
    force.evaluate(position)
    found = np.empty(CELLS, dtype=complex)
    force.normals(found)
    angles = np.angle(np.diff(position))
    middle = np.append(0.5 * (angles[1:] + angles[:-1]), angles[-1]) + 0.5 * math.pi
    np.testing.assert_allclose(found, np.exp(1j * middle), atol=1e-13)


def test_a_normal_load_on_a_straight_arm_is_a_transverse_one_at_first() -> None:
    sides = []
    for arm in (CHAPTER_ARM, following(CHAPTER_ARM)):
        plant = ArmPlant(PlantParameters(arm, TWO, 0.05, cells=24))
        for tick in range(3):
            plant.advance(np.array([1e-4, 2e-4]), tick)
        sides.append(plant.measure())
    np.testing.assert_allclose(sides[1], sides[0], rtol=1e-6)
    assert not np.array_equal(sides[1], sides[0])
