"""Shapes that n commands hold: in balance by quadrature, and nearly the wanted ones."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from closed_form import ARM
from numpy.polynomial import legendre
from statics import SETPOINT_2, SETPOINT_3, rest

from deploy.equilibrium import equilibrium
from deploy.feedforward import holding_commands
from deploy.grid import SegmentGrid, make_grid
from deploy.held import CELLS, Held, Holder
from wire.errors import UsageError

Array = npt.NDArray[np.float64]


def hold(curvature: list[float], grid: SegmentGrid, near: Held | None = None) -> Held:
    series = np.array(curvature)
    return Holder(ARM, grid).hold(series, equilibrium(ARM, series, "s"), "s", near)


def load(grid: SegmentGrid, commands: Array, s: Array) -> Array:
    """What the arm carries: linear between the outer faces, constant on the first segment."""
    return np.interp(s, grid.faces_m[1:], commands)


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
def test_the_held_shape_is_the_one_that_shooting_finds(spacing: str) -> None:
    grid = make_grid(1.0, 6, spacing)
    held = hold(SETPOINT_2, grid)
    found = rest(
        ARM,
        lambda s: float(load(grid, held.command_n_per_m, np.array([s]))[0]),
        float(np.radians(54.0)),
        grid.faces_m,
    )
    np.testing.assert_allclose(held.position_m.T, found[1:, 1:3], atol=2e-6)
    bend = found[:-1, 3] / ARM.bending_stiffness_n_m2
    np.testing.assert_allclose(held.curvature_per_m[1:], bend[1:], atol=2e-3)


@pytest.mark.parametrize("nodes", [5, 10])
def test_a_strongly_bent_shape_is_in_balance_and_ends_where_it_should(nodes: int) -> None:
    grid = make_grid(1.0, nodes, "equispaced")
    held = hold(SETPOINT_3, grid)
    assert held.angle_rad is not None
    step = 1.0 / CELLS
    s = (np.arange(CELLS) + 0.5) * step
    fine = np.linspace(0.0, 1.0, 20 * CELLS + 1)
    f = load(grid, held.command_n_per_m, fine)
    tail = np.append(np.cumsum((0.5 * (f[1:] + f[:-1]) * np.diff(fine))[::-1])[::-1], 0.0)
    force = np.interp(s, fine, tail)
    strain = force * np.sin(held.angle_rad) / ARM.axial_stiffness_n
    bends = force * (1.0 + strain) * np.cos(held.angle_rad)
    moment = np.append(np.cumsum((bends * step)[::-1])[::-1], 0.0)[1:-1]
    slope = np.diff(held.angle_rad) / step
    np.testing.assert_allclose(moment, ARM.bending_stiffness_n_m2 * slope, atol=1e-6)

    wanted = legendre.legval(1.0, equilibrium(ARM, SETPOINT_3, "s").position_m.T)
    assert np.hypot(*(held.position_m[:, -1] - wanted)) < 1e-3 * (1.0 if nodes > 5 else 2.0)


def test_more_segments_come_nearer_and_smooth_loads_are_met_at_once() -> None:
    angle = legendre.legint(np.array(SETPOINT_3), lbnd=-1.0) * 0.5
    misses = []
    for nodes in (5, 10, 20):
        held = hold(SETPOINT_3, make_grid(1.0, nodes, "equispaced"))
        assert held.angle_rad is not None
        s = (np.arange(CELLS) + 0.5) / CELLS
        misses.append(float(np.std(held.angle_rad - legendre.legval(2.0 * s - 1.0, angle))))
    assert misses[1] < 0.2 * misses[0]
    assert misses[2] < 0.2 * misses[1]


def test_another_shape_to_start_from_changes_nothing() -> None:
    grid = make_grid(1.0, 10, "equispaced")
    alone = hold(SETPOINT_3, grid)
    onward = hold(SETPOINT_3, grid, hold((0.98 * np.array(SETPOINT_3)).tolist(), grid))
    np.testing.assert_allclose(onward.command_n_per_m, alone.command_n_per_m, atol=1e-6)
    np.testing.assert_allclose(onward.position_m, alone.position_m, atol=1e-9)


def test_a_straight_arm_is_held_by_nothing() -> None:
    held = hold([0.0], make_grid(1.0, 4, "equispaced"))
    for values in (held.command_n_per_m, held.curvature_per_m, held.strain, held.position_m[1]):
        np.testing.assert_allclose(values, 0.0, atol=1e-15)


def farthest_degrees(held: Held, series: Array, length_m: float) -> float:
    assert held.angle_rad is not None
    angle = legendre.legint(series, lbnd=-1.0) * 0.5 * length_m
    wanted = legendre.legval(2.0 * (np.arange(CELLS) + 0.5) / CELLS - 1.0, angle)
    return float(np.degrees(np.max(np.abs(held.angle_rad - wanted))))


@pytest.mark.parametrize("spacing", ["chebyshev", [0.0, 0.05, 0.15, 0.4, 0.7, 1.0]])
def test_few_segments_hold_a_strongly_bent_shape_by_way_of_others(
    spacing: str | list[float],
) -> None:
    """From the projected load the search finds another shape here, or none."""
    held = hold(SETPOINT_3, make_grid(1.0, 5, spacing))
    assert farthest_degrees(held, np.array(SETPOINT_3), 1.0) < 3.0
    assert np.max(np.abs(held.command_n_per_m)) < 4.0


def test_a_moment_at_the_tip_is_made_by_the_outer_segments() -> None:
    series = np.array([0.9, -1.3, 0.5, 0.1, -0.2])
    arm = msgspec.structs.replace(ARM, length_m=1.25)
    rest_of_it = equilibrium(arm, series, "s")
    held = Holder(arm, make_grid(1.25, 4, "equispaced")).hold(series, rest_of_it, "s")
    assert farthest_degrees(held, series, 1.25) < 1.0


def test_a_shape_that_the_segments_cannot_hold_is_refused() -> None:
    with pytest.raises(UsageError, match="s: 2 segments hold no shape like it"):
        hold([0.0, 0.0, 0.0, 8.0], make_grid(1.0, 2, "equispaced"))


def test_projected_commands_are_where_the_search_starts() -> None:
    grid = make_grid(1.0, 8, "equispaced")
    series = equilibrium(ARM, SETPOINT_2, "s").load_n_per_m
    np.testing.assert_allclose(
        Holder(ARM, grid).commands(series), holding_commands(series, grid), rtol=1e-12
    )
