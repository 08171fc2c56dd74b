import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.recognise.line_structure import disjointness, line_scores, pooled_line_scores

INTENSITY = np.array([0.25, 0.5, 0.75, 1.0])


def rays(rng, noise=0.0, k=5):
    """Four expressions as rays through neutral along four axes."""
    v, labels = [], []
    for axis, name in enumerate(("anger", "disgust", "fear", "smile")):
        for level in INTENSITY:
            v.append(3.0 * level * np.eye(k)[axis] + noise * rng.standard_normal(k))
            labels.append(name)
    return np.array(v), labels


def test_a_perfect_ray_scores_one_everywhere():
    v, _ = rays(np.random.default_rng(0))
    scores = line_scores(v[:4], INTENSITY)
    assert scores.r2_through_neutral == pytest.approx(1.0)
    assert scores.sign_consistency == 1.0
    assert scores.spearman == pytest.approx(1.0)
    assert scores.permutation_p == pytest.approx(1 / 24, abs=0.02)  # one order in 4! is as good


def test_r2_through_neutral_is_that_of_the_uncentred_svd():
    v = np.random.default_rng(1).standard_normal((6, 4)) + 2.0
    singular = np.linalg.svd(v, compute_uv=False)
    scores = line_scores(v, np.arange(6.0))
    assert scores.r2_through_neutral == pytest.approx(singular[0] ** 2 / (singular**2).sum())


def test_a_line_that_misses_neutral_scores_better_free_than_through_neutral():
    v = np.stack([np.full(4, 5.0), 10.0 * INTENSITY], axis=1)
    scores = line_scores(v, INTENSITY)
    assert scores.r2_free == pytest.approx(1.0)
    assert scores.r2_through_neutral < 0.97


def test_samples_on_both_sides_of_neutral_are_inconsistent():
    v = np.outer([-2.0, 1.0, 2.0, 3.0], [1.0, 0.0])
    assert line_scores(v, INTENSITY).sign_consistency == 0.75


def test_turning_the_line_around_changes_nothing():
    v, _ = rays(np.random.default_rng(2), noise=0.2)
    assert line_scores(v[:4], INTENSITY) == line_scores(-v[:4], INTENSITY)


def test_disjoint_rays_are_told_apart_and_shuffled_labels_are_not():
    rng = np.random.default_rng(3)
    v, labels = rays(rng, noise=0.1)
    good = disjointness(v, labels)
    assert good.leave_one_out_accuracy == 1.0
    assert good.cosine_silhouette > 0.8
    assert good.accuracy_p <= 0.002
    bad = disjointness(v, list(rng.permutation(labels)))
    assert bad.leave_one_out_accuracy < 0.7
    assert bad.accuracy_p > 0.02
    assert bad.separability < good.separability


def test_the_silhouette_matches_its_definition():
    rng = np.random.default_rng(4)
    v, labels = rays(rng, noise=0.8)
    unit = v / np.linalg.norm(v, axis=1, keepdims=True)
    expected = []
    for i, own in enumerate(labels):
        distance = {
            name: np.mean([1 - unit[i] @ unit[j] for j in range(len(v)) if labels[j] == name and j != i])
            for name in set(labels)
        }
        a, b = distance[own], min(value for name, value in distance.items() if name != own)
        expected.append((b - a) / max(a, b))
    assert disjointness(v, labels, permutations=1).cosine_silhouette == pytest.approx(np.mean(expected))


@pytest.mark.parametrize(
    ("v", "labels"),
    [
        (np.zeros((2, 3)), ["a", "b"]),
        (np.ones((4, 3)), ["a", "a", "a", "a"]),
        (np.ones((4, 3)), ["a", "a", "a", "b"]),
        (np.full((4, 3), np.nan), ["a", "a", "b", "b"]),
    ],
)
def test_too_little_to_score_is_refused(v, labels):
    with pytest.raises(InputError):
        disjointness(v, labels)


def test_neutral_samples_have_no_line():
    with pytest.raises(InputError):
        line_scores(np.zeros((4, 3)), INTENSITY)


def test_lines_of_the_paper_are_significant_each_and_shuffled_labels_are_not():
    rng = np.random.default_rng(5)
    v, labels = rays(rng, noise=0.1)
    pooled = pooled_line_scores(v, labels, np.tile(INTENSITY, 4))
    for c, name in enumerate(("anger", "disgust", "fear", "smile")):
        alone = line_scores(v[4 * c : 4 * c + 4], INTENSITY)
        assert pooled.r2_through_neutral[name] == pytest.approx(alone.r2_through_neutral)
        assert pooled.r2_p[name] < 0.01
    assert pooled.mean_r2_p == pooled.monotonicity_p == 0.001
    assert pooled.spearman == pytest.approx(1.0)
    wrong = pooled_line_scores(v, list(rng.permutation(labels)), rng.permutation(np.tile(INTENSITY, 4)))
    assert min(wrong.mean_r2_p, wrong.monotonicity_p) > 0.02


def test_without_intensities_there_is_no_monotonicity():
    v, labels = rays(np.random.default_rng(6), noise=0.1)
    pooled = pooled_line_scores(v, labels, permutations=9)
    assert pooled.spearman is None and pooled.monotonicity_p is None


def test_a_wrong_order_of_one_expression_is_seen_by_the_pooled_test_as_by_its_own():
    v, labels = rays(np.random.default_rng(7))
    turned = np.concatenate([INTENSITY[::-1], np.tile(INTENSITY, 3)])
    assert pooled_line_scores(v, labels, turned).spearman == pytest.approx(0.5)


def test_the_smallest_margin_is_the_gap_in_standard_deviations():
    # Two clouds whose within-class covariance is round: the discriminant is the line between their means.
    square = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    v = np.concatenate([square, square + np.array([10.0, 0.0]), square + np.array([0.0, 30.0])])
    scores = disjointness(v, ["a"] * 4 + ["b"] * 4 + ["c"] * 4, permutations=99)
    spread = np.sqrt(12 / 9)  # squares of one coordinate over the degrees of freedom
    assert scores.smallest_margin == pytest.approx(8 / spread, rel=1e-6)
    assert scores.smallest_margin_pair == ("a", "b")


def test_margins_of_classes_that_overlap_are_negative_and_mean_nothing():
    rng = np.random.default_rng(8)
    scores = disjointness(rng.standard_normal((40, 3)), ["a", "b"] * 20, permutations=99)
    assert scores.smallest_margin < 0
    assert min(scores.margin_p, scores.separability_p) > 0.02


def test_disjoint_rays_have_margins_and_separability_that_shuffled_labels_do_not():
    v, labels = rays(np.random.default_rng(9), noise=0.1)
    scores = disjointness(v, labels, permutations=199)
    assert scores.smallest_margin > 1
    assert max(scores.margin_p, scores.separability_p) <= 0.01


@pytest.mark.parametrize("v", [np.zeros((16, 5)), np.eye(16)])
def test_samples_without_scatter_or_with_more_modes_than_samples_still_have_finite_scores(v):
    scores = disjointness(v, ["a", "b", "c", "d"] * 4, permutations=5)
    assert np.isfinite([scores.smallest_margin, scores.separability, scores.margin_p]).all()
    exact, labels = rays(np.random.default_rng(0))
    assert np.isfinite(disjointness(np.sign(exact), labels, permutations=5).smallest_margin)


@pytest.mark.parametrize(
    ("v", "labels"), [(np.ones((4, 3)), ["a"] * 4), (np.ones((4, 3)), ["a", "a", "a", "b"]), (np.eye(4), "aabb")]
)
def test_lines_that_cannot_be_compared_are_refused(v, labels):
    v = v.copy()
    v[:2] = 0.0
    with pytest.raises(InputError):
        pooled_line_scores(v, list(labels))
