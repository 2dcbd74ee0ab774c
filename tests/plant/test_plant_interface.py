"""What the plant's process sees: parameters, sensors, truth, shape, energy, faults."""

import re

import numpy as np
import pytest
from plant_arms import CHAPTER_ARM, SETPOINT_CURVATURE, THICK_ARM, Array, stiffnesses

from plant.disturbance import DisturbanceSpec
from plant.initial import InitialShape, legendre_profile
from plant.model import ArmPlant, PlantParameters
from wire.artefact import Arm
from wire.errors import UsageError

TEN = tuple(np.linspace(0.0, 1.0, 11))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tick_s": 0.0}, "tick_s"),
        ({"tick_s": float("inf")}, "tick_s"),
        ({"cells": 39}, "at least 40"),
        ({"cfl_safety": 1.0}, "cfl_safety"),
        ({"faces_m": (0.0, 0.5)}, "faces_m"),
    ],
)
def test_wrong_parameters_are_refused_by_name(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"arm": CHAPTER_ARM, "faces_m": TEN, "tick_s": 0.5}
    with pytest.raises(UsageError, match=message):
        PlantParameters(**(arguments | change))  # type: ignore[arg-type]


@pytest.mark.parametrize("faces", [TEN, (0.0, 0.03, 0.2, 0.31, 0.66, 0.97, 1.0)])
def test_truth_at_rest_is_the_shape_asked_for(faces: tuple[float, ...]) -> None:
    """Also between the points of a grid that shares none with the faces."""

    def strain(s_m: Array) -> Array:
        return np.asarray(0.05 * np.cos(2.0 * s_m))

    curvature = legendre_profile(SETPOINT_CURVATURE, 1.0)
    parameters = PlantParameters(CHAPTER_ARM, faces, 0.5, InitialShape(curvature, strain), cells=43)
    truth = ArmPlant(parameters).truth()
    inner, outer = np.array(faces[:-1]), np.array(faces[1:])
    exact = np.polynomial.Legendre(SETPOINT_CURVATURE, domain=[0.0, 1.0])
    np.testing.assert_allclose(truth[:, :2], 0.0, atol=0.0)
    np.testing.assert_allclose(truth[:, 2], strain(0.5 * (inner + outer)), atol=1e-6)
    np.testing.assert_allclose(truth[:, 3], exact(inner), atol=1e-6)


def test_measurements_are_the_sensed_columns_of_the_truth() -> None:
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5))
    for tick in range(8):
        plant.advance(np.linspace(-2e-3, 5e-3, 10), tick)
    truth, measured = plant.truth(), plant.measure()
    assert measured.shape == (10, 2)
    np.testing.assert_array_equal(measured, truth[:, [1, 3]])
    assert np.min(np.abs(truth[:, 3])) > 0.0


def test_velocities_are_the_rate_of_the_shape() -> None:
    """Positions at three ticks give the velocity between: the sensors' faces and signs agree."""
    faces = (0.0, 0.13, 0.5, 0.77, 1.0)
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, faces, 0.05, cells=40))
    shapes, velocities = [], []
    for tick in range(120):
        plant.advance(np.array([0.01, 0.03, -0.02, 0.05]), tick)
        shapes.append(plant.shape_at(faces[1:]))
        velocities.append(plant.truth()[:, :2])
    rate = (shapes[-1] - shapes[-3]) / 0.1
    np.testing.assert_allclose(velocities[-2], rate, atol=2e-3 * np.max(np.abs(rate)))


def test_shape_tip_and_interpolated_shape_agree() -> None:
    initial = InitialShape(lambda s_m: np.full_like(s_m, 2.0))
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5, initial, cells=80))
    assert plant.shape().shape == (81, 2)
    np.testing.assert_array_equal(plant.shape()[0], 0.0)
    np.testing.assert_array_equal(plant.shape()[-1], plant.tip())
    points = np.array([0.0, 0.111, 0.5, 1.0])
    for _ in range(2):  # the second time from the kept matrix
        circle = 0.5 * np.stack([np.sin(2.0 * points), 1.0 - np.cos(2.0 * points)], axis=1)
        np.testing.assert_allclose(plant.shape_at(points), circle, atol=1e-4)
    np.testing.assert_allclose(plant.shape_at([1.0])[0], plant.tip(), atol=1e-14)


def test_energies_of_known_shapes() -> None:
    EA, EI, mass = stiffnesses(THICK_ARM)
    initial = InitialShape(lambda s: np.full_like(s, 2.0), lambda s: np.full_like(s, 0.1))
    plant = ArmPlant(PlantParameters(THICK_ARM, (0.0, 0.7), 1e-4, initial, cells=40))
    kinetic, axial, bending = plant.energy()
    assert kinetic == 0.0
    assert axial == pytest.approx(0.5 * EA * 0.01 * 0.7)
    assert bending == pytest.approx(0.5 * EI * 4.0 * 0.7 * (1.0 - 0.5 / 40))  # the tip has none
    limp = ArmPlant(PlantParameters(THICK_ARM, (0.0, 0.7), 1e-4, cells=40))
    limp.advance(np.array([50.0]), 0)  # too short for any elastic answer inside the arm
    speed = 50.0 / mass * 1e-4
    assert limp.energy()[0] == pytest.approx(0.5 * mass * 0.7 * speed**2, rel=0.03)


def test_disturbance_and_command_push_alike() -> None:
    pushed, disturbed = (
        ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5, disturbance=spec))
        for spec in (DisturbanceSpec(), DisturbanceSpec("step", 3e-3))
    )
    for tick in range(10):
        pushed.advance(np.full(10, 3e-3), tick)
        disturbed.advance(np.zeros(10), tick)
    np.testing.assert_allclose(pushed.shape(), disturbed.shape(), atol=1e-13)
    assert pushed.tip()[1] > 1e-3


def test_disturbance_is_evaluated_at_the_time_of_the_tick() -> None:
    """A step at 2.2 s leaves the arm alone through ticks 0 to 3 of 0.5 s and moves it in tick 4."""
    spec = DisturbanceSpec("step", 1e-2, start_s=2.2)
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5, disturbance=spec))
    moved = []
    for tick in range(6):
        plant.advance(np.zeros(10), tick)
        moved.append(plant.tip()[1] != 0.0)
    assert moved == [False] * 4 + [True] * 2


def test_held_command_does_not_depend_on_how_ticks_are_cut() -> None:
    ends = []
    for parts in (1, 2):
        plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5 / parts, cells=40, cfl_safety=0.1))
        for tick in range(20 * parts):
            plant.advance(np.full(10, 2e-3), tick)
        ends.append(plant.shape())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


def test_command_of_wrong_shape_is_refused() -> None:
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5))
    with pytest.raises(ValueError, match=re.escape("expected shape (10,), got (9,)")):
        plant.advance(np.zeros(9), 0)


def test_finite_state_has_no_complaint() -> None:
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5))
    plant.advance(np.zeros(10), 0)
    assert plant.first_non_finite() is None


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_command_is_named_with_its_place(bad: float) -> None:
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5))
    command = np.zeros(10)
    command[3] = bad
    plant.advance(command, 0)
    assert plant.first_non_finite() == f"plant command force_n_per_m at s = 0.4 m is {bad}"


def test_blow_up_is_named_and_raises_no_warning() -> None:
    limp = Arm("limp", 1.0, 0.025, 1e-9, 1.1e3, 0.0)
    plant = ArmPlant(PlantParameters(limp, TEN, 100.0))
    plant.advance(np.full(10, 1e307), 0)
    found = plant.first_non_finite()
    assert found is not None
    assert re.match(r"plant (position|velocity)_?\w* ?\w* at s = [0-9.]+ m is (nan|-?inf)", found)


def test_caller_may_reuse_the_command_array() -> None:
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5))
    command = np.zeros(10)
    plant.advance(command, 0)
    command[0] = float("nan")
    assert plant.first_non_finite() is None


def test_a_plant_whose_state_is_put_back_moves_as_before() -> None:
    plant, other = (ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5)) for _ in range(2))
    push = np.linspace(-2e-3, 5e-3, 10)
    for tick in range(4):
        plant.advance(push, tick)
    kept = plant.state
    other.state = kept
    for moving in (plant, other):
        moving.advance(push, 4)
    np.testing.assert_array_equal(other.state, plant.state)
    assert np.abs(plant.state - kept).max() > 1e-6  # a copy: the arm went on, the kept one did not
    x, y = plant.tip()
    np.testing.assert_array_equal(plant.state[78:80], [x, y])
