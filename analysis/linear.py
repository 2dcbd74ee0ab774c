"""The estimation on the design's own model: what the gains do where the model is exact.

Besides the figures measured on the emulated arm, which is nonlinear, is disturbed and has bending
modes that the grid has not: the same initial error, iterated by the error maps of the deployed
linear model alone,

    observer         xh(k+1) - x(k+1) = M_xx (xh(k) - x(k))
    open-loop model  xh(k+1) - x(k+1) = (M_xx + M_xy C) (xh(k) - x(k)),

from xh(k+1) = M_xx xh + M_xu u + M_xy y (theory, section 5) and from the model's own arm, which is
the same without innovation: x(k+1) = (M_xx + M_xy C) x + M_xu u, y = C x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.metrics import time_below
from analysis.open_loop import MEASURED, THRESHOLD
from analysis.recording import Recording
from deploy import DenseStep
from wire.channels import STATE

Array = npt.NDArray[np.float64]

LONGEST_S = 3600.0
"""The iteration ends here, in s of the arm's time."""
MOST_TICKS = 1 << 18
"""The iteration ends here also, whatever the tick."""
SAFELY = 0.1
"""It ends as soon as the error has been below this share of the threshold for a whole block."""
BEYOND = 1e8
"""An error that is this many times the first one does not come back."""
_BLOCK = 128


@dataclass(frozen=True)
class LinearDecay:
    """When the error of the linear model is below 1 % for good, energy norm, in s.

    None if it is not within `LONGEST_S` (and `MOST_TICKS`), or if there is no initial error.
    """

    observer_s: float | None
    open_loop_model_s: float | None


def error_maps(step: DenseStep) -> tuple[Array, Array]:
    """Maps of the estimation error over one tick, observer and open-loop model, each (4n, 4n)."""
    states, inputs = len(STATE), len(STATE) + 1 + len(MEASURED)
    blocks = step.M.reshape(-1, states + 1, step.M.shape[1] // inputs, inputs)[:, :states]
    size = states * blocks.shape[0]
    observer = blocks[..., :states].copy()
    model = observer.copy()
    model[..., MEASURED] += blocks[..., states + 1 :]
    return observer.reshape(size, size), model.reshape(size, size)


def decay_time(
    error_map: Array,
    initial_error: Array,
    weights: Array,
    tick_s: float,
    threshold: float = THRESHOLD,
) -> float | None:
    """First time from which |map^k e(0)| stays below threshold * |e(0)|, energy norm, in s.

    error_map: (4n, 4n); initial_error: (n, 4), SI; weights: (n, 4), `energy_norm`. See
    `LinearDecay` for None.
    """
    scale = np.sqrt(weights).ravel()  # in scaled states the energy norm is the Euclidean one
    start = scale * initial_error.ravel()
    first = float(np.linalg.norm(start))
    if not math.isfinite(first) or first == 0.0:
        return None
    one = scale[:, None] * error_map / scale
    block = (start / first)[:, None]
    power = one
    while block.shape[1] < _BLOCK:  # states of ticks 0 .. _BLOCK - 1 as columns
        block = np.concatenate([block, power @ block], axis=1)
        power = power @ power
    most = int(min(LONGEST_S / tick_s, MOST_TICKS))
    shares: list[Array] = []
    for _ in range(0, most + 1, _BLOCK):
        share: Array = np.linalg.norm(block, axis=0)
        shares.append(share)
        if not np.all(share < BEYOND):
            return None
        if np.all(share < SAFELY * threshold):
            break
        block = power @ block
    course: Array = np.asarray(np.concatenate(shares), dtype=np.float64)
    times: Array = np.arange(course.size, dtype=np.float64) * tick_s
    return time_below(times, course, threshold)


def linear_decay(recording: Recording) -> LinearDecay:
    """Both times from the recording's own initial error, without noise and disturbance."""
    if recording.ticks == 0:
        return LinearDecay(None, None)
    step = recording.deployment.dense[recording.configuration.setpoint_index]
    error = recording.estimates[0] - recording.truth[0]
    observer, model = (
        decay_time(one, error, recording.energy_weights, recording.tick_s)
        for one in error_maps(step)
    )
    return LinearDecay(observer, model)
