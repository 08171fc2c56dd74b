"""What every classifier must do; a new entry of CLASSIFIERS is tested by being there."""

import numpy as np
import pytest
from sklearn.base import BaseEstimator, clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.utils.estimator_checks import parametrize_with_checks

from shapespace.recognise.classifiers import (
    CLASSIFIERS,
    GRIDS,
    CalibratedSVC,
    NearestMeanDirection,
    ShrinkageLDA,
    ShrinkageQDA,
)

# A scikit-learn Pipeline fits the very steps it was given; scikit-learn expects these two of its own pipelines to fail.
OF_ANY_PIPELINE = {
    "check_dont_overwrite_parameters": "a Pipeline changes its parameter steps",
    "check_estimators_overwrite_params": "a Pipeline changes its parameter steps",
}


def expected(estimator: BaseEstimator) -> dict[str, str]:
    return OF_ANY_PIPELINE if hasattr(estimator, "steps") else {}


@parametrize_with_checks(
    [
        NearestMeanDirection(),
        ShrinkageLDA(),
        ShrinkageQDA(),
        CalibratedSVC(),
        *(make(0) for make in CLASSIFIERS.values()),
    ],
    expected_failed_checks=expected,
)
def test_scikit_learn_finds_nothing_wrong(estimator, check):
    check(estimator)


def three_directions(n=60, spread=0.5, seed=0, k=4):
    rng = np.random.default_rng(seed)
    own = np.arange(n) % 3
    z = 3.0 * np.eye(k)[own] * rng.uniform(0.5, 1.5, (n, 1)) + spread * rng.standard_normal((n, k))
    return z, np.array(["anger", "fear", "smile"])[own]


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_a_classifier_tells_three_directions_apart_with_probabilities(name):
    z, labels = three_directions()
    fitted = CLASSIFIERS[name](0).fit(z, labels)
    new, truth = three_directions(seed=1)
    p = fitted.predict_proba(new)
    assert list(fitted.classes_) == ["anger", "fear", "smile"]
    assert p.shape == (60, 3) and (p >= 0).all()
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    assert (fitted.predict(new) == truth).mean() > 0.9
    assert (fitted.classes_[p.argmax(axis=1)] == truth).mean() > 0.9


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_a_classifier_has_its_two_steps_and_the_parameters_of_its_grid(name):
    made = CLASSIFIERS[name](3)
    assert list(made.named_steps) == ["scale", "classify"]
    assert set(GRIDS.get(name, {})) <= set(made.get_params())
    assert repr(clone(made)) == repr(made)


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_the_same_seed_gives_the_same_answers(name):
    z, labels = three_directions(spread=1.5)
    first, second = (CLASSIFIERS[name](5).fit(z, labels).predict_proba(z) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("shrinkage", [0.0, 0.1, 0.7])
def test_our_lda_is_that_of_scikit_learn(shrinkage):
    z, labels = three_directions(n=50, spread=2.0)
    ours = ShrinkageLDA(shrinkage).fit(z, labels)
    theirs = LinearDiscriminantAnalysis(solver="lsqr", shrinkage=shrinkage).fit(z, labels)
    new, _ = three_directions(seed=2, spread=2.0)
    np.testing.assert_allclose(ours.predict_proba(new), theirs.predict_proba(new), atol=1e-9)


def test_our_qda_is_that_of_the_normal_densities_and_with_full_shrinkage_the_lda():
    from scipy.stats import multivariate_normal

    z, labels = three_directions(n=90, spread=2.0)
    new, _ = three_directions(seed=2, spread=2.0)
    density = []
    for name in np.unique(labels):
        mine = z[labels == name]
        density.append(multivariate_normal(mine.mean(axis=0), np.cov(mine.T, bias=True)).pdf(new))
    expected = np.stack(density, axis=1)
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(ShrinkageQDA(0.0).fit(z, labels).predict_proba(new), expected, atol=1e-9)
    linear = ShrinkageLDA().fit(z, labels).predict_proba(new)
    np.testing.assert_allclose(ShrinkageQDA(1.0).fit(z, labels).predict_proba(new), linear, atol=1e-9)


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_classes_with_fewer_samples_than_modes_can_be_told_apart(name):
    z, labels = three_directions(n=9, k=20)
    new, truth = three_directions(n=60, k=20, seed=1)
    assert (CLASSIFIERS[name](0).fit(z, labels).predict(new) == truth).mean() > 0.6


def test_the_nearest_mean_direction_is_that_of_its_definition():
    z, labels = three_directions(spread=2.0)
    new, _ = three_directions(seed=3, spread=2.0)
    answers = NearestMeanDirection().fit(z, labels).predict(new)
    for sample, answer in zip(new, answers, strict=True):
        cosines = {}
        for name in np.unique(labels):
            mean = np.mean([v / np.linalg.norm(v) for v in z[labels == name]], axis=0)
            cosines[name] = mean @ sample / (np.linalg.norm(mean) * np.linalg.norm(sample))
        assert answer == max(cosines, key=cosines.get)


def test_how_far_a_sample_lies_out_does_not_matter_to_the_nearest_mean_direction():
    z, labels = three_directions()
    new, _ = three_directions(seed=4)
    fitted = NearestMeanDirection().fit(z, labels)
    np.testing.assert_allclose(fitted.predict_proba(1e-200 * new), fitted.predict_proba(1e200 * new))


def test_a_sample_without_direction_is_given_no_class_before_another():
    z, labels = three_directions()
    p = NearestMeanDirection().fit(z, labels).predict_proba(np.zeros((1, 4)))
    np.testing.assert_allclose(p, 1 / 3)


def test_the_temperature_rises_where_directions_say_less():
    clear, vague = (NearestMeanDirection().fit(*three_directions(n=300, spread=s)).temperature_ for s in (0.5, 4.0))
    assert clear < vague
    assert NearestMeanDirection(0.25).fit(*three_directions()).temperature_ == 0.25


@pytest.mark.parametrize(
    "wrong", [NearestMeanDirection(0.0), CalibratedSVC(temperature=-1.0), ShrinkageLDA(1.5), ShrinkageQDA(-0.1)]
)
def test_settings_without_meaning_are_refused(wrong):
    with pytest.raises(ValueError, match="must"):
        wrong.fit(*three_directions())


def test_quadratic_discriminants_of_one_sample_a_class_go_to_the_nearest():
    X = np.array([[0.0, 1.0, 2.0], [3.0, 0.0, -1.0]])
    rule = ShrinkageQDA().fit(X, ["a", "b"])
    np.testing.assert_array_equal(rule.predict(X + 0.1), ["a", "b"])
    assert np.isfinite(rule.predict_proba(1e3 * X)).all()
