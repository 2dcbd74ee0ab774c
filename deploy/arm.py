"""The arm as the sampled loop meets it: exact in time, on a finer grid than the nodes' (for
checks).

The observer's model steps with a finite tick on the nodes' grid; the arm does neither. High modes,
which the observer turns at a wrong rate or does not have at all, come back through the sensors and
can be fed by the gains. `deploy` asks this module whether they grow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy.grid import SegmentGrid
from deploy.model import make_model
from wire.artefact import Arm

Array = npt.NDArray[np.float64]

FINEST = 4
"""Cells of the arm per segment with few segments."""
CELLS = 100
"""With many segments, as many cells per segment as stay below this number, at least 1."""


@dataclass(frozen=True, eq=False)
class ArmModes:
    """The linear arm at a setpoint in its undamped modes: a_t = -damping a - w b + load u, b_t = w a.

    a and b are m amplitudes of velocity and strain, y = sense_a a + sense_b b in SI. The modes stay apart
    with Kelvin-Voigt damping, which is tau w^2 in each.
    """

    frequency_rad_per_s: Array
    """w, (m,)."""
    damping_per_s: Array
    """drag + tau w^2, (m,)."""
    load: Array
    """(m, n): from the commands in N/m, linear between the faces, constant on the first segment."""
    sense_a: Array
    """(2n, m)."""
    sense_b: Array
    """(2n, m)."""


def make_arm_modes(arm: Arm, curvature_per_m: Sequence[float], grid: SegmentGrid) -> ArmModes:
    """Modes of the arm on the grid whose segments are divided into `FINEST` cells or fewer."""
    n = grid.nodes
    parts = int(np.clip(CELLS // n, 1, FINEST))
    faces = np.interp(np.arange(n * parts + 1) / parts, np.arange(n + 1), grid.faces_m)
    fine = SegmentGrid(faces)
    model = make_model(arm, curvature_per_m, fine)
    size = 4 * fine.nodes
    scale = np.sqrt(2.0 * model.energy_weights).ravel()
    kind = np.tile([True, True, False, False], fine.nodes)
    velocities, strains = np.flatnonzero(kind), np.flatnonzero(~kind)
    rates = (scale[:, None] * model.A0 / scale)[np.ix_(strains, velocities)]
    left, frequency, right = np.linalg.svd(rates)

    corners = np.vstack([np.eye(n)[:1], np.eye(n)])  # the root's face takes the first command
    interpolated = np.stack([np.interp(faces[1:], grid.faces_m, column) for column in corners.T])
    load = right @ (scale[:, None] * (model.B @ interpolated.T))[velocities]

    sensors = np.zeros((n, 2, size))
    node = np.arange(n)
    sensors[node, 0, 4 * ((node + 1) * parts - 1) + 1] = 1.0
    sensors[node, 1, 4 * node * parts + 3] = 1.0
    sense = sensors.reshape(2 * n, size) / scale
    return ArmModes(
        frequency_rad_per_s=frequency,
        damping_per_s=arm.drag_per_s + arm.kelvin_voigt_s * frequency**2,
        load=load,
        sense_a=sense[:, velocities] @ right.T,
        sense_b=sense[:, strains] @ left,
    )


def sample(modes: ArmModes, tick_s: float) -> tuple[Array, Array, Array]:
    """Exact motion over a tick with held commands: transition (2m, 2m), input (2m, n), y (2n, 2m).

    Per mode with M = [[-damping, -w], [w, 0]] the transition is exp(h M) and the input M^-1 (exp(h M)
    - I).
    """
    w, d, h = modes.frequency_rad_per_s, modes.damping_per_s, tick_s
    square = w**2 - 0.25 * d**2
    turns = square >= 0.0
    turn, fade = np.sqrt(np.where(turns, square, 0.0)), np.exp(-0.5 * d * h)
    # exp(-d h / 2) times cosine and sine / turn. Where the mode creeps back without turning these are
    # hyperbolic and may be out of range by themselves, so that the slower exponential is taken out.
    creep = np.sqrt(np.where(turns, 1.0, -square))
    slow, gap = np.exp(-h * w**2 / (0.5 * d + creep)), np.expm1(-2.0 * creep * h)
    cosine = np.where(turns, fade * np.cos(turn * h), slow * (1.0 + 0.5 * gap))
    sine = np.where(turns, fade * (h * np.sinc(turn * h / np.pi)), -0.5 * slow * gap / creep)
    aa, bb = cosine - 0.5 * d * sine, cosine + 0.5 * d * sine
    ba = w * sine
    by_a = ba / w
    by_b = (1.0 - bb) / w
    transition = np.block([[np.diag(aa), np.diag(-ba)], [np.diag(ba), np.diag(bb)]])
    force = np.vstack([by_a[:, None] * modes.load, by_b[:, None] * modes.load])
    return transition, force, np.hstack([modes.sense_a, modes.sense_b])
