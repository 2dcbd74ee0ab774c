import numpy as np
import pytest
from plant_arms import CHAPTER_ARM, SETPOINT_CURVATURE

from plant.initial import check_name, initial_shape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import Certificate, OperatorFactors, PolynomialMatrix, Setpoint
from wire.errors import UsageError

S = np.linspace(0.0, 2.0, 21)


def _setpoint() -> Setpoint:
    def zeros(rows: int, columns: int) -> PolynomialMatrix:
        return PolynomialMatrix.from_array(np.zeros((rows, columns, 1)))

    def operator(rows: int, columns: int) -> OperatorFactors:
        return OperatorFactors(
            zeros(rows, columns),
            zeros(rows, 1),
            zeros(1, columns),
            zeros(rows, 1),
            zeros(1, columns),
        )

    certificate = Certificate(
        "certified", 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 0.0, [], 0, 0, "none", "", 0.0
    )
    return Setpoint(
        "1", SETPOINT_CURVATURE, [0.01, -0.01], [0.0], [1.0, 0.0],
        operator(4, 2), operator(1, 4), certificate, certificate,
    )  # fmt: skip


def test_setpoint_is_the_artefacts_series() -> None:
    shape = initial_shape("setpoint", _setpoint(), 2.0)
    exact = np.polynomial.Legendre(SETPOINT_CURVATURE, domain=[0.0, 2.0])
    np.testing.assert_allclose(shape.curvature_per_m(S), exact(S), rtol=1e-13)
    np.testing.assert_allclose(shape.strain(S), 0.01 - 0.01 * (S - 1.0), atol=1e-15)


def test_chapter_adds_the_second_derivative_of_its_displacement() -> None:
    """x3 = 2 s^2 - 8/3 s^3 + s^4 over the arclength in units of L = 2 m, differentiated twice."""
    setpoint = initial_shape("setpoint", _setpoint(), 2.0)
    shape = initial_shape("chapter", _setpoint(), 2.0)
    displacement = np.polynomial.Polynomial([0.0, 0.0, 2.0, -8.0 / 3.0, 1.0])
    expected = displacement.deriv(2)(S / 2.0) / 2.0
    added = shape.curvature_per_m(S) - setpoint.curvature_per_m(S)
    np.testing.assert_allclose(added, expected, atol=1e-12)
    np.testing.assert_array_equal(shape.strain(S), setpoint.strain(S))


def test_straight_is_straight_whatever_the_setpoint() -> None:
    shape = initial_shape("straight", _setpoint(), 1.0)
    plant = ArmPlant(PlantParameters(CHAPTER_ARM, (0.0, 0.5, 1.0), 0.5, shape))
    np.testing.assert_allclose(plant.shape()[:, 1], 0.0, atol=0.0)
    np.testing.assert_allclose(plant.tip(), [1.0, 0.0], atol=1e-15)
    assert plant.energy() == pytest.approx((0.0, 0.0, 0.0), abs=1e-28)


def test_setpoint_tip_is_that_of_the_continuous_curve() -> None:
    shape = initial_shape("setpoint", _setpoint(), 1.0)
    angle = np.polynomial.Legendre(SETPOINT_CURVATURE, domain=[0.0, 1.0]).integ(lbnd=0.0)
    middle = (np.arange(20000) + 0.5) / 20000
    strain = 0.01 - 0.01 * (2.0 * middle - 1.0)
    exact = [np.mean((1.0 + strain) * np.cos(angle(middle))),
             np.mean((1.0 + strain) * np.sin(angle(middle)))]  # fmt: skip
    errors = [
        np.max(np.abs(ArmPlant(
            PlantParameters(CHAPTER_ARM, (0.0, 0.5, 1.0), 0.5, shape, cells=cells)
        ).tip() - exact))
        for cells in (20, 40, 80)
    ]  # fmt: skip
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 1.8) & (orders < 2.2))


def test_unknown_name_lists_the_known() -> None:
    with pytest.raises(UsageError, match=r"'curly'.*setpoint, chapter, straight"):
        initial_shape("curly", _setpoint(), 1.0)
    with pytest.raises(UsageError, match="curly"):
        check_name("curly")
    check_name("chapter")
