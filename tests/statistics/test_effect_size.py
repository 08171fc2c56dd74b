"""Effect sizes: against published values of RRPP, scipy's Box-Cox likelihood, and plain logarithms."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from shapespace.cohort.cohort import Cohort
from shapespace.statistics.compare_shapes import CompareConfig, SquaresType, compare
from shapespace.statistics.effect_size import box_cox_exponent, effect_size

MONTE_CARLO = 0.35
"""Of Z by Box-Cox at 9,999 permutations: 3 standard deviations of 8 seeds (at most 0.12 each)."""


@pytest.mark.parametrize("shape", [0.3, 1.0, 4.0])
def test_the_exponent_is_that_of_scipys_profile_likelihood(shape: float) -> None:
    values = np.random.default_rng(1).gamma(shape, size=500) + 0.01
    assert box_cox_exponent(values) == pytest.approx(float(stats.boxcox_normmax(values, method="mle")), abs=2e-3)


def test_z_of_normal_powers_is_the_standard_score_and_has_no_unit() -> None:
    rng = np.random.default_rng(2)
    base = rng.normal(10, 1, 4000)
    base[0] = 14
    for power in (1.0, 2.0):
        assert effect_size(base**power) == pytest.approx((14 - base.mean()) / base.std(), abs=0.15)
    assert effect_size(1e-9 * base) == pytest.approx(effect_size(base), rel=1e-6)


def test_the_observed_value_does_not_move_the_exponent() -> None:
    drawn = np.random.default_rng(3).lognormal(size=999)
    own = box_cox_exponent(drawn)
    transformed = (np.append(1e4, drawn) ** own - 1) / own
    assert effect_size(np.append(1e4, drawn)) == pytest.approx(
        (transformed[0] - transformed.mean()) / transformed.std()
    )


def test_z_of_logarithms_is_the_plain_one_and_of_equal_values_0() -> None:
    values = np.random.default_rng(4).gamma(2.0, size=300)
    logs = np.log(values)
    assert effect_size(values, "log") == pytest.approx((logs[0] - logs.mean()) / logs.std())
    assert effect_size(np.full(20, 3.0)) == 0
    assert effect_size(np.array([2.0])) == 0


@pytest.mark.parametrize("squares", ["I", "II"])
def test_published_z_of_plethodon_are_reproduced(squares: SquaresType, geomorph_reference: dict[str, Any]) -> None:
    pytest.importorskip("formulaic")
    data = geomorph_reference
    flat = np.array(data["plethodon_gpa"]["coords"])
    shapes = np.zeros((len(flat), flat.shape[1] // 2, 3))
    shapes[:, :, :2] = flat.reshape(len(flat), -1, 2)
    table = {name: data["plethodon_table"][name] for name in ("species", "site")}
    cohort = Cohort.of_shapes(shapes, table, align=False)
    expected = data["plethodon_lm_raw_landmark_gpa"][f"pleth_{squares}"]
    options = CompareConfig(anova_type=squares, permutations=10_000, maps=False)
    found = compare(cohort, "~ species * site", options)
    for term, z, log in zip(expected["terms"], expected["Z"], expected["zlog"], strict=True):
        test = found.test(term)
        assert test.z == pytest.approx(z, abs=MONTE_CARLO)
        assert effect_size(test.arrangements, "log") == pytest.approx(log, abs=MONTE_CARLO)
