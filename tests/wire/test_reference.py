"""The reference against numpy's Chebyshev series and finite differences; damage is named."""

from __future__ import annotations

import msgpack
import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import chebyshev

from wire.errors import UsageError
from wire.reference import Leg, Reference, progress

Array = npt.NDArray[np.float64]


def coefficients(seed: int, quantities: int = 3, degree: int = 5) -> Array:
    return np.random.default_rng(seed).standard_normal((4, quantities, degree + 1))


def test_the_time_law_starts_and_ends_at_rest_and_its_rates_are_derivatives() -> None:
    assert progress(0.0) == (0.0, 0.0, 0.0)
    assert progress(1.0) == (1.0, 0.0, 0.0)
    assert progress(0.5)[0] == pytest.approx(0.5)
    x, h = np.linspace(0.05, 0.95, 19), 1e-4
    for at in x:
        before, here, after = progress(at - h), progress(at), progress(at + h)
        assert here[1] == pytest.approx((after[0] - before[0]) / (2.0 * h), abs=1e-6)
        assert here[2] == pytest.approx((after[1] - before[1]) / (2.0 * h), abs=1e-5)


def test_values_are_the_series_times_the_powers_of_the_rates() -> None:
    tick_s, begin, move = 0.25, 1.0, 3.0
    table = coefficients(1)
    reference = Reference(tick_s, [Leg(begin, move, table)])
    for tick in range(4, 16):
        sigma, rate, second = progress((tick * tick_s - begin) / move)
        rate, second = rate / move, second / move**2
        a = [chebyshev.chebval(2.0 * sigma - 1.0, one.T) for one in table]
        expected = a[0] + a[1] * rate + a[2] * rate**2 + a[3] * second
        np.testing.assert_allclose(reference.at(tick), expected, rtol=1e-12, atol=1e-12)


def test_rests_are_the_ends_of_the_legs_and_cost_nothing() -> None:
    first, second = coefficients(2), coefficients(3)
    reference = Reference(0.5, [Leg(1.0, 2.0, first), Leg(5.0, 1.0, second)])
    start, middle, end = (
        chebyshev.chebval(x, table[0].T)
        for x, table in ((-1.0, first), (1.0, first), (1.0, second))
    )
    for ticks, value in (((0, 1, 2), start), ((6, 8, 9), middle), ((12, 500), end)):
        got = [reference.at(tick) for tick in ticks]
        assert all(reference.rests(tick) for tick in ticks if tick != 2)
        np.testing.assert_allclose(got, np.tile(value, (len(ticks), 1)), atol=1e-12)
        assert got[-1] is reference.at(ticks[-1])
        assert not got[-1].flags.writeable
    assert not reference.rests(4)


def test_a_reference_that_only_rests() -> None:
    table = coefficients(4, degree=0)
    reference = Reference(0.1, [Leg(0.0, 0.0, table)])
    np.testing.assert_array_equal(reference.at(0), table[0, :, 0])
    assert reference.at(0) is reference.at(9999)


def test_through_msgpack_and_back_is_bitwise() -> None:
    reference = Reference(0.1, [Leg(0.5, 2.0, coefficients(5)), Leg(3.0, 1.0, coefficients(6))])
    back = Reference.from_plain(msgpack.unpackb(msgpack.packb(reference.to_plain())))
    for tick in range(60):
        assert reference.at(tick).tobytes() == back.at(tick).tobytes()


def test_what_does_not_fit_is_refused() -> None:
    good = Leg(0.0, 2.0, coefficients(7))
    with pytest.raises(UsageError, match="no leg"):
        Reference(0.1, [])
    with pytest.raises(UsageError, match="overlap"):
        Reference(0.1, [good, Leg(1.0, 2.0, coefficients(8))])
    with pytest.raises(UsageError, match="expected coefficients of shape"):
        Leg(0.0, 1.0, np.zeros((3, 2, 2)))
    with pytest.raises(UsageError, match="not finite"):
        Leg(0.0, 1.0, np.full((4, 1, 1), np.nan))
    for begin, move in ((np.nan, 1.0), (0.0, -1.0), (0.0, np.inf)):
        with pytest.raises(UsageError, match="expected finite times"):
            Leg(begin, move, coefficients(9))
    plain = Reference(0.1, [good]).to_plain()
    for damaged in (
        {"tick_s": 0.1},
        plain | {"legs": [[0.0, 1.0, 4, 3, 7, b"short"]]},
        plain | {"legs": 3},
    ):
        with pytest.raises(UsageError, match="deploy the gains again"):
            Reference.from_plain(damaged)
