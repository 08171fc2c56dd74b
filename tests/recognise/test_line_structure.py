import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.recognise.line_structure import disjointness, line_scores

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
