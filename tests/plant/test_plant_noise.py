import numpy as np
import pytest
from scipy.stats import kstest

from plant.noise import SensorNoise
from wire.errors import UsageError


def test_noise_is_a_function_of_seed_and_tick() -> None:
    noise = SensorNoise(7, 1e-3, 1e-2)
    in_order = [noise.sample(tick, 10) for tick in range(5)]
    again = SensorNoise(7, 1e-3, 1e-2)
    for tick in (3, 0, 4, 3):
        np.testing.assert_array_equal(again.sample(tick, 10), in_order[tick])


def test_seeds_and_ticks_differ() -> None:
    samples = [
        SensorNoise(seed, 1.0, 1.0).sample(tick, 4).tobytes()
        for seed in range(4)
        for tick in (0, 1, 2, 2**40)
    ]
    assert len(set(samples)) == len(samples)


def test_noise_is_white_gaussian_of_the_stated_deviations() -> None:
    noise = SensorNoise(11, 2e-3, 0.05)
    series = np.stack([noise.sample(tick, 50) for tick in range(400)])
    for column, deviation in enumerate((2e-3, 0.05)):
        values = series[:, :, column] / deviation
        assert kstest(values.ravel(), "norm").pvalue > 1e-3
        assert np.std(values) == pytest.approx(1.0, abs=0.02)
        assert abs(np.mean(values[1:] * values[:-1])) < 0.03  # neighbouring ticks
        assert abs(np.mean(values[:, 1:] * values[:, :-1])) < 0.03  # neighbouring segments
    assert abs(np.corrcoef(series[:, :, 0].ravel(), series[:, :, 1].ravel())[0, 1]) < 0.03


def test_no_deviation_is_no_noise() -> None:
    sample = SensorNoise(3, 0.0, 0.1).sample(5, 6)
    assert sample.shape == (6, 2)
    np.testing.assert_array_equal(sample[:, 0], 0.0)
    assert np.all(sample[:, 1] != 0.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((-1,), "seed"), ((0, -1.0), "velocity_y"), ((0, 0.0, float("nan")), "curvature_per_m")],
)
def test_wrong_parameters_are_refused_by_name(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        SensorNoise(*arguments)  # type: ignore[arg-type]


def test_negative_tick_is_refused() -> None:
    with pytest.raises(ValueError, match="tick"):
        SensorNoise(0).sample(-1, 3)
