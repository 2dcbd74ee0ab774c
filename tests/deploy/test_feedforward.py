"""Holding commands against the plant's own load matrix and a closed form."""

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import legendre

from deploy.feedforward import holding, holding_commands, profiles
from deploy.grid import make_grid
from wire.artefact import Arm

Array = npt.NDArray[np.float64]


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


CURVATURE, STRAIN, LOAD = [0.8, -1.1, 0.3], [0.02, -0.01], [0.3, -1.0, 0.5, 0.2]


def curvature_of(arm: Arm, load: Array, s: Array) -> Array:
    """Curvature by a load at the fine points s, trapezoidal sums from the tip, shape as `CURVATURE`."""
    x = 2.0 * s / s[-1] - 1.0
    rate = legendre.legval(x, CURVATURE)
    angle = np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(s)))
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    along = normal if arm.actuator == "normal" else np.tile([0.0, 1.0], (len(s), 1))
    force = from_tip(load[:, None] * along, s)
    bend = (1.0 + legendre.legval(x, STRAIN)) * np.sum(force * normal, axis=1)
    return from_tip(bend[:, None], s)[:, 0] / arm.bending_stiffness_n_m2


def from_tip(values: Array, s: Array) -> Array:
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(s)[:, None]
    return np.vstack([np.cumsum(steps[::-1], axis=0)[::-1], np.zeros((1, values.shape[1]))])


@pytest.mark.parametrize("actuator", ["transverse", "normal"])
def test_bent_shapes_are_held_by_the_moment(actuator: str) -> None:
    """What is missing bends the arm orthogonally to what any profile could add."""
    arm = Arm("bent", 1.0, 0.025, 5e3, 1.1e3, 0.02, actuator=actuator)
    grid = make_grid(1.0, 5, [0.0, 0.1, 0.3, 0.5, 0.8, 1.0])
    held = holding(arm, CURVATURE, STRAIN, LOAD, grid)
    s = np.linspace(0.0, 1.0, 20001)
    hats = profiles(grid, s)
    gap = hats @ held.commands_n_per_m - legendre.legval(2.0 * s - 1.0, LOAD)
    missing = curvature_of(arm, gap, s)
    added = np.stack([curvature_of(arm, hat, s) for hat in hats.T])
    products = np.trapezoid(added * missing, s, axis=1)
    sizes = np.linalg.norm(added, axis=1) * np.linalg.norm(missing) / len(s)
    assert np.max(np.abs(products / sizes)) < 1e-3
    at_faces = np.interp(grid.faces_m[:-1], s, missing)
    assert held.curvature_change_per_m == pytest.approx(at_faces, abs=1e-5 * np.ptp(at_faces))
