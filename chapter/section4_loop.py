"""Does the arm rest under section 4's formula? Eigenvalues of the sampled loop on the nodes' grid and on a
finer one.

The linear model at a setpoint, the nodes' commands held over a tick and made of what was measured a tick
before, as the run of `chapter.section4_run` does it.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from chapter.section4 import Rule, columns, pairs
from deploy.grid import make_grid
from deploy.model import make_model
from wire.artefact import GainsArtefact

STATES = 4
V_Y, CURVATURE = 1, 3


def growth_per_s(
    artefact: GainsArtefact,
    count: int,
    cells: int,
    rule: Rule,
    tick_s: float | None,
    *,
    middle: bool = False,
) -> float:
    """Rate of the slowest decaying (positive: growing) motion, 1/s, with `count` nodes on a model of `cells`
    cells.

    `tick_s` None: commands follow the state at once. `middle`: both measurements are of a segment's middle,
    where the midpoint rule has the node, not of its ends, where the arm's sensors are.
    """
    setpoint, length = artefact.setpoints[0], artefact.arm.length_m
    model = make_model(
        artefact.arm, setpoint.curvature_per_m, make_grid(length, cells, "equispaced")
    )
    each = cells // count
    size = STATES * cells
    measure = np.zeros((count, 2, size))
    held = np.zeros((cells, count))
    for i in range(count):  # of a cell v_y is at the outer, k at the inner face
        before = i * each + each // 2
        velocity, curvature = (before - 1, before) if middle else ((i + 1) * each - 1, i * each)
        measure[i, 0, STATES * velocity + V_Y] = 1.0
        measure[i, 1, STATES * curvature + CURVATURE] = 1.0
        held[i * each : (i + 1) * each, i] = 1.0
    gain = pairs(columns(setpoint.controller, [V_Y, CURVATURE]), length, count, rule)[:, 0]
    feedback = np.einsum("inm,nmx->ix", gain, measure)
    drive = model.B @ held
    if tick_s is None:
        return float(np.linalg.eigvals(model.A + drive @ feedback).real.max())
    generator = np.zeros((size + count, size + count))
    generator[:size, :size], generator[:size, size:] = model.A, drive
    sampled = expm(tick_s * generator)
    sampled[size:, :size], sampled[size:, size:] = feedback, 0.0
    return float(np.log(np.abs(np.linalg.eigvals(sampled)).max()) / tick_s)
