"""Holding commands against the plant's own load matrix and a closed form."""

import numpy as np
import pytest
from numpy.polynomial import legendre

from deploy.feedforward import holding_commands, profiles
from deploy.grid import make_grid


def test_a_load_that_is_a_profile_is_reproduced() -> None:
    grid = make_grid(0.8, 7, "chebyshev")
    assert holding_commands([3.0], grid) == pytest.approx(np.full(7, 3.0), rel=1e-12)


def test_the_difference_has_no_moment_against_any_profile() -> None:
    grid = make_grid(1.0, 6, "equispaced")
    series = [0.3, -1.0, 0.5, 0.2]
    commands = holding_commands(series, grid)
    s = np.linspace(0.0, 1.0, 6 * 2000 + 1)
    load = legendre.legval(2.0 * s - 1.0, series)
    hats = profiles(grid, s)
    moments = np.trapezoid(hats * (load - hats @ commands)[:, None], s, axis=0)
    assert np.max(np.abs(moments)) < 1e-7


@pytest.mark.parametrize("series", [[0.3, -1.0, 0.5, 0.2]])
def test_bending_moment_converges_faster_than_with_samples(series: list[float]) -> None:
    """The root moment of what is missing: the hold error of the arm is proportional to it."""

    def missing(nodes: int, *, projected: bool) -> float:
        grid = make_grid(1.0, nodes, "equispaced")
        faces = grid.faces_m[1:]
        samples = legendre.legval(2.0 * faces - 1.0, series)
        commands = holding_commands(series, grid) if projected else samples
        s = np.linspace(0.0, 1.0, nodes * 2000 + 1)
        gap = legendre.legval(2.0 * s - 1.0, series) - profiles(grid, s) @ commands
        return abs(float(np.trapezoid(gap * s**2, s)))

    assert missing(10, projected=True) < 0.1 * missing(10, projected=False)
