"""From the legs of a scenario to tables that nodes and plant can evaluate: shapes between setpoints.

Along a leg the curvature is the polynomial in sigma that passes through the leg's setpoints (first, through,
last; equally spaced in sigma). Nodes follow what their commands really hold (`deploy.held`); the plant measures
against the shape that is wanted (`deploy.equilibrium`). What the arm should do at a time is then (theory, 5)

    v = r_sigma sigma',   e, k as at rest,
    u = holding load + load of the acceleration a,
    a = r_sigma (sigma'' + drag sigma') + r_sigma_sigma sigma'^2,

the loads as commands of the segments (`deploy.equilibrium.inertia_load`, `deploy.feedforward`). All of it is
sampled at Chebyshev points of sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev, legendre

from deploy.equilibrium import SIZE, Equilibrium, equilibrium, inertia_load, series_of
from deploy.grid import SegmentGrid
from deploy.held import Held, Holder
from wire.artefact import Arm, GainsArtefact
from wire.channels import COMMAND, STATE
from wire.errors import OctarmError
from wire.reference import TERMS, Leg, Reference
from wire.run_config import LegConfig

Array = npt.NDArray[np.float64]

DEGREES = (12, 24, 48)
"""Degrees in sigma to try."""
RESOLVED = 1e-7
"""The last coefficients of every quantity are below this share of its largest, or below `FLOOR`."""
FLOOR = 1e-9
"""In SI units: nothing that a sensor or the tip would show."""
NODE = (*STATE, *COMMAND, "chord_x_m", "chord_y_m")
"""Quantities of a node's reference: at the places of its state and command, and from inner to outer face."""
HELD = len(STATE)
PLANT = ("tip_x_m", "tip_y_m", "mean_velocity_y_m_per_s", "mean_curvature_per_m")
"""Quantities of the plant's reference."""


@dataclass(frozen=True, eq=False)
class References:
    """The reference of a run: one table a node (`NODE`), one for the plant (`PLANT`)."""

    nodes: tuple[Reference, ...]
    plant: Reference

    def states(self, tick: int) -> Array:
        """(n, 5): state and command that all nodes should have at a tick."""
        return np.stack([one.at(tick)[: HELD + 1] for one in self.nodes])

    def chords_m(self, tick: int) -> Array:
        """(n, 2): from inner to outer face of every segment at a tick."""
        return np.stack([one.at(tick)[HELD + 1 :] for one in self.nodes])


@dataclass(frozen=True, eq=False)
class _Samples:
    """Quantities at p points of sigma: of the held shapes at the nodes, and of the wanted ones."""

    position: Array
    """(p, 2, n) of the outer faces."""
    strain: Array
    """(p, n)."""
    curvature: Array
    """(p, n)."""
    holding: Array
    """(p, n)."""
    push: Array
    """(p, n): commands that give the acceleration r_sigma."""
    pull: Array
    """(p, n): commands that give the acceleration r_sigma_sigma."""
    tip: Array
    """(p, 2), wanted."""
    face_height: Array
    """(p, n): y of the outer faces, wanted."""
    bend: Array
    """(p, n): curvature at the inner faces, wanted."""


def curvature_path(artefact: GainsArtefact, names: Sequence[str]) -> Callable[[float], Array]:
    """Curvature (Legendre series, 1/m) at sigma of the path through these setpoints, one or more."""
    series = [artefact.setpoints[artefact.setpoint_index(name)].curvature_per_m for name in names]
    size = max(map(len, series))
    stacked = np.stack([np.pad(np.asarray(one), (0, size - len(one))) for one in series])
    places = np.linspace(0.0, 1.0, len(names))

    def at(sigma: float) -> Array:
        others = sigma - places
        weights = [
            np.prod(np.delete(others, i)) / np.prod(np.delete(places[i] - places, i))
            for i in range(len(names))
        ]
        return np.asarray(np.asarray(weights) @ stacked)

    return at


def make_references(
    artefact: GainsArtefact,
    grid: SegmentGrid,
    tick_s: float,
    start: str,
    first_hold_s: float = 0.0,
    legs: Sequence[LegConfig] = (),
) -> References:
    """Tables of a run that rests at `start` for first_hold_s and then goes through the legs.

    Raises UsageError if a setpoint does not exist, or a shape on the way cannot be held.
    """
    tables: dict[tuple[str, ...], tuple[Array, Array]] = {}
    holder = Holder(artefact.arm, grid)

    def table(names: tuple[str, ...]) -> tuple[Array, Array]:
        if names not in tables:
            back = tables.get(names[::-1])
            tables[names] = (
                _table(artefact, grid, holder, names)
                if back is None
                else (_reversed(back[0]), _reversed(back[1]))
            )
        return tables[names]

    moves: list[tuple[float, float, Array, Array]] = []
    if not legs:
        moves.append((0.0, 0.0, *table((start,))))
    begin, here = first_hold_s, start
    for leg in legs:
        moves.append((begin, leg.move_s, *table((here, *leg.through, leg.to))))
        begin += leg.move_s + leg.hold_s
        here = leg.to
    return References(
        nodes=tuple(
            Reference(tick_s, [Leg(t, m, nodes[i]) for t, m, nodes, _ in moves], held=HELD)
            for i in range(grid.nodes)
        ),
        plant=Reference(tick_s, [Leg(t, m, plant) for t, m, _, plant in moves]),
    )


def _table(
    artefact: GainsArtefact, grid: SegmentGrid, holder: Holder, names: Sequence[str]
) -> tuple[Array, Array]:
    """Coefficients of the nodes (n, 4, 7, degree + 1) and of the plant (4, 4, degree + 1) on one leg."""
    arm, path = artefact.arm, curvature_path(artefact, names)
    if len(names) == 1:
        found = _sample(arm, grid, holder, path, np.zeros(1), names)
        return _coefficients(arm, grid, found, 0)
    for degree in DEGREES:
        points = 0.5 * (1.0 + np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)))
        found = _sample(arm, grid, holder, path, points, names)
        if _resolved(found, degree):
            return _coefficients(arm, grid, found, degree)
    raise OctarmError(
        f"the way {' -> '.join(names)} is not resolved by {DEGREES[-1]} polynomials: it comes too close "
        "to a shape that no load can hold"
    )


def _reversed(coefficients: Array) -> Array:
    """The same way backwards, sigma -> 1 - sigma; coefficients (..., 4, quantities, degree + 1)."""
    flips = np.array([1.0, -1.0, 1.0, -1.0])  # of sigma' and sigma'', as factors and as arguments
    parity = (-1.0) ** np.arange(coefficients.shape[-1])
    return np.ascontiguousarray(coefficients * flips[:, None, None] * parity)


def _sample(
    arm: Arm,
    grid: SegmentGrid,
    holder: Holder,
    path: Callable[[float], Array],
    sigma: Array,
    names: Sequence[str],
) -> _Samples:
    what = f"setpoint {' -> '.join(names)}"
    wanted: list[tuple[Array, Equilibrium]] = []
    held: list[Held] = []
    for one in sigma:
        series = path(float(one))
        name = what if len(names) == 1 else f"{what} at {one:.2f} of the way"
        rest = equilibrium(arm, series, name)
        wanted.append((series, rest))
        held.append(holder.hold(series, rest, name, held[-1] if held else None))
    waves_outer, waves_inner, waves_tip = (
        legendre.legvander(2.0 * places / grid.length_m - 1.0, SIZE - 1)
        for places in (grid.faces_m[1:], grid.faces_m[:-1], grid.faces_m[-1:])
    )
    positions = np.stack([rest.position_m for _, rest in wanted])
    series = _series(positions, len(sigma) - 1)

    def accelerating(accelerations: Array) -> Array:
        pairs = zip(wanted, accelerations, strict=True)
        return np.stack([holder.commands(inertia_load(arm, bend, one)) for (bend, _), one in pairs])

    return _Samples(
        position=np.stack([one.position_m for one in held]),
        strain=np.stack([one.strain for one in held]),
        curvature=np.stack([one.curvature_per_m for one in held]),
        holding=np.stack([one.command_n_per_m for one in held]),
        push=accelerating(_values(_by_sigma(series), sigma)),
        pull=accelerating(_values(_by_sigma(_by_sigma(series)), sigma)),
        tip=(positions @ waves_tip.T)[:, :, 0],
        face_height=positions[:, 1] @ waves_outer.T,
        bend=np.stack([series_of(bend) for bend, _ in wanted]) @ waves_inner.T,
    )


def _resolved(found: _Samples, degree: int) -> bool:
    quantities = found.position, found.strain, found.curvature, found.holding, found.push
    for values in quantities:
        series = np.abs(_series(values, degree))
        if np.max(series[-2:]) > max(RESOLVED * np.max(series), FLOOR):
            return False
    return True


def _series(values: Array, degree: int) -> Array:
    """Chebyshev coefficients (degree + 1, ...) of values (degree + 1, ...) at the Chebyshev points."""
    if degree == 0:
        return values.copy()
    order = np.arange(degree + 1)
    matrix = np.cos(np.pi * np.outer(order, order + 0.5) / (degree + 1)) * 2.0 / (degree + 1)
    matrix[0] *= 0.5
    return np.tensordot(matrix, values, axes=1)


def _values(series: Array, sigma: Array) -> Array:
    """Values (p, ...) of Chebyshev series (degree + 1, ...) at sigma (p,)."""
    return np.tensordot(chebyshev.chebvander(2.0 * sigma - 1.0, len(series) - 1), series, axes=1)


def _by_sigma(series: Array) -> Array:
    """Coefficients of the derivative by sigma, of the same size; sigma = (x + 1) / 2."""
    out = np.zeros_like(series)
    if len(series) > 1:
        out[:-1] = 2.0 * chebyshev.chebder(series)
    return out


def _coefficients(arm: Arm, grid: SegmentGrid, found: _Samples, degree: int) -> tuple[Array, Array]:
    """Coefficients of all nodes (n, 4, 7, degree + 1) and of the plant (4, 4, degree + 1)."""
    rates = _by_sigma(_series(found.position, degree))  # (degree + 1, 2, n)
    push = _series(found.push, degree)
    nodes = np.zeros((grid.nodes, TERMS, len(NODE), degree + 1))
    nodes[:, 0, 2] = _series(found.strain, degree).T
    nodes[:, 0, 3] = _series(found.curvature, degree).T
    nodes[:, 0, 4] = _series(found.holding, degree).T
    chords = np.diff(found.position, axis=2, prepend=0.0)
    nodes[:, 0, 5:] = _series(chords, degree).transpose(2, 1, 0)
    nodes[:, 1, :2] = rates.transpose(2, 1, 0)
    # Kelvin-Voigt damping resists as a shape does that goes ahead by its time: exact for small bends
    viscous = arm.kelvin_voigt_s * _by_sigma(_series(found.holding, degree))
    nodes[:, 1, 4] = (arm.drag_per_s * push + viscous).T
    nodes[:, 2, 4] = _series(found.pull, degree).T
    nodes[:, 3, 4] = push.T
    plant = np.zeros((TERMS, len(PLANT), degree + 1))
    plant[0, :2] = _series(found.tip, degree).T
    outer, inner = mean_weights(grid)
    plant[1, 2] = _by_sigma(_series(found.face_height, degree)) @ outer
    plant[0, 3] = _series(found.bend, degree) @ inner
    return nodes, plant


def mean_weights(grid: SegmentGrid) -> Array:
    """Weights (2, n) of the means over the arm of v_y (outer faces) and of the curvature (inner faces)."""
    middle, faces = grid.centres_m, grid.faces_m
    outer = np.diff(np.append(middle, faces[-1]))
    inner = np.diff(np.concatenate(([faces[0]], middle)))
    return np.asarray(np.stack([outer, inner]) / (faces[-1] - faces[0]))
