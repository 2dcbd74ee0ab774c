"""Setpoints against the graphs they come from and against the exact beam's boundary value problem."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import Legendre, Polynomial
from scipy.integrate import quad, solve_bvp, solve_ivp

from design.setpoint import CHAPTER_SHAPES, Setpoint, equilibrium_load, from_shape, tip_position

Array = npt.NDArray[np.float64]
Scalar = Callable[[float], float]
AXIAL_STIFFNESS = 6400.0
"""EA L^2 / EI of the chapter's arm (theory, section 2)."""
RIGID = np.zeros(1)


def series(coefficients: Array) -> Legendre:
    """The function with these orthonormal coefficients."""
    scale = np.sqrt(2.0 * np.arange(coefficients.size) + 1.0)
    return Legendre(coefficients * scale, domain=[0.0, 1.0])


def from_powers(name: str, *powers: float) -> Setpoint:
    """Setpoint whose curvature is the polynomial with these coefficients in s."""
    plain = Polynomial(powers).convert(kind=Legendre, domain=[0.0, 1.0])
    coefficients = plain.coef / np.sqrt(2.0 * np.arange(len(plain.coef)) + 1.0)
    return Setpoint(name=name, curvature=coefficients)


def chapter(name: str) -> Setpoint:
    return from_shape(name, CHAPTER_SHAPES[name])


def graph_in_arclength(name: str) -> tuple[Array, Array, Array, Array]:
    """(s, x, w, angle) along the chapter's graph, walked from the root to arclength 1."""
    w = Polynomial(CHAPTER_SHAPES[name])
    slope = w.deriv()
    s = np.linspace(0.0, 1.0, 401)
    walk = solve_ivp(
        lambda _, x: 1.0 / np.hypot(1.0, slope(x)),
        (0.0, 1.0),
        [0.0],
        t_eval=s,
        rtol=1e-11,
        atol=1e-12,
    )
    x = walk.y[0]
    return s, x, np.asarray(w(x)), np.arctan(slope(x))


def polar_degrees(tip: Array) -> float:
    return float(np.degrees(np.arctan2(tip[1], tip[0])))


@pytest.mark.parametrize(
    ("name", "x_tip", "degrees", "millimetres"),
    [("1", 0.9645, 14.45, 0.15), ("2", 0.6896, 45.08, 0.6)],
)
def test_tips_of_the_chapters_setpoints(
    name: str, x_tip: float, degrees: float, millimetres: float
) -> None:
    _, x, w, _ = graph_in_arclength(name)
    exact = np.array([x[-1], w[-1]])
    assert exact[0] == pytest.approx(x_tip, abs=6e-5)
    assert polar_degrees(exact) == pytest.approx(degrees, abs=6e-3)
    fitted = tip_position(chapter(name), RIGID)
    assert np.linalg.norm(fitted - exact) < millimetres * 1e-3
    assert polar_degrees(fitted) == pytest.approx(degrees, abs=0.03)


def test_setpoint_3_is_a_shape_that_the_arm_can_take() -> None:
    _, x, w, _ = graph_in_arclength("3")
    assert x[-1] == pytest.approx(0.2568, abs=6e-5)
    assert polar_degrees(np.array([x[-1], w[-1]])) == pytest.approx(74.94, abs=6e-3)
    setpoint = chapter("3")
    assert series(setpoint.curvature)(0.0) == pytest.approx(15.7, abs=0.05)  # 1/r is 40
    assert polar_degrees(tip_position(setpoint, RIGID)) == pytest.approx(73.95, abs=6e-3)


@pytest.mark.parametrize("name", ["1", "2", "3"])
def test_fit_is_the_best_angle_over_arclength(name: str) -> None:
    s, _, _, angle = graph_in_arclength(name)
    fitted = series(chapter(name).curvature).integ(lbnd=0.0)
    error = fitted(s) - angle
    for j in range(3):  # the error is orthogonal to every angle that the fit can add
        direction = (Polynomial([1.0, -2.0, 1.0]) * Polynomial.basis(j)).integ()(s)
        cosine = np.trapezoid(error * direction, s) / np.sqrt(
            np.trapezoid(error**2, s) * np.trapezoid(direction**2, s)
        )
        assert abs(cosine) < 2e-3
    assert np.sqrt(np.trapezoid(error**2, s)) < {"1": 0.003, "2": 0.013, "3": 0.14}[name]


@pytest.mark.parametrize("name", ["1", "2", "3"])
@pytest.mark.parametrize("degree", [2, 4, 6])
def test_no_moment_and_no_shear_at_the_tip(name: str, degree: int) -> None:
    setpoint = from_shape(name, CHAPTER_SHAPES[name], degree)
    assert setpoint.curvature.shape == (degree + 1,)
    curvature = series(setpoint.curvature)
    scale = abs(curvature(0.0))
    assert curvature(1.0) == pytest.approx(0.0, abs=1e-11 * scale)
    assert curvature.deriv()(1.0) == pytest.approx(0.0, abs=1e-10 * scale)


def test_higher_degrees_come_closer_to_the_graph() -> None:
    _, x, w, _ = graph_in_arclength("2")
    exact = np.array([x[-1], w[-1]])
    errors = [
        np.linalg.norm(tip_position(from_shape("2", CHAPTER_SHAPES["2"], degree), RIGID) - exact)
        for degree in (2, 4, 8)
    ]
    assert errors[0] > 10 * errors[1] > 50 * errors[2]


def test_angle_is_the_integral_of_the_curvature_from_the_root() -> None:
    setpoint = chapter("2")
    curvature, angle = series(setpoint.curvature), series(setpoint.angle)
    for s in (0.0, 0.3, 1.0):
        assert angle(s) == pytest.approx(quad(curvature, 0.0, s)[0], abs=1e-12)


def test_tip_of_a_circular_arc_in_closed_form() -> None:
    quarter = from_powers("quarter circle", 0.5 * np.pi)
    np.testing.assert_allclose(tip_position(quarter, RIGID), [2 / np.pi, 2 / np.pi], atol=1e-14)
    stretched = tip_position(quarter, np.array([0.1]))
    np.testing.assert_allclose(stretched, [2.2 / np.pi, 2.2 / np.pi], atol=1e-14)


# Frames


def l2(f: Scalar, g: Scalar) -> float:
    return float(quad(lambda s: f(s) * g(s), 0.0, 1.0)[0])


@pytest.mark.parametrize("degree", [2, 5])
def test_frame_is_the_l2_projection_of_cosine_and_sine(degree: int) -> None:
    setpoint = chapter("2")
    angle = series(setpoint.curvature).integ(lbnd=0.0)
    square = 0.0

    def error(function: Scalar, approximation: Scalar) -> Scalar:
        return lambda s: float(function(angle(s)) - approximation(s))

    for coefficients, function in zip(setpoint.frame(degree), (np.cos, np.sin), strict=True):
        assert coefficients.shape == (degree + 1,)
        approximation = series(coefficients)
        for j in range(degree + 1):
            unit = Legendre.basis(j, domain=[0.0, 1.0])
            assert l2(error(function, approximation), unit) == pytest.approx(0.0, abs=1e-12)
        missed = error(function, approximation)
        square += l2(missed, missed)
    assert setpoint.frame_error(degree) == pytest.approx(np.sqrt(square), rel=1e-6)


def test_frame_degree_is_the_smallest_within_the_tolerance() -> None:
    setpoint = chapter("1")
    for degree in (1, 2, 3):
        error = setpoint.frame_error(degree)
        assert setpoint.frame_degree(1.001 * error) == degree
        assert setpoint.frame_degree(0.999 * error) == degree + 1
    assert setpoint.frame_degree(1e-15, most=3) == 3
    assert from_powers("straight", 0.0).frame_degree() == 0


# The holding load


def exact_beam(
    load: Legendre, guess: Setpoint, axial_stiffness: float, follows: bool = False
) -> tuple[Array, Array, Array]:
    """Static beam, chapter (1), under a load along y, or along n: (s, curvature, positions (2, m)).

    States (x, y, theta, kappa, N_x, N_y) with r' = (1 + e) t, theta' = kappa, N' = -load (y or n),
    kappa' = -(1 + e) n.N, e = t.N / axial_stiffness; clamped at 0, N = 0 and kappa = 0 at 1.
    """

    def rates(s: Array, state: Array) -> Array:
        _, _, theta, kappa, n_x, n_y = state
        cosine, sine = np.cos(theta), np.sin(theta)
        stretch = 1.0 + (cosine * n_x + sine * n_y) / axial_stiffness
        bend = -stretch * (cosine * n_y - sine * n_x)
        push = -load(s) * (np.stack([-sine, cosine]) if follows else np.array([[0.0], [1.0]]))
        return np.stack([stretch * cosine, stretch * sine, kappa, bend, *push])

    def ends(root: Array, tip: Array) -> Array:
        return np.array([root[0], root[1], root[2], tip[3], tip[4], tip[5]])

    s = np.linspace(0.0, 1.0, 81)
    start = np.zeros((6, s.size))
    angle = series(guess.curvature).integ(lbnd=0.0)
    start[2], start[3] = angle(s), series(guess.curvature)(s)
    if not follows:
        start[5] = -load.integ(lbnd=1.0)(s)
    start[0] = s
    found = solve_bvp(rates, ends, s, start, tol=1e-8, max_nodes=20000)
    assert found.success, found.message
    check = np.linspace(0.0, 1.0, 51)
    state = found.sol(check)
    return check, state[3], state[:2]


@pytest.mark.parametrize(
    ("name", "axial_stiffness"),
    [("1", AXIAL_STIFFNESS), ("2", AXIAL_STIFFNESS), ("3", AXIAL_STIFFNESS), ("2", 60.0)],
)
def test_the_exact_beam_takes_the_shape_under_the_holding_load(
    name: str, axial_stiffness: float
) -> None:
    setpoint = chapter(name)
    load, strain = equilibrium_load(setpoint, axial_stiffness)
    s, curvature, position = exact_beam(series(load), setpoint, axial_stiffness)
    expected = series(setpoint.curvature)(s)
    np.testing.assert_allclose(curvature, expected, atol=1e-6 * np.max(np.abs(expected)))
    np.testing.assert_allclose(position[:, -1], tip_position(setpoint, strain), atol=1e-7)


@pytest.mark.parametrize(("turn", "axial_stiffness"), [(50.0, AXIAL_STIFFNESS), (130.0, 300.0)])
def test_the_exact_beam_takes_the_shape_under_a_load_along_its_normal(
    turn: float, axial_stiffness: float
) -> None:
    """Also beyond 90 degrees, where no transverse load could."""
    c = np.radians(turn)
    setpoint = from_powers("hook", *(Polynomial([1, -2, 1]) * Polynomial([1.5 * c, 6.0 * c])).coef)
    load, strain = equilibrium_load(setpoint, axial_stiffness, "normal")
    s, curvature, position = exact_beam(series(load), setpoint, axial_stiffness, follows=True)
    expected = series(setpoint.curvature)(s)
    np.testing.assert_allclose(curvature, expected, atol=1e-6 * np.max(np.abs(expected)))
    np.testing.assert_allclose(position[:, -1], tip_position(setpoint, strain), atol=1e-6)


def test_nothing_pulls_along_an_arm_under_normal_loads() -> None:
    """Balance of forces on the piece beyond s, by quadrature: N(s) = int_s^1 f n, EA e = t.N."""
    setpoint = chapter("3")
    load, strain = equilibrium_load(setpoint, AXIAL_STIFFNESS, "normal")
    angle = series(setpoint.angle)
    for s in (0.0, 0.05, 0.4, 0.9):
        here = angle(s)
        axial, shear = (
            quad(lambda z, f=f, a=here: series(load)(z) * f(angle(z) - a), s, 1.0, epsabs=1e-12)[0]
            for f in (lambda x: -np.sin(x), np.cos)
        )
        e = series(strain)(s)
        assert AXIAL_STIFFNESS * e == pytest.approx(axial, abs=1e-10 * AXIAL_STIFFNESS)
        bend = series(setpoint.curvature).deriv()(s)
        assert shear == pytest.approx(-bend / (1.0 + e), abs=1e-8 * np.max(np.abs(load)))


def test_the_two_actuators_agree_on_a_nearly_straight_arm() -> None:
    size = 1e-5
    setpoint = from_powers("small", size, -2 * size, size)
    transverse, _ = equilibrium_load(setpoint, AXIAL_STIFFNESS)
    normal, _ = equilibrium_load(setpoint, AXIAL_STIFFNESS, "normal")
    s = np.linspace(0.0, 1.0, 7)
    np.testing.assert_allclose(series(normal)(s), series(transverse)(s), rtol=1e-8)


def test_bends_that_would_crush_a_soft_arm_are_refused_for_normal_loads_too() -> None:
    setpoint = from_powers("tight", 9.0, -18.0, 9.0)
    equilibrium_load(setpoint, 1.1 * 9.0**2 / 0.75, "normal")
    with pytest.raises(ValueError, match="setpoint tight: no normal load holds this shape"):
        equilibrium_load(setpoint, 0.9 * 9.0**2 / 0.75, "normal")


def test_strain_carries_the_axial_part_of_the_force() -> None:
    setpoint = chapter("2")
    load, strain = equilibrium_load(setpoint, AXIAL_STIFFNESS)
    for s in (0.05, 0.4, 0.9):
        force_y = quad(series(load), s, 1.0)[0]  # N_y(s) = int_s^1 f
        axial = force_y * np.sin(series(setpoint.angle)(s))
        assert AXIAL_STIFFNESS * series(strain)(s) == pytest.approx(axial, rel=1e-7)
    assert np.max(np.abs(strain)) > 1e-5


def test_small_deflections_obey_the_linear_beam() -> None:
    # f = theta'''' of the deflection: kappa = c (1 - s)^2 gives f = kappa'' = 2 c
    size = 1e-5
    load, _ = equilibrium_load(from_powers("small", size, -2 * size, size), AXIAL_STIFFNESS)
    np.testing.assert_allclose(series(load)(np.linspace(0, 1, 7)), 2 * size, rtol=1e-8)


def test_straight_arm_needs_no_load() -> None:
    straight = from_shape("straight", (0.0,))
    assert not np.any(straight.curvature)
    load, strain = equilibrium_load(straight, AXIAL_STIFFNESS)
    assert not np.any(load)
    assert not np.any(strain)
    np.testing.assert_allclose(tip_position(straight, strain), [1.0, 0.0], atol=1e-15)


# Errors


def test_shapes_beyond_90_degrees_are_refused() -> None:
    # kappa = 3 c (1 - s)^2 turns by c: at the tip only, where no quadrature point lies
    for turn, refused in ((89.9, False), (90.1, True), (-120.0, True)):
        c = 3.0 * np.radians(turn)
        setpoint = from_powers("hook", c, -2 * c, c)
        if refused:
            with pytest.raises(ValueError, match="less than 90") as caught:
                equilibrium_load(setpoint, AXIAL_STIFFNESS)
            assert "setpoint hook" in str(caught.value)
            assert f"{abs(turn):.1f} degrees" in str(caught.value)
        else:
            equilibrium_load(setpoint, AXIAL_STIFFNESS)


def test_shapes_that_would_crush_a_soft_arm_are_refused() -> None:
    # bent upwards, then down again: the load pushes along the arm
    setpoint = from_powers("s", *(Polynomial([1, -2, 1]) * Polynomial([3.0, -30.0])).coef)
    with pytest.raises(ValueError, match="setpoint s: no transverse load holds this shape"):
        equilibrium_load(setpoint, 1.0)


def test_graphs_that_leave_the_clamp_are_refused() -> None:
    for shape in ((0.1, 0.0, 1.0), (0.0, 0.1, 1.0)):
        with pytest.raises(ValueError, match=r"setpoint bad: .*clamped root"):
            from_shape("bad", shape)


def test_degrees_too_low_to_vanish_at_the_tip_are_refused() -> None:
    with pytest.raises(ValueError, match="setpoint low: curvature of degree 1"):
        from_shape("low", CHAPTER_SHAPES["1"], degree=1)
