"""The plant's motion: conservation, decay, frequencies, stability limit, balances, symmetry."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from plant_arms import (
    CHAPTER_ARM,
    SETPOINT_CURVATURE,
    THICK_ARM,
    Array,
    damped,
    stiffnesses,
    undamped,
)
from scipy.interpolate import CubicSpline

from plant.disturbance import DisturbanceSpec
from plant.elastic import ElasticForce
from plant.grid import Grid
from plant.initial import InitialShape, legendre_profile
from plant.model import ArmPlant, PlantParameters, highest_frequency_rad_per_s
from wire.artefact import Arm

TWO = (0.0, 0.5, 1.0)


def _setpoint(scale: float = 1.0) -> InitialShape:
    return InitialShape(legendre_profile([scale * c for c in SETPOINT_CURVATURE], 1.0))


def _energies(parameters: PlantParameters, ticks: int) -> Array:
    plant = ArmPlant(parameters)
    totals = [sum(plant.energy())]
    for tick in range(ticks):
        plant.advance(np.zeros(parameters.segments), tick)
        totals.append(sum(plant.energy()))
    return np.array(totals)


def test_energy_drift_falls_with_the_square_of_the_substep() -> None:
    drifts = []
    for safety in (0.8, 0.4, 0.2):
        parameters = PlantParameters(
            undamped(CHAPTER_ARM), TWO, 0.5, _setpoint(4.0), cells=40, cfl_safety=safety
        )
        totals = _energies(parameters, 160)
        drifts.append(np.max(np.abs(totals / totals[0] - 1.0)))
    orders = np.log2(np.array(drifts[:-1]) / drifts[1:])
    print("relative energy drifts", drifts, "orders", orders)
    assert drifts[0] < 2e-3
    assert np.all((orders > 1.7) & (orders < 2.3))


def test_energy_does_not_creep_in_a_long_run() -> None:
    """Ten bending periods: the mean over the last equals that over the first (symplectic)."""
    parameters = PlantParameters(undamped(CHAPTER_ARM), TWO, 0.5, _setpoint(4.0), cells=24)
    totals = _energies(parameters, 1340)
    first, last = np.mean(totals[:134]), np.mean(totals[-134:])
    assert abs(last / first - 1.0) < 2e-4


def test_drag_takes_energy_out_at_its_rate() -> None:
    drag = 0.02
    parameters = PlantParameters(damped(CHAPTER_ARM, drag), TWO, 0.5, _setpoint(), cells=24)
    totals = _energies(parameters, 402)  # three periods of 67 s
    assert np.all(np.diff(totals) <= 1e-5 * totals[:-1])
    assert -np.log(totals[-1] / totals[0]) == pytest.approx(drag * 201.0, rel=0.1)


def test_drag_alone_is_integrated_exactly() -> None:
    """A stiffness near zero leaves v_t = f / rhoA - d v, whose solution is known."""
    arm = Arm("limp", 1.0, 0.025, 1e-9, 1.1e3, 0.8)
    plant = ArmPlant(PlantParameters(arm, TWO, 2.0, cells=8))
    for tick in range(3):
        plant.advance(np.array([0.01, 0.01]), tick)
    _, _, mass = stiffnesses(arm)
    expected = 0.01 / mass / 0.8 * -np.expm1(-0.8 * 6.0)
    np.testing.assert_allclose(plant.measure()[:, 0], expected, rtol=1e-6)


def _frequency(
    arm: Arm, initial: InitialShape, cells: int, tick_s: float, read: Callable[[ArmPlant], float]
) -> float:
    """Angular frequency from the first two zero crossings of a sensor, half a period apart."""
    plant = ArmPlant(
        PlantParameters(
            arm,
            (0.0, 0.5 * arm.length_m, arm.length_m),
            tick_s,
            initial,
            cells=cells,
            cfl_safety=0.4,
        )
    )
    values = [read(plant)]
    signs = 0
    while signs < 2:
        plant.advance(np.zeros(2), len(values) - 1)
        values.append(read(plant))
        signs = int(np.sum(np.diff(np.sign(values)) != 0))
    roots = CubicSpline(np.arange(len(values)) * tick_s, values).roots(extrapolate=False)
    return float(np.pi / (roots[1] - roots[0]))


@pytest.mark.parametrize("arm", [CHAPTER_ARM, THICK_ARM], ids=["chapter", "thick"])
def test_first_bending_frequency_converges_to_the_clamped_free_beam(arm: Arm) -> None:
    _, EI, mass = stiffnesses(arm)
    beta = 1.8751040687119611
    ratio = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))

    def curvature(s_m: Array) -> Array:
        x = beta * s_m / arm.length_m
        return np.asarray(
            1e-5 * (np.cosh(x) + np.cos(x) - ratio * (np.sinh(x) + np.sin(x))) / arm.length_m
        )

    exact = beta**2 * np.sqrt(EI / mass) / arm.length_m**2
    errors = [
        _frequency(
            undamped(arm),
            InitialShape(curvature),
            cells,
            0.05 / exact,
            lambda plant: float(plant.tip()[1]),
        )
        / exact
        - 1.0
        for cells in (8, 16, 32)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    print("bending: relative errors", errors, "orders", orders)
    assert np.all((orders > 1.8) & (orders < 2.2))
    assert abs(errors[-1]) < 1e-3


@pytest.mark.parametrize("arm", [CHAPTER_ARM, THICK_ARM], ids=["chapter", "thick"])
def test_first_axial_frequency_converges_to_the_fixed_free_bar(arm: Arm) -> None:
    EA, _, mass = stiffnesses(arm)
    exact = 0.5 * np.pi * np.sqrt(EA / mass) / arm.length_m

    def strain(s_m: Array) -> Array:
        return np.asarray(1e-4 * np.cos(0.5 * np.pi * s_m / arm.length_m))

    errors = [
        _frequency(
            undamped(arm),
            InitialShape(strain=strain),
            cells,
            0.05 / exact,
            lambda plant: float(plant.tip()[0]) - arm.length_m,
        )
        / exact
        - 1.0
        for cells in (8, 16, 32)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    print("axial: relative errors", errors, "orders", orders)
    assert np.all((orders > 1.8) & (orders < 2.2))
    assert abs(errors[-1]) < 1e-3


def test_whole_integrator_is_of_second_order_in_time() -> None:
    """Drag, held commands, a disturbance: halving the substep quarters the change.

    The run is short, for the phases of the highest frequencies to be resolved at all.
    """
    ends = []
    for safety in (0.08, 0.04, 0.02, 0.01):
        parameters = PlantParameters(
            CHAPTER_ARM,
            TWO,
            0.5,
            _setpoint(2.0),
            DisturbanceSpec("sine", 1e-3, 2.0),
            cells=20,
            cfl_safety=safety,
        )
        plant = ArmPlant(parameters)
        for tick in range(8):
            plant.advance(np.array([1e-3, -2e-3]) * np.cos(0.3 * tick), tick)
        ends.append(plant.shape())
    changes = [np.max(np.abs(b - a)) for a, b in pairwise(ends)]
    orders = np.log2(np.array(changes[:-1]) / changes[1:])
    print("time: changes", changes, "orders", orders)
    assert np.all((orders > 1.6) & (orders < 2.4))


def _true_highest_frequency(arm: Arm, position: np.ndarray) -> float:
    """From the stiffness found by differences of the forces, with lumped masses."""
    grid = Grid(position.size - 1, arm.length_m)
    EA, EI, mass = stiffnesses(arm)
    force = ElasticForce(grid, EA, EI)
    columns = []
    small = 1e-6 * grid.step_m
    for direction in (1.0, 1j):
        for node in range(1, position.size):
            ends = []
            for sign in (1.0, -1.0):
                moved = position.copy()
                moved[node] += sign * small * direction
                force.evaluate(moved)
                ends.append(force.kick.copy())
            change = (ends[1] - ends[0]) / (2.0 * small * mass * grid.step_m)
            columns.append(np.concatenate([change.real, change.imag]))
    return float(np.sqrt(np.max(np.linalg.eigvals(np.array(columns).T).real)))


@pytest.mark.parametrize("cells", [8, 40, 100])
@pytest.mark.parametrize("bend_per_m", [0.0, 6.0])
@pytest.mark.parametrize("stretch", [0.8, 1.0])
def test_stability_limit_is_below_the_true_one_and_close(
    cells: int, bend_per_m: float, stretch: float
) -> None:
    step = CHAPTER_ARM.length_m / cells
    edges = stretch * step * np.exp(1j * bend_per_m * step * (np.arange(cells) + 0.5))
    position = np.concatenate([[0.0], np.cumsum(edges)])
    true = _true_highest_frequency(CHAPTER_ARM, position)
    bound = highest_frequency_rad_per_s(CHAPTER_ARM, Grid(cells, 1.0), stretch)
    assert true <= bound
    assert bound < 1.5 * true


def test_substeps_follow_the_grid_and_the_compression() -> None:
    parameters = PlantParameters(CHAPTER_ARM, TWO, 0.5, cells=100)
    plain = ArmPlant(parameters).substeps()
    assert 3.5 < ArmPlant(replace(parameters, cells=200)).substeps() / plain < 4.1
    squeezed = InitialShape(strain=lambda s: np.full_like(s, -0.3))
    more = ArmPlant(PlantParameters(CHAPTER_ARM, TWO, 0.5, squeezed, cells=100)).substeps()
    assert 1.3 < more / plain < 1.5


def test_just_below_the_stability_limit_the_roughest_motion_stays_bounded() -> None:
    def rough(s_m: Array) -> Array:
        return np.where(np.arange(s_m.size) // 2 % 2 == 0, 0.3, -0.3)

    parameters = PlantParameters(
        undamped(CHAPTER_ARM), TWO, 0.5, InitialShape(rough), cells=100, cfl_safety=0.99
    )
    totals = _energies(parameters, 40)
    assert np.max(totals) < 20.0 * totals[0]


def test_momentum_changes_by_loads_and_clamp_alone() -> None:
    """With one substep a tick both balances hold to rounding, whatever the motion."""
    arm = undamped(THICK_ARM)
    cells, load = 16, 0.4
    step = arm.length_m / cells
    parameters = PlantParameters(
        arm, (0.0, 0.35, 0.7), 1e-3, InitialShape(lambda s: 3.0 - 4.0 * s), cells=cells
    )
    plant = ArmPlant(parameters)
    assert plant.substeps() == 1
    mass = stiffnesses(arm)[2] * np.concatenate([[0.0], np.full(cells - 1, step), [0.5 * step]])
    forces = load * np.concatenate([[0.0], np.full(cells - 1, step), [0.5 * step]])

    def momenta(before: Array, after: Array) -> tuple[Array, float]:
        # Leapfrog: both half kicks act at known positions, the drift between them changes neither.
        velocity = (after - before) / parameters.tick_s
        momentum = mass[:, None] * velocity
        turn = before[:, 0] * momentum[:, 1] - before[:, 1] * momentum[:, 0]
        return momentum.sum(axis=0), float(turn.sum())

    shapes, reactions = [plant.shape()], []
    for tick in range(50):
        plant.advance(np.array([load, load]), tick)
        shapes.append(plant.shape())
        reactions.append(plant.clamp_reaction())
    dt = parameters.tick_s
    largest = max(abs(r[2]) for r in reactions)
    for k in range(1, 50):
        p0, h0 = momenta(shapes[k - 1], shapes[k])
        p1, h1 = momenta(shapes[k], shapes[k + 1])
        fx, fy, moment = reactions[k - 1]
        x = shapes[k][:, 0]
        np.testing.assert_allclose((p1 - p0) / dt, [fx, fy + forces.sum()], atol=1e-8 * largest)
        assert (h1 - h0) / dt == pytest.approx(moment + forces @ x, abs=1e-8 * largest)


def test_mirrored_loads_give_the_mirrored_motion() -> None:
    sides = []
    for sign in (1.0, -1.0):
        parameters = PlantParameters(
            CHAPTER_ARM,
            (0.0, 0.2, 0.5, 0.9, 1.0),
            0.25,
            _setpoint(sign * 3.0),
            DisturbanceSpec("sine", sign * 2e-3, 1.5),
            cells=33,
        )
        plant = ArmPlant(parameters)
        for tick in range(40):
            plant.advance(sign * np.array([2e-3, -1e-3, 3e-3, 1e-3]), tick)
        sides.append((plant.shape(), plant.truth(), plant.energy()))
    (shape, truth, energy), (shape2, truth2, energy2) = sides
    np.testing.assert_allclose(shape, shape2 * [1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(truth, truth2 * [1.0, -1.0, 1.0, -1.0], atol=1e-11)
    np.testing.assert_allclose(energy, energy2, rtol=1e-10)
    assert np.max(np.abs(shape[:, 1])) > 0.1


def test_two_runs_are_equal_to_the_last_bit() -> None:
    ends = []
    for _ in range(2):
        plant = ArmPlant(
            PlantParameters(CHAPTER_ARM, TWO, 0.5, _setpoint(), DisturbanceSpec("chapter"))
        )
        for tick in range(20):
            plant.advance(np.array([1e-3, 2e-3]), tick)
        ends.append(plant.truth())
    assert np.array_equal(ends[0], ends[1])
