"""Where things live on the segment grid, and which divisions of the arm are refused."""

import numpy as np
import pytest
from deploy_artefacts import ARM

from deploy.grid import Place, Spacing, make_grid
from wire.errors import UsageError


def test_equispaced_faces() -> None:
    np.testing.assert_allclose(make_grid(2.0, 4, "equispaced").faces_m, [0.0, 0.5, 1.0, 1.5, 2.0])


def test_chebyshev_faces_are_denser_at_root_and_tip() -> None:
    grid = make_grid(2.0, 9, Spacing.CHEBYSHEV)
    widths = grid.cell_widths_m
    assert grid.faces_m[0] == 0.0
    assert grid.faces_m[-1] == 2.0
    np.testing.assert_allclose(widths, widths[::-1])
    assert np.all(np.diff(widths[:5]) > 0.0)
    assert widths[4] > 5.0 * widths[0]


def test_given_faces_are_taken_as_they_are() -> None:
    grid = make_grid(1.0, 3, [0.0, 0.2, 0.7, 1.0])
    np.testing.assert_array_equal(grid.locations_m(Place.OUTER_FACE), [0.2, 0.7, 1.0])
    np.testing.assert_allclose(grid.locations_m(Place.CENTRE), [0.1, 0.45, 0.85])
    np.testing.assert_array_equal(grid.locations_m(Place.INNER_FACE), [0.0, 0.2, 0.7])
    np.testing.assert_allclose(grid.dual_widths_m(Place.OUTER_FACE), [0.35, 0.4, 0.15])
    np.testing.assert_allclose(grid.dual_widths_m(Place.CENTRE), [0.2, 0.5, 0.3])
    np.testing.assert_allclose(grid.dual_widths_m(Place.INNER_FACE), [0.1, 0.35, 0.4])


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
def test_energy_weights_give_the_energy_of_a_smooth_deviation(spacing: str) -> None:
    grid = make_grid(ARM.length_m, 200, spacing)
    v, e, k = (grid.locations_m(p) / ARM.length_m for p in Place)
    x = np.stack([v, 2.0 * v**2, 1.0 - e, 3.0 * (1.0 - k) ** 2], axis=1)
    energy = float(np.sum(grid.energy_weights(ARM) * x**2))
    # by hand: integrals over [0, L] of s^2, 4 s^4, (1 - s)^2, 9 (1 - s)^4 with s = arclength / L
    mass, axial = ARM.mass_per_length_kg_per_m, ARM.axial_stiffness_n
    by_hand = mass * (1 / 3 + 4 / 5) + axial / 3 + ARM.bending_stiffness_n_m2 * 9 / 5
    assert energy == pytest.approx(0.5 * ARM.length_m * by_hand, rel=1e-4)


@pytest.mark.parametrize("nodes", [1, 0, -3, 2.5, True])
def test_too_few_nodes_are_refused(nodes: int) -> None:
    with pytest.raises(UsageError, match="number of nodes: expected a whole number of at least 2"):
        make_grid(1.0, nodes, "equispaced")


@pytest.mark.parametrize(
    ("spacing", "message"),
    [
        ("geometric", "expected 'equispaced', 'chebyshev' or a list of 4 faces in m"),
        ([0.0, 0.5, 1.0], "3 nodes need 4 faces in m from root to tip, got 3"),
        ([[0.0, 0.5], [0.7, 1.0]], "got an array of shape"),
        ([0.0, 0.5, float("nan"), 1.0], "face 2 is nan"),
        ([0.1, 0.5, 0.7, 1.0], "start at 0 and end at the arm's length 1 m, got 0.1 to 1 m"),
        ([0.0, 0.5, 0.7, 1.1], "got 0 to 1.1 m"),
        ([0.0, 0.7, 0.5, 1.0], "face 1 is at 0.7 m, face 2 at 0.5 m"),
        ([0.0, 0.5, 0.5, 1.0], "must increase"),
        (["a", 0.5, 0.6, 1.0], "expected a list of numbers in m"),
    ],
)
def test_spacing_errors_say_what_is_wrong(spacing: list[float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make_grid(1.0, 3, spacing)
