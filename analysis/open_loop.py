"""The model alone, as the yardstick of the observer: same arm, same commands, no measurement.

The open-loop model starts where the observer starts (xh(0), observer state zero) and is driven by
the recorded commands with L = 0,

    x(k+1) = S x(k) + F u(k)   in deviations from the reference (theory, section 5),

so its error decays by the arm's own damping only; what the observer is better by is the merit of
the measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.goals import active_setpoints
from analysis.metrics import (
    decay_rate,
    energy_norm,
    extrapolated_time_below,
    relative,
    time_below,
)
from analysis.recording import Recording
from analysis.shape_error import shape_error
from deploy import DenseStep
from wire.channels import MEASUREMENT, STATE

Array = npt.NDArray[np.float64]

MEASURED = [STATE.index(field) for field in MEASUREMENT]
"""Columns of the state that are measured, at the same places: v_y and k."""
THRESHOLD = 0.01
"""The share of the initial error whose crossing is reported."""


def open_loop_run(
    steps: Sequence[DenseStep],
    active: npt.NDArray[np.int64],
    reference: Callable[[int], Array],
    initial_estimates: Array,
    commands: Array,
) -> Array:
    """Estimates of the model without correction at each tick, absolute, SI.

    The observer's own steps with its own estimate in the measurement's place: the innovation
    C xh - y is zero, which is the same as L = 0. active: (K,) which step is used at each tick;
    reference: state and command (n, 5) that are wanted at a tick; initial_estimates: (n, 4);
    commands: (K, n) in N/m, command k held over tick k. Returns (K, n, 4).
    """
    ticks, nodes = commands.shape
    now = reference(0)
    out = np.empty((ticks, nodes, 4))
    inputs = np.empty((nodes, 7))
    inputs[:, :4] = initial_estimates
    for k in range(ticks):
        out[k] = inputs[:, :4]
        inputs[:, 4] = commands[k]
        inputs[:, 5:] = inputs[:, MEASURED]
        then = reference(k + 1)
        inputs[:, :4] = steps[active[k]].about(inputs, now, then)[:, :4]
        now = then
    return out


@dataclass(frozen=True)
class ErrorCourse:
    """Estimation error of one estimator over a run, in one norm."""

    norm: Array
    """(K,) the norm's value, see `EstimationErrors`."""
    relative: Array
    """(K,) the same divided by its value at tick 0."""
    below_1_percent_s: float | None
    """First time from which the relative error stays below 1 % to the end; None if it does not."""
    below_1_percent_extrapolated_s: float | None
    """Where `below_1_percent_s` is None: when the fitted decay would get there, an estimate."""
    decay_per_s: float | None
    """Fitted exponential rate over the second half of the run."""


@dataclass(frozen=True)
class EstimationErrors:
    """Error of one estimator in both norms."""

    energy: ErrorCourse
    """Energy norm of estimate - truth, J^(1/2) (`analysis.metrics.energy_norm`)."""
    shape: ErrorCourse
    """Root-mean-square distance of estimated and true faces, m (`analysis.shape_error`)."""


def error_course(times_s: Array, norm: Array) -> ErrorCourse:
    """What is told of an error over time; times_s and norm: (K,)."""
    share = relative(norm)
    reached = time_below(times_s, share, THRESHOLD)
    return ErrorCourse(
        norm=norm,
        relative=share,
        below_1_percent_s=reached,
        below_1_percent_extrapolated_s=(
            extrapolated_time_below(times_s, share, THRESHOLD) if reached is None else None
        ),
        decay_per_s=decay_rate(times_s, share),
    )


def estimation_errors(recording: Recording, estimates: Array) -> EstimationErrors:
    """Error over time of estimates (K, n, 4), absolute, against the recorded truth."""
    faces = np.asarray(recording.configuration.faces_m)
    times, truth = recording.times_s, recording.truth
    return EstimationErrors(
        energy=error_course(times, energy_norm(estimates - truth, recording.energy_weights)),
        shape=error_course(times, shape_error(estimates, truth, faces)),
    )


def known_commands(recording: Recording) -> tuple[Array, int]:
    """The recorded commands (K, n) and how many of them were lost; for these the last known ones stand."""
    commands = recording.commands.copy()
    lost = ~np.isfinite(commands)
    commands[0, lost[0]] = recording.initial_commands[lost[0]]
    for k in 1 + np.flatnonzero(lost[1:].any(axis=1)):
        commands[k, lost[k]] = commands[k - 1, lost[k]]
    return commands, int(np.count_nonzero(lost))


def compare_with_open_loop(recording: Recording) -> tuple[EstimationErrors, EstimationErrors]:
    """Errors over time of the recorded observer and of the open-loop model, in this order."""
    commands, _ = known_commands(recording)
    model = open_loop_run(
        recording.deployment.dense,
        active_setpoints(recording),
        recording.references.states,
        recording.initial_estimates,
        commands,
    )
    return estimation_errors(recording, recording.estimates), estimation_errors(recording, model)
