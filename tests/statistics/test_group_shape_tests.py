"""Tests of groups of shapes: against geomorph's results, brute force, scipy and scikit-learn, and under the null."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigvalsh
from scipy.optimize import minimize

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.shape_tests.groups import (
    assess_equivalence,
    compare_disparity,
    compare_means_and_covariances,
    discriminate,
)
from shapespace.statistics.shape_tests.ordination import ordinate
from shapespace.statistics.shape_tests.permutations import orders
from shapespace.types import FloatArray

GROUP = ("group",)


def cohort_of(values: FloatArray, columns: dict[str, list[str]]) -> Cohort:
    """Return a cohort of which rows of values (N, D) are coordinates, padded with zeros."""
    shapes = np.zeros((len(values), values.shape[1] // 2 + 2, 3))
    shapes[:, : values.shape[1] // 2, :2] = values.reshape(len(values), -1, 2)
    return Cohort.of_shapes(shapes, columns, align=False, unit="")


def simulated(
    sizes: tuple[int, ...], dimensions: int = 10, shift: float = 0.0, scales: tuple[float, ...] = (), seed: int = 0
) -> Cohort:
    """Return normal data of groups a, b, ... in an even number of dimensions; group k is shifted by k * shift."""
    rng = np.random.default_rng(seed)
    codes = np.repeat(np.arange(len(sizes)), sizes)
    values = rng.normal(size=(len(codes), dimensions)) * 0.85 ** np.arange(dimensions)
    values *= np.array(scales or [1.0] * len(sizes))[codes, None]
    values[:, 0] += shift * codes
    return cohort_of(values, {"group": [chr(97 + code) for code in codes]})


def plethodon(geomorph_reference: dict[str, Any]) -> Cohort:
    return cohort_of(np.array(geomorph_reference["plethodon_gpa"]["coords"]), geomorph_reference["plethodon_table"])


def codes_of(cohort: Cohort) -> Any:
    return np.unique(cohort.table.texts("group"), return_inverse=True)[1]


# Disparity


@pytest.mark.parametrize(
    ("data", "key", "group", "formula"),
    [
        ("plethodon", "plethodon_disparity", ("species", "site"), None),
        ("plethodon", "plethodon_disparity_partial", ("species", "site"), "~ species * site"),
        ("pupfish", "pupfish_disparity", ("Pop", "Sex"), None),
    ],
)
def test_disparities_and_p_are_those_of_geomorph(
    geomorph_reference: dict[str, Any], data: str, key: str, group: tuple[str, ...], formula: str | None
) -> None:
    if formula:
        pytest.importorskip("formulaic")
    expected, permutations = geomorph_reference[key], 4000
    cohort = (
        plethodon(geomorph_reference)
        if data == "plethodon"
        else cohort_of(np.array(geomorph_reference["pupfish_coords"]), geomorph_reference["pupfish_table"])
    )
    found = compare_disparity(cohort, group=group, formula=formula, residuals="raw", permutations=permutations)
    variances = [found.statistic("Procrustes variance", name).value for name in expected["groups"]]
    assert variances == pytest.approx(expected["var"], rel=1e-6)
    if data == "pupfish":
        assert variances == pytest.approx(geomorph_reference["pupfish_lm"]["pup_md"], rel=1e-6)
    for a, first in enumerate(expected["groups"]):
        for b, second in enumerate(expected["groups"][a + 1 :], a + 1):
            p = expected["p"][a][b]
            test = found.statistic("difference of disparity", f"{first} – {second}")
            assert test.value == pytest.approx(abs(expected["var"][a] - expected["var"][b]), rel=1e-6)
            assert test.p == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / permutations) + 2 / permutations)


def test_partial_disparities_add_up_to_the_total() -> None:
    cohort = simulated((5, 9, 14), shift=1.0)
    found = compare_disparity(cohort, group=GROUP, partial=True, permutations=20)
    centred = cohort.coefficients - cohort.coefficients.mean(axis=0)
    total = float((centred**2).sum()) / (len(cohort) - 1)
    parts = [found.statistic("partial disparity", name).value for name in "abc"]
    assert sum(parts) == pytest.approx(total)
    assert parts[0] == pytest.approx(float((centred[:5] ** 2).sum()) / 27)


def test_scaled_residuals_have_the_variance_of_errors_and_repeated_columns_are_harmless() -> None:
    pytest.importorskip("formulaic")
    cohort = simulated((5, 20), shift=3.0)
    raw = compare_disparity(cohort, group=GROUP, formula="~ group", residuals="raw", permutations=20)
    scaled = compare_disparity(cohort, group=GROUP, formula="~ group", permutations=20)
    variances: list[float] = []
    for name, n in (("a", 5), ("b", 20)):
        variance = raw.statistic("Procrustes variance", name).value
        variances.append(scaled.statistic("Procrustes variance", name).value)
        assert variances[-1] == pytest.approx(variance * n / (n - 1))
        rows = cohort.coefficients[codes_of(cohort) == "ab".index(name)]
        assert variance == pytest.approx(float(rows.var(axis=0).sum()))
    assert scaled.statistic("difference of disparity").value == pytest.approx(abs(variances[0] - variances[1]))


def test_each_permutation_of_scaled_residuals_is_that_of_a_plain_loop_over_refitted_models() -> None:
    pytest.importorskip("formulaic")
    cohort = simulated((5, 9), shift=1.0)
    found = compare_disparity(cohort, group=GROUP, formula="~ group + size", permutations=60, seed=3).statistics[0]
    codes = codes_of(cohort)
    columns = np.column_stack([codes == 0, codes == 1, cohort.sizes_mm]).astype(float)
    off = np.eye(14) - columns @ np.linalg.pinv(columns)
    free = np.diag(off)
    residual = off @ cohort.coefficients
    errors = residual / np.sqrt(free)[:, None]
    for k, rows in enumerate(np.concatenate([rows for _, rows in orders(14, 60, 3)])):
        # Shape j has the place rows[j].
        placed = np.empty_like(errors)
        placed[rows] = errors
        squares = ((off @ placed if k else residual) ** 2).sum(axis=1) / free
        first, second = (float(squares[codes == group].mean()) for group in (0, 1))
        assert found.arrangements[k] == pytest.approx(abs(first - second))


def test_variances_about_group_means_rarely_differ_in_small_groups_of_equal_variance() -> None:
    pytest.importorskip("formulaic")
    wrong = {"scaled": 0, "raw": 0}
    groups = {"group": ["a"] * 5 + ["b"] * 25}
    for seed in range(60):
        cohort = cohort_of(np.random.default_rng(seed).normal(size=(30, 30)), groups)
        for residuals in ("scaled", "raw"):
            found = compare_disparity(
                cohort, group=GROUP, formula="~ group", residuals=residuals, permutations=60, seed=seed
            )
            p = found.statistics[0].p
            assert p is not None
            wrong[residuals] += p <= 0.05
    assert wrong["scaled"] <= 8 and wrong["raw"] > 12  # 8 are 3 standard errors above 5 %


def test_intervals_of_disparity_cover_the_variance() -> None:
    covered = 0
    for seed in range(40):
        cohort = simulated((25, 25), seed=seed)
        found = compare_disparity(cohort, group=GROUP, permutations=2, seed=seed)
        one = found.statistic("Procrustes variance", "a")
        assert one.low is not None and one.high is not None and one.low < one.value < one.high
        covered += one.low < float((0.85 ** (2 * np.arange(10))).sum()) * 49 / 50 < one.high
    assert covered >= 33  # of 40 at 93 %: 37 +- 1.6


# Equality


def test_riemannian_distances_are_those_of_scipys_relative_eigenvalues() -> None:
    cohort = simulated((12, 20), shift=2.0, scales=(1.0, 1.5))
    found = compare_means_and_covariances(cohort, group=GROUP, components=4, permutations=4)
    residuals = []
    for values in (cohort.coefficients[:12], cohort.coefficients[12:]):
        start = values.mean(axis=0)
        median = minimize(
            lambda m, values=values: np.sqrt(((values - m) ** 2).sum(axis=1) + 1e-12).sum(), start, tol=1e-10
        ).x
        residuals.append(values - median)
    scales = [np.median(np.linalg.norm(one, axis=1)) for one in residuals]
    for name, factors in (("covariance", (1.0, 1.0)), ("relative covariance", scales)):
        scaled = [one / factor for one, factor in zip(residuals, factors, strict=True)]
        pooled = np.vstack(scaled)
        axes = np.linalg.svd(pooled - pooled.mean(axis=0), full_matrices=False)[2][:4].T
        logs = np.log(eigvalsh(*(np.cov((one @ axes).T) for one in scaled)))
        expected = np.linalg.norm(logs - logs.mean() * (name != "covariance"))
        assert found.statistic(f"Riemannian distance of {name}").value == pytest.approx(expected, rel=1e-3)


def test_f_of_means_is_that_of_compare_with_equal_and_unequal_variances() -> None:
    pytest.importorskip("formulaic")
    cohort = simulated((8, 15, 11), shift=0.4, scales=(1.0, 1.5, 0.8))
    found = compare_means_and_covariances(cohort, group=GROUP, permutations=300)
    for name, unequal in (("F of means", False), ("F of means, unequal covariances", True)):
        options = CompareConfig(permutations=300, maps=False, variances="unequal" if unequal else "equal")
        expected = compare(cohort, "~ group", options).test("group")
        assert found.statistic(name).value == pytest.approx(expected.f, rel=1e-9)
        assert found.statistic(name).p == pytest.approx(expected.p, abs=0.1)


def test_the_form_of_covariance_is_not_compared_in_one_component() -> None:
    one, two = (
        compare_means_and_covariances(simulated((6, 6)), group=GROUP, components=k, permutations=20) for k in (1, 2)
    )
    assert {item.name for item in two.statistics} - {item.name for item in one.statistics} == {
        "Riemannian distance of relative covariance"
    }


def test_covariance_that_differs_in_scale_or_in_form_is_found_by_its_statistic() -> None:
    scaled = compare_means_and_covariances(simulated((40, 40), scales=(1.0, 2.0)), group=GROUP, permutations=200)
    assert scaled.statistic("Riemannian distance of covariance").p == pytest.approx(1 / 200)
    assert (scaled.statistic("Riemannian distance of relative covariance").p or 0) > 0.05
    values = np.random.default_rng(1).normal(size=(120, 6)) * 0.6 ** np.arange(6)
    values[60:] = values[60:, ::-1]
    other = cohort_of(values, {"group": ["a"] * 60 + ["b"] * 60})
    formed = compare_means_and_covariances(other, group=GROUP, permutations=200)
    assert formed.statistic("Riemannian distance of relative covariance").p == pytest.approx(1 / 200)


def rejections(test: Callable[[int], float | None], sets: int) -> float:
    return float(np.mean([(test(seed) or 1.0) <= 0.05 for seed in range(sets)]))


@pytest.mark.parametrize(
    "name", ["Riemannian distance of covariance", "Riemannian distance of relative covariance", "F of means"]
)
def test_groups_of_unequal_size_and_equal_distribution_are_rarely_different(name: str) -> None:
    rate = rejections(
        lambda seed: compare_means_and_covariances(
            simulated((12, 24), seed=seed), group=GROUP, permutations=100
        ).statistic(name).p,
        100,
    )  # fmt: skip
    assert rate <= 0.12  # 5 % + 3 standard errors


# Equivalence


def test_the_corrected_distance_is_free_of_the_bias_by_sampling() -> None:
    squares = []
    for seed in range(60):
        found = assess_equivalence(simulated((10, 10), shift=0.5, seed=seed), group=GROUP, margin=1.0, permutations=20)
        _, observed, corrected, *_ = found.table("Equivalence").rows[0]
        assert corrected < observed
        squares.append((observed**2, corrected**2))
    plain, corrected = np.mean(squares, axis=0)
    assert plain > 0.25 + 0.5
    assert corrected == pytest.approx(0.25, abs=0.25)


def test_the_level_is_kept_at_the_margin_and_equal_means_are_equivalent() -> None:
    def p(seed: int, shift: float) -> float | None:
        cohort = simulated((30, 20), shift=shift, seed=seed)
        return assess_equivalence(cohort, group=GROUP, margin=1.4, permutations=200).statistics[0].p

    assert rejections(lambda seed: p(seed, 1.4), 150) == pytest.approx(0.05, abs=0.054)
    assert rejections(lambda seed: p(seed, 0.0), 40) > 0.9


def test_the_upper_bound_is_the_smallest_margin_that_is_shown() -> None:
    cohort = simulated((15, 20), shift=0.8)
    bound = assess_equivalence(cohort, group=GROUP, margin=1.0).statistic("corrected Procrustes distance").high
    assert bound is not None
    for factor, shown in ((0.99, False), (1.01, True)):
        p = assess_equivalence(cohort, group=GROUP, margin=factor * bound).statistics[0].p
        assert p is not None and (p <= 0.05) is shown


def test_the_upper_bound_of_equal_means_is_that_of_sampling_alone_or_larger() -> None:
    noise, small = np.sqrt((0.85 ** (2 * np.arange(10))).sum() * 2 / 10), 0
    for seed in range(30):
        found = assess_equivalence(simulated((10, 10), seed=seed), group=GROUP, margin=0.25 * noise, permutations=200)
        distance = found.statistic("corrected Procrustes distance")
        small += distance.value == 0.0
        assert distance.high is not None and distance.high > 0.25 * noise
        assert found.statistics[0].p is not None and found.statistics[0].p > 0.05
    assert small >= 10


def test_a_margin_in_standard_deviations_and_one_below_the_noise_are_reported() -> None:
    cohort = simulated((200, 150))
    found = assess_equivalence(cohort, group=GROUP, margin_sd=0.5, permutations=50)
    variance = float((0.85 ** (2 * np.arange(10))).sum())
    assert found.table("Equivalence").rows[0][4] == pytest.approx(0.5 * np.sqrt(variance), rel=0.05)
    assert not [note for note in found.cohort.notes if "sampling alone" in note]
    noisy = assess_equivalence(simulated((6, 6)), group=GROUP, margin=0.5, permutations=50)
    assert [note for note in noisy.cohort.notes if "sampling alone" in note]


# Discriminants


def brute_force(values: FloatArray, codes: Any, components: int | None, priors: FloatArray) -> FloatArray:
    """Return leave-one-out posterior probabilities with principal components of the other shapes."""
    out = []
    for row in range(len(values)):
        keep = np.arange(len(values)) != row
        train, own = values[keep], codes[keep]
        mean = train.mean(axis=0)
        axes = np.linalg.svd(train - mean, full_matrices=False)[2]
        axes = axes[: components or np.linalg.matrix_rank(values - values.mean(axis=0))].T
        train, shape = (train - mean) @ axes, (values[row] - mean) @ axes
        means = np.stack([train[own == k].mean(axis=0) for k in range(len(priors))])
        off = train - means[own]
        covariance = off.T @ off / (len(train) - len(priors))
        away = shape - means
        score = np.log(priors) - 0.5 * np.einsum("gk,gk->g", away, np.linalg.solve(covariance, away.T).T)
        out.append(np.exp(score - score.max()) / np.exp(score - score.max()).sum())
    return np.array(out)


@pytest.mark.parametrize("components", [None, 3])
def test_leave_one_out_posteriors_and_permutations_are_those_of_brute_force(components: int | None) -> None:
    cohort = simulated((9, 16, 12), dimensions=8, shift=1.5)
    found = discriminate(cohort, group=GROUP, components=components, permutations=6)
    codes, priors = codes_of(cohort), np.array([9, 16, 12]) / 37
    posterior = np.array([row[3:] for row in found.table("Posterior probabilities").rows])
    assert posterior == pytest.approx(brute_force(cohort.coefficients, codes, components, priors), abs=1e-8)
    [(_, rows)] = orders(37, 6, 0)
    keys = []
    for order, rate in zip(rows, found.statistics[0].arrangements, strict=True):
        own = codes[order]
        shares = brute_force(cohort.coefficients, own, components, priors)
        assert rate == pytest.approx((shares.argmax(axis=1) == own).mean())
        keys.append((rate, shares[np.arange(37), own].mean()))
    assert found.statistics[0].p == pytest.approx(np.mean([key >= keys[0] for key in keys]))


def test_posterior_odds_are_those_of_scikit_learn(geomorph_reference: dict[str, Any]) -> None:
    discriminant = pytest.importorskip("sklearn.discriminant_analysis")
    cohort = plethodon(geomorph_reference)
    found = discriminate(cohort, group=("species", "site"), priors="equal", permutations=2)
    posterior = np.array([row[3:] for row in found.table("Posterior probabilities").rows])
    centred = cohort.coefficients - cohort.coefficients.mean(axis=0)
    u, s, _ = np.linalg.svd(centred, full_matrices=False)
    rank = int((s > 1e-9 * s[0]).sum())
    values = u[:, :rank] * s[:rank]
    labels = np.array([row[1] for row in found.table("Posterior probabilities").rows])
    for row in range(0, 40, 7):
        keep = np.arange(40) != row
        lda = discriminant.LinearDiscriminantAnalysis(priors=[0.25] * 4).fit(values[keep], labels[keep])
        log = lda.predict_log_proba(values[[row]])[0]
        own = np.log(posterior[row])
        # Covariances within groups have the divisor N - G here and in MASS, and N in scikit-learn.
        assert own - own[0] == pytest.approx((log - log[0]) * 35 / 39, rel=1e-6, abs=1e-6)


def test_classes_and_mahalanobis_distances_agree_with_canonical_variates() -> None:
    cohort = simulated((15, 25), dimensions=6, shift=1.0)
    found = discriminate(cohort, group=GROUP, permutations=2)
    variates = ordinate(cohort, method="cva", group=GROUP)
    assert variates.predicted is not None
    predicted = [row[2] for row in found.table("Posterior probabilities").rows]
    assert predicted == ["ab"[code] for code in variates.predicted]
    distance = float(np.linalg.norm(variates.scores[:15].mean(axis=0) - variates.scores[15:].mean(axis=0)))
    assert found.statistic("Mahalanobis distance of means").value == pytest.approx(distance)


def test_groups_without_a_difference_are_classified_by_chance() -> None:
    rate = rejections(
        lambda seed: discriminate(
            simulated((12, 18), dimensions=20, seed=seed), group=GROUP, components=3, permutations=40
        ).statistics[0].p,
        40,
    )  # fmt: skip
    assert rate <= 0.16  # 5 % + 3 standard errors


# All


@pytest.mark.parametrize(
    ("test", "sizes", "options", "words"),
    [
        (compare_disparity, (1, 5), {}, "1 shape"),
        (compare_disparity, (5, 5), {"partial": True, "formula": "~ group"}, "remove --formula or --partial"),
        (compare_means_and_covariances, (2, 8), {}, "3 or more"),
        (compare_means_and_covariances, (8, 8), {"components": 7}, "take 1 to 6"),
        (compare_means_and_covariances, (8, 8), {"components": 0}, "take 1 to 6"),
        (assess_equivalence, (5, 5), {}, "one margin above 0"),
        (assess_equivalence, (5, 5), {"margin": 1.0, "margin_sd": 1.0}, "one margin above 0"),
        (assess_equivalence, (5, 5), {"margin": -1.0}, "one margin above 0"),
        (assess_equivalence, (2, 5), {"margin": 1.0}, "3 or more"),
        (discriminate, (6, 6), {"components": 10}, "singular"),
        (discriminate, (6, 6), {"components": 0}, "singular"),
        (discriminate, (2, 6), {}, "3 or more"),
        (discriminate, (9,), {}, "two different values"),
    ],
)
def test_designs_that_cannot_be_tested_are_refused_in_one_sentence(
    test: Callable[..., Any], sizes: tuple[int, ...], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words) as error:
        test(simulated(sizes), group=GROUP, permutations=20, **options)
    assert "\n" not in str(error.value)


def test_a_direction_without_variation_within_groups_is_refused() -> None:
    values = np.random.default_rng(2).normal(size=(20, 4))
    values[:, 3] = np.repeat([0.0, 5.0], 10)
    with pytest.raises(InputError, match="take fewer with --components"):
        discriminate(cohort_of(values, {"group": ["a"] * 10 + ["b"] * 10}), group=GROUP, permutations=20)


@pytest.mark.parametrize(
    ("test", "options"),
    [
        (compare_disparity, {}),
        (compare_means_and_covariances, {}),
        (assess_equivalence, {"margin": 1.0}),
        (discriminate, {}),
    ],
)
def test_results_repeat_by_seed_and_are_saved(
    test: Callable[..., Any], options: dict[str, Any], tmp_path: Path
) -> None:
    first, second = (test(simulated((8, 10)), group=GROUP, permutations=30, seed=4, **options) for _ in range(2))
    assert [(s.label, s.value, s.p, s.low, s.high) for s in first.statistics] == [
        (s.label, s.value, s.p, s.low, s.high) for s in second.statistics
    ]
    saved = first.save(tmp_path)
    assert saved.is_file()
    assert (tmp_path / "statistics.csv").is_file()
