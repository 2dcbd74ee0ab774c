"""Distributed transverse disturbances by name: the load in N/m that nobody commanded.

Chosen in the run configuration, evaluated by the plant at the times of its substeps, as functions
of (t, s).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wire.artefact import Arm
from wire.errors import UsageError

Array = npt.NDArray[np.float64]
Disturbance = Callable[[Array, Array], Array]
"""From times (m,) in s and arclengths (p,) in m to transverse loads (m, p) in N/m."""


@dataclass(frozen=True)
class DisturbanceSpec:
    """Name and parameters of a disturbance, uniform along the arm.

    | name | load in N/m |
    |---|---|
    | none | 0 |
    | chapter | amplitude * pi r^2 * sin(t) / (10 t), t in s (section 4.1 of the chapter) |
    | sine | amplitude * sin(frequency_rad_per_s * t) |
    | gust | amplitude * sin^2(pi (t - start_s) / duration_s) during duration_s, else 0 |
    | step | amplitude from t = start_s on, 0 before |

    `amplitude` is in N/m, but for "chapter" it is a factor without unit: the chapter uses the
    volume density 1.1e3 kg/m^3 as a mass per length (theory, section 1), so its w is read as a body
    force in N/m^3 and multiplied by the area of the cross-section; the acceleration w / rho is then
    the chapter's. Raises UsageError for an unknown name or a parameter that is not finite or out of
    range.
    """

    name: str = "none"
    amplitude: float = 1.0
    frequency_rad_per_s: float = 1.0
    start_s: float = 0.0
    duration_s: float = 10.0

    def __post_init__(self) -> None:
        if self.name not in _BUILDERS:
            raise UsageError(f"disturbance {self.name!r} is not known; known: {', '.join(NAMES)}")
        for key in ("amplitude", "frequency_rad_per_s", "start_s", "duration_s"):
            value = getattr(self, key)
            if not math.isfinite(value):
                raise UsageError(f"disturbance {self.name!r}: {key} must be finite, got {value!r}")
        if self.duration_s <= 0.0:
            raise UsageError(
                f"disturbance {self.name!r}: duration_s must be positive, got {self.duration_s!r}"
            )


def make_disturbance(spec: DisturbanceSpec, arm: Arm) -> Disturbance:
    """The disturbance as a function of times and arclengths, see `Disturbance`."""
    signal = _BUILDERS[spec.name](spec, arm)

    def load(t_s: Array, s_m: Array) -> Array:
        return np.repeat(signal(np.asarray(t_s))[:, None], np.size(s_m), axis=1)

    return load


_Signal = Callable[[Array], Array]


def _none(spec: DisturbanceSpec, arm: Arm) -> _Signal:  # noqa: ARG001
    return np.zeros_like


def _chapter(spec: DisturbanceSpec, arm: Arm) -> _Signal:
    area = math.pi * arm.radius_m**2
    scale = 0.1 * spec.amplitude * area
    return lambda t: np.asarray(scale * np.sinc(t / np.pi))


def _sine(spec: DisturbanceSpec, arm: Arm) -> _Signal:  # noqa: ARG001
    return lambda t: np.asarray(spec.amplitude * np.sin(spec.frequency_rad_per_s * t))


def _gust(spec: DisturbanceSpec, arm: Arm) -> _Signal:  # noqa: ARG001
    def signal(t: Array) -> Array:
        phase = np.clip((t - spec.start_s) / spec.duration_s, 0.0, 1.0)
        return np.asarray(spec.amplitude * np.sin(np.pi * phase) ** 2)

    return signal


def _step(spec: DisturbanceSpec, arm: Arm) -> _Signal:  # noqa: ARG001
    return lambda t: np.where(t >= spec.start_s, spec.amplitude, 0.0)


_BUILDERS: dict[str, Callable[[DisturbanceSpec, Arm], _Signal]] = {
    "none": _none,
    "chapter": _chapter,
    "sine": _sine,
    "gust": _gust,
    "step": _step,
}
NAMES = tuple(_BUILDERS)
NO_DISTURBANCE = DisturbanceSpec()
