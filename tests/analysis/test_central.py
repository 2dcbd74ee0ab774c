"""The centralised reference: agrees with a sound run, and finds where an unsound one departs."""

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from simulated_run import Scenario, make_artefact, write_recording

from analysis.central import compare_with_central
from analysis.open_loop import compare_with_open_loop, open_loop_run
from analysis.recording import Recording, read_recording
from analysis.table import Table
from deploy import DenseStep, deploy
from wire.channels import COMMAND, STATE

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module", params=["bent", "straight"])
def recording(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Recording:
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(path, Scenario(nodes=6, ticks=200, setpoint=request.param))
    return read_recording(path)


def altered(recording: Recording, topic: str, field: str, tick: int, value: float) -> Recording:
    table = recording.tables[topic]
    column = table.column(field).astype(np.float64)
    column[tick] = value
    changed = Table(topic, {**table.columns, field: column})
    return dataclasses.replace(recording, tables={**recording.tables, topic: changed})


def test_a_sound_run_agrees_to_rounding(recording: Recording) -> None:
    comparison = compare_with_central(recording)
    assert comparison.worst.relative < 1e-12
    assert comparison.first_above_tolerance is None
    assert comparison.ticks == 200
    assert comparison.missing == 0
    assert comparison.per_tick.shape == (200,)
    assert list(comparison.per_quantity) == [*STATE, *COMMAND]


@pytest.mark.parametrize("field", STATE)
def test_one_flipped_bit_is_found_with_tick_node_and_field(
    recording: Recording, field: str
) -> None:
    topic, tick, node = "/node/04/estimate", 77, 4
    true = recording.tables[topic].column(field)[tick]
    if abs(true) < 1e-6:  # v_x and e vanish at the straight setpoint: the lowest exponent bit
        flipped = 1e-6
    else:
        bits = np.float64(true).view(np.uint64) ^ np.uint64(1 << 24)  # a change of 4e-9
        flipped = float(bits.view(np.float64))
    comparison = compare_with_central(altered(recording, topic, field, tick, flipped))
    for found in (comparison.worst, comparison.first_above_tolerance):
        assert found is not None
        assert (found.tick, found.node, found.quantity) == (tick, node, field)
        assert found.recorded == flipped
        assert found.central == pytest.approx(true, rel=1e-9, abs=1e-12)
    assert int(np.count_nonzero(comparison.per_tick > 1e-12)) == 1


def test_one_wrong_command_is_found(recording: Recording) -> None:
    changed = altered(recording, "/node/00/command", "force_n_per_m", 3, 0.5)
    worst = compare_with_central(changed).worst
    assert (worst.tick, worst.node, worst.quantity) == (3, 0, "force_n_per_m")


def test_one_wrong_measurement_shows_from_the_next_tick_on(recording: Recording) -> None:
    topic = "/node/02/measurement"
    changed = altered(recording, topic, "curvature_per_m", 50, 9.0)
    first = compare_with_central(changed).first_above_tolerance
    assert first is not None
    assert first.tick == 51


def test_the_recomputed_step_is_the_one_of_the_theory(tmp_path: Path) -> None:
    """u(k) enters xh(k+1) as the load that accelerates the arm: dv = h u / (rho A)."""
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=3, ticks=2, tick_s=1e-3))
    recording = read_recording(path)
    step = recording.deployment.dense[recording.configuration.setpoint_index]
    inputs = step.in_offset.reshape(3, 7).copy()
    inputs[1, 4] += 0.1
    change = step(inputs) - step.out_offset.reshape(3, 5)
    mass = recording.artefact.arm.mass_per_length_kg_per_m
    assert change[1, 1] == pytest.approx(1e-3 * 0.1 / mass, rel=1e-2)


def resting(step: DenseStep, start: Array, commands: Array) -> Array:
    """The open-loop model around a setpoint that does not change."""
    reference = step.out_offset.reshape(-1, 5)
    active = np.zeros(len(commands), dtype=np.int64)
    return open_loop_run([step], active, lambda _: reference, start, commands)


def test_the_open_loop_model_comes_to_rest_as_a_cantilever_under_its_load() -> None:
    """k(s) = q (L - s)^2 / (2 EI) under a uniform load q; the motion is damped by e^-6 by then."""
    artefact = make_artefact()
    nodes, load = 12, 1e-4
    step = deploy(artefact, nodes, 0.1).dense[artefact.setpoint_index("straight")]
    loads = np.full((6000, nodes), load)
    rest = resting(step, np.zeros((nodes, 4)), loads)[-200:]
    s = np.arange(nodes) / nodes
    expected = load * (1.0 - s) ** 2 / (2.0 * artefact.arm.bending_stiffness_n_m2)
    assert rest[:, :, 3].mean(axis=0) == pytest.approx(expected, abs=0.03 * expected[0])
    assert np.abs(rest[:, :, :2]).max() < 1e-4


def test_the_open_loop_model_does_not_know_the_observers_gain() -> None:
    random = np.random.default_rng(4)
    start, commands = random.standard_normal((5, 4)) * 1e-2, random.standard_normal((80, 5)) * 1e-3
    weak, strong = (
        resting(deploy(make_artefact(gain), 5, 0.05).dense[1], start, commands)
        for gain in (0.05, 0.6)
    )
    assert np.abs(weak).max() > 1e-2
    assert np.abs(weak - strong).max() < 1e-12


def test_without_correction_the_error_decays_by_the_arms_damping_only(tmp_path: Path) -> None:
    """The model's error is the arm's free motion; its energy decays by the drag."""
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=4, ticks=1500, setpoint="straight", noise=(0.0, 0.0)))
    recording = read_recording(path)
    observer, model = (errors.energy for errors in compare_with_open_loop(recording))
    assert model.relative[0] == observer.relative[0] == 1.0
    assert model.decay_per_s == pytest.approx(0.5 * recording.artefact.arm.drag_per_s, rel=0.3)
    assert model.below_1_percent_s is None
    assert model.below_1_percent_extrapolated_s is not None
    assert model.below_1_percent_extrapolated_s > 150.0
    assert observer.norm[-1] < 0.5 * model.norm[-1]
