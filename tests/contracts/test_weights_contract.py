"""What every robust weight must do; a new entry of WEIGHTS is tested by being there."""

import numpy as np
import pytest

from shapespace.fit.robust.matching import WEIGHTS, spread, tails


@pytest.mark.parametrize("name", WEIGHTS)
def test_a_weight_is_one_at_no_residual_and_falls_the_same_for_both_signs(name: str) -> None:
    residual = np.linspace(0.0, 20.0, 400)
    w = WEIGHTS[name](residual, 1.5)
    assert w[0] == pytest.approx(1.0)
    assert (np.diff(w) <= 0).all() and (w >= 0).all()
    assert w[-1] < 0.1
    np.testing.assert_array_equal(w, WEIGHTS[name](-residual, 1.5))


@pytest.mark.parametrize("name", WEIGHTS)
def test_a_weight_has_no_unit_of_its_own(name: str) -> None:
    residual = np.linspace(-5.0, 5.0, 101)
    np.testing.assert_allclose(WEIGHTS[name](residual, 0.7), WEIGHTS[name](10 * residual, 7.0))


def test_the_spread_is_the_standard_deviation_of_noise_whatever_a_third_of_outliers_does() -> None:
    rng = np.random.default_rng(0)
    noise = 0.3 * rng.standard_normal(20_000)
    assert spread(noise) == pytest.approx(0.3, rel=0.03)
    noise[:4_000] = 50.0
    assert spread(noise) < 0.45


@pytest.mark.parametrize("count", [1, 2, 30, 31, 36, 1001])
def test_tails_are_the_quantile_of_numpy_to_the_last_bit(count: int) -> None:
    residual = np.random.default_rng(count).standard_normal(count)
    assert tails(residual, 1.0) == np.quantile(np.abs(residual), 0.9) / 1.645


def test_tails_are_one_for_noise_and_more_with_outliers() -> None:
    rng = np.random.default_rng(1)
    noise = 0.3 * rng.standard_normal(20_000)
    assert tails(noise, spread(noise)) == pytest.approx(1.0, rel=0.03)
    noise[:2_500] *= 10
    assert tails(noise, spread(noise)) > 1.5
