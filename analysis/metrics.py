"""Figures of merit of a run as functions of plain arrays: errors, effort, settling times.

Pure mathematics between `analysis.recording`, which supplies the arrays, and the summary and the
plot. K is the number of ticks, n the number of nodes; the state of a node is (v_x, v_y, e, k) in
m/s, m/s, 1, 1/m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wire.errors import UsageError

Array = npt.NDArray[np.float64]


def energy_norm(deviation: Array, weights: Array) -> Array:
    """Square root of the energy of a state deviation, in J^(1/2) (theory, section 2).

    deviation: (..., n, 4) in SI units; weights: (n, 4) such that sum(weights * x**2) is the energy
    in J. Returns shape (...).
    """
    if deviation.shape[-2:] != weights.shape:
        raise UsageError(
            f"energy norm: expected a deviation of shape (..., {weights.shape[0]}, "
            f"{weights.shape[1]}) like the weights, got {deviation.shape}"
        )
    squares: Array = np.einsum("...ij,ij->...", deviation**2, weights)
    return np.sqrt(squares)


NO_INITIAL_ERROR = 1e-6
"""A first value below this share of the largest one is no initial error to be relative to."""


def relative(values: Array) -> Array:
    """The values divided by the first one; NaN throughout if that is not finite or next to nothing.

    Next to nothing: below `NO_INITIAL_ERROR` of the largest value, as when a run starts at rest in its
    setpoint and only a disturbance makes an error.
    """
    if values.size == 0:
        return values.copy()
    first = float(values[0])
    largest = float(np.max(values[np.isfinite(values)], initial=0.0))
    if not math.isfinite(first) or first <= NO_INITIAL_ERROR * largest:
        return np.full(values.shape, np.nan)
    return values / first


def time_below(times_s: Array, values: Array, threshold: float) -> float | None:
    """First time from which the values stay below the threshold to the end of the record, in s.

    None if the last value is not below it (or the record is empty): a value that comes back up has
    not settled. Values that are not finite count as above.
    """
    above = np.flatnonzero(~(values < threshold))
    if values.size == 0 or (above.size and above[-1] == values.size - 1):
        return None
    return float(times_s[above[-1] + 1]) if above.size else float(times_s[0])


def decay_rate(times_s: Array, values: Array) -> float | None:
    """Rate r in 1/s of the fit log(values) = a - r t (least squares) over the record's second half.

    None with fewer than 8 usable samples in that half. A negative rate means growth.
    """
    if times_s.size == 0:
        return None
    late = times_s >= times_s[0] + 0.5 * (times_s[-1] - times_s[0])
    usable = late & np.isfinite(values) & (values > 0.0)
    if int(np.count_nonzero(usable)) < 8:
        return None
    t = times_s[usable] - float(np.mean(times_s[usable]))
    return -float(t @ np.log(values[usable]) / (t @ t))


def extrapolated_time_below(times_s: Array, values: Array, threshold: float) -> float | None:
    """Where the fitted decay of the second half would cross the threshold, in s.

    An estimate, not a measurement, meant for a record in which `time_below` is None. None as well
    if the values do not decay.
    """
    rate = decay_rate(times_s, values)
    if rate is None or rate <= 0.0:
        return None
    late = times_s >= times_s[0] + 0.5 * (times_s[-1] - times_s[0])
    usable = late & np.isfinite(values) & (values > 0.0)
    level = float(np.mean(np.log(values[usable])))
    middle = float(np.mean(times_s[usable]))
    return max(float(times_s[-1]), middle + (level - math.log(threshold)) / rate)


@dataclass(frozen=True)
class ControlEffort:
    """How much force the controller spent."""

    rms_n_per_m: float
    """Root mean square over arm and time."""
    peak_n_per_m: float
    """Largest magnitude of any command."""
    integral_n2_s_per_m: float
    """int int u(s, t)^2 ds dt."""


def control_effort(commands: Array, faces_m: Array, tick_s: float) -> ControlEffort:
    """Effort of the load that the plant applies: linear between faces, constant on the first cell.

    commands: (K, n) in N/m, each held for one tick; ticks with a value that is not finite are left
    out. faces_m: (n + 1,).
    """
    if commands.ndim != 2 or commands.shape[1] != faces_m.size - 1:
        raise UsageError(
            f"control effort: expected commands of shape (K, {faces_m.size - 1}) for "
            f"{faces_m.size} faces, got {commands.shape}"
        )
    commands = commands[np.isfinite(commands).all(axis=1)]
    if commands.size == 0:
        return ControlEffort(0.0, 0.0, 0.0)
    at_faces = np.concatenate([commands[:, :1], commands], axis=1)
    left, right = at_faces[:, :-1], at_faces[:, 1:]
    over_arm = ((left**2 + left * right + right**2) / 3.0) @ np.diff(faces_m)
    length = float(faces_m[-1] - faces_m[0])
    return ControlEffort(
        rms_n_per_m=math.sqrt(float(np.mean(over_arm)) / length),
        peak_n_per_m=float(np.max(np.abs(commands))),
        integral_n2_s_per_m=float(np.sum(over_arm)) * tick_s,
    )
