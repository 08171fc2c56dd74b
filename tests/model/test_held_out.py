"""Variances of people left out: what brute force says, and nearer the truth than a sample's own."""

import numpy as np
import pytest

from shapespace.model.held_out import held_out_variances


def by_brute_force(data: np.ndarray, groups: list[str], modes: int, centred: bool) -> tuple[np.ndarray, float]:
    squares, left = np.zeros(modes), 0.0
    for name in dict.fromkeys(groups):
        out = np.array([g == name for g in groups])
        mean = data[~out].mean(axis=0) if centred else np.zeros(data.shape[1])
        basis = np.linalg.svd(data[~out] - mean, full_matrices=False)[2][:modes]
        along = (data[out] - mean) @ basis.T
        squares += (along**2).sum(axis=0)
        left += ((data[out] - mean - along @ basis) ** 2).sum()
    return squares / len(data), left / len(data)


def sample_variances(data: np.ndarray, modes: int) -> np.ndarray:
    return np.linalg.svd(data - data.mean(axis=0), compute_uv=False)[:modes] ** 2 / (len(data) - 1)


@pytest.mark.parametrize("centred", [True, False])
def test_they_are_those_of_leaving_each_group_out(centred: bool) -> None:
    rng = np.random.default_rng(3)
    data = rng.standard_normal((20, 40)) * 2.0 ** -np.arange(40) + 5.0
    groups = [f"g{k // 2}" for k in range(20)]
    variances, left = held_out_variances(data @ data.T, groups, np.full(6, 1e-12), centred=centred)
    wanted, wanted_left = by_brute_force(data, groups, 6, centred)
    assert np.allclose(variances, wanted, rtol=1e-6)
    assert left == pytest.approx(wanted_left, rel=1e-6)


def test_last_modes_are_nearer_the_truth_than_in_the_sample() -> None:
    rng = np.random.default_rng(4)
    data = rng.standard_normal((60, 50))
    sample = sample_variances(data, 50)
    centred = data - data.mean(axis=0)
    variances, left = held_out_variances(centred @ centred.T, [str(k) for k in range(60)], sample, centred=True)
    assert sample[-10:].mean() < 0.1
    assert 0.5 < variances[-10:].mean() < 1.5
    assert abs(variances.sum() + left - 50) < 5


def test_modes_that_the_others_are_too_few_to_have_keep_the_variance_of_the_sample() -> None:
    rng = np.random.default_rng(5)
    data = rng.standard_normal((6, 30))
    sample = sample_variances(data, 5)
    centred = data - data.mean(axis=0)
    variances, _ = held_out_variances(centred @ centred.T, list("aabbcc"), sample, centred=True)
    assert np.array_equal(variances[3:], sample[3:])
    assert not np.array_equal(variances[:3], sample[:3])


def test_of_one_group_the_sample_is_all_there_is() -> None:
    data = np.random.default_rng(6).standard_normal((4, 9))
    sample = sample_variances(data, 2)
    variances, left = held_out_variances(data @ data.T, ["a"] * 4, sample, centred=True)
    assert np.array_equal(variances, sample)
    assert left == pytest.approx(sample_variances(data, 3)[2])
