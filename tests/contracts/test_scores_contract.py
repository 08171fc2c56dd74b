"""What every score of who is it must do; a new entry of SCORES is tested by being there."""

import numpy as np
import pytest

from identity_people import people
from shapespace.statistics.identity.scores import SCORES

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")


@pytest.fixture(scope="module")
def training():
    return people(40, 4, error=0.2)


@pytest.mark.parametrize("name", SCORES)
def test_a_score_gives_a_finite_number_for_each_pair_whichever_comes_first(name, training):
    gallery, probes = people(5, 2, 1, error=0.2), people(7, 1, 2, error=0.2)
    score = SCORES[name](training)
    found = score(gallery, probes)
    assert found.shape == (10, 7) and np.isfinite(found).all()
    np.testing.assert_allclose(score(probes, gallery), found.T, atol=1e-9)


@pytest.mark.parametrize("name", SCORES)
def test_a_score_of_a_pair_does_not_depend_on_the_others(name, training):
    gallery, probes = people(5, 2, 1, error=0.2), people(7, 1, 2, error=0.2)
    score = SCORES[name](training)
    found = score(gallery, probes)
    np.testing.assert_allclose(
        score(gallery.take([3, 0]), probes.take([6, 1, 2])), found[[3, 0]][:, [6, 1, 2]], atol=1e-9
    )


@pytest.mark.parametrize("name", SCORES)
def test_a_score_is_larger_for_more_alike(name, training):
    tested = people(30, 3, 1)
    found = SCORES[name](training)(tested, tested)
    same = np.asarray(tested.subjects)[:, None] == np.asarray(tested.subjects)
    own = np.eye(len(tested), dtype=bool)
    assert np.median(found[same & ~own]) > np.median(found[~same])
    assert (found[own] > np.percentile(found[~same], 90)).all()


@pytest.mark.parametrize("name", SCORES)
def test_learning_changes_nothing_and_gives_the_same_again(name, training):
    x, variance, mm = training.x.copy(), training.variance.copy(), training.mm.copy()
    tested = people(6, 2, 1)
    one, again = (SCORES[name](training)(tested, tested) for _ in range(2))
    np.testing.assert_array_equal(one, again)
    for before, after in ((x, training.x), (variance, training.variance), (mm, training.mm)):
        np.testing.assert_array_equal(before, after)
