"""The robustness table: its cases, its verdicts, the worst node, and what it prints; on closed-form gains."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from simulated_run import make_artefact

from analysis.study import robustness
from analysis.study.loop import Rest
from analysis.study.robustness import CHANGE, cases, settling, verdict
from analysis.study.simulate import Simulation, simulate
from analysis.study.workers import call_all
from wire.errors import UsageError

WEIGHTS = {"measurement_noise": 0.1, "control_effort": 0.1}
GAINS = msgspec.structs.replace(make_artefact(), weights=WEIGHTS)
CHOICES: dict[str, Any] = {"setpoints": ["bent"], "nodes": 2, "ticks": 350, "plant_cells": 8}


@pytest.fixture(scope="module")
def facts() -> dict[str, Any]:
    told: list[str] = []
    found = robustness.run(GAINS, told.append, jobs=1, **CHOICES)
    assert told[-1] == "robustness: 13 cases done"
    return json.loads(json.dumps(found, allow_nan=False))  # type: ignore[no-any-return]


def test_every_fault_of_the_table_is_a_case() -> None:
    all_cases = cases(GAINS.arm, 3)
    names = list(dict.fromkeys(case.name for case in all_cases))
    assert names == [
        "nominal", "E +20%", "E -20%", "rho +20%", "rho -20%", "drag +20%", "drag -20%",
        "one dead sensor", "one dead actuator", "1 tick late", "2 ticks late",
    ]  # fmt: skip
    by = {case.name: case for case in all_cases}
    light = by["rho -20%"].plant_arm
    assert light is not None
    assert light.density_kg_per_m3 == pytest.approx((1.0 - CHANGE) * GAINS.arm.density_kg_per_m3)
    assert light.youngs_modulus_pa == GAINS.arm.youngs_modulus_pa
    assert sorted(case.dead_sensors[0] for case in all_cases if case.dead_sensors) == [0, 1, 2]
    assert sorted(case.dead_actuators[0] for case in all_cases if case.dead_actuators) == [0, 1, 2]


def test_rows_hold_together(facts: dict[str, Any]) -> None:
    rows = {row["case"]: row for row in facts["rows"]}
    assert len(facts["rows"]) == 11
    nominal = rows["nominal"]
    assert nominal["stable"]
    assert nominal["norm_change_percent"] == 0.0
    assert nominal["decay_per_s"] == pytest.approx(nominal["linear_decay_per_s"], rel=0.2)
    # drag is what damps the modes that the gains do not reach
    assert (
        rows["drag -20%"]["decay_per_s"] < nominal["decay_per_s"] < rows["drag +20%"]["decay_per_s"]
    )
    # a softer arm sags further under the same holding load; the mass does not matter at rest
    assert (
        rows["E -20%"]["rest_error_m"]
        > rows["E +20%"]["rest_error_m"]
        > 5.0 * nominal["rest_error_m"]
    )
    assert rows["rho +20%"]["rest_error_m"] == pytest.approx(nominal["rest_error_m"], rel=1e-3)
    for kind in ("one dead sensor", "one dead actuator"):
        each = [row["tip_error_m"] for row in facts["each_node"] if row["case"] == kind]
        assert len(each) == 2
        assert rows[kind]["tip_error_m"] == max(each)


def test_the_table_and_the_plot_show_every_row(facts: dict[str, Any], tmp_path: Path) -> None:
    text = robustness.table(facts)
    lines = text.splitlines()
    assert len(lines) >= 3 + 11 + 2
    assert max(map(len, lines)) <= 112
    nominal = next(line for line in lines if " nominal " in line)
    assert nominal.split()[:3] == ["bent", "nominal", "yes"]
    assert f"{1e3 * facts['rows'][0]['tip_error_m']:.2f}" in nominal
    broken = {
        **facts,
        "rows": [{**facts["rows"][0], "stable": False, "why": "goes elsewhere", "norm": None}],
    }
    assert "setpoint bent, nominal: not stable, goes elsewhere" in robustness.table(broken)
    robustness.plot(facts, tmp_path / "new" / "bars.png")
    assert (tmp_path / "new" / "bars.png").read_bytes().startswith(b"\x89PNG")


def test_workers_answer_in_order_and_hand_errors_on() -> None:
    told: list[int] = []
    arguments = [(2, 5), (7, 2), (3, 3)]
    assert call_all(pow, arguments, 2, told.append) == [32, 49, 27]
    assert told == [1, 2, 3]
    with pytest.raises(ZeroDivisionError):
        call_all(divmod, [(1, 1), (1, 0)], 2)


def test_verdicts() -> None:
    run = simulate(GAINS, setpoint="bent", ticks=20, nodes=2, plant_cells=16)
    rest = Rest(np.zeros(0), np.zeros(0), run.tip_m[-1], None)  # type: ignore[arg-type]
    assert verdict(run, rest, 0.01) == ""
    assert "twofold in 35 s" in verdict(run, rest, -0.02)
    assert verdict(run, None, None) == "no place of rest"
    far = dataclasses.replace(rest, tip_m=run.tip_m[0] + 2.0 * (run.tip_m[-1] - run.tip_m[0]) + 1.0)
    assert verdict(run, far, 0.01) == "goes elsewhere"
    assert verdict(dataclasses.replace(run, diverged_at=7), rest, 0.01) == "not finite from tick 7"


def test_settling_is_to_five_per_cent_of_the_way_to_rest() -> None:
    times = np.arange(200) * 0.1
    tip = np.stack([0.3 + 0.2 * np.exp(-times), np.zeros(200)], axis=1)
    run = simulate(GAINS, setpoint="bent", ticks=1, nodes=2, plant_cells=16)
    moved: Simulation = dataclasses.replace(run, tip_m=tip, tip_error_m=np.zeros(200))
    rest = Rest(np.zeros(0), np.zeros(0), np.array([0.3, 0.0]), None)  # type: ignore[arg-type]
    assert settling(moved, rest) == pytest.approx(math.log(20.0), abs=0.1)
    assert settling(moved, None) is None


@pytest.mark.parametrize(
    ("choices", "words"),
    [({"setpoints": ["9"]}, "'9'"), ({"ticks": 3}, "10 ticks"), ({"nodes": 1}, "at least 2")],
)
def test_wrong_choices_are_refused(choices: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        robustness.run(GAINS, lambda text: None, **{**CHOICES, **choices})


def test_gains_without_the_weights_of_their_design_are_refused() -> None:
    with pytest.raises(UsageError, match="measurement_noise"):
        robustness.run(make_artefact(), lambda text: None, **CHOICES)
