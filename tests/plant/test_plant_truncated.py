"""The source chapter's models as models of the plant: differences, products of (2), the arm that they move."""

import math

import mpmath
import numpy as np
import pytest
import sympy as sp
from plant_arms import CHAPTER_ARM, SETPOINT_CURVATURE, Array, stiffnesses, undamped

from plant.differences import Bias, Differences, differences
from plant.initial import InitialShape, legendre_profile
from plant.model import ArmPlant, PlantParameters
from plant.truncated import Form, TruncatedModel, first_order
from wire.errors import UsageError

EA, EI, RHO = stiffnesses(CHAPTER_ARM)
TEN = tuple(np.linspace(0.0, 1.0, 11))
ROOTS = (1.875104068711961, 4.694091132974175, 7.854757438237613)  # cos x cosh x = -1


def _mode(k: float, s: Array, order: int) -> Array:
    """Derivative of the clamped-free beam's mode with wave number k, up to a factor."""
    ratio = (math.cos(k) + math.cosh(k)) / (math.sin(k) + math.sinh(k))
    smooth = (np.cosh(k * s), np.sinh(k * s))
    waves = [np.cos(k * s), -np.sin(k * s), -np.cos(k * s), np.sin(k * s)]
    cosine, sine = waves[order % 4], waves[(order + 3) % 4]
    even, odd = smooth[order % 2], smooth[1 - order % 2]
    return np.asarray(k**order * (even - cosine - ratio * (odd - sine)))


@pytest.mark.parametrize("bias", ["root", "tip"])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_even_differences_are_of_second_order_and_odd_ones_of_first(order: int, bias: Bias) -> None:
    """Of a mode's displacement, away from the ends, where one ghost point is of lower order."""
    errors = []
    for cells in (80, 160):
        s = np.arange(1, cells + 1) / cells
        found = differences(cells, 1.0, bias=bias).transverse[order] @ _mode(ROOTS[1], s, 0)
        inside = (s > 0.2) & (s < 0.8)
        errors.append(np.max(np.abs(found - _mode(ROOTS[1], s, order))[inside]))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(1.0 if order % 2 else 2.0, abs=0.05)


def test_the_sides_of_odd_differences_differ_in_the_sign_of_their_error() -> None:
    """Towards the root -step / 2 times the next derivative, towards the tip the opposite."""
    s, step = np.arange(1, 81) / 80, 1 / 80
    exact, inside = _mode(ROOTS[0], s, 3), (s > 0.2) & (s < 0.8)
    leading = 0.5 * step * _mode(ROOTS[0], s, 4)[inside]
    sides: tuple[tuple[Bias, float], ...] = (("root", -1.0), ("tip", 1.0))
    for bias, sign in sides:
        found = differences(80, 1.0, bias=bias).transverse[3] @ _mode(ROOTS[0], s, 0)
        error = (found - exact)[inside]
        np.testing.assert_allclose(error, sign * leading, atol=0.05 * np.abs(leading).max())


def test_frequencies_of_the_straight_arm_converge_to_the_closed_form() -> None:
    """Second order; with two conditions for u the axial ones too, with the chapter's four u floats free."""
    errors = []
    for cells in (10, 20, 40):
        model = TruncatedModel(EA, EI, RHO, differences(cells, 1.0))
        still = np.zeros((5, cells))
        squares = -np.linalg.eigvals(model.linear(still, still))
        assert np.max(np.abs(squares.imag)) < 1e-9 * np.max(np.abs(squares))
        found = np.sqrt(np.sort(squares.real))
        bending = [k**2 * math.sqrt(EI / RHO) for k in ROOTS]
        axial = 0.5 * math.pi * math.sqrt(EA / RHO)
        errors.append([np.min(np.abs(found - exact)) / exact for exact in (*bending, axial)])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders[-1], 2.0, atol=0.1)
    assert errors[0][0] < 0.01
    four = TruncatedModel(EA, EI, RHO, differences(10, 1.0, axial_ends="four"))
    along = four.linear(np.zeros((5, 10)), np.zeros((5, 10)))[:10, :10]
    u = np.arange(1, 11) / 10
    np.testing.assert_allclose(along @ u, 0.0, atol=1e-9)  # a stretch that nothing opposes


def _exact_differences(points: Array) -> Differences:
    """Matrices that differentiate polynomials s^1..s^n exactly, in the place of the chapter's."""
    powers = np.arange(1, points.size + 1)
    samples = points[:, None] ** powers
    found = []
    for order in range(5):
        factor = np.array([math.perm(int(p), order) for p in powers])
        found.append(factor * points[:, None] ** np.maximum(powers - order, 0))
    matrices = np.array(found) @ np.linalg.inv(samples)
    return Differences(float(points[0]), matrices, matrices)


def test_products_are_the_second_order_of_the_exact_model() -> None:
    """(1) differentiated by sympy for polynomial displacements, expanded by differences of 60 digits; as
    printed, the last products are others."""
    x, small = sp.symbols("x epsilon")
    u = small * (sp.Rational(1, 2) * x - x**2 / 3 + x**5 / 7)
    w = small * (x**2 - sp.Rational(3, 4) * x**3 + x**4 / 5)
    ux, wx = sp.diff(u, x), sp.diff(w, x)
    angle, stretch = sp.atan2(wx, 1 + ux), sp.sqrt((1 + ux) ** 2 + wx**2)
    shear = sp.diff(angle, x, 2) / stretch
    axial = (stretch - 1) * EA
    forces = (
        axial * sp.cos(angle) + EI * shear * sp.sin(angle),
        axial * sp.sin(angle) - EI * shear * sp.cos(angle),
    )
    points = np.array([0.15, 0.4, 0.55, 0.8, 1.0])
    exact = []
    for force in forces:
        along = sp.lambdify((x, small), sp.diff(force, x), "mpmath")
        with mpmath.workdps(60):  # differences in epsilon, off by its square: 1e-24
            step = mpmath.mpf(10) ** -12
            ahead, behind = ([along(mpmath.mpf(s), e) for s in points] for e in (step, -step))
            pairs = list(zip(ahead, behind, strict=True))
            exact.append(
                [
                    [float((a - b) / (2 * step)) for a, b in pairs],
                    [float((a + b) / step**2) for a, b in pairs],
                ]
            )
    values = [np.array([float(f.subs({x: s, small: 1})) for s in points]) for f in (u, w)]
    model = TruncatedModel(EA, EI, 1.0, _exact_differences(points))
    found = model.accelerations(*values)
    linear = model.linear(np.zeros((5, 5)), np.zeros((5, 5))) @ np.concatenate(values)
    for got, first, wanted in zip(found, np.split(linear, 2), np.array(exact), strict=True):
        np.testing.assert_allclose(first, wanted[0], rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(got - first, 0.5 * wanted[1], rtol=1e-8, atol=1e-9)
    printed = TruncatedModel(EA, EI, 1.0, _exact_differences(points), "printed")
    assert np.max(np.abs(printed.accelerations(*values)[1] - found[1])) > 1e-4


@pytest.mark.parametrize("form", ["printed", "corrected"])
def test_the_jacobian_is_the_derivative_of_the_accelerations(form: Form) -> None:
    """They are polynomials of degree two, so a central difference has no error but rounding."""
    random = np.random.default_rng(5)
    model = TruncatedModel(EA, EI, RHO, differences(7, 1.0), form)
    u, w, du, dw = random.standard_normal((4, 7)) * 1e-2
    ahead, behind = (np.concatenate(model.accelerations(u + k * du, w + k * dw)) for k in (1, -1))
    along = model.jacobian(u, w) @ np.concatenate([du, dw])
    np.testing.assert_allclose(
        along, 0.5 * (ahead - behind), rtol=1e-9, atol=1e-9 * np.abs(along).max()
    )


def test_first_order_form_has_the_drag_on_the_velocities() -> None:
    model = TruncatedModel(EA, EI, RHO, differences(6, 1.0))
    still = np.zeros((5, 6))
    eigenvalues = np.linalg.eigvals(first_order(model.linear(still, still), 0.02))
    np.testing.assert_allclose(eigenvalues.real, -0.01, atol=1e-9)


def _small(s_m: Array) -> Array:
    return 1e-3 * (4.0 - 16.0 * s_m + 12.0 * s_m**2)


@pytest.mark.parametrize("model", ["quadratic", "quadratic-printed", "linear", "linear-printed"])
def test_a_small_motion_is_the_exact_models(model: str) -> None:
    """Same grid; millimetres, of which micrometres differ."""
    shape, load = InitialShape(_small), np.full(10, 1e-5)
    plants = [
        ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5, shape, cells=40, model=name))
        for name in (model, "exact")
    ]
    for tick in range(40):
        for plant in plants:
            plant.advance(load, tick)
    tips = [plant.tip() for plant in plants]
    assert abs(tips[1][1]) > 1e-4
    np.testing.assert_allclose(tips[0], tips[1], atol=3e-6)
    np.testing.assert_allclose(plants[0].measure(), plants[1].measure(), atol=2e-4)


def test_the_integrator_follows_the_linear_model_on_the_chapters_grid() -> None:
    """Against the matrix exponential of the same matrix, from rest; second order in the substep."""
    from scipy.linalg import expm

    errors = []
    for safety in (0.2, 0.1):
        parameters = PlantParameters(
            CHAPTER_ARM, TEN, 0.5, InitialShape(_small), model="linear", cfl_safety=safety
        )
        plant = ArmPlant(parameters)
        assert parameters.grid.cells == 10
        start = plant.state.reshape(2, 10, 2)
        points = np.arange(1, 11) / 10
        still = np.zeros((5, 10))
        matrix = first_order(
            TruncatedModel(EA, EI, RHO, differences(10, 1.0)).linear(still, still),
            CHAPTER_ARM.drag_per_s,
        )
        x = np.concatenate(
            [start[0, :, 0] - points, start[1, :, 0], start[0, :, 1], start[1, :, 1]]
        )
        for tick in range(20):
            plant.advance(np.zeros(10), tick)
        wanted = expm(10.0 * matrix) @ x
        errors.append(np.max(np.abs(plant.shape()[1:, 1] - wanted[20:30])))
    assert errors[1] < 2e-6
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


def test_a_linear_model_rests_at_its_setpoint_under_the_holding_load() -> None:
    """And leaves it, growing, from anywhere beside it: (4) at a curved setpoint is unstable."""
    setpoint = InitialShape(legendre_profile(SETPOINT_CURVATURE, 1.0))
    holding = tuple(np.linspace(1e-3, 5e-3, 10))
    parameters = PlantParameters(
        CHAPTER_ARM, TEN, 0.05, setpoint, model="linear", about=setpoint, holding_n_per_m=holding
    )
    plant = ArmPlant(parameters)
    rest = plant.shape()
    plant.advance(np.asarray(holding), 0)
    np.testing.assert_allclose(plant.shape(), rest, atol=1e-12)
    plant.advance(np.asarray(holding) + 1e-6, 1)
    away = []
    for tick in range(2, 62):
        plant.advance(np.asarray(holding), tick)
        away.append(float(np.max(np.abs(plant.shape() - rest))))
    assert away[-1] > 1e3 * away[19]


def test_the_quadratic_model_leaves_for_infinity_and_says_so() -> None:
    """From the chapter's initial condition, within a second; the exact arm swings back."""

    def chapter(s_m: Array) -> Array:
        return 4.0 - 16.0 * s_m + 12.0 * s_m**2

    names = ("quadratic", "exact")
    plants = [
        ArmPlant(
            PlantParameters(undamped(CHAPTER_ARM), TEN, 0.5, InitialShape(chapter), model=name)
        )
        for name in names
    ]
    for tick in range(40):
        for plant in plants:
            plant.advance(np.zeros(10), tick)
    told = plants[0].first_non_finite()
    assert told is not None
    assert "plant model quadratic, which has no bound" in told
    assert plants[1].first_non_finite() is None


def test_models_grids_and_loads_are_checked() -> None:
    with pytest.raises(
        UsageError, match="plant model 'cubic' is not known; known: exact, quadratic"
    ):
        PlantParameters(CHAPTER_ARM, TEN, 0.5, model="cubic")
    with pytest.raises(UsageError, match=r"expected 4\.\.400 for the chapter's models, got 3"):
        PlantParameters(CHAPTER_ARM, TEN, 0.5, model="linear", cells=3)
    with pytest.raises(UsageError, match=r"expected 4\.\.400 .* got 401"):
        PlantParameters(CHAPTER_ARM, TEN, 0.5, model="quadratic", cells=401)
    with pytest.raises(UsageError, match="expected 10 loads, got 2"):
        PlantParameters(CHAPTER_ARM, TEN, 0.5, model="linear", holding_n_per_m=(0.0, 0.0))
    with pytest.raises(ValueError, match="at least 4, got 3"):
        differences(3, 1.0)
    with pytest.raises(ValueError, match="reaction of the clamp"):
        ArmPlant(PlantParameters(CHAPTER_ARM, TEN, 0.5, model="linear")).clamp_reaction()
