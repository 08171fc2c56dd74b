"""Variances of people left out: what brute force says, nearer the truth than a sample's own, and none from too few."""

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from shapespace.model.held_out import held_out_variances


def by_brute_force(data: np.ndarray, groups: list[str], modes: int, centred: bool) -> tuple[np.ndarray, float]:
    squares, left = np.zeros(modes), 0.0
    names = list(dict.fromkeys(groups))
    for part in range(25):
        out = np.array([names.index(g) % 25 == part for g in groups])
        mean = data[~out].mean(axis=0) if centred else np.zeros(data.shape[1])
        basis = np.linalg.svd(data[~out] - mean, full_matrices=False)[2][:modes]
        along = (data[out] - mean) @ basis.T
        squares += (along**2).sum(axis=0)
        left += ((data[out] - mean - along @ basis) ** 2).sum()
    return isotonic_regression(squares / len(data), increasing=False).x, left / len(data)


def sample_variances(data: np.ndarray, modes: int) -> np.ndarray:
    return np.linalg.svd(data - data.mean(axis=0), compute_uv=False)[:modes] ** 2 / (len(data) - 1)


@pytest.mark.parametrize("centred", [True, False])
def test_they_are_those_of_leaving_a_part_of_the_groups_out_in_falling_order(centred: bool) -> None:
    rng = np.random.default_rng(3)
    data = rng.standard_normal((120, 40)) * 1.2 ** -np.arange(40) + 5.0
    groups = [f"g{k // 2}" for k in range(120)]
    found = held_out_variances(data @ data.T, groups, np.full(12, 1e-12), centred=centred)
    assert found is not None
    wanted, wanted_left = by_brute_force(data, groups, 12, centred)
    assert np.allclose(found[0], wanted, rtol=1e-6) and (np.diff(found[0]) <= 0).all()
    assert found[1] == pytest.approx(wanted_left, rel=1e-6)


def test_last_modes_are_nearer_the_truth_than_in_the_sample() -> None:
    rng = np.random.default_rng(4)
    data = rng.standard_normal((60, 50))
    sample = sample_variances(data, 50)
    centred = data - data.mean(axis=0)
    found = held_out_variances(centred @ centred.T, [str(k) for k in range(60)], sample, centred=True)
    assert found is not None
    assert sample[-10:].mean() < 0.1
    assert 0.5 < found[0][-10:].mean() < 1.5
    assert abs(found[0].sum() + found[1] - 50) < 5


def test_new_shapes_vary_as_they_say() -> None:
    rng = np.random.default_rng(7)
    spread = 1.1 ** -np.arange(80)
    data, new = (rng.standard_normal((n, 80)) * spread for n in (60, 4_000))
    mean = data.mean(axis=0)
    _, size, rows = np.linalg.svd(data - mean, full_matrices=False)
    sample, basis = size[:50] ** 2 / 59, rows[:50]
    found = held_out_variances((data - mean) @ (data - mean).T, [str(k) for k in range(60)], sample, centred=True)
    assert found is not None
    true = (((new - mean) @ basis.T) ** 2).mean(axis=0)

    def wrong_by(variance: np.ndarray) -> float:
        return float((0.5 * (true / variance - 1 - np.log(true / variance))).mean())

    assert wrong_by(found[0]) < 0.25 * wrong_by(sample)
    assert 0.7 < (true / found[0]).mean() < 1.3


def test_too_few_groups_or_modes_give_none() -> None:
    rng = np.random.default_rng(5)
    data = rng.standard_normal((98, 30))
    gram = data @ data.T
    assert held_out_variances(gram, [f"g{k // 2}" for k in range(98)], sample_variances(data, 5), centred=True) is None
    few = rng.standard_normal((60, 10))
    few[0, :9], few[1:, 9] = 0.0, 0.0
    groups = [str(k) for k in range(60)]
    assert held_out_variances(few @ few.T, groups, sample_variances(few, 9), centred=False) is not None
    assert held_out_variances(few @ few.T, groups, sample_variances(few, 10), centred=False) is None
