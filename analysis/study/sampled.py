"""The sampled loop with a continuum of segments around the exact arm: what runs converge to.

The reference of `analysis.study.convergence` in time. Observer and controller are those of
`analysis.study.continuum`, in Legendre polynomials; the tick is the deployed one (correct, predict, feed
back: `deploy.step`), the arm is the plant's, read and loaded at Gauss points along its length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from analysis.study.continuum import STRAINS, arm_matrices, make_continuum
from deploy import SegmentGrid
from deploy.feedforward import holding_commands
from deploy.step import IMPLICITNESS
from plant.disturbance import DisturbanceSpec
from plant.initial import InitialShape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import Arm, Setpoint

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SampledCourse:
    """K ticks of the arm and of the estimate, absolute, m."""

    tip_m: Array
    """(K, 2) of the arm."""
    estimate_m: Array
    """(K, p, 2): positions of the estimated arm at the arclengths asked for."""


def sampled_course(
    arm: Arm,
    setpoint: Setpoint,
    *,
    ticks: int,
    tick_s: float,
    plant_cells: int,
    initial: InitialShape,
    disturbance: DisturbanceSpec,
    shape_at_m: Array,
    strains: int = STRAINS,
) -> SampledCourse:
    """Run it without noise from xh(0) = setpoint; see `analysis.study.simulate` for the segments' side."""
    model = make_continuum(arm, setpoint, strains)
    loop = arm_matrices(arm, setpoint, strains)
    line, length = model.line, arm.length_m
    size, signals = len(loop.A), loop.force.shape[1]
    time = length**2 * math.sqrt(arm.mass_per_length_kg_per_m / arm.bending_stiffness_n_m2)
    h, p = tick_s / time, IMPLICITNESS
    predict = np.linalg.inv(np.eye(size) - p * h * loop.A)
    transition = predict @ (np.eye(size) + (1.0 - p) * h * loop.A)
    force = h * predict @ loop.force
    correct = h * loop.L @ np.linalg.inv(np.eye(len(loop.measure)) - h * loop.measure @ loop.L)
    feedback = np.linalg.solve(np.eye(signals) - h * loop.K @ loop.force, loop.K)

    # polynomials, orthonormal over [0, 1], to and from the plant at the Gauss points
    faces = np.concatenate([[0.0], line.s_m, [length]])
    plain = np.diag(np.sqrt(2.0 * np.arange(signals) + 1.0))  # Legendre series of each
    load = arm.bending_stiffness_n_m2 / length**3
    to_plant = load * np.stack([holding_commands(one, SegmentGrid(faces)) for one in plain], axis=1)
    holding = holding_commands(setpoint.feedforward_n_per_m, SegmentGrid(faces))
    back = (line.basis[:, :signals] * (line.weights_m / math.sqrt(length))[:, None]).T
    units = np.array([length / time, 1.0 / length])
    x = 2.0 * line.s_m / length - 1.0
    bent = legendre.legval(x, np.asarray(setpoint.curvature_per_m))
    strained = legendre.legval(x, np.asarray(setpoint.strain))

    plant = ArmPlant(
        PlantParameters(arm, tuple(faces.tolist()), tick_s, initial, disturbance, cells=plant_cells)
    )
    # coordinates of `loop` are those of `model` over the energy of a unit state
    strain_values = model.values[:, 2:] * math.sqrt(arm.bending_stiffness_n_m2 / length)
    at_points = line.at(shape_at_m)
    state, command = np.zeros(size), np.zeros(signals)
    tip, estimate = np.empty((ticks, 2)), np.empty((ticks, len(shape_at_m), 2))
    for k in range(ticks):
        e, curvature = np.moveaxis(strain_values @ state, 1, 0)
        angle = line.running @ (bent + curvature)
        slope = (1.0 + strained + e)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        tip[k], estimate[k] = plant.tip(), at_points @ (line.running @ slope)
        read = plant.measure()
        y = np.concatenate([back @ read[:-1, 0] / units[0], back @ (read[1:, 1] - bent) / units[1]])
        plant.advance(holding + to_plant @ command, k)
        state = transition @ (state + correct @ (loop.measure @ state - y)) + force @ command
        command = feedback @ state
    return SampledCourse(tip, estimate)
