"""Unequal group dispersion: its test, and tests of means that stay valid under it, by plain oracles and simulation."""

import itertools
from typing import Any

import numpy as np
import pytest
from scipy import stats

from shapespace.errors import InputError
from shapespace.statistics.dispersion import UnequalVariances, dispersion_test, unequal_variances
from shapespace.statistics.map_tests import difference_test
from shapespace.types import FloatArray

STUDIES = 150
"""Of each simulation here; benchmarks/dispersion.py runs 1,000."""


def one_way(counts: tuple[int, ...]) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Group of each row, the mean as a column, and orthonormal columns of mean and groups."""
    codes = np.repeat(np.arange(len(counts)), counts)
    mean = np.full((len(codes), 1), len(codes) ** -0.5)
    indicator = np.eye(len(counts))[codes][:, 1:]
    own = np.linalg.qr(indicator - indicator.mean(axis=0))[0]
    return codes, mean, np.hstack([mean, own])


def flips(shapes: FloatArray, counts: tuple[int, ...], permutations: int = 40, seed: int = 0) -> UnequalVariances:
    codes, mean, full = one_way(counts)
    return unequal_variances(
        shapes=shapes, full=full, reduced=mean, groups=codes, permutations=permutations, seed=seed, where="group"
    )


def test_the_statistic_of_two_groups_is_the_squared_distance_by_its_welch_variance() -> None:
    shapes = np.random.default_rng(0).normal(size=(17, 6)) * np.repeat([[3.0], [1.0]], (5, 12), axis=0)
    made = flips(shapes, (5, 12))
    one, other = shapes[:5], shapes[5:]
    variance = one.var(axis=0, ddof=1).sum() / 5 + other.var(axis=0, ddof=1).sum() / 12
    expected = ((one.mean(axis=0) - other.mean(axis=0)) ** 2).sum() / variance
    np.testing.assert_allclose(made.estimate(made.full[:, 1:]).statistic()[0], expected, rtol=1e-10)


def test_at_one_coordinate_it_is_the_squared_welch_t() -> None:
    shapes = np.random.default_rng(1).normal(size=(17, 4))
    made = flips(shapes, (5, 12))
    found = made.estimate(made.full[:, 1:]).statistic_of(np.eye(4), 1, 0, 1)[0]
    welch = stats.ttest_ind(shapes[:5], shapes[5:], equal_var=False).statistic
    np.testing.assert_allclose(found, welch**2, rtol=1e-10)


def test_each_sign_flip_is_that_of_a_plain_loop_over_refitted_models() -> None:
    rng = np.random.default_rng(2)
    shapes, counts = rng.normal(size=(20, 6)), (5, 7, 8)
    codes, _, full = one_way(counts)
    age = rng.normal(size=20)
    whole = np.linalg.qr(np.column_stack([full, age]))[0]
    reduced = np.linalg.qr(np.column_stack([np.ones(20), age]))[0]
    own = np.linalg.qr(whole - reduced @ (reduced.T @ whole))[0][:, 1:3]
    own = np.linalg.svd(whole - reduced @ (reduced.T @ whole), full_matrices=False)[0][:, :2]
    made = unequal_variances(
        shapes=shapes, full=whole, reduced=reduced, groups=codes, permutations=30, seed=5, where="group"
    )
    estimate = made.estimate(own)
    found = estimate.statistic()
    at_vertices = np.concatenate([estimate.statistic_of(np.eye(6), 3, start, start + 10) for start in (0, 10, 20)])
    hat = whole @ whole.T
    signs = np.concatenate([factors for _, factors in made.signs()])
    assert (np.abs(signs[1:]) >= 1).all() and (signs[0] == 1).all()
    for k, factors in enumerate(signs):
        flipped = factors[:, None] * made.residual
        left = flipped - hat @ flipped
        weights = (own**2).sum(axis=1) / (1 - np.diag(hat))
        explained, noise = (own.T @ flipped) ** 2, weights[:, None] * left**2
        np.testing.assert_allclose(found[k], explained.sum() / noise.sum(), rtol=1e-8)
        plain = explained.reshape(2, 2, 3).sum(axis=(0, 2)) / noise.reshape(20, 2, 3).sum(axis=(0, 2))
        np.testing.assert_allclose(at_vertices[k], plain, rtol=1e-8)


def test_the_observed_statistic_does_not_depend_on_the_weights_of_the_reduced_model() -> None:
    shapes = np.random.default_rng(3).normal(size=(12, 5))
    codes, mean, full = one_way((4, 8))
    weighted = unequal_variances(
        shapes=shapes, full=full, reduced=mean, groups=codes, permutations=20, seed=0, where="group"
    )
    plain = unequal_variances(
        shapes=shapes, full=full, reduced=mean, groups=None, permutations=20, seed=0, where="group"
    )
    own = full[:, 1:]
    np.testing.assert_allclose(weighted.estimate(own).statistic()[0], plain.estimate(own).statistic()[0], rtol=1e-10)
    assert not np.allclose(weighted.residual, plain.residual)


def test_a_class_of_one_is_refused() -> None:
    with pytest.raises(InputError, match="only member of a class"):
        flips(np.random.default_rng(0).normal(size=(6, 3)), (1, 5))


def rejected(counts: tuple[int, ...], spread: tuple[float, ...], *, standard: bool = False) -> tuple[float, float]:
    """Shares of studies without a difference of means in which the term, and a vertex, are significant at 5 %."""
    found = np.zeros(2)
    codes, _, full = one_way(counts)
    own = full[:, 1:]
    for study in range(STUDIES):
        rng = np.random.default_rng([study, 9])
        shapes = rng.normal(size=(len(codes), 30)) * np.array(spread)[codes][:, None]
        if standard:
            residual = shapes - shapes.mean(axis=0)
            rows = np.argsort(rng.random((100, len(codes))), axis=1)
            rows[0] = np.arange(len(codes))
            explained = ((own[rows].transpose(0, 2, 1) @ residual) ** 2).sum(axis=1)
            f = explained / ((residual**2).sum(axis=0) - explained)
            whole = explained.sum(axis=1)
        else:
            made = unequal_variances(
                shapes=shapes, full=full, reduced=full[:, :1], groups=codes, permutations=100, seed=study, where="group"
            ).estimate(own)
            whole, f = made.statistic(), made.statistic_of(np.eye(30), 3, 0, 100)
        found += [(whole >= whole[0] * (1 - 1e-9)).mean() <= 0.05, (f.max(axis=1) >= f[0].max()).mean() <= 0.05]
    share = found / STUDIES
    return float(share[0]), float(share[1])


def test_the_level_is_kept_where_the_smaller_group_is_more_variable() -> None:
    # 2.5 standard errors of a share of 5 % above it.
    most = 0.05 + 2.5 * (0.05 * 0.95 / STUDIES) ** 0.5
    for counts, spread in (((10, 40), (2.0, 1.0)), ((6, 12, 30), (3.0, 2.0, 1.0))):
        assert max(rejected(counts, spread)) <= most
        assert max(rejected(counts, spread, standard=True)) > 0.3


def test_equal_dispersions_are_rejected_at_the_level_and_unequal_ones_found() -> None:
    codes, _, full = one_way((10, 30))
    p: dict[float, list[float]] = {1.0: [], 1.7: []}
    for study, spread in itertools.product(range(STUDIES), p):
        shapes = np.random.default_rng([study, 1]).normal(size=(40, 12)) * np.where(codes == 0, spread, 1.0)[:, None]
        found = dispersion_test(
            variable="sex",
            shapes=shapes,
            full=full,
            codes=codes,
            groups=("f", "m"),
            n_vertices=4,
            permutations=99,
            seed=study,
        )
        assert found is not None
        p[spread].append(found.p)
    assert np.mean(np.array(p[1.0]) <= 0.05) <= 0.05 + 2.5 * (0.05 * 0.95 / STUDIES) ** 0.5
    assert np.mean(np.array(p[1.7]) <= 0.05) > 0.9


def test_another_form_of_covariance_is_found_also_with_equal_dispersion_and_at_the_level_otherwise() -> None:
    codes, _, full = one_way((8, 24))
    p: dict[bool, list[float]] = {False: [], True: []}
    for study, local in itertools.product(range(STUDIES), p):
        shapes = np.random.default_rng([study, 2]).normal(size=(32, 12))
        if local:
            shapes[codes == 0] *= np.where(np.arange(12) < 3, 1.8, 0.4)
        found = dispersion_test("sex", 3.0 * shapes, full, codes, ("f", "m"), 4, 99, study)
        assert found is not None
        p[local].append(found.p_form)
    assert np.mean(np.array(p[False]) <= 0.05) <= 0.05 + 2.5 * (0.05 * 0.95 / STUDIES) ** 0.5
    assert np.mean(np.array(p[True]) <= 0.05) > 0.8


def test_dispersions_are_standard_deviations_about_the_group_mean_and_classes_of_one_are_left_out() -> None:
    codes, _, full = one_way((3, 8, 1))
    shapes = np.random.default_rng(4).normal(size=(12, 6)) * np.array([4.0, 1.0, 1.0])[codes][:, None]
    found = dispersion_test(
        variable="site",
        shapes=shapes,
        full=full,
        codes=codes,
        groups=("a", "b", "c"),
        n_vertices=2,
        permutations=50,
        seed=0,
    )
    assert found is not None and found.groups == ("a", "b") and found.counts == (3, 8)
    expected = [np.sqrt(shapes[codes == k].var(axis=0, ddof=1).sum() / 2) for k in (0, 1)]
    np.testing.assert_allclose(found.stddev_mm, expected, rtol=1e-10)
    assert found.ratio == pytest.approx(expected[0] / expected[1])
    assert found.smaller_is_more_variable is True
    assert (
        dispersion_test(
            variable="site",
            shapes=shapes[:4] * 0,
            full=full[:4] * 0,
            codes=codes[:4],
            groups=("a", "b"),
            n_vertices=2,
            permutations=50,
            seed=0,
        )
        is None
    )


def test_dispersions_and_their_p_are_those_of_morphol_disparity(geomorph_reference: dict[str, Any]) -> None:
    data = geomorph_reference
    shapes, expected = np.array(data["plethodon_gpa"]["coords"]), data["plethodon_disparity_partial"]
    table = data["plethodon_table"]
    cells = [f"{one}.{other}" for one, other in zip(table["species"], table["site"], strict=True)]
    codes = np.array([expected["groups"].index(cell) for cell in cells])
    counts = np.bincount(codes)
    names = tuple(expected["groups"])
    found = dispersion_test(
        variable="group",
        shapes=shapes,
        full=np.eye(4)[codes] / np.sqrt(counts),
        codes=codes,
        groups=names,
        n_vertices=12,
        permutations=999,
        seed=0,
    )
    assert found is not None
    # Theirs is divided by n, ours by n - 1.
    np.testing.assert_allclose(12 * np.array(found.stddev_mm) ** 2 * (counts - 1) / counts, expected["var"], rtol=1e-6)
    assert found.p > 0.4 and np.min(expected["p"]) > 0.4


def test_change_between_groups_of_unequal_variance_keeps_its_level() -> None:
    second = np.arange(20) < 5
    area = np.ones(12)
    wrong = np.zeros((2, 2))
    for study in range(STUDIES):
        maps = np.random.default_rng([study, 2]).normal(size=(20, 12)) * np.where(second, 3.0, 1.0)[:, None]
        for k in (0, 1):
            found = difference_test(maps, second, area, 100, study, unequal_variances=bool(k))
            wrong[k] += [found.omnibus_p <= 0.05, (found.p <= 0.05).any()]
    most = 0.05 + 2.5 * (0.05 * 0.95 / STUDIES) ** 0.5
    assert (wrong[0] / STUDIES > 0.5).all()
    assert (wrong[1] / STUDIES <= most).all()


def test_welchs_t_of_changes_is_scipys() -> None:
    rng = np.random.default_rng(5)
    maps, second = rng.normal(size=(8, 5)), np.arange(8) < 3
    found = difference_test(maps, second, np.ones(5), 100, 0, unequal_variances=True)
    assert found.permutations == 100 and found.unequal_variances and found.n == (5, 3)
    np.testing.assert_allclose(found.t, stats.ttest_ind(maps[second], maps[~second], equal_var=False).statistic)
    np.testing.assert_allclose(found.effect, maps[second].mean(axis=0) - maps[~second].mean(axis=0))


def test_small_classes_are_rotated_and_their_statistic_is_that_of_a_plain_loop_over_rotated_rows() -> None:
    rng = np.random.default_rng(6)
    counts = (4, 9)
    shapes = rng.normal(size=(13, 6))
    codes, _, full = one_way(counts)
    made = flips(shapes, counts)
    assert [rows.tolist() for rows in made.rotated] == [[0, 1, 2, 3]]
    found = made.estimate(full[:, 1:]).statistic()
    signs = np.concatenate([factors for _, factors in made.signs()]) / made.scale
    np.testing.assert_allclose((signs[1:, :4] ** 2).sum(axis=1), 4.0)
    np.testing.assert_allclose(np.abs(signs[1:, 4:]), 1.0)
    assert (np.abs(np.abs(signs[1:, :4]) - 1.0) > 1e-3).any(axis=1).all()
    for k, factors in enumerate(signs[1:], 1):
        # The first row of the rotation is the factors by their length; the others complete an orthonormal basis.
        rotation = np.linalg.qr(np.column_stack([factors[:4], np.eye(4)[:, :3]]))[0].T
        rotation[0] *= np.sign(rotation[0] @ factors[:4])
        average = np.linalg.qr(np.column_stack([np.ones(4), np.eye(4)[:, :3]]))[0]
        average[:, 0] = 0.5
        rows = made.scale[:, None] * made.residual
        placed = np.vstack([average @ rotation @ rows[:4], factors[4:, None] * rows[4:]])
        means = [placed[codes == group].mean(axis=0) for group in (0, 1)]
        variance = sum(placed[codes == group].var(axis=0, ddof=1).sum() / counts[group] for group in (0, 1))
        assert found[k] == pytest.approx(float(((means[0] - means[1]) ** 2).sum() / variance))


def test_four_subjects_of_larger_variance_do_not_seem_to_differ() -> None:
    term, vertex = rejected((4, 16), (3.0, 1.0))
    most = 0.05 + 2.5 * (0.05 * 0.95 / STUDIES) ** 0.5
    assert 0.01 <= term <= most and vertex <= most
