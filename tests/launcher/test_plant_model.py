"""Runs of real processes with the source chapter's models of the plant (`plant_model` in the scenario)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from closed_form import artefact

from analysis.info import info
from analysis.info_table import info_table
from analysis.recording import read_recording
from analysis.render import render
from analysis.summary import summary_of
from deploy import deploy
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from supervise.options import RunOptions
from supervise.scenario import settle
from wire.artefact import write_artefact
from wire.errors import UsageError

if TYPE_CHECKING:
    from conftest import Start

TICKS = 200
SCENARIO = f"""
name = "model"
start = "straight"
hold_s = {TICKS / 10}
initial = "chapter"
control = false
plant_model = "MODEL"
"""


def _scenario(tmp_path: Path, model: str, more: str = "") -> Path:
    path = tmp_path / f"{model}.toml"
    path.write_text(SCENARIO.replace("MODEL", model) + more)
    return path


def test_the_estimate_finds_an_arm_that_moves_by_4(start: Start, tmp_path: Path) -> None:
    """Ten nodes beside (4) on the chapter's ten cells: same numbers as plant and dense step in one process.

    Slopes of 0.017 are below 2.4 sqrt(EI / EA): there (4) does not grow.
    """
    made, gains = artefact(strength=0.05), tmp_path / "gains.json"
    write_artefact(made, gains)
    path = _scenario(tmp_path, "linear")
    path.write_text(
        path.read_text().replace('"straight"', '"1"').replace('"chapter"', '"straight"')
    )
    cli = start("run", "--gains", gains, "--scenario", path, "--json", "--no-plot")
    assert cli.finish() == 0, cli.err
    assert cli.json()["max_difference_to_central"] <= 1e-12
    recording = read_recording(cli.recording())
    assert recording.configuration.plant_model == "linear"
    assert "plant model linear" in render(summary_of(recording)).replace("\n" + 63 * " ", " ")
    assert "plant model linear" in info_table(info(cli.recording()))
    assert recording.configuration.plant_cells == 10
    deployment = deploy(made, 10, 0.1).without_control()
    plant = ArmPlant(
        PlantParameters(
            made.arm,
            tuple(deployment.faces_m.tolist()),
            0.1,
            initial_shape("straight", made.setpoints[1], 1.0),
            model="linear",
            about=initial_shape("setpoint", made.setpoints[1], 1.0),
            holding_n_per_m=tuple(float(one.initial_command[1]) for one in deployment.nodes),
        )
    )
    step = deployment.dense[1]
    state = step.out_offset.reshape(10, 5).copy()
    errors = np.empty((TICKS, 10, 4))
    for k in range(TICKS):
        truth = plant.truth()
        errors[k] = state[:, :4] - truth
        np.testing.assert_allclose(recording.truth[k], truth, rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(recording.estimates[k], state[:, :4], rtol=0.0, atol=1e-10)
        measured = plant.measure()
        plant.advance(state[:, 4], k)
        state = step(np.concatenate([state, measured], axis=1))
    energies = np.sum(deployment.energy_weights * errors**2, axis=1)
    across = np.sqrt(energies[:, 1] + energies[:, 3])  # axial waves of (4) are not measured
    assert np.max(across[-20:]) < 0.1 * across[0]


def test_an_arm_that_leaves_ends_the_run_safely(start: Start, tmp_path: Path) -> None:
    """(2) from the chapter's initial condition; the recording says which model it was."""
    cli = start.run("--scenario", _scenario(tmp_path, "quadratic"), "--no-plot")
    assert cli.finish() == 4
    assert "safety stop" in cli.err
    assert "which has no bound" in cli.err
    recording = read_recording(cli.recording())
    assert recording.configuration.plant_model == "quadratic"
    assert recording.ticks < 20
    assert cli.gone() == {}


def test_the_model_of_the_options_wins_and_both_are_checked(tmp_path: Path) -> None:
    path = _scenario(tmp_path, "linear")
    assert settle(RunOptions(scenario=str(path))).plant_model == "linear"
    changed = settle(RunOptions(scenario=str(path), plant_model="exact"))
    assert (changed.plant_model, changed.plant_cells) == ("exact", 40)
    assert settle(RunOptions(plant_model="quadratic", nodes=12)).plant_cells == 12
    with pytest.raises(UsageError, match="plant model 'cubic' is not known"):
        RunOptions(plant_model="cubic")
    with pytest.raises(UsageError, match=r"scenario .*: plant model 'cubic' is not known"):
        settle(RunOptions(scenario=str(_scenario(tmp_path, "cubic"))))
    with pytest.raises(UsageError, match="plant cells: expected at least 40"):
        settle(RunOptions(plant_cells=20))
    assert settle(RunOptions(plant_cells=20, plant_model="linear")).plant_cells == 20
