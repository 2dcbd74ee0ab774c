"""Is the loop still stable while a node process is out? Asked before a run in which dead nodes are
replaced.

Beside `deploy.stability`, which asks the same of the whole chain. A node that is out leaves its segments
passive and cuts the chain: on either side the sums of the other are zero, so that the arm there is taken to
be where the reference has it. What is left of a tick's dense matrix are its blocks within the pieces, around
the arm as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from deploy.arm import ArmModes, make_arm_modes, sample
from deploy.deployment import Deployment
from deploy.grid import SegmentGrid
from deploy.stability import GROWTH_PER_S
from deploy.step import Step, make_loop, make_step
from wire.artefact import GainsArtefact
from wire.errors import UsageError
from wire.factors import INPUTS, OUTPUTS, STATES

Array = npt.NDArray[np.float64]

MOST_GAPS = 20
"""So many gaps are looked at, evenly along the arm: each is an eigenvalue problem of some hundred unknowns."""


def growth_per_s(step: Step, modes: ArmModes, tick_s: float, out: Sequence[int]) -> float:
    """How fast the fastest growing motion grows, 1/s, at one setpoint while these segments are out; negative if
    everything decays."""
    n = len(step.command_scale)
    piece = np.cumsum(np.isin(np.arange(n), out))
    there = ~np.isin(np.arange(n), out)
    kept = (piece[:, None] == piece) & there[:, None] & there
    tick = step.whole().reshape(n, OUTPUTS, n, INPUTS) * kept[:, None, :, None]
    by_state = tick[..., :OUTPUTS].reshape(OUTPUTS * n, OUTPUTS * n)
    by_measurement = tick[..., OUTPUTS:].reshape(OUTPUTS * n, -1)
    transition, force, sense = sample(modes, tick_s)
    command = np.zeros((n, OUTPUTS * n))
    command[np.arange(n), OUTPUTS * np.arange(n) + STATES] = 1.0 / step.command_scale
    measured = step.measurement_scale[:, None] * sense
    loop = np.block([[transition, force @ command], [by_measurement @ measured, by_state]])
    return float(np.log(np.max(np.abs(np.linalg.eigvals(loop)))) / tick_s)


def refuse_growing_gaps(
    artefact: GainsArtefact, deployment: Deployment, setpoints: Sequence[str], segments: int
) -> None:
    """UsageError if the loop would grow while one of the processes of so many segments is out.

    With more than `MOST_GAPS` processes these are taken evenly along the arm, the first and the last included.
    """
    n, tick_s = len(deployment.faces_m) - 1, deployment.tick_s
    grid = SegmentGrid(deployment.faces_m)
    firsts = np.arange(0, n, segments)
    places = np.unique(np.linspace(0, len(firsts) - 1, MOST_GAPS).round().astype(int))
    for name in dict.fromkeys(setpoints):
        setpoint = artefact.setpoints[artefact.setpoint_index(name)]
        step = make_step(make_loop(artefact.arm, setpoint, grid), tick_s)
        modes = make_arm_modes(artefact.arm, setpoint.curvature_per_m, grid)
        for first in firsts[places].tolist():
            own = range(first, min(first + segments, n))
            growth = growth_per_s(step, modes, tick_s, own)
            if growth > GROWTH_PER_S:
                raise UsageError(
                    f"--restart: at setpoint {name} the loop would grow by {growth:.3g} per second while node "
                    f"{first} is out; leave --restart out, or choose another tick or number of nodes"
                )
