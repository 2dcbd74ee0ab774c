from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from plant.grid import Grid, check_faces, interpolation_matrix, load_matrix, plant_cells
from wire.errors import UsageError


def test_cells_default_to_forty_or_four_a_segment() -> None:
    assert [plant_cells(n) for n in (2, 10, 11, 50)] == [40, 40, 44, 200]
    assert plant_cells(10, 57) == 57


def test_too_few_and_too_many_cells_are_refused() -> None:
    with pytest.raises(UsageError, match="at most 4000, got 1000000"):
        plant_cells(10, 1_000_000)
    with pytest.raises(UsageError, match=r"at least 40 .*got 39"):
        plant_cells(10, 39)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([0.0], "at least 2"),
        ([0.0, 0.5, 0.5, 1.0], r"faces_m\[2\]"),
        ([0.0, float("nan"), 1.0], r"faces_m\[1\]"),
        ([0.0, 0.5, 0.9], "end at the length"),
        ([0.1, 0.5, 1.0], "start at 0"),
    ],
)
def test_wrong_faces_are_refused_by_name(faces: list[float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_faces(faces, 1.0)


@pytest.mark.parametrize("cells", [8, 41])
def test_grid_tiles_the_arm(cells: int) -> None:
    grid = Grid(cells, 0.7)
    assert grid.weights_m.sum() == pytest.approx(0.7 - 0.5 * grid.step_m)  # all but the clamp's
    assert grid.curvature_lengths_m.sum() == pytest.approx(0.7 - 0.5 * grid.step_m)
    assert grid.nodes_m[-1] == pytest.approx(0.7)
    np.testing.assert_allclose(grid.centres_m, 0.5 * (grid.nodes_m[1:] + grid.nodes_m[:-1]))


def test_interpolation_is_exact_for_cubics_also_outside() -> None:
    samples = Grid(12, 2.0).centres_m
    points = np.array([0.0, 0.03, 0.4, 1.0, 1.777, 2.0])
    cubic = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7])
    matrix = interpolation_matrix(points, samples)
    np.testing.assert_allclose(matrix @ cubic(samples), cubic(points), atol=1e-13)


def test_interpolation_is_of_fourth_order() -> None:
    points = np.linspace(0.0, 1.0, 101)
    errors = []
    for cells in (20, 40):
        nodes = Grid(cells, 1.0).nodes_m
        found = interpolation_matrix(points, nodes) @ np.sin(5.0 * nodes)
        errors.append(np.max(np.abs(found - np.sin(5.0 * points))))
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.5


@pytest.mark.parametrize("faces", [np.linspace(0, 1, 6), np.array([0, 0.07, 0.3, 0.55, 0.93, 1.0])])
def test_loads_do_the_work_of_the_piecewise_linear_load(faces: np.ndarray) -> None:
    grid = Grid(23, 1.0)
    command = np.array([0.4, -1.0, 0.3, 2.0, -0.7])
    forces = load_matrix(faces, grid) @ command
    nodes = grid.nodes_m
    for node in (1, 7, 22, 23):
        hat = np.eye(nodes.size)[node]

        def work(s: float, hat: np.ndarray = hat) -> float:
            return float(np.interp(s, faces[1:], command) * np.interp(s, nodes, hat))

        low, high = nodes[node - 1], nodes[min(node + 1, nodes.size - 1)]
        breaks = sorted({low, nodes[node], high, *faces[(faces > low) & (faces < high)]})
        parts = [quad(work, a, b)[0] for a, b in pairwise(breaks)]
        assert forces[node - 1] == pytest.approx(sum(parts), abs=1e-12)
