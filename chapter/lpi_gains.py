"""Observer gains for the chapter's outputs (22) at its setpoints: stored, re-verified, and in SI units.

The experiment of section 4.1 runs on these. `observer_gains` reads chapter/data/observer_gains.json, which
`write_gains` makes from the programs of `chapter.lpi_solve` (minutes, once); what is not stored is solved.

    xh_t = A xh + L (C xh - y),   y = (y1, y2):
    y1 = w(L), displacement of the tip along y in m;   y2 = int_0^L d_s^4 w ds = -w'''(0) in 1/m^2,

the w-part of the chapter's mean of the fundamental state; times E I it is the root's force along y, N_y(0).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chapter.constants import LENGTH_M, Constants
from chapter.lpi_check import GridArm, error_channel, grid_arm
from chapter.lpi_solve import (
    Outcome,
    Storage,
    Weights,
    coordinates,
    judged,
    observer_problem,
    solve,
)
from chapter.part import Tell
from design import legendre
from design.arm_file import FIRST_BENDING_ROOT
from design.arm_pie import ArmPIE, arm_pie
from design.channel import Channel, riccati_optimum
from design.operators import PIOperator, Shape
from design.setpoint import CHAPTER_SHAPES, Setpoint, from_shape

Array = npt.NDArray[np.float64]

DATA = Path(__file__).parent / "data" / "observer_gains.json"
DAMPING_RATIO = 0.1
"""Of the first mode by the water, as in examples/chapter_arm.toml. The chapter's arm has no damping: then the
inequality leaves nothing below zero for the high modes, and has no solution of this kind."""
DRAG = 2.0 * DAMPING_RATIO * FIRST_BENDING_ROOT**2
ALPHA = 80.0
"""L sqrt(EA / EI) = 2 L / r."""
NOISE = (0.01, 0.1)
"""Weights of the noise on (y1, y2), a tenth of what a unit load does to them (0.12 and 1, nondimensional). With
the chapter's D21 = 0 the problem is singular: the smallest gamma is an infimum that no bounded gain reaches."""
EPSILONS = (1e-3, 1.0, 10.0)
COUNT = 3
GRIDS = (60, 120)
RESOLVED = 300.0
"""Frequency, nondimensional, up to which decay is reported mode by mode: some 20 bending modes of a grid."""


@dataclass(frozen=True)
class ChapterGains:
    """L of one setpoint, and what is known of it. Norms and rates are nondimensional unless a name says SI.

    energy: (4, 2, d) coefficients (orthonormal Legendre, `design.legendre`) of the injection of (y1, y2) into
    (v_x, v_y, e, k), nondimensional; displacement: (2, 2, d) the same injection of e and k as a rate of (u, w).
    """

    setpoint: str
    epsilon: float
    constants: Constants
    outcome: str
    status: str
    gamma: float
    achieved: float
    """On a grid that shares no code with the design, refined and extrapolated."""
    open_loop: float
    optimum: float
    root_force: float
    """Largest gain from (w, noise) to the error of N_y(0) itself, the chapter's z, at frequencies up to
    RESOLVED: measured on the finer grid, not certified."""
    root_force_open_loop: float
    undamped_abscissa: float
    """Largest real part of the error's eigenvalues up to RESOLVED with the same gains and no drag at all."""
    decay: float
    """Slowest of all modes of the finer grid; tends to half the drag for any gain of this kind."""
    first_mode_decay: float
    """Of the first bending mode, which alone is seen in a simulation for long (open loop: half the drag)."""
    certified_decay: float
    """epsilon / (2 |P|), what the inequality promises for every mode."""
    eigenvalue: float
    smallest_p: float
    largest_p: float
    storage: Storage
    energy: Array
    displacement: Array

    @property
    def time_s(self) -> float:
        """Unit of time, L^2 sqrt(rho / EI): 37.5 s, or 846 s with the printed rho."""
        return LENGTH_M**2 * math.sqrt(self.constants.mass_kg_m / self.constants.bending_n_m2)

    @property
    def drag_per_s(self) -> float:
        """Drag per mass and velocity that the design assumes, SI: add -drag u_t, -drag w_t to (4)."""
        return DRAG / self.time_s

    def energy_si(self, s_m: Array) -> Array:
        """Injection into (v_x, v_y [m/s], axial strain, curvature [1/m]) per second at s_m (m,): (4, 2, m).

        Column 0 per metre of y1, column 1 per 1/m^2 of y2.
        """
        tau, length = self.time_s, LENGTH_M
        state = np.array([length / tau, length / tau, 1.0 / ALPHA, 1.0 / length]) / tau
        return state[:, None, None] * self._outputs(self._values(self.energy, s_m))

    def chapter_si(self, s_m: Array) -> Array:
        """Injection into the chapter's states (u [m], u_t, w, w_t [m/s]) per second at s_m (m,): (4, 2, m)."""
        tau, length = self.time_s, LENGTH_M
        v = self._outputs(self._values(self.energy[:2], s_m)) * length / tau**2
        r = self._outputs(self._values(self.displacement, s_m)) * length / tau
        return np.stack([r[0], v[0], r[1], v[1]])

    def _outputs(self, values: Array) -> Array:
        """Per metre of y1 and per 1/m^2 of y2."""
        return np.asarray(values * np.array([1.0 / LENGTH_M, LENGTH_M**2])[:, None])

    @staticmethod
    def _values(coefficients: Array, s_m: Array) -> Array:
        return np.asarray(coefficients @ legendre.basis(s_m / LENGTH_M, coefficients.shape[2]).T)


@cache
def chapter_setpoint(name: str) -> Setpoint:
    """One of Fig. 2 by arclength, degree-4 curvature. Raises KeyError for another name than "1", "2", "3"."""
    return from_shape(name, CHAPTER_SHAPES[name])


@cache
def chapter_pie(name: str) -> ArmPIE:
    """The arm at a setpoint in energy states, nondimensional."""
    setpoint = chapter_setpoint(name)
    return arm_pie(*setpoint.frame(setpoint.frame_degree()), ALPHA, DRAG)


def chapter_grid(name: str, cells: int, drag: float = DRAG) -> GridArm:
    """The arm at a setpoint on the grid that judges."""
    angle = chapter_setpoint(name).angle
    return grid_arm(lambda s: legendre.basis(s, angle.size) @ angle, ALPHA, drag, cells)


def observer_gains(setpoint_name: str, constants: Constants, epsilon: float) -> ChapterGains:
    """The observer of a setpoint ("1", "2", "3") with -epsilon T*T in (18).

    Stored for the EPSILONS; any other epsilon is solved for (some 20 s). The nondimensional problem does not
    depend on `constants`, which set the time scale. Raises KeyError for another setpoint and ArithmeticError
    if the program has no solution.
    """
    chapter_setpoint(setpoint_name)
    for entry in _stored():
        if entry["setpoint"] == setpoint_name and math.isclose(entry["epsilon"], epsilon):
            return _from_entry(entry, constants)
    return design(setpoint_name, constants, epsilon)


def design(name: str, constants: Constants, epsilon: float) -> ChapterGains:
    """Solve, invert P, judge. Raises ArithmeticError if the solver finds nothing."""
    pie, weights = chapter_pie(name), Weights(NOISE, epsilon)
    posed = observer_problem(pie)
    found = solve(posed, weights, COUNT)
    if found.storage is None:
        raise ArithmeticError(f"setpoint {name}, epsilon {epsilon:g}: (18) is {found.outcome}")
    energy = _rounded(found.L.q2)
    L = gain_of(energy)
    P = found.storage.operator(coordinates(posed, COUNT))
    again = judged(posed, weights, found.storage, P, L, found.gamma, found.status)
    compliance = PIOperator.multiplier(np.diag([1.0 / ALPHA, 1.0])[:, :, None])
    moved = (pie.virtual @ compliance @ L.rows([], [2, 3])).q2
    return _verified(name, constants, weights, again, energy, _rounded(moved))


def gain_of(energy: Array) -> PIOperator:
    """L as an operator from R^2 to four functions."""
    return PIOperator.zeros(Shape(0, 4), Shape(2, 0)).replace(q2=energy)


def recheck(gains: ChapterGains) -> Outcome:
    """The verdict on stored gains, from their P and L."""
    posed = observer_problem(chapter_pie(gains.setpoint))
    P = gains.storage.operator(coordinates(posed, COUNT))
    return judged(
        posed, Weights(NOISE, gains.epsilon), gains.storage, P, gain_of(gains.energy), gains.gamma,
        gains.status,
    )  # fmt: skip


def on_grid(arm: GridArm, energy: Array) -> Array:
    """L on a grid, (entries, 2)."""

    def functions(s: Array) -> Array:
        values = np.asarray(energy @ legendre.basis(s, energy.shape[2]).T)
        return values.transpose(1, 0, 2)

    return arm.gain(functions)


def _verified(
    name: str,
    constants: Constants,
    weights: Weights,
    found: Outcome,
    energy: Array,
    displacement: Array,
) -> ChapterGains:
    noise = np.array(weights.noise)
    arms = [chapter_grid(name, cells) for cells in GRIDS]
    loops = [
        tuple(
            error_channel(arm, on_grid(arm, energy), noise, outputs)
            for outputs in (arm.C1, arm.root[None])
        )
        for arm in arms
    ]
    norms = [pair[0].hinf_norm() for pair in loops]
    undamped = chapter_grid(name, GRIDS[1], 0.0)
    without = np.linalg.eigvals(undamped.A + on_grid(undamped, energy) @ undamped.outputs)
    coarse = chapter_grid(name, 24)
    values = np.linalg.eigvals(loops[1][0].A)
    bending = values[(values.imag > 0.0)]
    first = bending[np.argmin(np.abs(bending))]
    return ChapterGains(
        setpoint=name,
        epsilon=weights.epsilon,
        constants=constants,
        outcome=found.outcome,
        status=found.status,
        gamma=found.gamma,
        achieved=max(norms[1], 2.0 * norms[1] - norms[0]),  # first order in the cell
        open_loop=_open_loop(arms[1], arms[1].C1).hinf_norm(),
        optimum=riccati_optimum(
            coarse.A.T, coarse.C1.T, coarse.B.T, (coarse.outputs / noise[:, None]).T, 1.0
        ),
        root_force=band_norm(loops[1][1], RESOLVED),
        root_force_open_loop=band_norm(_open_loop(arms[1], arms[1].root[None]), RESOLVED),
        undamped_abscissa=float(without[np.abs(without) <= RESOLVED].real.max()),
        decay=-float(values.real.max()),
        first_mode_decay=-float(first.real),
        certified_decay=0.5 * weights.epsilon / found.largest_p,
        eigenvalue=found.eigenvalue,
        smallest_p=found.smallest_p,
        largest_p=found.largest_p,
        storage=found.storage or Storage(0.0, 0.0, np.zeros((0, 0))),
        energy=energy,
        displacement=displacement,
    )


def _open_loop(arm: GridArm, outputs: Array) -> Channel:
    return Channel(arm.A, arm.B, outputs, np.zeros((len(outputs), 1)))


def band_norm(channel: Channel, fastest: float) -> float:
    """Largest gain at frequencies up to `fastest`: at every resonance below it and between."""
    poles = np.linalg.eigvals(channel.A)
    resonances = np.abs(poles.imag[np.abs(poles.imag) <= fastest])
    sweep = np.unique(np.concatenate([np.linspace(0.0, fastest, 601), resonances]))
    return max(channel.norm_at(float(omega)) for omega in sweep)


def _rounded(coefficients: Array) -> Array:
    """Without the tail below 1e-11 of the largest coefficient."""
    level = 1e-11 * float(np.abs(coefficients).max())
    return np.asarray(legendre.trim(coefficients, (2,), level))


_NUMBERS = (
    "gamma", "achieved", "open_loop", "optimum", "root_force", "root_force_open_loop",
    "undamped_abscissa", "decay",
    "first_mode_decay", "certified_decay", "eigenvalue", "smallest_p", "largest_p",
)  # fmt: skip


def _entry(gains: ChapterGains) -> dict[str, Any]:
    P = gains.storage
    return {
        "setpoint": gains.setpoint,
        "epsilon": gains.epsilon,
        "outcome": gains.outcome,
        "status": gains.status,
        **{name: float(f"{getattr(gains, name):.8g}") for name in _NUMBERS if name != "gamma"},
        "gamma": gains.gamma,
        "q": P.q,
        "kappa": P.kappa,
        "W": P.W.tolist(),
        "energy": gains.energy.tolist(),
        "displacement": gains.displacement.tolist(),
    }


def _from_entry(entry: Mapping[str, Any], constants: Constants) -> ChapterGains:
    return ChapterGains(
        setpoint=entry["setpoint"],
        epsilon=entry["epsilon"],
        constants=constants,
        outcome=entry["outcome"],
        status=entry["status"],
        **{name: entry[name] for name in _NUMBERS},
        storage=Storage(entry["q"], entry["kappa"], np.array(entry["W"])),
        energy=np.array(entry["energy"]),
        displacement=np.array(entry["displacement"]),
    )


@cache
def _stored() -> tuple[dict[str, Any], ...]:
    return tuple(json.loads(DATA.read_text(encoding="utf-8"))["gains"]) if DATA.exists() else ()


def write_gains(constants: Constants, tell: Tell) -> None:
    """Solve for all setpoints and EPSILONS and write the data file (about four minutes)."""
    entries = []
    for name in CHAPTER_SHAPES:
        for epsilon in EPSILONS:
            gains = design(name, constants, epsilon)
            tell(
                f"setpoint {name}, epsilon {epsilon:g}: {gains.outcome}, gamma {gains.gamma:.4f}, "
                f"achieved {gains.achieved:.4f}, optimum {gains.optimum:.4f}"
            )
            entries.append(_entry(gains))
    DATA.parent.mkdir(exist_ok=True)
    head = {"about": "gains of chapter/lpi_gains.py, nondimensional", "noise": NOISE, "drag": DRAG}
    DATA.write_text(json.dumps({**head, "gains": entries}) + "\n", encoding="utf-8")
    _stored.cache_clear()
