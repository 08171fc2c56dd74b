import dataclasses
import itertools

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.evaluate import (
    Fold,
    calibrated,
    calibration,
    confusion,
    decision_map,
    fit_temperature,
    fixed_predictions,
    folds_of,
    learning_curve,
    macro_accuracy,
    mode_importance,
    nested_predictions,
    per_class,
    permutation_test,
    predict_probabilities,
    region_shares,
    subject_bootstrap,
    subject_folds,
)

NAMES = ("anger", "fear", "smile")


def people(n=15, spread=0.6, seed=0, k=6, per_class=2):
    """Three expressions of each of n people, along three axes of k."""
    rng = np.random.default_rng(seed)
    z, labels, subjects = [], [], []
    for person, (axis, name), _ in itertools.product(range(n), enumerate(NAMES), range(per_class)):
        z.append(2.0 * np.eye(k)[axis] + spread * rng.standard_normal(k))
        labels.append(name)
        subjects.append(f"p{person:02d}")
    return np.array(z), labels, subjects


def test_folds_never_split_a_person_and_are_balanced():
    subjects = [f"p{i}" for i in range(23) for _ in range(1 + i % 4)]
    folds = subject_folds(subjects, 5, seed=3)
    tests = np.concatenate([test for _, test in folds])
    assert sorted(tests) == list(range(len(subjects)))
    for train, test in folds:
        assert not {subjects[i] for i in train} & {subjects[i] for i in test}
        assert len(train) + len(test) == len(subjects)
    sizes = [len(test) for _, test in folds]
    assert max(sizes) - min(sizes) <= 4
    again = subject_folds(subjects, 5, seed=3)
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(folds, again, strict=True))
    assert any(not np.array_equal(a[1], b[1]) for a, b in zip(folds, subject_folds(subjects, 5, seed=4), strict=True))


@pytest.mark.parametrize("n_folds", [1, 4])
def test_folds_that_cannot_be_made_are_refused(n_folds):
    with pytest.raises(InputError, match="3 subjects"):
        subject_folds(["a", "a", "b", "c"], n_folds)


def test_a_person_in_both_sets_is_refused_by_name():
    z = np.ones((2, 3))
    with pytest.raises(InputError, match="anna would be trained on and tested"):
        Fold(z, ["x", "y"], ["anna", "ben"], z, ["x", "y"], ["carl", "anna"])
    with pytest.raises(InputError, match=r"\(n, K\)"):
        Fold(z, ["x"], ["anna", "ben"], z, ["x", "y"], ["carl", "dora"])


def test_nested_predictions_are_right_where_classes_lie_apart_and_come_in_the_order_of_the_samples():
    z, labels, subjects = people()
    found = nested_predictions(folds_of(z, labels, subjects, 3), classifiers=["mean-direction", "lda"], modes=(3, None))
    assert found.labels == tuple(labels) and found.subjects == tuple(subjects)
    assert found.classes == NAMES
    assert macro_accuracy(found.labels, found.predicted, found.classes) > 0.9
    assert list(found.index) == list(range(len(z)))
    assert [found.classes[k] for k in found.probabilities.argmax(axis=1)] == list(found.predicted)
    assert len(found.chosen) == 3
    assert all(choice.classifier in ("mean-direction", "lda") and choice.modes in (3, 6) for choice in found.chosen)


def test_the_number_of_modes_is_chosen_where_only_some_tell_anything():
    z, labels, subjects = people(n=10, spread=0.8, k=60)
    found = nested_predictions(folds_of(z, labels, subjects, 3), classifiers=["lda"], modes=(1, 3, None))
    assert {choice.modes for choice in found.chosen} == {3}


def test_what_is_chosen_does_not_depend_on_the_test_samples():
    z, labels, subjects = people(spread=1.5)
    folds = folds_of(z, labels, subjects, 3)
    rng = np.random.default_rng(9)
    others = [
        dataclasses.replace(f, test=rng.standard_normal(f.test.shape), test_labels=list(rng.permutation(f.test_labels)))
        for f in folds
    ]
    names = ("lda", "knn", "mean-direction")
    assert nested_predictions(folds, classifiers=names).chosen == nested_predictions(others, classifiers=names).chosen


def test_a_failed_fit_gets_no_answer_and_counts_as_wrong():
    z, labels, subjects = people(n=9, spread=0.1)
    z[[0, 7]] = np.nan
    found = nested_predictions(folds_of(z, labels, subjects, 3), classifiers=["mean-direction"], modes=(None,))
    assert [i for i, answer in enumerate(found.predicted) if not answer] == [0, 7]
    assert np.isnan(found.probabilities[[0, 7]]).all() and np.isfinite(np.delete(found.probabilities, [0, 7], 0)).all()
    right = np.mean([np.mean([a == t for a, t in zip(found.predicted, labels, strict=True) if t == n]) for n in NAMES])
    assert right < 1.0
    assert macro_accuracy(labels, found.predicted, NAMES) == pytest.approx(right)


def test_a_class_that_training_lacks_has_probability_zero():
    z, labels, subjects = people(n=6)
    train = [i for i, name in enumerate(labels) if name != "fear" and subjects[i] < "p03"]
    test = [i for i in range(len(z)) if subjects[i] >= "p03"]
    fold = Fold(z[train], [labels[i] for i in train], [subjects[i] for i in train],
                z[test], [labels[i] for i in test], [subjects[i] for i in test])  # fmt: skip
    found = fixed_predictions([fold], "lda")
    assert found.classes == NAMES
    assert (found.probabilities[:, 1] == 0).all() and "fear" not in found.predicted


def test_macro_accuracy_weighs_classes_alike_whatever_their_number():
    labels, predicted = ["a"] * 8 + ["b"] * 2, ["a"] * 8 + ["a", "b"]
    assert macro_accuracy(labels, predicted, ("a", "b", "c")) == pytest.approx(0.75)
    assert macro_accuracy(labels, ["unsure"] * 10, ("a", "b")) == 0.0


def test_macro_accuracy_is_that_of_scikit_learn():
    from sklearn.metrics import recall_score

    rng = np.random.default_rng(3)
    labels, predicted = rng.choice(NAMES[:2], 60).tolist(), rng.choice([*NAMES, "unsure"], 60).tolist()
    theirs = recall_score(labels, predicted, labels=NAMES, average="macro", zero_division=np.nan)
    assert macro_accuracy(labels, predicted, NAMES) == pytest.approx(theirs)


def test_the_confusion_counts_each_answer_once_and_other_answers_apart():
    labels = ["a", "a", "a", "b", "b"]
    counts = confusion(labels, ["a", "b", "unsure", "b", ""], ("a", "b"))
    np.testing.assert_array_equal(counts, [[1, 1, 1], [0, 1, 1]])


def test_per_class_figures_are_those_of_scikit_learn():
    from sklearn.metrics import precision_recall_fscore_support

    rng = np.random.default_rng(0)
    labels, predicted = (rng.choice(NAMES, 200).tolist() for _ in range(2))
    expected = precision_recall_fscore_support(labels, predicted, labels=NAMES)
    ours = per_class(labels, predicted, NAMES)
    for k, name in enumerate(NAMES):
        scores = ours[name]
        np.testing.assert_allclose((scores.precision, scores.recall, scores.f1, scores.count), [e[k] for e in expected])


def test_the_bootstrap_draws_people_not_samples():
    # All samples of a person are right or all are wrong: the interval is that of 20 throws, not of 400.
    labels = ["a", "b"] * 200
    subjects = [f"p{i // 20}" for i in range(400)]
    predicted = [label if int(person[1:]) % 4 else "wrong" for label, person in zip(labels, subjects, strict=True)]
    low, high = subject_bootstrap(labels, predicted, subjects)
    assert low < 0.75 < high
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.75 * 0.25 / 20), rel=0.2)
    alone_low, alone_high = subject_bootstrap(labels, predicted, [str(i) for i in range(400)])
    assert alone_high - alone_low < 0.4 * (high - low)


def test_the_bootstrap_interval_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(100):
        right = rng.random((30, 4)) < 0.7
        labels = ["a", "a", "b", "b"] * 30
        predicted = [t if r else "no" for t, r in zip(labels, right.ravel(), strict=True)]
        low, high = subject_bootstrap(labels, predicted, [str(i // 4) for i in range(120)], draws=300)
        covered += low <= 0.7 <= high
    assert 86 <= covered <= 100


def test_an_accuracy_of_one_has_the_exact_interval_of_the_class_that_the_fewest_people_show():
    labels, subjects = ["a"] * 12 + ["b"] * 6, [f"p{k}" for k in range(12)] + [f"p{k}" for k in range(6)]
    low, high = subject_bootstrap(labels, labels, subjects)
    assert high == 1.0 and low == pytest.approx(0.025 ** (1 / 6))


def test_the_fast_permutation_test_is_the_slow_one(monkeypatch):
    z, labels, subjects = people(n=8, spread=1.5)
    z[5] = np.nan
    folds = folds_of(z, labels, subjects, 4)
    fast = permutation_test(folds, "lda", permutations=20, seed=2)
    monkeypatch.setattr("shapespace.recognise.evaluate._score_lda", None)
    monkeypatch.setitem(CLASSIFIERS, "the same", CLASSIFIERS["lda"])
    slow = permutation_test(folds, "the same", permutations=20, seed=2)
    assert fast.observed == pytest.approx(slow.observed)
    np.testing.assert_allclose(fast.null, slow.null)


def test_a_permutation_test_finds_meaning_only_where_there_is_some():
    z, labels, subjects = people(n=12, spread=1.0)
    good = permutation_test(folds_of(z, labels, subjects, 4), permutations=99)
    assert good.p == pytest.approx(0.01)
    assert good.null.mean() == pytest.approx(1 / 3, abs=0.05)
    noise = np.random.default_rng(4).standard_normal(z.shape)
    assert permutation_test(folds_of(noise, labels, subjects, 4), permutations=99).p > 0.05


def test_people_whose_rows_differ_between_folds_are_refused():
    z, labels, subjects = people(n=6)
    first, second = folds_of(z, labels, subjects, 2)
    shorter = dataclasses.replace(
        first, train=first.train[1:], train_labels=first.train_labels[1:], train_subjects=first.train_subjects[1:]
    )
    with pytest.raises(InputError, match="rows in one fold"):
        permutation_test([shorter, second], permutations=1)


def test_more_people_to_learn_from_help():
    z, labels, subjects = people(n=30, spread=1.5, k=12, per_class=1)
    curve = learning_curve(folds_of(z, labels, subjects, 3), "lda", (2, 8, 20, 500), repeats=4)
    assert list(curve.subjects) == [2, 8, 20]
    assert curve.macro_accuracy.shape == (3, 4)
    assert curve.mean[0] < curve.mean[2]


def test_the_modes_that_carry_the_classes_are_those_that_matter():
    z, labels, subjects = people(n=20, spread=0.8)
    loss = mode_importance(folds_of(z, labels, subjects, 4), "lda").mean(axis=0)
    assert loss.shape == (6,)
    assert loss[:3].min() > 0.1 > np.abs(loss[3:]).max()


def test_calibration_of_honest_probabilities_finds_no_error_and_of_bold_ones_it_does():
    rng = np.random.default_rng(0)
    p = rng.dirichlet([0.5, 0.5, 0.5], 20_000)
    labels = [NAMES[k] for k in (p.cumsum(axis=1) < rng.random((20_000, 1))).sum(axis=1)]
    honest = calibration(labels, p, NAMES)
    bold = calibration(labels, calibrated(p, 0.3), NAMES)
    assert honest.expected_calibration_error < 0.02 < bold.expected_calibration_error
    assert honest.brier < bold.brier and honest.log_loss < bold.log_loss
    assert honest.count.sum() == 20_000
    np.testing.assert_allclose(honest.accuracy, honest.confidence, atol=0.05)
    # The temperature that undoes it.
    assert fit_temperature(labels, calibrated(p, 0.3), NAMES) == pytest.approx(1 / 0.3, rel=0.06)


def test_the_brier_score_is_that_of_its_definition():
    p = np.array([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8], [np.nan] * 3])
    expected = (0.3**2 + 0.2**2 + 0.1**2 + 0.1**2 + 0.9**2 + 0.8**2) / 2
    assert calibration(["anger", "fear", "smile"], p, NAMES).brier == pytest.approx(expected)


def test_a_decision_map_is_the_fisher_ratio_of_the_displacements():
    rng = np.random.default_rng(0)
    basis, stddev = rng.standard_normal((7, 3, 4)), np.array([4.0, 3.0, 2.0, 1.0])
    v, labels = rng.standard_normal((30, 4)), [NAMES[i % 3] for i in range(30)]
    moved = np.einsum("vck,nk->nvc", basis, v * stddev)
    own = np.arange(30) % 3
    means = np.stack([moved[own == c].mean(axis=0) for c in range(3)])
    between = ((means[own] - moved.mean(axis=0)) ** 2).sum(axis=2).mean(axis=0)
    within = ((moved - means[own]) ** 2).sum(axis=2).mean(axis=0)
    np.testing.assert_allclose(decision_map(basis, stddev, v, labels, noise_mm=0.2), between / (within + 0.04))


def test_a_decision_lies_where_the_face_moves_with_the_class():
    basis = np.zeros((10, 3, 2))
    basis[:5, 0, 0] = 1.0  # the first mode moves the mouth, the second the brow
    basis[5:, 1, 1] = 1.0
    rng = np.random.default_rng(1)
    own = np.arange(40) % 2
    v = np.stack([3.0 * own + 0.2 * rng.standard_normal(40), rng.standard_normal(40)], axis=1)
    found = decision_map(basis, np.ones(2), v, [NAMES[k] for k in own])
    shares = region_shares(found, {"mouth": np.arange(5), "brow": np.arange(5, 10), "none": np.arange(0)})
    assert shares["mouth"] > 0.95 and sum(shares.values()) == pytest.approx(1.0)


def test_what_cannot_be_evaluated_is_refused():
    z, labels, subjects = people(n=6)
    folds = folds_of(z, labels, subjects, 2)
    with pytest.raises(InputError, match="no folds"):
        nested_predictions([])
    with pytest.raises(InputError, match="no classifier 'forest'"):
        fixed_predictions(folds, "forest")
    with pytest.raises(InputError, match="at least two classes"):
        fixed_predictions(folds_of(z, ["a"] * len(z), subjects, 2), "lda")
    with pytest.raises(InputError, match="no point to show"):
        learning_curve(folds, subject_counts=(50,))
    with pytest.raises(InputError, match="not among the classes"):
        fit_temperature(["a", "b"], np.full((2, 2), 0.5), ("a", "c"))
    with pytest.raises(InputError, match="decision map"):
        decision_map(np.zeros((5, 3, 2)), np.ones(2), np.zeros((4, 3)), ["a"] * 4)


def test_what_is_chosen_is_chosen_on_people_that_were_not_trained_on(monkeypatch):
    from shapespace.recognise import predictions

    z, labels, subjects = people(n=12)
    owner = {row.tobytes(): person for row, person in zip(z[:, :1], subjects, strict=True)}
    seen = []

    def watched(**given):
        seen.append(tuple({owner[row[:1].tobytes()] for row in given[part]} for part in ("X", "test")))
        return original(**given)

    original = predictions.predict_probabilities
    monkeypatch.setattr(predictions, "predict_probabilities", watched)
    nested_predictions(folds_of(z, labels, subjects, 3), classifiers=["lda"], modes=(None,), inner_folds=4)
    assert len(seen) == 3 * (4 + 3 * 4 + 1)
    assert all(not trained & tested for trained, tested in seen)


def test_where_training_shows_one_class_alone_everything_is_that_class():
    X = np.random.default_rng(0).standard_normal((6, 3))
    test = np.vstack([X[:2], np.full((1, 3), np.nan)])
    for name in ("lda", "logistic", "svm"):
        found = predict_probabilities(X, np.array(["smile"] * 6), test, ("fear", "smile"), name, {})
        np.testing.assert_array_equal(found, [[0, 1], [0, 1], [np.nan, np.nan]])
