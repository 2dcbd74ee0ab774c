"""The baselines: gains of others against other solvers of the same equation, truncation, scales, the table."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import linalg
from simulated_run import make_artefact

from analysis.study import baselines, feedbacks, riccati
from analysis.study.feedbacks import sampled_gain, scales, state_norm, truncated
from analysis.study.riccati import Gains, Problem, solve
from analysis.study.simulate import with_feedback
from deploy import SegmentGrid, deploy
from deploy.step import make_loop
from design.arm_file import time_unit_s
from design.channel import Channel
from design.verify import arm_matrices, controller_channel
from wire.errors import OctarmError, UsageError

WEIGHTS = {"measurement_noise": 0.1, "control_effort": 0.1}
GAINS = msgspec.structs.replace(make_artefact(), weights=WEIGHTS)
N = 3
DEPLOYED = deploy(GAINS, N, 0.1)
BENT = GAINS.setpoints[GAINS.setpoint_index("bent")]
LOOP = make_loop(GAINS.arm, BENT, SegmentGrid(DEPLOYED.faces_m))
MATRICES = arm_matrices(GAINS.arm, BENT, N)
PROBLEM = Problem(
    MATRICES.A, MATRICES.disturbance, MATRICES.force, MATRICES.outputs, MATRICES.measure, 0.1, 0.1
)
GAMMA = 0.4
installed = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in riccati.PACKAGES),
    reason="the extra `baselines` is not installed",
)


def by_scipy(problem: Problem, gamma: float) -> Gains:
    """The state feedback by QZ; a controller that does nothing in hinfsyn's place."""
    weight = np.diag([-(gamma**2)] + [problem.effort**2] * problem.B2.shape[1])
    inputs = np.hstack([problem.B1, problem.B2])
    X = linalg.solve_continuous_are(problem.A, inputs, problem.C1.T @ problem.C1, weight)
    n, y, u = len(X), len(problem.C2), problem.B2.shape[1]
    K = -problem.B2.T @ X / problem.effort**2
    return Gains(K, -np.eye(n), np.zeros((n, y)), np.zeros((u, n)), 0.5)


def test_the_scales_are_those_of_the_design() -> None:
    state, command, output = scales(LOOP, MATRICES, GAINS.arm)
    time = time_unit_s(GAINS.arm)
    np.testing.assert_allclose(time * state[:, None] * LOOP.model.A / state, MATRICES.A, atol=1e-9)
    np.testing.assert_allclose(command[:, None] * LOOP.K / state, MATRICES.K, rtol=1e-10)
    np.testing.assert_allclose(
        time * state[:, None] * LOOP.L / output, MATRICES.L, rtol=1e-10, atol=1e-12
    )


def test_our_own_gain_sampled_by_the_study_is_the_deployed_one() -> None:
    step = DEPLOYED.dense[GAINS.setpoint_index("bent")]
    again = with_feedback(step, sampled_gain(LOOP, LOOP.K, 0.1))
    np.testing.assert_allclose(again.M, step.M, rtol=1e-9, atol=1e-15)


def test_a_truncated_gain_keeps_two_neighbours() -> None:
    dense = np.ones((5, 20))
    kept = truncated(dense)
    assert [int(np.count_nonzero(row)) // 4 for row in kept] == [2, 3, 3, 3, 2]
    assert np.all(kept[2, 4:16] == 1.0)


def test_the_norm_of_a_state_feedback_on_its_own_and_on_finer_grids() -> None:
    faces, arm = DEPLOYED.faces_m, GAINS.arm
    own = state_norm(arm, BENT, faces, LOOP.K, 0.1)
    assert own == pytest.approx(controller_channel(MATRICES, 0.1).hinf_norm(), rel=1e-6)
    nothing = np.zeros((N, 4 * N))
    open_loop = controller_channel(arm_matrices(arm, BENT, 2 * N), 0.1, closed=False).hinf_norm()
    assert state_norm(arm, BENT, faces, nothing, 0.1, 2) == pytest.approx(open_loop, rel=1e-6)
    # so little gain that samples feed no mode that the nodes' grid has not: it does on all grids the same
    kept = [
        state_norm(arm, BENT, faces, 0.02 * LOOP.K, 0.1, k)
        / state_norm(arm, BENT, faces, nothing, 0.1, k)
        for k in (1, 2, 3)
    ]
    np.testing.assert_allclose(kept[1:], kept[0], rtol=0.03)
    assert kept[0] < 0.9


@installed
def test_slycot_solves_the_riccati_equation_and_hinfsyn_its_problem() -> None:
    found = solve(PROBLEM, GAMMA)
    np.testing.assert_allclose(found.K, by_scipy(PROBLEM, GAMMA).K, rtol=1e-5, atol=1e-6)
    closed = controller_channel(dataclasses.replace(MATRICES, K=found.K), 0.1)
    assert closed.hinf_norm() <= GAMMA
    # hinfsyn's loop, closed by hand: disturbance and noise to outputs and command
    n, y = len(MATRICES.A), len(MATRICES.measure)
    A = np.block([[MATRICES.A, MATRICES.force @ found.C], [found.B @ MATRICES.measure, found.A]])
    B = np.block(
        [[MATRICES.disturbance, np.zeros((n, y))], [np.zeros((len(found.A), 1)), 0.1 * found.B]]
    )
    C = np.block(
        [
            [MATRICES.outputs, np.zeros((2, len(found.A)))],
            [np.zeros((len(found.C), n)), 0.1 * found.C],
        ]
    )
    norm = Channel(A, B, C, np.zeros((len(C), B.shape[1]))).hinf_norm()
    assert norm <= found.gamma * (1.0 + 1e-4)
    assert norm >= 0.5 * found.gamma


@installed
def test_a_solver_that_hangs_is_ended() -> None:
    with pytest.raises(OctarmError, match=r"within 0\.01 s"):
        solve(PROBLEM, GAMMA, time_limit_s=0.01)


def test_missing_packages_are_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(riccati, "PACKAGES", ("numpy", "no_such_package"))
    with pytest.raises(UsageError, match=r"not installed: no_such_package; .*baselines"):
        solve(PROBLEM, GAMMA)


def test_a_gain_that_is_no_solution_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(problem: Problem, gamma: float) -> Gains:
        return dataclasses.replace(by_scipy(problem, gamma), K=np.zeros((N, 4 * N)))

    monkeypatch.setattr(feedbacks, "solve", wrong)
    with pytest.raises(OctarmError, match="no solution of the Riccati equation"):
        feedbacks.make_feedbacks(GAINS, BENT, DEPLOYED)


def test_the_comparison_from_gains_to_table(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(feedbacks, "solve", by_scipy)
    told: list[str] = []
    facts = baselines.run(
        GAINS, told.append, setpoints=["bent"], nodes=N, ticks=250, plant_cells=12, jobs=1
    )
    facts = json.loads(json.dumps(facts, allow_nan=False))
    assert len(told) == 2
    rows: dict[str, dict[str, Any]] = {row["feedback"]: row for row in facts["rows"]}
    assert list(rows) == [
        "ours", "ours, truncated", "dense, slycot", "dense, truncated", "output, hinfsyn", "passive",
    ]  # fmt: skip
    assert [row["messages"] for row in rows.values()] == [4, 8, 10, 8, 6, 0]
    dense, passive = rows["dense, slycot"], rows["passive"]
    optimum = facts["optimum"]["bent"]
    assert optimum * (1.0 - 1e-3) <= dense["gamma"] <= feedbacks.SLACK * optimum
    assert dense["gamma"] < rows["ours"]["gamma"] < passive["gamma"]
    assert dense["loop_gamma"] < passive["loop_gamma"]
    assert passive["rms_n_per_m"] == 0.0 < dense["rms_n_per_m"] < dense["peak_n_per_m"]
    # the controller that does nothing is the passive arm
    idle = rows["output, hinfsyn"]
    assert idle["tip_course_mm"] == passive["tip_course_mm"]
    assert idle["loop_gamma"] == pytest.approx(passive["loop_gamma"], rel=1e-6)
    text = baselines.table(facts)
    assert max(map(len, text.splitlines())) <= 112
    line = next(line for line in text.splitlines() if "dense, slycot" in line)
    assert f"{dense['gamma']:.4f}" in line
    assert line.split()[-2:] == ["10", "4"]
    unstable = {**facts, "rows": [{**dense, "gamma": None}, {**idle, "setpoint": "bent"}]}
    shown = baselines.table(unstable).splitlines()[3:5]
    assert [line.split()[4] for line in shown] == ["inf", "-"]
    baselines.plot(facts, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
