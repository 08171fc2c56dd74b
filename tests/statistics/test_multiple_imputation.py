"""Completed shapes with samples: Rubin's rules, and analyses that combine imputations."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.report.analyses.methods_section import methods_text
from shapespace.report.analyses.result_report import analysis_report
from shapespace.statistics.asymmetry import measure_asymmetry
from shapespace.statistics.change_result import ChangeConfig
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.measure_change import change
from shapespace.statistics.multiple_imputation import pool_estimates, pool_intervals, pool_p_values
from shapespace.statistics.regression import regress
from shapespace.statistics.score_subjects import score
from shapespace.types import BoolArray, FloatArray
from symmetric_object import symmetric_object
from synthetic_shapes import training_meshes

N, V, M = 16, 60, 4
GROUPS = ["a"] * 8 + ["b"] * 8
COMPLETED = (2, 9, 12)


def shapes() -> FloatArray:
    rng = np.random.default_rng(3)
    whole = np.stack([mesh.vertices for mesh in training_meshes(N, vertices=V)])
    return whole + 0.3 * rng.standard_normal(whole.shape)


def observed() -> BoolArray:
    mask = np.ones((N, V), np.bool_)
    mask[list(COMPLETED), :20] = False
    return mask


def samples(spread: float, seed: int = 0) -> list[FloatArray | None]:
    """Return M samples of three shapes, whose missing vertices vary by `spread` millimetres."""
    rng, whole = np.random.default_rng(seed), shapes()
    out: list[FloatArray | None] = [None] * N
    for row in COMPLETED:
        own = np.repeat(whole[row][None], M, axis=0)
        own[:, :20] += spread * rng.standard_normal((M, 20, 3))
        out[row] = own
    return out


def cohort(spread: float = 2.0, **columns: list[object]) -> Cohort:
    faces = training_meshes(3, vertices=V)[0].faces
    values = {"group": GROUPS, **columns}
    return Cohort.of_shapes(shapes(), values, faces=faces, gauge="form", observed=observed(), samples=samples(spread))


# Rubin's rules


def test_estimates_are_combined_by_the_formulas_of_rubin_and_of_barnard_and_rubin() -> None:
    q, u, m, df = [1.0, 2.0, 4.0, 3.0], [0.5, 0.4, 0.6, 0.7], 4, 20
    pooled = pool_estimates(np.array(q), np.array(u), df)
    mean, within = sum(q) / m, sum(u) / m
    between = sum((one - mean) ** 2 for one in q) / (m - 1)
    r = (1 + 1 / m) * between / within
    old = (m - 1) * (1 + 1 / r) ** 2
    lam = (1 + 1 / m) * between / (within + (1 + 1 / m) * between)
    com = (df + 1) / (df + 3) * df * (1 - lam)
    assert pooled.value == mean
    assert pooled.variance == pytest.approx(within + 1.25 * between)
    assert pooled.df == pytest.approx(old * com / (old + com))
    assert pooled.missing_information == pytest.approx((r + 2 / (old + 3)) / (r + 1))
    assert pool_estimates(np.array(q), np.array(u)).df == pytest.approx(old)


def test_equal_estimates_have_no_missing_information() -> None:
    pooled = pool_estimates(np.full((5, 2), 3.0), 0.25)
    assert (pooled.variance == 0.25).all() and np.isinf(pooled.df).all() and (pooled.missing_information == 0).all()


def test_p_values_are_combined_by_their_normal_quantiles() -> None:
    p = [0.01, 0.04, 0.2]
    z = [stats.norm.ppf(1 - one) for one in p]
    mean = sum(z) / 3
    total = 1 + (1 + 1 / 3) * sum((one - mean) ** 2 for one in z) / 2
    combined, missing = pool_p_values(np.array(p), 1 / 200)
    assert combined == pytest.approx(1 - stats.norm.cdf(mean / math.sqrt(total)))
    assert 0 < missing < 1
    equal, none = pool_p_values(np.full((20, 1), 0.035), 1 / 200)
    assert equal[0] == pytest.approx(0.035) and none[0] < 1e-12


def test_combined_p_values_keep_the_resolution_of_the_permutations() -> None:
    p, _ = pool_p_values(np.array([[0.0, 1.0], [0.0, 1.0]]), 1 / 100)
    np.testing.assert_allclose(p, [0.01, 0.99])


def test_intervals_of_equal_imputations_stay_and_others_widen() -> None:
    own = np.array([1.0, 0.4, 2.0])
    np.testing.assert_allclose(pool_intervals(np.tile(own, (5, 1)), 0.9), own)
    shifted = own + np.array([-0.2, 0.1, 0.1])[:, None]
    value, low, high = pool_intervals(shifted, 0.9)
    assert value == pytest.approx(1) and low < 0.4 and high > 2


# Cohorts


def test_completed_vertices_are_used_and_the_mask_is_kept() -> None:
    made = cohort()
    whole = Cohort.of_shapes(shapes(), {"group": GROUPS}, gauge="form")
    np.testing.assert_allclose(made.vertices(2), whole.vertices(2), atol=1e-9)
    assert made.imputations == M and made.estimated_share.sum() == pytest.approx(3 * 20 / V)
    assert made.take([2, 3]).imputations == M and made.take([0, 1]).imputations == 0


def test_an_imputation_has_the_sample_in_the_pose_of_the_cohort() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    made = cohort()
    posed = [None if own is None else own @ turn + 40 for own in samples(2.0)]
    for k in (0, M - 1):
        one, other = made.imputation(k), replace(made, samples=tuple(posed)).imputation(k)
        assert one.observed is None and one.imputations == 0
        np.testing.assert_allclose(one.vertices(9), other.vertices(9), atol=1e-8)
        np.testing.assert_allclose(one.vertices(3), made.vertices(3), atol=1e-9)
    assert np.abs(made.imputation(0).vertices(9) - made.imputation(1).vertices(9)).max() > 1
    with pytest.raises(InputError, match="4 imputations"):
        made.imputation(M)


def test_one_imputation_at_a_time_is_read() -> None:
    read: list[int] = []

    class Recorded:
        def __init__(self, own: FloatArray) -> None:
            self.own = own

        def __len__(self) -> int:
            return len(self.own)

        def __getitem__(self, k: int) -> FloatArray:
            read.append(k)
            return self.own[k]

    recorded = tuple(None if own is None else Recorded(own) for own in samples(1.0))
    compare(replace(cohort(), samples=recorded), "~ group", CompareConfig(permutations=20, maps=False))
    assert read == [k for k in range(M) for _ in COMPLETED]


# Analyses

OPTIONS = CompareConfig(permutations=50)


def test_samples_equal_to_the_shape_change_no_p() -> None:
    made = cohort(spread=0.0)
    plain = compare(replace(made, samples=(), observed=None), "~ group", OPTIONS)
    combined = compare(made, "~ group", OPTIONS)
    assert combined.tests[0].p == pytest.approx(plain.tests[0].p)
    assert combined.effects[0].p_family == pytest.approx(plain.effects[0].p_family)
    assert combined.imputations is not None
    assert combined.imputations.count == M and combined.imputations.missing_information["group"] == 0


def test_more_variable_samples_have_more_missing_information_and_larger_p() -> None:
    groups = ["a" if k in (2, 4, 6, 9, 11, 12, 14, 15) else "b" for k in range(N)]
    difference = np.repeat([1.2 * (group == "a") for group in groups], V * 3).reshape(N, V, 3)
    difference[:, :40] = 0.0
    made = [
        Cohort.of_shapes(
            shapes() + difference, {"group": groups}, gauge="form", observed=observed(),
            samples=[None if own is None else own + difference[row] for row, own in enumerate(samples(spread))],
        )
        for spread in (0.5, 10.0)
    ]  # fmt: skip
    config = CompareConfig(permutations=200, maps=False)
    near, far = (compare(one, "~ group", config) for one in made)
    assert near.imputations is not None and far.imputations is not None
    assert near.imputations.missing_information["group"] < far.imputations.missing_information["group"]
    assert near.tests[0].p < far.tests[0].p
    # Sums of squares are those of the completed shapes.
    assert near.tests[0].squares == far.tests[0].squares


def test_the_order_of_the_shapes_does_not_matter_beyond_the_permutations() -> None:
    made, order = cohort(), list(range(N))[::-1]
    for k in range(M):
        one, other = made.imputation(k), made.take(order).imputation(k)
        np.testing.assert_allclose(one.vertices(2), other.vertices(order.index(2)), atol=1e-8)


def test_maps_combine_p_of_each_vertex_and_blank_vertices_stay_blank() -> None:
    mask = np.ones((N, V), np.bool_)
    mask[8:, :20] = False
    whole = [np.repeat(one[None], M, axis=0) for one in shapes()]
    made = Cohort.of_shapes(
        shapes(), {"group": GROUPS}, observed=mask, samples=[None if row < 8 else whole[row] for row in range(N)]
    )
    shown = compare(made, "~ group", OPTIONS).effects[0].map
    assert shown is not None and shown.blank is not None
    assert shown.blank[:20].all() and (shown.test.p_family[shown.blank] == 1).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_reports_state_the_imputations(seed: int) -> None:
    result = compare(cohort(), "~ group", CompareConfig(permutations=20, maps=False, seed=seed))
    report = analysis_report(result)
    [note] = [one for one in report.notes if "imputations" in one]
    assert f"combine {M} imputations of 3 completed shapes by Rubin's rules" in note and "(group)" in note
    assert any("completed by a shape model, with samples" in one for one in report.notes)
    assert report.settings["imputations"] == M and "group" in report.settings["missing_information"]
    text = methods_text(report.analysis())
    assert f"{M} imputations" in text and "Rubin D. B. (1987)" in text and "Licht" in text


def test_other_analyses_state_that_samples_are_not_used() -> None:
    made = cohort(subject=[f"p{k // 2}" for k in range(N)], time=[k % 2 for k in range(N)])
    report = analysis_report(change(made, ChangeConfig(permutations=20)))
    assert any("samples of 3 completed shapes are not used" in note for note in report.notes)


def test_regression_combines_p_measures_and_predictions() -> None:
    age = [float(k) for k in range(N)]
    plain, combined = (
        regress(one, "age", folds=4, permutations=19, draws=50)
        for one in (replace(cohort(age=age), samples=(), observed=None), cohort(3.0, age=age))
    )
    assert combined.imputations is not None and "age" in combined.imputations.missing_information
    width = [(one.high - one.low)[list(COMPLETED)].mean() for one in (plain, combined)]
    assert width[1] > width[0]
    runs = [regress(cohort(3.0, age=age).imputation(k), "age", folds=4, permutations=19, draws=50) for k in range(M)]
    assert combined.measures["r2"].value == pytest.approx(np.mean([one.measures["r2"].value for one in runs]))
    assert combined.measures["coverage"].high <= 1
    assert combined.p == pytest.approx(float(pool_p_values(np.array([one.p for one in runs]), 1 / 20)[0]))


def test_predictions_of_new_completed_shapes_have_wider_intervals() -> None:
    predictor = regress(cohort(age=[float(k) for k in range(N)]), "age", folds=4, permutations=0, draws=50).predictor
    rows = [2, 3]
    new = cohort(spread=20.0).take(rows)
    plain, combined = predictor.predict(replace(new, samples=())), predictor.predict(new)
    assert combined.imputations is not None and combined.imputations.count == M and plain.imputations is None
    wider = (combined.high - combined.low) - (plain.high - plain.low)
    assert wider[0] > 1e-3 and abs(wider[1]) < 1e-6


def test_scores_are_means_over_imputations_with_a_standard_deviation() -> None:
    made = cohort(6.0)
    rows = [k for k in range(N) if k not in (2, 3)]
    reference = replace(made.take(rows), samples=(), observed=None)
    subjects = Cohort.of_shapes(
        shapes()[[2, 3]], {}, names=["own", "whole"], onto=reference, observed=observed()[[2, 3]],
        samples=[samples(6.0)[2], None],
    )  # fmt: skip
    found = score(reference, subjects)
    assert found.imputations is not None and found.imputations.count == M
    runs = [score(reference, subjects.imputation(k, reference)) for k in range(M)]
    distances = np.array([one.distance for one in runs])
    np.testing.assert_allclose(found.distance, distances.mean(axis=0))
    std = found.imputations.stddev
    np.testing.assert_allclose(std["distance"], np.sqrt(1.25 * distances.var(axis=0, ddof=1)), atol=1e-7)
    assert std["distance"][0] > 0 and std["distance"][1] < 1e-6
    assert np.isfinite(found.z).all() and std["z"][0, :20].mean() > 3 * std["z"][0, 20:].mean()
    report = analysis_report(found)
    assert "distance_imputation_sd" in report.tables["scores.csv"][0]
    assert any("imputations vary by" in sentence for sentence in report.summary)


def test_asymmetry_combines_p_on_the_same_plane_of_symmetry() -> None:
    made, rng = symmetric_object(half=30), np.random.default_rng(0)
    whole = made.x + 0.5 * rng.standard_normal((8, *made.x.shape))
    mask = np.ones(whole.shape[:2], np.bool_)
    mask[0, :10] = False
    own = np.repeat(whole[:1], M, axis=0)
    own[:, :10] += 3 * rng.standard_normal((M, 10, 3))
    one = Cohort.of_shapes(
        whole, {}, faces=made.faces, gauge="form", observed=mask, samples=[own, *[None] * 7]
    )  # fmt: skip
    found = measure_asymmetry(one, permutations=49)
    assert found.imputations is not None and found.imputations.missing_information["side"] > 0
    side = found.effect("side").p
    assert side is not None and 0.02 <= side <= 0.98 and found.directional_p.min() >= 0.02


def test_progress_covers_all_imputations() -> None:
    seen: list[tuple[int, int]] = []
    compare(cohort(), "~ group", CompareConfig(permutations=20, maps=False), progress=lambda *one: seen.append(one))
    assert seen[-1][0] == seen[-1][1] and [done for done, _ in seen] == sorted(done for done, _ in seen)


@pytest.mark.parametrize("analyse", [compare, regress])
def test_the_decorator_keeps_names_and_documentation(analyse: Callable[..., object]) -> None:
    assert "Rubin" in (analyse.__doc__ or "") and analyse.__name__ in ("compare", "regress")
