"""The sampled loop as a linear map: against closed forms of a cantilever and the nonlinear simulation."""

from __future__ import annotations

import math
from collections import deque

import msgspec
import numpy as np
import pytest
from simulated_run import make_artefact

from analysis.study.loop import (
    Case,
    Rest,
    bilinear,
    closed_loop,
    decay_per_s,
    exact_arm,
    find_rest,
    linear_arm,
    loop_channel,
    radius,
)
from analysis.study.simulate import simulate
from deploy import deploy
from plant.disturbance import DisturbanceSpec
from plant.model import ArmPlant, PlantParameters
from wire.run_config import NoiseConfig

GAINS = make_artefact()
N, TICK, CELLS = 4, 0.1, 16
DEPLOYED = deploy(GAINS, N, TICK)
BENT = GAINS.setpoint_index("bent")
PARAMETERS = PlantParameters(GAINS.arm, tuple(DEPLOYED.faces_m.tolist()), TICK, cells=CELLS)
STEP, SETPOINT = DEPLOYED.dense[BENT], GAINS.setpoints[BENT]


def test_the_differentiated_plant_is_a_damped_cantilever() -> None:
    parameters = PlantParameters(GAINS.arm, tuple(DEPLOYED.faces_m.tolist()), TICK, cells=32)
    arm = exact_arm(parameters, ArmPlant(parameters).state, np.zeros(N))
    values = np.linalg.eigvals(arm.transition)
    # drag in proportion to mass: every mode that swings fades with half of it
    np.testing.assert_allclose(
        np.abs(values), math.exp(-0.5 * GAINS.arm.drag_per_s * TICK), rtol=1e-7
    )
    first = np.min(np.abs(np.angle(values))) / TICK
    bending = GAINS.arm.bending_stiffness_n_m2 / GAINS.arm.mass_per_length_kg_per_m
    exact = math.sqrt(1.8751040687**4 * bending - 0.25 * GAINS.arm.drag_per_s**2)
    assert first == pytest.approx(exact, rel=1e-2)
    # a uniform load is all commands alike: constant on the first segment, linear between equals
    np.testing.assert_allclose(arm.load[:, 0], arm.force.sum(axis=1), atol=1e-7)


@pytest.mark.parametrize(
    "case",
    [Case(), Case(delay_ticks=2), Case(dead_sensors=(1,), dead_actuators=(2,))],
    ids=["nominal", "late", "dead"],
)
def test_the_loop_moves_about_its_place_of_rest_as_the_map_says(case: Case) -> None:
    rest = find(case)
    plant, m = ArmPlant(PARAMETERS), len(rest.plant_state)
    matrix = closed_loop(rest.arm, STEP, case)
    z = 1e-6 * np.random.default_rng(5).standard_normal(len(matrix))
    plant.state = rest.plant_state
    y_rest, truth_rest = plant.measure(), plant.truth()
    y_rest[list(case.dead_sensors)] = 0.0
    plant.state = rest.plant_state + z[:m]
    node_rest = rest.node_state.reshape(N, 5)
    nodes = node_rest + z[m : m + 5 * N].reshape(N, 5)
    late = deque(z[m + 5 * N :].reshape(case.delay_ticks, N, 2))  # of the tick before comes first
    moved, expected = [], []
    for _ in range(15):
        moved.append(np.concatenate([plant.truth() - truth_rest, nodes - node_rest], axis=1))
        own = z[m : m + 5 * N].reshape(N, 5)
        expected.append(np.concatenate([(rest.arm.truth @ z[:m]).reshape(N, 4), own], axis=1))
        y = plant.measure()
        y[list(case.dead_sensors)] = 0.0
        late.appendleft(y - y_rest)
        command = nodes[:, 4].copy()
        command[list(case.dead_actuators)] = 0.0
        plant.advance(command, 0)
        nodes = STEP(np.concatenate([nodes, y_rest + late.pop()], axis=1))
        z = matrix @ z
    difference = np.abs(np.array(moved) - expected).max(axis=(0, 1))
    assert np.all(difference < 5e-3 * np.abs(expected).max(axis=(0, 1)))
    # the design's linear arm shares none of this code and is nearly the same arm at this setpoint
    other = radius(closed_loop(linear_arm(GAINS.arm, SETPOINT, DEPLOYED), STEP, case))
    assert decay_per_s(radius(matrix), TICK) == pytest.approx(decay_per_s(other, TICK), rel=0.25)


def test_late_enough_measurements_make_the_loop_grow() -> None:
    arm = linear_arm(GAINS.arm, SETPOINT, DEPLOYED)
    decays = [
        decay_per_s(radius(closed_loop(arm, STEP, Case(delay_ticks=d))), TICK) for d in (0, 4)
    ]
    assert decays[0] > 0.005 > -0.005 > decays[1]


def test_the_norm_at_rest_is_the_shift_that_a_steady_load_makes() -> None:
    """A slow load moves the means of curvature and command to new values: the nonlinear loop's at the end."""
    load = 1e-5
    slow = msgspec.structs.replace(GAINS.arm, drag_per_s=0.15)  # comes to rest soon
    case = Case(plant_arm=slow)
    channel = loop_channel(find(case).arm, STEP, case, DEPLOYED, GAINS.arm, noise=0.1, effort=0.2)
    static = (channel.D - channel.C @ np.linalg.solve(channel.A, channel.B))[:, 0]
    ends = []
    for amplitude in (-load, load):
        run = simulate(
            GAINS,
            setpoint="bent",
            ticks=3000,
            plant_arm=slow,
            initial="setpoint",
            disturbance=DisturbanceSpec("step", amplitude),
            noise=NoiseConfig(),
            plant_cells=CELLS,
            deployment=DEPLOYED,
        )
        ends.append((run.truth[-1, :, 3], run.commands_n_per_m[-1]))
    bend, push = (0.5 * (up - down) for down, up in zip(*ends, strict=True))
    units = GAINS.arm.bending_stiffness_n_m2 / load  # the arm is 1 m long
    width = np.array([0.125, 0.25, 0.25, 0.25])
    assert static[1] == pytest.approx(units * float(width @ bend), rel=2e-3)
    share = np.array([0.375, 0.25, 0.25, 0.125])  # the first from the clamp on
    np.testing.assert_allclose(static[2:], 0.2 * np.sqrt(share) * push / load, rtol=2e-3)
    assert abs(static[0]) < 1e-6  # no mean velocity
    assert np.linalg.norm(static) <= channel.hinf_norm()


def find(case: Case) -> Rest:
    rest = find_rest(DEPLOYED, STEP, SETPOINT, GAINS.arm, case, CELLS)
    assert rest is not None
    return rest


@pytest.mark.parametrize(("a", "peak"), [(0.8, 5.0), (-0.5, 2.0)])
def test_the_bilinear_transform_keeps_the_norm(a: float, peak: float) -> None:
    """x(k+1) = a x + w has its peak 1 / (1 - |a|) at frequency 0, or at that of the sampling."""
    one = np.eye(1)
    assert bilinear(a * one, one, one, 2.0).hinf_norm() == pytest.approx(peak, rel=1e-3)


def test_an_arm_without_a_place_of_rest_has_none() -> None:
    """Elastic enough that the held load would turn it over."""
    soft = msgspec.structs.replace(GAINS.arm, youngs_modulus_pa=1.0)
    assert find_rest(DEPLOYED, STEP, SETPOINT, GAINS.arm, Case(plant_arm=soft), CELLS) is None
