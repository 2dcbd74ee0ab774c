"""Large deflections against the boundary value problem of chapter (1), and the setpoint's hold."""

import numpy as np
import pytest
from plant_arms import (
    CHAPTER_ARM,
    SETPOINT_CURVATURE,
    THICK_ARM,
    Array,
    damped,
    setpoint_feedforward,
    stiffnesses,
)
from scipy.integrate import solve_bvp

from plant.initial import InitialShape, legendre_profile
from plant.model import ArmPlant, PlantParameters
from wire.artefact import Arm

FACES = np.array([0.0, 0.11, 0.24, 0.5, 0.61, 0.7])


def _settled(
    arm: Arm, faces: Array, command: Array, cells: int, initial: InitialShape | None = None
) -> ArmPlant:
    """The equilibrium, reached by motion at the critical damping of the first mode."""
    _, EI, mass = stiffnesses(arm)
    first = 3.516 * np.sqrt(EI / mass) / arm.length_m**2
    parameters = PlantParameters(
        damped(arm, 2.0 * first), tuple(faces), 1.0 / first, initial or InitialShape(), cells=cells
    )
    plant = ArmPlant(parameters)
    for tick in range(26):
        plant.advance(command, tick)
    assert plant.energy()[0] < 1e-14 * sum(plant.energy())
    return plant


def _reference(arm: Arm, faces: Array, command: Array, points: Array) -> Array:
    """x, y, angle, curvature, strain at arclengths `points`: extensible elastica under dead loads.

    x' = (1+e) cos a, y' = (1+e) sin a, a' = k, EI k' = -(1+e) N.n,
    N_y' = -f, e = N.t / EA, N_x = 0.
    """
    EA, EI, _ = stiffnesses(arm)

    def slopes(s: Array, z: Array) -> Array:
        _, _, a, k, force = z
        stretch = 1.0 + force * np.sin(a) / EA
        return np.array(
            [
                stretch * np.cos(a),
                stretch * np.sin(a),
                k,
                -stretch * force * np.cos(a) / EI,
                -np.interp(s, faces[1:], command),
            ]
        )

    def ends(root: Array, tip: Array) -> Array:
        return np.array([root[0], root[1], root[2], tip[3], tip[4]])

    mesh = np.unique(np.concatenate([faces, np.linspace(0.0, arm.length_m, 101)]))
    guess = np.zeros((5, mesh.size))
    guess[0] = mesh
    found = solve_bvp(slopes, ends, mesh, guess, tol=1e-9, max_nodes=20000)
    assert found.success
    z = found.sol(points)
    return np.vstack([z[:4], z[4] * np.sin(z[2]) / EA])


def test_large_deflection_converges_to_the_extensible_elastica() -> None:
    """Tip angle near 60 degrees, strains of per cent, uneven faces that share no grid point."""
    command = np.array([3.0, 5.0, 9.0, 14.0, 6.0])
    errors: dict[str, list[float]] = {"shape": [], "curvature": [], "strain": []}
    middles = 0.5 * (FACES[1:] + FACES[:-1])
    at_outer = _reference(THICK_ARM, FACES, command, FACES[1:])
    at_inner = _reference(THICK_ARM, FACES, command, FACES[:-1])
    at_middle = _reference(THICK_ARM, FACES, command, middles)
    print("tip angle", np.degrees(at_outer[2, -1]), "largest strain", np.max(at_middle[4]))
    assert np.degrees(at_outer[2, -1]) > 45.0
    assert np.max(np.abs(at_middle[4])) > 0.01
    for cells in (20, 40, 80):
        plant = _settled(THICK_ARM, FACES, command, cells)
        truth = plant.truth()
        errors["shape"].append(np.max(np.abs(plant.shape_at(FACES[1:]) - at_outer[:2].T)))
        errors["curvature"].append(np.max(np.abs(truth[:, 3] - at_inner[3])))
        errors["strain"].append(np.max(np.abs(truth[:, 2] - at_middle[4])))
    for name, values in errors.items():
        orders = np.log2(np.array(values[:-1]) / values[1:])
        print(name, "errors", values, "orders", orders)
        assert np.all(orders > 1.6), name
    assert errors["shape"][-1] < 1e-3 * THICK_ARM.length_m


def test_clamp_carries_the_load() -> None:
    command = np.array([3.0, 5.0, 9.0, 14.0, 6.0])
    plant = _settled(THICK_ARM, FACES, command, 40)
    points = np.linspace(0.0, 0.7, 7001)
    load = np.interp(points, FACES[1:], command)
    x = plant.shape_at(points)[:, 0]
    fx, fy, moment = plant.clamp_reaction()
    assert fx == pytest.approx(0.0, abs=1e-6)
    # What acts within half a cell of the clamp goes into the wall.
    assert fy == pytest.approx(-np.trapezoid(load, points) + 0.5 * 0.7 / 40 * command[0], rel=1e-6)
    assert moment == pytest.approx(-np.trapezoid(load * x, points), rel=1e-3)


def _hold(segments: int) -> float:
    """Largest distance from the setpoint's shape after settling under its feed-forward load."""
    faces = np.linspace(0.0, 1.0, segments + 1)
    command = setpoint_feedforward(CHAPTER_ARM, faces[1:])
    initial = InitialShape(legendre_profile(SETPOINT_CURVATURE, 1.0))
    plant = _settled(CHAPTER_ARM, faces, command, max(40, 4 * segments), initial)
    points = np.linspace(0.0, 1.0, 33)
    angle = np.polynomial.Legendre(SETPOINT_CURVATURE, domain=[0.0, 1.0]).integ(lbnd=0.0)
    fine = np.linspace(0.0, 1.0, 3201)
    middle = 0.5 * (fine[1:] + fine[:-1])
    # Equilibrium strains are below 1e-4 and move the tip by less than 0.05 mm.
    x = np.concatenate([[0.0], np.cumsum(np.cos(angle(middle)) * np.diff(fine))])
    y = np.concatenate([[0.0], np.cumsum(np.sin(angle(middle)) * np.diff(fine))])
    target = np.stack([np.interp(points, fine, x), np.interp(points, fine, y)], axis=1)
    return float(np.max(np.hypot(*(plant.shape_at(points) - target).T)))


def test_feedforward_holds_the_setpoint() -> None:
    """The piecewise linear load of 10 segments holds the shape to 4 mm, of 20 to 1 mm."""
    coarse, fine = _hold(10), _hold(20)
    print("distance from the setpoint in m: 10 segments", coarse, "20 segments", fine)
    assert coarse < 4e-3
    assert fine < 1e-3
    assert 1.6 < np.log2(coarse / fine) < 2.4
