import math

import numpy as np
import pytest
from plant_arms import THICK_ARM, Array, stiffnesses

from plant.elastic import ElasticForce, elastic_energy, rest_shape, strains
from plant.grid import Grid

CELLS = 9


def _energy(points: Array) -> float:
    """Discrete energy of chapter (1), written with angles and loops; points (CELLS + 1, 2)."""
    EA, EI, _ = stiffnesses(THICK_ARM)
    step = THICK_ARM.length_m / CELLS
    angle, total = 0.0, 0.0
    for j in range(CELLS):
        dx, dy = points[j + 1] - points[j]
        total += 0.5 * EA * step * (math.hypot(dx, dy) / step - 1.0) ** 2
        raw = math.atan2(dy, dx)
        new = raw + 2.0 * math.pi * round((angle - raw) / (2.0 * math.pi))
        length = 0.5 * step if j == 0 else step
        total += 0.5 * EI * (new - angle) ** 2 / length
        angle = new
    return total


def _bent(seed: int, bend_per_m: float) -> np.ndarray:
    """A crooked, unevenly stretched shape; with 14 / m it turns by more than a full circle."""
    random = np.random.default_rng(seed)
    step = THICK_ARM.length_m / CELLS
    angles = bend_per_m * step * np.arange(1, CELLS + 1) + random.uniform(-0.3, 0.3, CELLS)
    edges = step * random.uniform(0.8, 1.2, CELLS) * np.exp(1j * angles)
    return np.concatenate([[0.0], np.cumsum(edges)])


def _force() -> ElasticForce:
    EA, EI, _ = stiffnesses(THICK_ARM)
    return ElasticForce(Grid(CELLS, THICK_ARM.length_m), EA, EI)


@pytest.mark.parametrize(("seed", "bend_per_m"), [(1, 0.0), (2, 4.0), (3, 14.0), (4, -14.0)])
def test_forces_are_the_gradient_of_an_energy_written_independently(
    seed: int, bend_per_m: float
) -> None:
    position = _bent(seed, bend_per_m)
    points = np.stack([position.real, position.imag], axis=1)
    force = _force()
    force.evaluate(position)
    kick = force.kick.copy()
    kick[-1] *= 0.5  # the tip's kick is per half mass
    expected = np.zeros((CELLS, 2))
    small = 1e-6
    for node in range(1, CELLS + 1):
        for axis in range(2):
            ends = []
            for sign in (1.0, -1.0):
                moved = points.copy()
                moved[node, axis] += sign * small
                ends.append(_energy(moved))
            expected[node - 1, axis] = -(ends[0] - ends[1]) / (2.0 * small)
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(kick.real, expected[:, 0], atol=1e-8 * scale)
    np.testing.assert_allclose(kick.imag, expected[:, 1], atol=1e-8 * scale)


@pytest.mark.parametrize("bend_per_m", [0.0, 14.0])
def test_energy_agrees_with_the_one_written_independently(bend_per_m: float) -> None:
    position = _bent(5, bend_per_m)
    EA, EI, _ = stiffnesses(THICK_ARM)
    axial, bending = elastic_energy(position, Grid(CELLS, THICK_ARM.length_m), EA, EI)
    points = np.stack([position.real, position.imag], axis=1)
    assert axial + bending == pytest.approx(_energy(points), rel=1e-12)
    assert axial > 0.0
    assert bending > 0.0


def test_clamp_carries_what_the_nodes_feel() -> None:
    """The forces on the free nodes add up to the clamp's force, their moments to its moment."""
    position = _bent(6, 5.0)
    force = _force()
    force.evaluate(position)
    kick = force.kick.copy()
    kick[-1] *= 0.5
    internal, moment = force.clamp
    assert np.sum(kick) == pytest.approx(-internal, rel=1e-12)
    assert np.sum((position[1:].conj() * kick).imag) == pytest.approx(-moment, rel=1e-12)


def test_rigid_stretch_and_scale() -> None:
    """A straight arm stretched by 10 % pulls with EA / 10 at both ends; kicks scale."""
    grid = Grid(CELLS, THICK_ARM.length_m)
    force = _force()
    force.set_scale(3.0)
    force.evaluate(1.1 * grid.nodes_m.astype(np.complex128))
    EA = stiffnesses(THICK_ARM)[0]
    np.testing.assert_allclose(force.kick[:-1], 0.0, atol=1e-12 * EA)
    assert force.kick[-1] == pytest.approx(3.0 * 2.0 * -0.1 * EA)
    assert force.clamp[0] == pytest.approx(3.0 * 0.1 * EA)


def test_rest_shape_has_the_strains_it_was_made_from() -> None:
    random = np.random.default_rng(7)
    grid = Grid(30, 0.7)
    curvature, strain = random.uniform(-20.0, 20.0, 30), random.uniform(-0.3, 0.3, 30)
    found = strains(rest_shape(curvature, strain, grid), grid)
    np.testing.assert_allclose(found.axial, strain, atol=1e-13)
    np.testing.assert_allclose(found.curvature_per_m[:-1], curvature, atol=1e-10)
    assert found.curvature_per_m[-1] == 0.0
