"""The PLDA score of two people against the densities that it is made of."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from identity_people import MODES, people, spreads
from shapespace.errors import InputError
from shapespace.statistics.identity.rates import Sweep
from shapespace.statistics.identity.scores import SCORES, Samples, TwoCovariance

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")


def eer(score, gallery, probes):
    same = np.asarray(gallery.subjects)[:, None] == np.asarray(probes.subjects)
    kept = ~np.eye(*same.shape, dtype=bool)
    return Sweep(score[kept], same[kept]).roc().eer


def test_it_is_the_ratio_of_normal_densities():
    learned = TwoCovariance.learn(people(60, 4, error=0.5))
    gallery, probes = people(3, 1, 1, error=0.5), people(4, 1, 2, error=0.5)
    back = np.linalg.inv(learned.basis)
    between = back.T @ np.diag(learned.between) @ back
    found = learned.score(gallery, probes)
    for i, g in enumerate(gallery.x):
        for j, p in enumerate(probes.x):
            one, other = (
                between + back.T @ np.diag(learned.within(samples)[row]) @ back
                for samples, row in ((gallery, i), (probes, j))
            )
            together = multivariate_normal(
                np.tile(learned.mean, 2), np.block([[one, between], [between, other]])
            ).logpdf(np.concatenate([g, p]))
            apart = multivariate_normal(learned.mean, one).logpdf(g) + multivariate_normal(learned.mean, other).logpdf(
                p
            )
            assert found[i, j] == pytest.approx(together - apart, abs=1e-8)


def test_with_many_people_it_learns_the_covariances_they_were_drawn_with():
    learned = TwoCovariance.learn(people(2000, 4))
    back = np.linalg.inv(learned.basis)
    between, within = spreads()
    np.testing.assert_allclose(back.T @ np.diag(learned.between) @ back, between, atol=0.12)
    np.testing.assert_allclose(back.T @ back, within, atol=0.2)
    assert learned.people == 2000 and learned.scans == 8000


def test_it_does_not_change_with_the_coordinates():
    """Up to shrinkage, which is towards the unit matrix of the coordinates, and is nothing for so many people."""
    rng = np.random.default_rng(1)
    turn, move = np.linalg.qr(rng.standard_normal((MODES, MODES)))[0], rng.standard_normal(MODES)

    def other(samples):
        return replace(samples, x=3.0 * samples.x @ turn.T + move)

    training, gallery, probes = people(40, 4), people(5, 1, 1), people(6, 1, 2)
    found = TwoCovariance.learn(training).score(gallery, probes)
    again = TwoCovariance.learn(other(training)).score(other(gallery), other(probes))
    np.testing.assert_allclose(again, found, atol=1e-6)


def test_a_fit_that_knows_nothing_says_nothing():
    learned = TwoCovariance.learn(people(60, 4, error=0.3))
    gallery, probe = people(5, 1, 1, error=0.3), people(1, 1, 2, error=0.3)
    blind = replace(probe, variance=np.full_like(probe.variance, 1e9))
    assert np.abs(learned.score(gallery, blind)).max() < 1e-3
    assert np.abs(learned.score(gallery, probe)).max() > 1.0


def test_within_a_person_it_finds_on_average_what_it_learned():
    training = people(80, 4, error=0.4)
    learned = TwoCovariance.learn(training)
    np.testing.assert_allclose(learned.within(training).mean(axis=0), 1.0)
    assert (learned.noise <= 0.9).all() and (learned.noise > 0).all()


def test_it_beats_distance_and_cosine_where_expressions_are_large():
    training, tested = people(60, 4), people(40, 3, 1)
    errors = {name: eer(learn(training)(tested, tested), tested, tested) for name, learn in SCORES.items()}
    assert errors["plda"] < 0.5 * min(errors[name] for name in ("cosine", "mahalanobis", "distance"))


def test_errors_that_fits_state_help_where_they_differ():
    """Two of five scans are far worse than the others, and say so."""
    rng = np.random.default_rng(0)

    def worse(samples):
        variance = np.where(rng.random((len(samples), 1)) < 0.4, 0.6, 1e-4) * np.ones(samples.x.shape)
        x = samples.x + np.sqrt(variance) * rng.standard_normal(variance.shape)
        return replace(samples, x=x, variance=variance)

    training, tested = worse(people(100, 4)), worse(people(80, 3, 1))

    def without(samples):
        return replace(samples, variance=np.zeros_like(samples.x))

    stated, exact = (
        eer(TwoCovariance.learn(one).score(other, other), tested, tested)
        for one, other in ((training, tested), (without(training), without(tested)))
    )
    assert stated < 0.9 * exact


@pytest.mark.parametrize(("count", "scans"), [(2, 5), (6, 1)])
def test_too_few_people_to_learn_from_are_refused(count, scans):
    with pytest.raises(InputError, match="three subjects or more and several scans"):
        TwoCovariance.learn(people(count, scans))


def test_few_people_with_many_modes_are_shrunk_and_not_refused():
    few = people(4, 2, k=30)
    learned = TwoCovariance.learn(few)
    assert np.isfinite(learned.score(few, few)).all()
    assert (learned.between >= 0).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_refused(bad):
    x = np.full((2, 3), bad)
    with pytest.raises(InputError, match="finite"):
        Samples(x, np.zeros((2, 3)), np.zeros((2, 4)), ("a", "b"))


def test_negative_variances_are_refused():
    with pytest.raises(InputError, match="not negative"):
        Samples(np.zeros((2, 3)), np.full((2, 3), -1.0), np.zeros((2, 4)), ("a", "b"))
