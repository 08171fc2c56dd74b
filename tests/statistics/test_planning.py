"""Planning of sample sizes: planned power against the power on fresh data with a known truth."""

from pathlib import Path

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.statistics.shape_tests.permutations import Groups, permuted
from shapespace.statistics.shape_tests.planning import plan_sample_size
from shapespace.types import FloatArray

GROUP = ("group",)
DEVIATIONS = 0.8 ** np.arange(12)


def drawn(sizes: tuple[int, ...], shift: float, rng: np.random.Generator) -> tuple[FloatArray, Groups]:
    """Return normal data of groups whose means differ along the third axis."""
    codes = np.repeat(np.arange(len(sizes)), sizes)
    values = rng.normal(size=(len(codes), 12)) * DEVIATIONS
    values[:, 2] += shift * codes
    return values, Groups(tuple("abc"[: len(sizes)]), codes)


def pilot(sizes: tuple[int, ...], shift: float, seed: int = 0) -> Cohort:
    values, groups = drawn(sizes, shift, np.random.default_rng(seed))
    shapes = np.zeros((len(values), 6, 3))
    shapes[:, :, :2] = values.reshape(len(values), 6, 2)
    return Cohort.of_shapes(shapes, {"group": [groups.names[k] for k in groups.codes]}, align=False, unit="")


def power_of(found: object, size: int) -> float:
    return found.statistic("power", f"{size} per group").value  # type: ignore[attr-defined]


def test_planned_power_is_that_of_fresh_data() -> None:
    shift, size, sets = 0.7, 25, 250
    rng = np.random.default_rng(8)
    hits = 0
    for seed in range(sets):
        values, groups = drawn((size, size), shift, rng)
        centred = values - values.mean(axis=0)
        f = permuted(2 * size, 100, seed, lambda rows: (groups.sums(centred, rows) ** 2).sum(axis=(1, 2)), None)  # noqa: B023
        hits += (f >= f[0] * (1 - 1e-9)).mean() <= 0.05
    found = plan_sample_size(
        pilot((120, 120), shift), group=GROUP, effect=str(shift), sizes=(size,), simulations=250, permutations=100
    )
    fresh, planned = hits / sets, power_of(found, size)
    assert 0.3 < fresh < 0.9
    assert planned == pytest.approx(fresh, abs=4 * np.sqrt(2 * fresh * (1 - fresh) / sets))


def test_without_an_effect_the_power_is_the_level() -> None:
    found = plan_sample_size(
        pilot((15, 20), 0.5), group=GROUP, effect="1e-6", sizes=(12,), simulations=300, permutations=40
    )
    assert power_of(found, 12) == pytest.approx(0.05, abs=0.04)


def test_power_rises_with_the_size_and_the_size_for_80_percent_lies_between() -> None:
    found = plan_sample_size(
        pilot((20, 20), 1.0), group=GROUP, effect="0.9", sizes=(40, 5, 15), simulations=80, permutations=40
    )
    powers = [power_of(found, size) for size in (5, 15, 40)]
    assert powers == sorted(powers)
    assert 5 < found.statistic("shapes per group").value <= 40
    assert found.table("Power").rows[0][0] == 5


def test_effects_are_corrected_observed_multiples_or_distances() -> None:
    cohort = pilot((12, 12), 1.0)
    distances = {}
    for effect in ("corrected", "observed", "2x", "0.25"):
        found = plan_sample_size(cohort, group=GROUP, effect=effect, sizes=(5,), simulations=1, permutations=20)
        distances[effect] = found.settings["distance"]
        assert any("biased upwards" in note for note in found.cohort.notes)
    values, codes = cohort.coefficients, np.repeat([0, 1], 12)
    means = [values[codes == k].mean(axis=0) for k in (0, 1)]
    noise = sum(float(values[codes == k].var(axis=0, ddof=1).sum()) / 12 for k in (0, 1))
    observed = float(np.linalg.norm(means[1] - means[0]))
    assert distances["observed"] == pytest.approx(observed)
    assert distances["corrected"] == pytest.approx(np.sqrt(observed**2 - noise))
    assert distances["2x"] == pytest.approx(2 * distances["corrected"])
    assert distances["0.25"] == 0.25


def test_three_groups_and_fewer_shapes_than_dimensions_are_planned_and_saved(tmp_path: Path) -> None:
    found = plan_sample_size(
        pilot((3, 4, 3), 1.5), group=GROUP, effect="observed", sizes=(4, 8), simulations=20, permutations=20
    )
    assert power_of(found, 8) > 0.3
    again = plan_sample_size(
        pilot((3, 4, 3), 1.5), group=GROUP, effect="observed", sizes=(4, 8), simulations=20, permutations=20
    )
    assert [s.value for s in again.statistics] == [s.value for s in found.statistics]
    assert found.save(tmp_path).is_file()


@pytest.mark.parametrize(
    ("sizes", "options", "words"),
    [
        ((5, 5), {"sizes": (1,)}, "sizes of 2 or more"),
        ((5, 5), {"sizes": ()}, "sizes of 2 or more"),
        ((5, 5), {"permutations": 10}, "20 or more permutations"),
        ((5, 5), {"effect": "large"}, "cannot be read"),
        ((5, 5), {"effect": "0"}, "cannot be read"),
        ((2, 5), {}, "3 or more"),
    ],
)
def test_plans_that_cannot_be_simulated_are_refused(
    sizes: tuple[int, ...], options: dict[str, object], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        plan_sample_size(pilot(sizes, 1.0), group=GROUP, **options)  # type: ignore[arg-type]


def test_a_pilot_without_a_difference_needs_a_distance() -> None:
    cohorts = (pilot((6, 6), 0.0, seed) for seed in range(20))
    with pytest.raises(InputError, match="give a distance with --effect"):
        for cohort in cohorts:
            plan_sample_size(cohort, group=GROUP, sizes=(3,), simulations=1, permutations=20)
