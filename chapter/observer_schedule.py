"""The gain-scheduled observer of section 4.1 beside the exact arm (1): the experiment where both are sound.

Ten segments, energy states (theory, section 2), one tick at a time as octarm runs it; no feedback, the commands
hold the first setpoint. The active observer is that of the 30-degree sector in which the estimated tip is.
Gains come from the inequality with the chapter's two outputs, from octarm's artefact with its own outputs,
or are zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from deploy import deploy
from deploy.deployment import offsets
from deploy.grid import MEASURED_STATES, Place, SegmentGrid, make_grid
from deploy.model import GridModel, make_model, tangent_angle
from node.scheduling import Sectors
from plant.disturbance import DisturbanceSpec
from plant.elastic import rest_shape
from plant.grid import Grid
from plant.initial import InitialShape, initial_shape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import Arm, GainsArtefact, Setpoint
from wire.joints import ArmEnd

Array = npt.NDArray[np.float64]
Injection = Callable[[str, Array], Array]
"""From a setpoint's name and arclengths (m,) to (4, 2, m): rates of (v_x, v_y, e, k) per metre of y1 and
1/m^2 of y2."""

BOUNDARIES_RAD = (math.pi / 6.0, math.pi / 3.0)
HYSTERESIS_RAD = math.radians(2.0)
SEGMENTS = 10
PLANT_CELLS = 40
SHAPE_POINTS = 41


@dataclass(frozen=True, eq=False)
class Tick:
    """One observer about one setpoint: x+ = rest + S (x - rest + X innovation) + pull, rest and x (4n,)."""

    rest: Array
    transition: Array
    correction: Array
    """(4n, outputs)."""
    pull: Array
    """(4n,): of the commands in force less those that hold this setpoint."""


@dataclass(frozen=True, eq=False)
class Observed:
    """One run, K ticks; SI units."""

    tick_s: float
    truth: Array
    """(K, n, 4)."""
    estimates: Array
    """(K, n, 4)."""
    setpoints: npt.NDArray[np.int64]
    """(K,): whose gains are in use."""
    true_shapes_m: Array
    """(K, p, 2)."""
    estimated_shapes_m: Array
    """(K, n + 1, 2)."""

    @property
    def times_s(self) -> Array:
        """(K,)."""
        return np.asarray(self.tick_s * np.arange(len(self.truth)), dtype=np.float64)

    @property
    def tip_error_m(self) -> Array:
        """(K,): distance of estimated from true tip."""
        away = self.estimated_shapes_m[:, -1] - self.true_shapes_m[:, -1]
        return np.hypot(away[:, 0], away[:, 1])

    @property
    def tip_y_error_m(self) -> Array:
        """(K,): error of the tip's y, the chapter's first output."""
        return np.asarray(self.estimated_shapes_m[:, -1, 1] - self.true_shapes_m[:, -1, 1])

    @property
    def root_error(self) -> Array:
        """(K,): error of -w'''(0), the chapter's mean of d_s^4 w, 1/m^2."""
        step = 1.0 / self.truth.shape[1]
        error = (self.estimates - self.truth)[:, :2, 3]
        return np.asarray((error[:, 0] - error[:, 1]) / step)


def chapter_outputs(setpoint: Setpoint, grid: SegmentGrid) -> Array:
    """Derivative (2, 4n) of (tip along y, root value of -d_s^3 w) by the segments' states at a setpoint."""
    n, widths = grid.nodes, grid.cell_widths_m
    angle = tangent_angle(setpoint.curvature_per_m, grid.centres_m, grid.length_m)
    out = np.zeros((2, n, 4))
    out[0, :, 2] = widths * np.sin(angle)
    beyond = np.cumsum((widths * np.cos(angle))[::-1])[::-1]
    out[0, :, 3] = grid.dual_widths_m(Place.INNER_FACE) * beyond
    out[1, 0, 3], out[1, 1, 3] = 1.0 / widths[0], -1.0 / widths[0]
    return out.reshape(2, 4 * n)


def sampled(grid: SegmentGrid, injection: Injection, name: str) -> Array:
    """The injection on the segments' places, (4n, 2)."""
    places = (Place.OUTER_FACE, Place.OUTER_FACE, Place.CENTRE, Place.INNER_FACE)
    rows = [injection(name, grid.locations_m(place))[k] for k, place in enumerate(places)]
    return np.asarray(np.stack(rows).transpose(2, 0, 1)).reshape(4 * grid.nodes, 2)


def chapter_ticks(
    artefact: GainsArtefact, grid: SegmentGrid, tick_s: float, injection: Injection | None
) -> list[Tick]:
    """Ticks for all setpoints under the load that holds the first: prediction exact, correction implicit."""
    holding = [offsets(artefact.arm, one, grid)[1] for one in artefact.setpoints]
    found = []
    for setpoint, held in zip(artefact.setpoints, holding, strict=True):
        model = make_model(artefact.arm, setpoint.curvature_per_m, grid)
        correction = np.zeros((4 * grid.nodes, 2))
        if injection is not None:
            C = chapter_outputs(setpoint, grid)
            gain = tick_s * sampled(grid, injection, setpoint.name)
            correction = gain @ np.linalg.inv(np.eye(2) - C @ gain)
        transition, pull = _predict(model, holding[0][:, 4] - held[:, 4], tick_s)
        found.append(Tick(held[:, :4].ravel(), transition, correction, pull))
    return found


def _predict(model: GridModel, command: Array, tick_s: float) -> tuple[Array, Array]:
    states = len(model.A)
    wide = np.zeros((states + 1, states + 1))
    wide[:states, :states], wide[:states, states] = model.A, model.B @ command
    found = expm(tick_s * wide)
    return np.asarray(found[:states, :states]), np.asarray(found[:states, states])


def shipped_ticks(artefact: GainsArtefact, grid: SegmentGrid, tick_s: float) -> list[Tick]:
    """octarm's own ticks with the artefact's gains; innovation is (v_y, k) of every segment."""
    n = grid.nodes
    deployed = deploy(artefact, n, tick_s).without_control()
    first = deployed.dense[0].out_offset.reshape(n, 5)[:, 4]
    found = []
    for step in deployed.dense:
        rest: Array = step.out_offset.reshape(n, 5)
        M = step.M.reshape(n, 5, n, 7)[:, :4]
        observed = -M[:, :, :, 5:].reshape(4 * n, 2 * n)  # S X
        C = np.zeros((2 * n, 4 * n))
        for row, column in enumerate(MEASURED_STATES):
            C[row::2, column::4] = np.eye(n)
        transition = M[:, :, :, :4].reshape(4 * n, 4 * n) - observed @ C
        pull = M[:, :, :, 4].reshape(4 * n, n) @ (first - rest[:, 4])
        correction = np.asarray(np.linalg.solve(transition, observed), dtype=np.float64)
        found.append(Tick(rest[:, :4].ravel(), transition, correction, pull))
    return found


def estimated_shape(state: Array, rest: Array, chords: Array, grid: SegmentGrid) -> Array:
    """Faces (n + 1, 2) of an estimate (n, 4): the chords (n,) of the rest (n, 4), turned and stretched."""
    turns = np.cumsum((state[:, 3] - rest[:, 3]) * grid.dual_widths_m(Place.INNER_FACE))
    pieces = chords * (1.0 + state[:, 2]) / (1.0 + rest[:, 2]) * np.exp(1j * turns)
    points = np.concatenate([[0.0], np.cumsum(pieces)])
    return np.stack([points.real, points.imag], axis=1)


def observe(
    artefact: GainsArtefact,
    ticks: Sequence[Tick],
    initial: InitialShape,
    *,
    tick_s: float,
    count: int,
    disturbance: DisturbanceSpec,
    own_outputs: bool,
    start: int = 0,
    plant_cells: int = PLANT_CELLS,
    arm: Arm | None = None,
) -> Observed:
    """Release the exact arm from `initial` with the estimate at rest at setpoint `start`, no noise.

    own_outputs: the innovation is octarm's (v_y, k) a segment instead of the chapter's two numbers.
    """
    n = SEGMENTS
    grid = make_grid(artefact.arm.length_m, n, "equispaced")
    held = offsets(artefact.arm, artefact.setpoints[0], grid)[1][:, 4]
    plant = ArmPlant(
        PlantParameters(
            arm or artefact.arm,
            tuple(grid.faces_m.tolist()),
            tick_s,
            initial,
            disturbance,
            cells=plant_cells,
        )
    )
    sectors = Sectors(tuple(range(len(artefact.setpoints))), BOUNDARIES_RAD, HYSTERESIS_RAD)
    chords = [setpoint_chords(artefact, one.name, grid) for one in artefact.setpoints]
    points = np.linspace(0.0, artefact.arm.length_m, SHAPE_POINTS)
    active, state = start, ticks[start].rest.copy()
    truth, estimates = np.empty((count, n, 4)), np.empty((count, n, 4))
    used = np.empty(count, dtype=np.int64)
    shapes, guesses = np.empty((count, SHAPE_POINTS, 2)), np.empty((count, n + 1, 2))
    step = grid.cell_widths_m[0]
    for k in range(count):
        tick = ticks[active]
        now, x = plant.truth(), state.reshape(n, 4)
        guess = estimated_shape(x, tick.rest.reshape(n, 4), chords[active], grid)
        truth[k], estimates[k], used[k] = now, x, active
        shapes[k], guesses[k] = plant.shape_at(points), guess
        if own_outputs:
            innovation = (x - now)[:, MEASURED_STATES].ravel()
        else:
            error = x - now
            innovation = np.array(
                [guess[-1, 1] - plant.tip()[1], (error[0, 3] - error[1, 3]) / step]
            )
        plant.advance(held, k)
        away = state - tick.rest + tick.correction @ innovation
        state = tick.rest + tick.transition @ away + tick.pull
        active = sectors.choose(active, ArmEnd(0.0, float(guess[-1, 0]), float(guess[-1, 1])))
    return Observed(tick_s, truth, estimates, used, shapes, guesses)


def setpoint_chords(artefact: GainsArtefact, name: str, grid: SegmentGrid) -> Array:
    """Segments (n,) of a setpoint as complex numbers, between the faces of the exact shape."""
    setpoint = artefact.setpoints[artefact.setpoint_index(name)]
    shape = initial_shape("setpoint", setpoint, artefact.arm.length_m)
    fine = Grid(40 * grid.nodes, grid.length_m)
    position = rest_shape(
        shape.curvature_per_m(fine.nodes_m[:-1]), shape.strain(fine.centres_m), fine
    )
    return np.diff(position[::40])
