"""The in-process loop against a recorded run of the nodes' own sweeps; its faults against their definitions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from simulated_run import Scenario, make_artefact, write_recording

from analysis.recording import read_recording
from analysis.study.simulate import Simulation, simulate
from plant.disturbance import NO_DISTURBANCE, DisturbanceSpec
from wire.errors import UsageError
from wire.run_config import NoiseConfig

GAINS = make_artefact()
QUIET: dict[str, Any] = {"disturbance": NO_DISTURBANCE, "noise": NoiseConfig()}


def run(ticks: int = 30, **choices: Any) -> Simulation:
    return simulate(GAINS, setpoint="bent", ticks=ticks, nodes=5, **choices)


def test_it_gives_the_numbers_of_a_run(tmp_path: Path) -> None:
    scenario = Scenario(ticks=40, disturbance="chapter", spacing="chebyshev")
    write_recording(tmp_path / "run.mcap", scenario, GAINS)
    recording = read_recording(tmp_path / "run.mcap")
    ours = run(
        40,
        spacing="chebyshev",
        disturbance=DisturbanceSpec("chapter"),
        noise=NoiseConfig(*scenario.noise),
        seed=scenario.seed,
    )
    for got, expected in (
        (ours.truth, recording.truth),
        (ours.measurements, recording.measurements),
        (ours.estimates, recording.estimates),
        (ours.commands_n_per_m, recording.commands),
        (ours.tip_m, recording.of_plant("tip", ("x_m", "y_m"))),
        (ours.times_s, recording.times_s),
    ):
        np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-11 * np.abs(expected).max())
    assert ours.diverged_at is None


def test_a_late_measurement_is_the_one_of_that_many_ticks_ago() -> None:
    late = run(delay_ticks=2, **QUIET)
    # the plant's truth at the sensors' places, without noise
    seen = late.truth[:, :, [1, 3]]
    for got, expected in (
        (late.measurements[2:], seen[:-2]),
        (late.measurements[:2], seen[[0, 0]]),
    ):
        np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-14)


def test_a_dead_sensor_reads_zero_and_a_dead_actuator_pushes_nothing() -> None:
    broken = run(dead_sensors=[1], dead_actuators=[3])
    assert np.all(broken.measurements[:, 1] == 0.0)
    assert np.all(broken.measurements[1:, 0] != 0.0)
    assert np.all(broken.applied_n_per_m[:, 3] == 0.0)
    assert np.all(broken.commands_n_per_m[:, 3] != 0.0)
    others = [0, 1, 2, 4]
    np.testing.assert_array_equal(
        broken.applied_n_per_m[:, others], broken.commands_n_per_m[:, others]
    )


def test_other_feedback_takes_the_estimate_of_its_own_tick() -> None:
    matrix = np.random.default_rng(4).normal(scale=1e-3, size=(5, 20))
    found = run(feedback=matrix)
    deviation = (found.estimates - found.equilibrium[:, :4]).reshape(30, 20)
    expected = found.equilibrium[:, 4] + deviation @ matrix.T
    np.testing.assert_allclose(found.commands_n_per_m, expected, rtol=0.0, atol=1e-15)
    passive = run(feedback=np.zeros((5, 20)))
    assert np.all(passive.commands_n_per_m == passive.equilibrium[:, 4])


def test_the_arm_that_moves_can_be_another_than_the_gains_are_for() -> None:
    arm, held = GAINS.arm, np.zeros((5, 20))
    heavy = msgspec.structs.replace(
        arm, density_kg_per_m3=4.0 * arm.density_kg_per_m3, drag_per_s=0.5 * arm.drag_per_s
    )
    light = run(feedback=held, tick_s=0.06, **QUIET)
    slow = run(feedback=held, tick_s=0.12, plant_arm=heavy, **QUIET)
    # four times the mass under the same forces: the same motion in twice the time, exactly
    np.testing.assert_allclose(slow.tip_m, light.tip_m, rtol=1e-12)
    assert np.linalg.norm(light.tip_m[-1] - light.tip_m[0]) > 0.05


def test_a_loop_that_runs_away_ends_where_numbers_are_not_finite() -> None:
    wild = 1e4 * np.eye(5, 20, k=1)
    found = run(200, feedback=wild)
    assert found.diverged_at is not None
    assert len(found.tip_error_m) == len(found.estimates) == found.diverged_at < 200


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"dead_sensors": [5]}, "dead_sensors: expected nodes 0..4, got 5"),
        ({"dead_actuators": [-1]}, "dead_actuators"),
        ({"delay_ticks": -1}, "delay"),
        ({"feedback": np.zeros((5, 5))}, r"expected shape \(5, 20\)"),
        ({"initial": "banana"}, "banana"),
    ],
)
def test_wrong_choices_are_refused(choices: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        run(**choices)
