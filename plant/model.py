"""The emulated arm: advances the exact model, chapter (1), by one tick under held commands.

Stands where the hardware would: commands of the segments in, measurements out (theory, section 6).
The forces are in `plant.elastic`, the grid in `plant.grid`; this module holds the state and the
time integration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from plant.disturbance import NO_DISTURBANCE, Disturbance, DisturbanceSpec, make_disturbance
from plant.elastic import ElasticForce, elastic_energy, rest_shape, strains
from plant.grid import Grid, check_faces, interpolation_matrix, load_matrix, plant_cells
from plant.initial import STRAIGHT, InitialShape
from plant.truncated_force import EXACT, Rest, TruncatedForce, check_model
from wire.artefact import Arm
from wire.errors import UsageError

if TYPE_CHECKING:
    from plant.viscous import ViscousStep

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

CFL_SAFETY = 0.8
"""Default length of a substep as a fraction of the explicit integrator's stability limit."""
_BLOCK = 64  # substeps whose disturbance is evaluated at once
_SHORTEST_CELL = (
    0.25  # compression, as a fraction of the cell, up to which the substep follows the limit
)


@dataclass(frozen=True)
class PlantParameters:
    """What an emulated arm is made of; checked and completed when made.

    faces_m: faces s_0 = 0 < ... < s_n = L of the n segments; tick_s: how long a command is held;
    initial: shape at t = 0, at rest; cells: of the plant's grid, None for max(40, 4 n); cfl_safety:
    in (0, 1). model: of `plant.truncated_force.MODELS`; a linear one is linear about the shape `about`, which
    the commands `holding_n_per_m` hold. Raises UsageError naming the parameter that is wrong.
    """

    arm: Arm
    faces_m: tuple[float, ...]
    tick_s: float
    initial: InitialShape = STRAIGHT
    disturbance: DisturbanceSpec = NO_DISTURBANCE
    cells: int | None = None
    cfl_safety: float = CFL_SAFETY
    model: str = EXACT
    about: InitialShape = STRAIGHT
    holding_n_per_m: tuple[float, ...] = ()
    """One a segment; none: no load."""

    def __post_init__(self) -> None:
        faces = check_faces(self.faces_m, self.arm.length_m)
        object.__setattr__(self, "faces_m", faces)
        check_model(self.model)
        exact = self.model == EXACT
        object.__setattr__(self, "cells", plant_cells(len(faces) - 1, self.cells, exact=exact))
        if len(self.holding_n_per_m) not in (0, self.segments):
            raise UsageError(
                f"holding_n_per_m: expected {self.segments} loads, got {len(self.holding_n_per_m)}"
            )
        if not (math.isfinite(self.tick_s) and self.tick_s > 0.0):
            raise UsageError(f"tick_s: expected a positive number of seconds, got {self.tick_s!r}")
        if not 0.0 < self.cfl_safety < 1.0:
            raise UsageError(
                f"cfl_safety: expected a number between 0 and 1, got {self.cfl_safety!r}"
            )

    @property
    def segments(self) -> int:
        """Number n of segments."""
        return len(self.faces_m) - 1

    @property
    def grid(self) -> Grid:
        """The plant's own grid."""
        exact = self.model == EXACT
        return Grid(plant_cells(self.segments, self.cells, exact=exact), self.arm.length_m)


def highest_frequency_rad_per_s(arm: Arm, grid: Grid, shortest_stretch: float = 1.0) -> float:
    """Upper bound of the discrete arm's frequencies, from its axial and bending speeds.

    The highest axial frequency on a grid of step ds is 2 sqrt(EA/rhoA)/ds, the highest bending
    frequency 4 sqrt(EI/rhoA)/ds^2; a cell compressed to the fraction `shortest_stretch` of its
    length turns that much more per displacement. The stiffness of a bent arm is the sum of both, so
    the squares add. The geometric stiffness of a stretched arm is left to the safety factor.
    """
    mass = arm.mass_per_length_kg_per_m
    axial = 2.0 * math.sqrt(arm.axial_stiffness_n / mass) / grid.step_m
    bending = 4.0 * math.sqrt(arm.bending_stiffness_n_m2 / mass) / grid.step_m**2
    return math.hypot(axial, bending / shortest_stretch)


def _viscous_step(arm: Arm, grid: Grid) -> ViscousStep | None:
    if arm.kelvin_voigt_s == 0.0:
        return None
    from plant.viscous import ViscousStep  # with SciPy, which the plant does without otherwise

    return ViscousStep(
        grid,
        arm.axial_stiffness_n,
        arm.bending_stiffness_n_m2,
        arm.mass_per_length_kg_per_m,
        arm.kelvin_voigt_s,
    )


def _initial_position(initial: InitialShape, grid: Grid) -> Complex:
    curvature = initial.curvature_per_m(grid.nodes_m[:-1])
    return rest_shape(curvature, initial.strain(grid.centres_m), grid)


class ArmPlant:
    """The state of the emulated arm.

    Integrator: Strang splitting into drift (positions) and kick with drag (velocities; the flow of
    v_t = a - d v with a held is exact), i.e. velocity Verlet when d = 0: second order, symplectic
    without drag. Kelvin-Voigt damping is an implicit part of the kick (`plant.viscous`). A tick is cut
    into equal substeps below `cfl_safety` times the stability limit 2 / omega, omega of
    `highest_frequency_rad_per_s` at the tick's start.
    Commands act along y, or along the normal of the present shape (`Arm.actuator`), in N per metre of
    the arm at rest.
    """

    def __init__(self, parameters: PlantParameters) -> None:
        self.parameters = parameters
        arm, grid = parameters.arm, parameters.grid
        self._grid = grid
        self._mass = arm.mass_per_length_kg_per_m * grid.weights_m
        self._disturbance: Disturbance | None = None
        if parameters.disturbance.name != "none":
            self._disturbance = make_disturbance(parameters.disturbance, arm)
        faces = np.asarray(parameters.faces_m)
        self._load = load_matrix(faces, grid) / self._mass[:, None]  # acceleration per N/m
        self._force, self._fastest_rad_per_s = self._forces()
        self._viscous = _viscous_step(arm, grid)
        self._position = _initial_position(parameters.initial, grid)
        self._velocity = np.zeros(grid.cells, dtype=np.complex128)  # of the free nodes 1..cells
        self._command = np.zeros(parameters.segments)
        self._at_outer = interpolation_matrix(faces[1:], grid.nodes_m)[:, 1:]  # v(0) = 0
        self._at_inner = interpolation_matrix(faces[:-1], grid.nodes_m)
        self._at_centre = interpolation_matrix(0.5 * (faces[1:] + faces[:-1]), grid.centres_m)
        self._shape_matrices: dict[bytes, Array] = {}

    def _forces(self) -> tuple[ElasticForce, float]:
        """The model's forces, and how fast what they are linear about moves or grows (exact: 0, it has a
        bound)."""
        parameters, grid = self.parameters, self._grid
        arm = parameters.arm
        if parameters.model == EXACT:
            return ElasticForce(grid, arm.axial_stiffness_n, arm.bending_stiffness_n_m2), 0.0
        held = np.asarray(parameters.holding_n_per_m or np.zeros(parameters.segments))
        rest = Rest(_initial_position(parameters.about, grid), self._load @ held)
        force = TruncatedForce(grid, arm, parameters.model, rest)
        return force, math.sqrt(float(np.max(np.abs(np.linalg.eigvals(force.jacobian)))))

    def substeps(self) -> int:
        """Number of substeps that the next tick takes."""
        tick, safety = self.parameters.tick_s, self.parameters.cfl_safety
        shortest = float(np.min(np.abs(np.diff(self._position)))) / self._grid.step_m
        # A state that is not finite takes the ordinary number: it is reported, not repaired.
        stretch = min(1.0, max(shortest, _SHORTEST_CELL)) if math.isfinite(shortest) else 1.0
        frequency = highest_frequency_rad_per_s(self.parameters.arm, self._grid, stretch)
        return max(1, math.ceil(tick * max(frequency, self._fastest_rad_per_s) / (2.0 * safety)))

    def advance(self, command: Array, tick: int) -> None:
        """Integrate over [tick, tick + 1) times tick_s with the command (n,) in N/m held.

        Numbers that are not finite go through without a warning; see `first_non_finite`.
        Raises ValueError if the command has another shape.
        """
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (self.parameters.segments,):
            raise ValueError(
                f"command: expected shape ({self.parameters.segments},), got {command.shape}"
            )
        self._command = command.copy()
        count = self.substeps()
        with np.errstate(all="ignore"):
            self._integrate(self._accelerations(command, tick, count), count)

    def _accelerations(self, command: Array, tick: int, count: int) -> Iterator[Complex]:
        """Accelerations (cells,) by the loads in m/s^2, at the count + 1 ends of the substeps.

        Each must be asked for after the force has been evaluated at that end: loads along the normal turn
        with the shape.
        """
        held = self._load @ command
        if self.parameters.arm.actuator == "transverse":
            yield from self._disturbed(np.asarray(1j * held), tick, count)
            return
        normals = np.empty(self._grid.cells, dtype=np.complex128)
        for disturbance in self._disturbed(np.zeros_like(normals), tick, count):
            self._force.normals(normals)
            yield held * normals + disturbance

    def _disturbed(self, held: Complex, tick: int, count: int) -> Iterator[Complex]:
        """`held` and the disturbance's acceleration (cells,), at the count + 1 ends of the substeps."""
        if self._disturbance is None:
            yield from repeat(held, count + 1)
            return
        nodes = self._grid.nodes_m[1:]
        density = self.parameters.arm.mass_per_length_kg_per_m
        for first in range(0, count + 1, _BLOCK):
            ends = np.arange(first, min(first + _BLOCK, count + 1))
            times = (tick + ends / count) * self.parameters.tick_s
            yield from held + (1j / density) * self._disturbance(times, nodes)

    def _integrate(self, accelerations: Iterator[Complex], count: int) -> None:
        """`count` substeps; inside, velocities are counted in metres per substep."""
        arm, force, step = self.parameters.arm, self._force, self.parameters.tick_s / count
        drag = arm.drag_per_s
        decay, half_decay = np.array(math.exp(-drag * step)), math.exp(-0.5 * drag * step)
        # int_0^step exp(-drag t) dt, and the part of it that the first and last half kicks take
        reach = -math.expm1(-drag * step) / drag if drag > 0.0 else step
        half = -math.expm1(-0.5 * drag * step) / drag if drag > 0.0 else 0.5 * step
        gain = step * reach
        force.set_scale(gain / (arm.mass_per_length_kg_per_m * self._grid.step_m))
        position, free, kick, evaluate = (
            self._position,
            self._position[1:],
            force.kick,
            force.evaluate,
        )
        scale, load = np.array(gain), np.empty_like(kick)
        before, viscous = step * self._velocity, self._viscous
        evaluate(position)
        moved = half_decay * before + (half / reach) * (kick + gain * next(accelerations))
        if viscous is not None:
            moved = viscous.apply(force.edges, before, moved, half)
        for _ in range(count - 1):
            np.add(free, moved, free)
            evaluate(position)
            if viscous is not None:
                before = moved.copy()
            np.multiply(moved, decay, moved)
            np.add(moved, kick, moved)
            np.multiply(next(accelerations), scale, load)
            np.add(moved, load, moved)
            if viscous is not None:
                moved = viscous.apply(force.edges, before, moved, reach)
        np.add(free, moved, free)
        evaluate(position)
        before = moved
        moved = half_decay * before + (half / reach) * (kick + gain * next(accelerations))
        if viscous is not None:
            moved = viscous.apply(force.edges, before, moved, half)
        self._velocity = moved / step

    @property
    def state(self) -> Array:
        """Positions in m, then velocities in m/s, x before y, of the grid nodes but the clamp, (4 cells,)."""
        free = np.concatenate([self._position[1:], self._velocity])
        return np.ascontiguousarray(free).view(np.float64)

    @state.setter
    def state(self, values: Array) -> None:
        cells = self._grid.cells
        free = np.ascontiguousarray(values, dtype=np.float64).reshape(4 * cells).view(np.complex128)
        self._position[1:], self._velocity = free[:cells], free[cells:].copy()

    def measure(self) -> Array:
        """Noise-free sensors (n, 2): v_y in m/s at outer, curvature in 1/m at inner faces."""
        curvature = strains(self._position, self._grid).curvature_per_m
        return np.stack([self._at_outer @ self._velocity.imag, self._at_inner @ curvature], axis=1)

    def truth(self) -> Array:
        """The state as the segments hold it, (n, 4).

        Columns: v_x and v_y in m/s at the outer face s_i, axial strain at the segment's centre,
        curvature in 1/m at the inner face s_{i-1}; local cubics through the samples of the plant's
        grid.
        """
        found = strains(self._position, self._grid)
        velocity = self._at_outer @ self._velocity
        strain = self._at_centre @ found.axial
        curvature = self._at_inner @ found.curvature_per_m
        return np.stack([velocity.real, velocity.imag, strain, curvature], axis=1)

    def shape(self) -> Array:
        """Positions of the grid nodes in m, (cells + 1, 2), from the clamp at (0, 0) to the tip."""
        return np.stack([self._position.real, self._position.imag], axis=1)

    def shape_at(self, s_m: npt.ArrayLike) -> Array:
        """Positions in m at arclengths s_m (p,), shape (p, 2)."""
        points = np.asarray(s_m, dtype=np.float64)
        key = points.tobytes()
        if key not in self._shape_matrices:
            matrix = interpolation_matrix(points, self._grid.nodes_m)
            self._shape_matrices = {key: matrix}  # one set of points is asked for again and again
        return np.asarray(self._shape_matrices[key] @ self.shape())

    def tip(self) -> Array:
        """Position of the tip in m, shape (2,)."""
        return np.array([self._position[-1].real, self._position[-1].imag])

    def energy(self) -> tuple[float, float, float]:
        """Kinetic, axial and bending energy in J."""
        arm = self.parameters.arm
        kinetic = 0.5 * float(np.sum(self._mass * np.abs(self._velocity) ** 2))
        axial, bending = elastic_energy(
            self._position, self._grid, arm.axial_stiffness_n, arm.bending_stiffness_n_m2
        )
        return kinetic, axial, bending

    def load_potential(self, command: Array) -> float:
        """Potential in J of loads (n,) in N/m along y, zero for the straight arm; loads along the normal have
        none, and give zero."""
        if self.parameters.arm.actuator != "transverse":
            return 0.0
        weights = self._load @ command * self._mass
        return -float(np.sum(weights * self._position[1:].imag))

    def clamp_reaction(self) -> tuple[float, float, float]:
        """What the clamp does to the arm: force (x, y) in N and moment in N m."""
        self._force.set_scale(1.0)
        self._force.evaluate(self._position)
        internal, moment = self._force.clamp
        if self._viscous is not None:
            # what the free nodes feel, and its moment, is what the clamp gives
            feel = self._viscous.rate(self._force.edges, self._velocity)
            feel *= self.parameters.arm.mass_per_length_kg_per_m * self._grid.step_m
            internal += complex(np.sum(feel))
            moment += float(np.sum((self._position[1:].conj() * feel).imag))
        return -internal.real, -internal.imag, -moment

    def first_non_finite(self) -> str | None:
        """Field and place of the first number that is not finite, None if all are finite."""
        outer = np.asarray(self.parameters.faces_m)[1:]
        nodes = self._grid.nodes_m
        for field, values, places in (
            ("command force_n_per_m", self._command, outer),
            ("position x_m", self._position.real, nodes),
            ("position y_m", self._position.imag, nodes),
            ("velocity_x_m_per_s", self._velocity.real, nodes[1:]),
            ("velocity_y_m_per_s", self._velocity.imag, nodes[1:]),
        ):
            wrong = np.flatnonzero(~np.isfinite(values))
            if wrong.size:
                index = int(wrong[0])
                model = self.parameters.model
                why = "" if model == EXACT else f" (plant model {model}, which has no bound)"
                return f"plant {field} at s = {places[index]:.4g} m is {values[index]}{why}"
        return None
