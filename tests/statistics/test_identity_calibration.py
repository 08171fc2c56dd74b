"""Likelihood ratios that mean what they say, and what they cost."""

import itertools

import numpy as np
import pytest

from shapespace.statistics.identity.rates import Pairs
from shapespace.statistics.identity.verify import calibrated, cllr, cllr_min

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")


def well_calibrated(n, seed=0, distance=2.0):
    """Return scores of two unit normal distributions, their log likelihood ratios, and which is which."""
    rng = np.random.default_rng(seed)
    same = np.arange(2 * n) < n
    score = rng.normal(0, 1, 2 * n) + np.where(same, distance, 0.0)
    return score, distance * (score - distance / 2), same


def pairs_of(people, scans):
    who = np.repeat(np.arange(people), scans)
    rows = np.array(list(itertools.combinations(range(len(who)), 2)))
    return Pairs(who[rows[:, 0]], who[rows[:, 1]], rows)


def test_the_cost_is_that_of_its_definition():
    llr, same = np.array([2.0, -1.0, 0.5, -3.0]), np.array([True, True, False, False])
    by_hand = 0.5 * (np.mean(np.log2(1 + np.exp([-2.0, 1.0]))) + np.mean(np.log2(1 + np.exp([0.5, -3.0]))))
    assert cllr(llr, same) == pytest.approx(by_hand)


def test_ratios_that_say_nothing_miss_one_bit_and_sure_ones_none():
    same = np.arange(10) < 4
    assert cllr(np.zeros(10), same) == pytest.approx(1.0)
    assert cllr(np.where(same, 1e6, -1e6), same) == 0.0
    assert cllr(np.where(same, -1e3, 1e3), same) > 1000


def test_well_calibrated_ratios_cost_what_the_best_calibration_does():
    _, llr, same = well_calibrated(5_000)
    assert cllr(llr, same) == pytest.approx(cllr_min(llr, same), abs=0.02)
    # Overconfident and timid ones cost more, and as little once they are calibrated.
    for wrong in (3.0 * llr, 0.3 * llr, llr + 2.0):
        assert cllr(wrong, same) > cllr(llr, same) + 0.02
        assert cllr_min(wrong, same) == pytest.approx(cllr_min(llr, same), abs=1e-9)


def test_the_least_cost_is_that_of_the_best_of_all_rising_functions():
    """Brute force: of each score the ratio may be one of a few values, none lower than that of a lower score."""
    score = np.array([0.0, 1.0, 2.0, 2.0, 3.0, 4.0])
    same = np.array([False, True, False, True, False, True])
    distinct, place = np.unique(score, return_inverse=True)
    values = np.linspace(-4, 4, 11)
    least = min(
        cllr(np.array(chosen)[place], same) for chosen in itertools.combinations_with_replacement(values, len(distinct))
    )
    found = cllr_min(score, same)
    assert found <= least + 1e-12
    # The ends may be infinite, which the brute force has not.
    assert found == pytest.approx(least, abs=0.03)


def test_calibration_gives_the_true_ratios_whatever_the_scale_of_the_scores():
    pairs = pairs_of(30, 4)
    rng = np.random.default_rng(0)
    score = rng.normal(0, 1, len(pairs)) + np.where(pairs.same, 2.0, 0.0)
    truth = 2.0 * (score - 1.0)
    group = np.arange(30) % 5
    for scaled in (score, 1000.0 * score - 7.0, 1e-3 * score):
        llr = calibrated(scaled, pairs, group)
        assert cllr(llr, pairs.same) == pytest.approx(cllr(truth, pairs.same), abs=0.03)
        assert np.corrcoef(llr, truth)[0, 1] > 0.99


def test_no_pair_of_a_person_has_a_part_in_the_calibration_of_their_own():
    pairs = pairs_of(12, 3)
    rng = np.random.default_rng(1)
    score = rng.normal(0, 1, len(pairs)) + np.where(pairs.same, 2.0, 0.0)
    group = np.arange(12) % 4
    before = calibrated(score, pairs, group)
    touched = (group[pairs.one] == 2) | (group[pairs.other] == 2)
    after = calibrated(np.where(touched & pairs.same, -50.0, score), pairs, group)
    of_them = touched & ~pairs.same
    np.testing.assert_array_equal(after[of_them], before[of_them])
    assert not np.array_equal(after[~touched], before[~touched])


def test_too_few_groups_to_learn_from_others_give_no_ratios():
    pairs = pairs_of(4, 2)
    assert calibrated(np.zeros(len(pairs)), pairs, np.array([0, 0, 1, 1])) is None
