"""Fig. 1 and Fig. 2: reach by sampling against closed form, arc lengths and tips by an ODE solver."""

import math

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import minimize

from chapter import fig_one, fig_two, setpoints
from chapter.pde import SETPOINTS
from design.arm_file import axial_ratio, read_arm_file
from supervise.shipped import DEFAULT_ARM


@pytest.mark.parametrize("segments", [2, 3, 4, 5])
def test_least_distance_is_the_least_that_a_search_finds(segments: int) -> None:
    def distance(turns: np.ndarray) -> float:
        angles = np.concatenate([[0.0], np.cumsum(turns)])
        return float(abs(np.exp(1j * angles).mean()))

    draw = np.random.default_rng(3)
    bounds = [(-0.5 * math.pi, 0.5 * math.pi)] * (segments - 1)
    starts = draw.uniform(-0.5 * math.pi, 0.5 * math.pi, (12, segments - 1))
    best = min(minimize(distance, s, bounds=bounds).fun for s in starts)
    # the distance has a kink at 0, where the search stops within 1e-4
    assert best == pytest.approx(fig_one.least_distance(segments), abs=1e-4)
    sampled = np.hypot(*fig_one.sampled_tips(segments, 20_000, seed=5).T)
    assert sampled.min() >= best - 1e-4 and sampled.max() <= 1.0


def test_two_segments_fill_the_ring() -> None:
    tips = fig_one.sampled_tips(2, 100_000, seed=2)
    radius, angle = np.hypot(*tips.T), np.arctan2(*tips.T[::-1])
    count, _, _ = np.histogram2d(
        radius, angle, bins=(12, 24), range=((math.sqrt(0.5), 1.0), (-math.pi, math.pi))
    )
    assert count.min() > 0 and count.sum() == tips.shape[0]
    for joint in (90.0, 120.0, 180.0):
        elbow = 0.5 + 0.5 * np.exp(1j * math.radians(180.0 - joint))
        assert fig_one.two_segment_distance(joint) == pytest.approx(abs(elbow), abs=1e-15)


def test_arcs_reach_every_distance_within_the_curvature_of_a_circle() -> None:
    curvatures = np.linspace(0.0, 2.0 * math.pi, 101)
    distances = [fig_one.arc_distance(k) for k in curvatures]
    assert distances[0] == 1.0 and distances[-1] < 1e-15
    assert np.all(np.diff(distances) < 0.0)
    for k, found in zip(curvatures[1::20], distances[1::20], strict=True):
        chord = (
            quad(lambda s, k=k: math.cos(k * s), 0, 1)[0],
            quad(lambda s, k=k: math.sin(k * s), 0, 1)[0],
        )
        assert found == pytest.approx(math.hypot(*chord), abs=1e-12)


def test_clamped_reach_is_bounded_by_turn_then_straight_and_filled() -> None:
    limit = 40.0
    boundary = fig_one.clamped_boundary(limit)
    missed, cells = fig_one.missed_cells(fig_one.clamped_tips(limit, 401, 401), boundary, 0.04)
    assert (missed, cells > 1000) == (0, True)
    # random arms within the limit, twenty pieces of constant curvature: none gets outside
    draw = np.random.default_rng(7)
    bends = limit * draw.uniform(-1.0, 1.0, (20_000, 20)) ** 3
    bends[::2, 2:] *= (
        0.02  # hard turns at the root, then nearly straight: these come near the boundary
    )
    angles = np.concatenate([np.zeros((20_000, 1)), np.cumsum(bends / 20, axis=1)], axis=1)
    middle = angles[:, :-1] + bends / 40
    chord = np.sinc(bends / 40 / math.pi) / 20
    x, y = (chord * np.cos(middle)).sum(axis=1), (chord * np.sin(middle)).sum(axis=1)
    outer = np.hypot(*boundary.T)
    polar = np.unwrap(np.arctan2(*boundary.T[::-1]))
    order = np.argsort(polar)
    edge = np.interp(np.arctan2(y, x), polar[order], outer[order])
    # the boundary is drawn with 721 points, chords within 1e-5
    assert np.all(np.hypot(x, y) <= edge + 2e-5)
    assert np.min(edge - np.hypot(x, y)) < 0.01
    assert fig_one.area(boundary) / math.pi == pytest.approx(0.9534, abs=1e-4)


@pytest.mark.parametrize(
    ("position", "x", "angle", "root", "length"),
    [
        (0, 0.9645, 14.45, 1.1, 1.0373),
        (1, 0.6896, 45.08, 5.6, 1.5454),
        (2, 0.2568, 74.94, 57.6, 26.3752),
    ],
)
def test_cut_at_a_metre_of_arc(
    position: int, x: float, angle: float, root: float, length: float
) -> None:
    w = SETPOINTS[position].w
    slope = w.deriv()
    end = fig_two.arc_end(w)
    by_ode = fig_two.arc_end_by_ode(w)
    assert end == pytest.approx(x, abs=5e-5)
    assert (end, w(end)) == pytest.approx(by_ode, abs=1e-10)
    assert math.degrees(math.atan2(by_ode[1], by_ode[0])) == pytest.approx(angle, abs=5e-3)
    whole, _ = quad(lambda t: math.hypot(1.0, slope(t)), 0.0, 1.0, epsabs=1e-11, limit=200)
    assert fig_two.arc_length(w, 1.0) == pytest.approx(whole, abs=1e-9)
    assert whole == pytest.approx(length, abs=5e-5)
    assert fig_two.curvature(w, np.zeros(1))[0] == pytest.approx(root)


def test_octarms_tips_by_an_ode_solver() -> None:
    arm = read_arm_file(DEFAULT_ARM)
    stiffness = axial_ratio(arm.arm()) ** 2
    for row, own in zip(fig_two.shapes(), arm.design_setpoints(), strict=True):
        # curvature from its orthonormal coefficients, by numpy's own Legendre class on [0, 1]
        scaled = own.curvature * np.sqrt(2.0 * np.arange(own.curvature.size) + 1.0)
        bend = np.polynomial.Legendre(scaled, domain=[0.0, 1.0])
        rate = bend.deriv()

        def go(s: float, y: np.ndarray, bend=bend, rate=rate) -> list[float]:  # type: ignore[no-untyped-def]
            # N = (0, N_y), EA e = N_y sin theta, M' = -(1 + e) N_y cos theta
            load, e = rate(s), 0.0
            for _ in range(60):
                e = -load * math.tan(y[0]) / ((1.0 + e) * stiffness)
            return [bend(s), (1.0 + e) * math.cos(y[0]), (1.0 + e) * math.sin(y[0])]

        found = solve_ivp(go, (0.0, 1.0), [0.0, 0.0, 0.0], method="DOP853", rtol=1e-10, atol=1e-11)
        assert row.octarm_tip == pytest.approx(tuple(found.y[1:, -1]), abs=1e-8)
        assert abs(bend(1.0)) < 1e-10 and abs(rate(1.0)) < 1e-9
        assert row.octarm_largest_curvature < 40.0


def test_how_near_octarms_setpoints_are() -> None:
    rows = fig_two.shapes()
    assert [r.unstrained_distance for r in rows] == pytest.approx(
        [1.08e-4, 5.59e-4, 2.54e-2], rel=0.01
    )
    assert [r.octarm_angle for r in rows] == pytest.approx([14.45, 45.05, 73.95], abs=0.01)
    assert all(r.line_distance >= r.tip_distance for r in rows)
    # nearly no moment at the cut, hundreds of times the root's at x = 1 for none but that cut
    assert all(abs(r.bend_at_cut) < 0.1 * r.root_curvature for r in rows)
    assert rows[2].bend_at_one > 8.0 * rows[2].root_curvature


def test_the_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setpoints, "SAMPLES", 5000)
    monkeypatch.setattr(setpoints, "BENDS", 401)
    found = setpoints.part(lambda _: None)
    assert set(found.figures) == {"setpoints-reach.png", "setpoints-shapes.png"}
    assert all(f"({name})" in found.text for name in found.figures)
    assert found.facts["largest_gap_gauss_ode_m"] < 1e-10
    assert {c.where: c.holds for c in found.claims}["Fig. 1b"]
