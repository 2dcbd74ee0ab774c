"""What `analysis.study.convergence` measures: one artefact on one grid against the continuum.

Every figure is a distance between something deployed (`deploy`, or the plant under deployed commands) and
the same thing without segments (`analysis.study.continuum`, `.sampled`, `.rest`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.interpolate import CubicSpline

from analysis.shape_error import face_positions
from analysis.study.continuum import (
    Line,
    apply_gain,
    arm_matrices,
    densities,
    make_line,
    tangent,
)
from analysis.study.rest import rest_gain, rest_tip
from analysis.study.sampled import SampledCourse, sampled_course
from analysis.study.simulate import DISTURBANCE, simulate
from deploy import Deployment, deploy
from deploy.grid import (
    COMMAND_PLACES,
    MEASURED_STATES,
    MEASUREMENT_PLACES,
    STATE_PLACES,
    Place,
    SegmentGrid,
    make_grid,
)
from deploy.operators import operator_matrix
from design import verify
from design.arm_file import time_unit_s
from design.channel import Channel
from plant.initial import InitialShape, initial_shape, legendre_profile
from wire.artefact import Arm, GainsArtefact, OperatorFactors, Setpoint
from wire.errors import UsageError
from wire.run_config import NoiseConfig

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

LEADING = 3
"""Eigenvalues (conjugate pairs once) of each closed loop that are compared, the smallest ones."""
SHAPES = 4
"""Places along the arm, equally spaced to the tip, where shapes are compared."""
TESTS = 3
"""Smooth states that the gain operators are tried on."""
FASTEST_RAD_PER_S = 20.0
"""Faster modes, w h > 2 with a tick of 0.1 s, are left out of the decay: the tick cannot turn them at their
rate. The gains hardly damp the axial ones among them: their decay tends to half the drag with the frequency."""
COARSER = 16
"""Polynomials of the second reference, from which the first one's own error is judged."""
CLAMPED_FREE = (1.8751040687119611, 0.7340955137589128)
"""First bending mode of a clamped beam: beta, and the share of sinh + sin in cosh + cos."""
DEVIATION = 1.0
"""Root curvature of the smooth initial deviation, times the arm's length."""

QUANTITIES = {
    "observer gain": "L applied to smooth measurements, energy norm, relative",
    "controller gain": "K applied to smooth states, L2, relative",
    "observer gamma": "H-infinity norm of the estimation error, relative",
    "controller gamma": "H-infinity norm with state feedback, relative",
    "observer eigenvalues": f"{LEADING} smallest of the error dynamics, worst, relative",
    "controller eigenvalues": f"{LEADING} smallest of the controlled arm, worst, relative",
    "observer decay": f"slowest mode of the error below {FASTEST_RAD_PER_S:g} rad/s, relative",
    "controller decay": f"slowest mode of the controlled arm below {FASTEST_RAD_PER_S:g} rad/s, relative",
    "tip": "sampled loop on the exact arm: rms over the run, mm",
    "estimated shape": "sampled loop on the exact arm: rms over run and arm, mm",
    "tip at rest": "distance from the setpoint's tip at rest, mm",
}


@dataclass(frozen=True)
class Choices:
    """What the sampled loop is compared in."""

    tick_s: float
    ticks: int
    plant_cells: int
    initial: str
    """"mode", or a name of `plant.initial`."""


@dataclass(frozen=True, eq=False)
class Limit:
    """The continuum's side at one setpoint."""

    gamma: tuple[float, float]
    """Of observer and controller."""
    eigenvalues: tuple[Complex, Complex]
    slowest_per_s: tuple[float, float]
    """Decay of the slowest mode below `FASTEST_RAD_PER_S`."""
    course: SampledCourse | None
    accuracy: dict[str, float]
    """Difference to a reference of fewer polynomials, per quantity, in the unit of its errors."""
    halved_mm: tuple[float, float] | None = None
    """How far the tip's course moves (rms) when the tick is halved, and when it is halved again."""


def start(arm: Arm, setpoint: Setpoint, name: str) -> InitialShape:
    """A shape at rest. "mode" adds the curvature of a straight beam's first bending mode to the setpoint:
    unlike the chapter's deviation it has neither shear nor moment at the free tip and leaves the clamp at
    rest, so that no jump sets out from either end."""
    if name != "mode":
        return initial_shape(name, setpoint, arm.length_m)
    still = initial_shape("setpoint", setpoint, arm.length_m)
    beta, ratio = CLAMPED_FREE
    curvature = legendre_profile(setpoint.curvature_per_m, arm.length_m)

    def bent(s_m: Array) -> Array:
        x = beta * s_m / arm.length_m
        mode = np.cosh(x) + np.cos(x) - ratio * (np.sinh(x) + np.sin(x))
        return curvature(s_m) + 0.5 * DEVIATION / arm.length_m * mode

    return InitialShape(bent, still.strain)


def channels(artefact: GainsArtefact, matrices: verify.ArmMatrices) -> tuple[Channel, Channel]:
    """Closed loops of observer and controller, weights of the artefact."""
    weights = artefact.weights
    return (
        verify.observer_channel(matrices, weights["measurement_noise"]),
        verify.controller_channel(matrices, weights["control_effort"]),
    )


def _leading(A: Array) -> Complex:
    values = np.linalg.eigvals(A).astype(np.complex128)
    values = values[values.imag >= 0.0]
    return np.asarray(values[np.argsort(np.abs(values))][:LEADING])


def _slowest(arm: Arm, A: Array) -> float:
    values = np.linalg.eigvals(A) / time_unit_s(arm)
    return float(-np.max(values.real[np.abs(values.imag) < FASTEST_RAD_PER_S]))


def _apart(A: Array, reference: Complex) -> float:
    """Largest relative distance of a reference value from the nearest eigenvalue of A."""
    values = np.linalg.eigvals(A).astype(np.complex128)
    distance = np.min(np.abs(values[None, :] - reference[:, None]), axis=1)
    return float(np.max(distance / np.abs(reference)))


def limit(artefact: GainsArtefact, name: str, choices: Choices | None) -> Limit:
    """The continuum at one setpoint; without `choices` no sampled loop. Some seconds."""
    arm, setpoint = artefact.arm, artefact.setpoints[artefact.setpoint_index(name)]
    fine, coarse = (
        channels(artefact, arm_matrices(arm, setpoint, *size)) for size in ((), (COARSER,))
    )
    gamma = (fine[0].hinf_norm(), fine[1].hinf_norm())
    eigenvalues = (_leading(fine[0].A), _leading(fine[1].A))
    slowest = (_slowest(arm, fine[0].A), _slowest(arm, fine[1].A))
    accuracy = {}
    for role, one, value, leading, decay in zip(
        ("observer", "controller"), coarse, gamma, eigenvalues, slowest, strict=True
    ):
        accuracy[f"{role} gamma"] = abs(one.hinf_norm() / value - 1.0)
        accuracy[f"{role} eigenvalues"] = _apart(one.A, leading)
        accuracy[f"{role} decay"] = abs(_slowest(arm, one.A) / decay - 1.0)
    if choices is None:
        return Limit(gamma, eigenvalues, slowest, None, accuracy)

    def sampled(finer: int = 1, **size: int) -> SampledCourse:
        return sampled_course(
            arm,
            setpoint,
            ticks=finer * choices.ticks,
            tick_s=choices.tick_s / finer,
            plant_cells=choices.plant_cells,
            initial=start(arm, setpoint, choices.initial),
            disturbance=DISTURBANCE,
            shape_at_m=_places(arm),
            **size,
        )

    course, other = sampled(), sampled(strains=COARSER)
    tips = [course.tip_m, *(sampled(finer).tip_m[::finer] for finer in (2, 4))]
    halved = (1e3 * _rms(tips[1] - tips[0]), 1e3 * _rms(tips[2] - tips[1]))
    accuracy["tip"] = 1e3 * _rms(course.tip_m - other.tip_m)
    accuracy["estimated shape"] = 1e3 * _rms(course.estimate_m - other.estimate_m)
    return Limit(gamma, eigenvalues, slowest, course, accuracy, halved)


def _places(arm: Arm) -> Array:
    return arm.length_m * np.arange(1, SHAPES + 1) / SHAPES


def _rms(apart: Array) -> float:
    """Root mean square of distances, (..., 2)."""
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=-1))))


def grid_errors(
    artefact: GainsArtefact,
    name: str,
    nodes: int,
    spacing: str | tuple[float, ...],
    reference: Limit,
    choices: Choices | None,
) -> dict[str, float | None]:
    """Distance of each of `QUANTITIES` on one grid; None where there is no stable loop or no rest."""
    arm, setpoint = artefact.arm, artefact.setpoints[artefact.setpoint_index(name)]
    grid = make_grid(arm.length_m, nodes, spacing)
    errors: dict[str, float | None] = dict(operator_errors(arm, setpoint, grid))
    loops = channels(artefact, verify.arm_matrices(arm, setpoint, nodes, spacing))
    for k, role in enumerate(("observer", "controller")):
        errors[f"{role} gamma"] = abs(loops[k].hinf_norm() / reference.gamma[k] - 1.0)
        errors[f"{role} eigenvalues"] = _apart(loops[k].A, reference.eigenvalues[k])
        decay = reference.slowest_per_s[k]
        errors[f"{role} decay"] = abs(_slowest(arm, loops[k].A) / decay - 1.0)
    if choices is None:
        return errors
    try:
        deployment = deploy(_only(artefact, setpoint), nodes, choices.tick_s, spacing)
    except UsageError:  # the sampled loop would not be stable: a finding, not a mistake
        return errors | dict.fromkeys(("tip", "estimated shape", "tip at rest"))
    return errors | _sampled_errors(artefact, setpoint, deployment, reference, choices)


def _only(artefact: GainsArtefact, setpoint: Setpoint) -> GainsArtefact:
    return GainsArtefact(artefact.arm, artefact.weights, [setpoint], artefact.versions)


def operator_errors(arm: Arm, setpoint: Setpoint, grid: SegmentGrid) -> dict[str, float]:
    """The matrices of both gains against Gauss quadrature of their kernels, the worst smooth state."""
    line = make_line(arm.length_m)
    worst = {"observer gain": 0.0, "controller gain": 0.0}
    for state in smooth_states(arm, setpoint, line):
        for role, factors, to, source, columns in (
            ("observer gain", setpoint.observer, STATE_PLACES, MEASUREMENT_PLACES, MEASURED_STATES),
            ("controller gain", setpoint.controller, COMMAND_PLACES, STATE_PLACES, [0, 1, 2, 3]),
        ):
            scale = densities(arm) if role == "observer gain" else np.ones(1)
            given = np.stack(
                [
                    line.at(grid.locations_m(p)) @ state[:, c]
                    for c, p in zip(columns, source, strict=True)
                ],
                axis=1,
            )
            found = operator_matrix(factors, grid, to, source) @ given.ravel()
            exact = _exact(factors, line, state[:, columns], to, grid)
            weights = np.stack([grid.dual_widths_m(p) for p in to], axis=1) * scale
            apart = np.sum(weights * (found.reshape(exact.shape) - exact) ** 2)
            worst[role] = max(worst[role], float(np.sqrt(apart / np.sum(weights * exact**2))))
    return worst


def _exact(
    factors: OperatorFactors,
    line: Line,
    signal: Array,
    to: tuple[Place, ...],
    grid: SegmentGrid,
) -> Array:
    columns = []
    for row, place in enumerate(to):
        matrix = apply_gain(factors, line, grid.locations_m(place))[:, row]
        columns.append(np.einsum("sti,ti->s", matrix, signal))
    return np.stack(columns, axis=1)


def smooth_states(arm: Arm, setpoint: Setpoint, line: Line) -> list[Array]:
    """States (m, 4) at the points of the line that meet the clamp and the free tip, of unit energy parts.

    Strains cos((j + 1/2) pi s / L), j = 0, 1, ..., which end at the tip, and velocities with such rates.
    """
    length, angle = arm.length_m, tangent(setpoint, arm.length_m, line.s_m)
    t = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    states = []
    for j in range(TESTS):
        wave = np.cos((j + 0.5) * np.pi * line.s_m / length)
        turn = line.running @ wave / length
        velocity = line.running @ (0.01 * t * wave[:, None] + normal * turn[:, None])
        parts = np.hstack([velocity, wave[:, None], wave[:, None]])
        energy = line.weights_m @ (parts**2 * densities(arm))
        share = np.array([energy[0] + energy[1], energy[0] + energy[1], energy[2], energy[3]])
        states.append(parts / np.sqrt(share))
    return states


def _sampled_errors(
    artefact: GainsArtefact,
    setpoint: Setpoint,
    deployment: Deployment,
    reference: Limit,
    choices: Choices,
) -> dict[str, float | None]:
    arm = artefact.arm
    run = simulate(
        _only(artefact, setpoint),
        setpoint=setpoint.name,
        ticks=choices.ticks,
        plant_cells=choices.plant_cells,
        initial=start(arm, setpoint, choices.initial),
        noise=NoiseConfig(),
        deployment=deployment,
    )
    errors: dict[str, float | None] = {"tip": None, "estimated shape": None}
    course = reference.course
    if run.diverged_at is None and course is not None:
        errors["tip"] = 1e3 * _rms(run.tip_m - course.tip_m)
        # deviations from the setpoint, whose own shape straight segments do not have exactly
        still = face_positions(run.equilibrium[None, :, :4], run.faces_m)
        moved = face_positions(run.estimates, run.faces_m) - still
        errors["estimated shape"] = 1e3 * _rms(
            _through_faces(run.faces_m, moved, _places(arm)) - _moved(arm, setpoint, course)
        )
    deployed = deployment.dense[0]
    offset = deployed.in_offset.reshape(-1, 7)
    try:
        tip = rest_tip(arm, deployment.faces_m, offset[:, 4], offset[:, 6], rest_gain(deployed))
    except ArithmeticError:
        return errors | {"tip at rest": None}
    return errors | {"tip at rest": 1e3 * float(np.hypot(*(tip - np.asarray(setpoint.tip_m))))}


def _moved(arm: Arm, setpoint: Setpoint, course: SampledCourse) -> Array:
    """Estimated positions (K, p, 2) minus the setpoint's."""
    line = make_line(arm.length_m)
    angle = tangent(setpoint, arm.length_m, line.s_m)
    x = 2.0 * line.s_m / arm.length_m - 1.0
    stretch = 1.0 + legendre.legval(x, np.asarray(setpoint.strain))
    still = [
        line.integral_to(_places(arm)) @ (stretch * turn) for turn in (np.cos(angle), np.sin(angle))
    ]
    return np.asarray(course.estimate_m - np.stack(still, axis=1))


def _through_faces(faces_m: Array, positions: Array, s_m: Array) -> Array:
    """Positions (K, n, 2) of the outer faces, 0 at the clamp, at arclengths s_m: (K, p, 2), cubic splines."""
    whole = np.concatenate([np.zeros((len(positions), 1, 2)), positions], axis=1)
    return np.asarray(CubicSpline(faces_m, whole, axis=1)(s_m), dtype=np.float64)
