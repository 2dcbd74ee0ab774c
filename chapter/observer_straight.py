"""The error dynamics (15) of section 4.1 about the straight arm, on the chapter's grid, gains of three origins.

The straight arm is where the first sector's model is sound on the grid; u and w are then uncoupled, and the
chapter's outputs see w only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.linalg import solve_continuous_are

from chapter.constants import LENGTH_M, Constants
from chapter.observer_gain import LmiGain, solve
from chapter.observer_grid import (
    CELLS,
    INITIAL,
    GridError,
    disturbance,
    grid_error,
    propagate,
)
from chapter.pde import STRAIGHT

Array = npt.NDArray[np.float64]

SAMPLES_PER_UNIT = 2000
"""Time steps in one unit of time; 0.02 s, in which w(t) is linear to 2e-5 of itself."""
NOISE_SHARE = 0.1
"""Noise weight of each output in (16), as a share of the output's norm on the energy states. The chapter
has none (D21 = 0)."""
FIT = (20.0, 40.0)
"""Units of time over which the rate is fitted, without disturbance."""


def unit_s(constants: Constants) -> float:
    """L^2 sqrt(rho / EI): 37.5 s, or 846 s as printed."""
    return LENGTH_M**2 * math.sqrt(constants.mass_kg_m / constants.bending_n_m2)


@dataclass(frozen=True, eq=False)
class Origin:
    """Gains and where they come from; no `gain` is an observer without correction."""

    name: str
    gain: Array | None
    """(4n, 2), SI: e_t = (A + gain C) e."""
    drag_per_s: float = 0.0
    """Of arm and observer; the chapter has none."""


@dataclass(frozen=True, eq=False)
class ErrorRun:
    """What one origin's error does from an initial condition; SI units."""

    origin: Origin
    times_s: Array
    states: Array
    """(times, 4n)."""
    tip_m: Array
    root: Array
    """z: integral of d_s^4 of the error of w, 1/m^2."""
    energy: Array
    """Of the error of w, as a share of the first (square root)."""


@dataclass(frozen=True, eq=False)
class EnergySystem:
    """A grid model in energy states; time in `unit_s`, loads in EI / L^3, outputs as they are with L = 1."""

    A: Array
    B: Array
    outputs: Array
    """(2, m)."""
    noise: Array
    """(2,): weights of the noise on the outputs."""
    scale: Array
    """(m, m): energy state = scale @ state."""

    def lmi(self, epsilon: float) -> LmiGain | None:
        """(16) with <= -epsilon I; z is the second output."""
        return solve(self.A, self.B, self.outputs[1:], self.outputs, self.noise, epsilon)

    def riccati_gain(self) -> Array:
        """Gain (m, 2) of the Kalman filter with a unit load as noise and 1e-6 on every state."""
        weight = np.diag(self.noise**2)
        drive = self.B @ self.B.T + 1e-6 * np.eye(len(self.A))
        P = solve_continuous_are(self.A.T, self.outputs.T, drive, weight)
        return np.asarray(-P @ self.outputs.T @ np.linalg.inv(weight))


def energy_system(
    model: GridError, constants: Constants, part: slice, noise_share: float = NOISE_SHARE
) -> EnergySystem:
    """`part` of a grid model's states in energy states."""
    tau, load = unit_s(constants), constants.bending_n_m2 / LENGTH_M**3
    scale = model.energy[part, part] / math.sqrt(constants.bending_n_m2 / LENGTH_M)
    inverse = np.linalg.inv(scale)
    outputs = model.outputs[:, part] @ inverse
    return EnergySystem(
        A=tau * scale @ model.A[part, part] @ inverse,
        B=tau * load * (scale @ model.B[part])[:, None],
        outputs=outputs,
        noise=noise_share * np.linalg.norm(outputs, axis=1),
        scale=scale,
    )


def grid_lmi(
    constants: Constants, epsilon: float, cells: int = CELLS
) -> tuple[LmiGain | None, Array]:
    """(16) on the straight grid for w alone, with <= -epsilon I; the gain once more in SI, (4n, 2)."""
    model = grid_error(STRAIGHT, constants, cells=cells)
    part = slice(2 * cells, 4 * cells)
    system = energy_system(model, constants, part)
    found, gain = system.lmi(epsilon), np.zeros((4 * cells, 2))
    if found is not None:
        gain[part] = np.linalg.solve(system.scale, found.gain) / unit_s(constants)
    return found, gain


def run(
    constants: Constants,
    origin: Origin,
    *,
    units: float,
    load: float = 1.0,
    initial: Polynomial = INITIAL,
    cells: int = CELLS,
) -> ErrorRun:
    """e_t = (A + L C) e - B w(t) from e_w = -initial, for so many units of time; `load` times w(t)."""
    model, A = closed(constants, origin, cells)
    # the disturbance has its own time, seconds, whatever the arm's is
    step = min(unit_s(constants) / SAMPLES_PER_UNIT, 0.1)
    times = step * np.arange(round(units * unit_s(constants) / step) + 1.0)
    states = propagate(A, -model.B, model.initial(initial), times, load * disturbance(times))
    return _measured(model, origin, times, states)


def _measured(model: GridError, origin: Origin, times: Array, states: Array) -> ErrorRun:
    outputs = states @ model.outputs.T
    sizes = _w_energy(model, states)
    return ErrorRun(origin, times, states, outputs[:, 0], outputs[:, 1], sizes / sizes[0])


def _w_energy(model: GridError, states: Array) -> Array:
    part = slice(2 * model.cells, 4 * model.cells)
    return np.asarray(np.linalg.norm(states[:, part] @ model.energy[part, part].T, axis=1))


def closed(constants: Constants, origin: Origin, cells: int = CELLS) -> tuple[GridError, Array]:
    """The grid model of the straight arm and A + L C."""
    model = grid_error(STRAIGHT, constants, cells=cells, drag_per_s=origin.drag_per_s)
    A = model.A if origin.gain is None else model.A + origin.gain @ model.outputs
    return model, A


def slowest_rate_per_s(constants: Constants, origin: Origin) -> float:
    """Largest real part among the eigenvalues of w's error; u's are not seen by the outputs."""
    model, A = closed(constants, origin)
    part = slice(2 * model.cells, 4 * model.cells)
    return float(np.linalg.eigvals(A[part, part]).real.max())


def growing_pairs(constants: Constants, origin: Origin) -> int:
    """How many pairs of w's error grow."""
    model, A = closed(constants, origin)
    part = slice(2 * model.cells, 4 * model.cells)
    values = np.linalg.eigvals(A[part, part])
    level = 1e-9 * np.abs(values).max()
    return int(np.count_nonzero((values.real > level) & (values.imag > 0.0)))


def first_mode_rate_per_s(constants: Constants, origin: Origin) -> float:
    """Real part of the slowest-turning pair of w's error: what is seen of a smooth error for long."""
    model, A = closed(constants, origin)
    part = slice(2 * model.cells, 4 * model.cells)
    values = np.linalg.eigvals(A[part, part])
    turning = values[values.imag > 1e-6 * np.abs(values).max()]
    return float(turning[np.argmin(np.abs(turning))].real)


def fitted_rate_per_s(constants: Constants, origin: Origin) -> float:
    """Slope of the logarithm of the free error's energy norm over `FIT`, from the time series."""
    model, A = closed(constants, origin)
    tau = unit_s(constants)
    times = np.arange(0.0, FIT[1], 0.05) * tau
    states = propagate(A, -model.B, model.initial(), times, np.zeros(len(times)))
    late = times >= FIT[0] * tau
    return float(np.polyfit(times[late], np.log(_w_energy(model, states[late])), 1)[0])


def below_after_s(times_s: Array, values: Array, share: float) -> float | None:
    """From when on |values| stay below a share of |the first|; None if not by the end."""
    above = np.flatnonzero(~(np.abs(values) < share * abs(float(values[0]))))
    if not above.size:
        return 0.0
    return None if above[-1] == len(values) - 1 else float(times_s[above[-1] + 1])


def at(times_s: Array, values: Array, wanted_s: Sequence[float]) -> list[float]:
    """Largest |values| in the tenth of the record that begins at each time: envelopes, not zero crossings."""
    width = 0.1 * float(times_s[-1])
    found = []
    for start in wanted_s:
        near = (times_s >= start) & (times_s <= start + width)
        found.append(float(np.max(np.abs(values[near]))))
    return found
