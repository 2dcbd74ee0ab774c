"""The feedbacks that `analysis.study.baselines` compares, each as a tick of the whole loop.

From the gains artefact (ours) and `analysis.study.riccati` (others', on the same discretised linear arm with
the same weights) to matrices that `analysis.study.simulate` runs.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from analysis.study.loop import design_weights
from analysis.study.riccati import Gains, Problem, solve
from analysis.study.simulate import with_feedback
from deploy import DenseStep, Deployment, Place, SegmentGrid
from deploy.feedforward import profiles
from deploy.step import Loop, make_loop, make_step
from design.arm_file import time_unit_s
from design.channel import riccati_optimum
from design.verify import ArmMatrices, arm_matrices, controller_channel, measured_rows
from wire.artefact import Arm, GainsArtefact, Setpoint
from wire.errors import OctarmError
from wire.factors import BACKWARD_EXTRA, FORWARD_EXTRA

Array = npt.NDArray[np.float64]

SLACK = 1.05
"""The dense state feedback is asked for this multiple of the optimum, at which itself gains are infinite."""
BAND = 1
"""A truncated gain keeps this many neighbours on each side."""


@dataclass(frozen=True, eq=False)
class Feedback:
    """One row: what turns measurements into commands, and what that costs in messages."""

    name: str
    step: DenseStep
    """The whole tick, observer and feedback."""
    gain: Array | None
    """(n, 4n), SI: the continuous state feedback; None if it is none of the state."""
    messages: int
    """A tick, observer included."""
    feedback_messages: int
    """Of these for the feedback; ours travels with the observer's."""
    numbers: str
    """In a message of the feedback, where two are given forward and backward; ours has the observer's in it."""


def make_feedbacks(
    artefact: GainsArtefact, setpoint: Setpoint, deployment: Deployment
) -> tuple[float, float, list[Feedback]]:
    """All feedbacks at one setpoint.

    First the least norm of any state feedback on the deployment's grid, and the norm that hinfsyn says its
    output feedback has there.
    """
    index = artefact.setpoint_index(setpoint.name)
    ours, n, arm = deployment.dense[index], len(deployment.nodes), artefact.arm
    noise, effort = design_weights(artefact)
    loop = make_loop(arm, setpoint, SegmentGrid(deployment.faces_m))
    matrices = arm_matrices(arm, setpoint, n, deployment.faces_m.tolist())
    optimum = riccati_optimum(
        matrices.A, matrices.disturbance, matrices.outputs, matrices.force, effort
    )
    problem = Problem(
        matrices.A,
        matrices.disturbance,
        matrices.force,
        matrices.outputs,
        matrices.measure,
        effort,
        noise,
    )
    gains = solve(problem, SLACK * optimum)
    _check(matrices, gains, effort, SLACK * optimum)
    state_scale, command_scale, output_scale = scales(loop, matrices, arm)
    dense = gains.K * state_scale / command_scale[:, None]
    observer, all_pairs = 2 * (n - 1), n * (n - 1)
    forward = max(deployment.ranks_forward[index]) + FORWARD_EXTRA
    backward = max(deployment.ranks_backward[index]) + BACKWARD_EXTRA

    def sampled(gain: Array, *, band: bool) -> DenseStep:
        matrix = sampled_gain(loop, gain, deployment.tick_s)
        return with_feedback(ours, truncated(matrix) if band else matrix)

    passive = np.zeros((n, 4 * n))
    return (
        optimum,
        gains.gamma,
        [
            Feedback("ours", ours, loop.K, observer, 0, f"{forward}/{backward}"),
            Feedback(
                "ours, truncated",
                sampled(loop.K, band=True),
                truncated(loop.K),
                2 * observer,
                observer,
                "4",
            ),
            Feedback(
                "dense, slycot",
                sampled(dense, band=False),
                dense,
                observer + all_pairs,
                all_pairs,
                "4",
            ),
            Feedback(
                "dense, truncated",
                sampled(dense, band=True),
                truncated(dense),
                2 * observer,
                observer,
                "4",
            ),
            Feedback(
                "output, hinfsyn",
                _hinfsyn_step(gains, ours, deployment, arm, command_scale, output_scale),
                None,
                all_pairs,
                all_pairs,
                "2",
            ),
            Feedback("passive", with_feedback(ours, passive), passive, 0, 0, "-"),
        ],
    )


def _check(matrices: ArmMatrices, gains: Gains, effort: float, gamma: float) -> None:
    """OctarmError unless the state feedback has the norm that it was asked for (slycot does not say)."""
    closed = controller_channel(dataclasses.replace(matrices, K=gains.K), effort)
    if not closed.hinf_norm() <= gamma * (1.0 + 1e-6):
        raise OctarmError(
            f"baselines: control.care's gain has the norm {closed.hinf_norm():.4f} on its own grid, asked for "
            f"{gamma:.4f}; it is no solution of the Riccati equation"
        )


def scales(loop: Loop, matrices: ArmMatrices, arm: Arm) -> tuple[Array, Array, Array]:
    """Factors from SI to the coordinates of `arm_matrices`: states (4n,), commands (n,), measurements (2n,)."""
    state = loop.state_scale / math.sqrt(arm.bending_stiffness_n_m2 / arm.length_m)
    rate = time_unit_s(arm) * state[:, None] * loop.model.B
    command = np.linalg.norm(rate, axis=0) / np.linalg.norm(matrices.force, axis=0)
    sensors = measured_rows(arm, len(command))
    output = np.zeros(len(loop.model.C))
    seen = np.linalg.norm(loop.model.C / state, axis=1)[sensors]
    output[sensors] = np.linalg.norm(matrices.measure, axis=1) / seen
    return state, command, output


def sampled_gain(loop: Loop, gain: Array, tick_s: float) -> Array:
    """The feedback of one tick (n, 4n), SI, of a continuous one, as `deploy.step` makes ours."""
    step = make_step(dataclasses.replace(loop, K=gain), tick_s)
    return np.asarray(step.feedback * loop.state_scale / loop.command_scale[:, None])


def truncated(gain: Array) -> Array:
    """A gain (n, 4n) with what is further than `BAND` nodes away taken out."""
    n = len(gain)
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= BAND
    return gain * np.repeat(near, 4, axis=1)


def _hinfsyn_step(
    gains: Gains,
    ours: DenseStep,
    deployment: Deployment,
    arm: Arm,
    command_scale: Array,
    output_scale: Array,
) -> DenseStep:
    """hinfsyn's controller over one tick with held measurement; its states in the places of the estimates."""
    n = len(command_scale)
    if len(gains.A) != 4 * n:
        raise OctarmError(
            f"baselines: hinfsyn's controller has {len(gains.A)} states, expected {4 * n}"
        )
    entry = gains.B * output_scale[output_scale > 0.0]
    block = np.zeros((4 * n + entry.shape[1],) * 2)
    block[: 4 * n] = np.hstack([gains.A, entry]) * (deployment.tick_s / time_unit_s(arm))
    over_tick = linalg.expm(block)[: 4 * n]
    push = gains.C / command_scale[:, None]
    M = np.zeros((n, 5, n, 7))
    states = np.zeros((4 * n, n, 7))
    states[:, :, :4] = over_tick[:, : 4 * n].reshape(4 * n, n, 4)
    measured = np.zeros((4 * n, 2 * n))
    measured[:, output_scale > 0.0] = over_tick[:, 4 * n :]
    states[:, :, 5:] = measured.reshape(4 * n, n, 2)
    M[:, :4] = states.reshape(n, 4, n, 7)
    M[:, 4] = np.tensordot(push, states, axes=1)
    return DenseStep(M.reshape(5 * n, 7 * n), ours.in_offset, ours.out_offset)


def state_norm(
    arm: Arm, setpoint: Setpoint, faces_m: Array, gain: Array, effort: float, finer: int = 1
) -> float:
    """H-infinity norm of a state feedback (n, 4n), SI, on the nodes' grid or one that is `finer` times finer.

    The gain takes the true state at the nodes' places, its commands act between them as the plant lets them
    act; disturbance and outputs are those of the design (theory, section 3).
    """
    n = len(faces_m) - 1
    faces = np.interp(np.arange(n * finer + 1) / finer, np.arange(n + 1), faces_m)
    fine, grid = SegmentGrid(faces), SegmentGrid(faces_m)
    matrices = arm_matrices(arm, setpoint, fine.nodes, faces.tolist())
    state, command, _ = scales(make_loop(arm, setpoint, fine), matrices, arm)
    picked = np.zeros((n, 4, fine.nodes, 4))
    node = np.arange(n)
    for component in (0, 1):
        picked[node, component, (node + 1) * finer - 1, component] = 1.0
    for beside in ((finer - 1) // 2, finer // 2):  # the cells at the centre, or the one cell twice
        picked[node, 2, node * finer + beside, 2] += 0.5
    picked[node, 3, node * finer, 3] = 1.0
    acting = profiles(grid, fine.locations_m(Place.OUTER_FACE))
    spread = acting @ gain @ picked.reshape(4 * n, 4 * fine.nodes)
    scaled = command[:, None] * spread / state
    return controller_channel(dataclasses.replace(matrices, K=scaled), effort).hinf_norm()
