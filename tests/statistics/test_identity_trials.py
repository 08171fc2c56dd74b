"""Who is compared with whom, what is found of them, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from identity_people import cohort, people, with_columns
from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table
from shapespace.errors import InputError
from shapespace.model.additive import AdditiveModel
from shapespace.report.analyses.result_report import analysis_report
from shapespace.schemas import Analysis
from shapespace.statistics.identity.identify import identify
from shapespace.statistics.identity.scores import samples_of
from shapespace.statistics.identity.trial import IdentityConfig, rows_of, trial_of
from shapespace.statistics.identity.verify import verify

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")

FEW = IdentityConfig(draws=20)


def names_of(trial, rows):
    return {trial.subjects[row] for row in rows}


@pytest.mark.parametrize("options", [FEW, replace(FEW, gallery="expression=neutral"), replace(FEW, folds=2)])
def test_nobody_is_learned_from_and_tested_in_one_round_and_all_are_tested_once(options):
    trial = trial_of(cohort(), options)
    tested = [row for one in trial.rounds for row in {*one.gallery, *one.probes}]
    assert sorted(tested) == list(range(36))
    for one in trial.rounds:
        assert not names_of(trial, one.training) & names_of(trial, (*one.gallery, *one.probes))
        assert len(names_of(trial, one.training)) + len(names_of(trial, one.probes)) == 12
    assert len(trial.rounds) == (options.folds or 4)


def test_a_gallery_is_compared_with_probes_alone():
    trial = trial_of(cohort(), replace(FEW, gallery="expression=neutral", probe="expression=fear"))
    shown = trial.cohort.table.texts("expression")
    for one in trial.rounds:
        assert {shown[row] for row in one.gallery} == {"neutral"}
        assert {shown[row] for row in one.probes} == {"fear"}
        pairs, _ = trial.pairs(one)
        assert len(pairs) == len(one.gallery) * len(one.probes)


def test_without_a_gallery_each_pair_is_compared_once():
    trial = trial_of(cohort(), FEW)
    for one in trial.rounds:
        pairs, _ = trial.pairs(one)
        n = len(one.probes)
        assert len(pairs) == n * (n - 1) // 2
        assert len({tuple(sorted(row)) for row in pairs.rows.tolist()}) == len(pairs)


def test_roles_of_a_column_are_taken_and_found_by_its_name():
    roles = tuple(("train" if k < 18 else "gallery" if k % 3 == 0 else "probe") for k in range(36))
    shapes = with_columns(cohort(), role=roles, other=roles)
    for options in (FEW, replace(FEW, role="other")):
        trial = trial_of(shapes, options)
        assert len(trial.rounds) == 1
        assert trial.rounds[0].training == tuple(range(18))
        assert trial.rounds[0].gallery == tuple(range(18, 36, 3))
    by_hand = trial_of(shapes, replace(FEW, train="role=train", gallery="role=gallery"))
    assert by_hand.rounds == trial.rounds


@pytest.mark.parametrize(
    ("expression", "expected"),
    [("k=a", [0, 3]), (" k = a , b ", [0, 1, 3]), ("k!=a", [1, 2]), ("k!=a,b", [2])],
)
def test_an_expression_names_rows_by_the_values_of_a_column(expression, expected):
    table = Table({"k": ("a", "b", "c", "a")}, ("1", "2", "3", "4"))
    assert rows_of(table, expression) == expected


BAD = {
    "no expression": (replace(FEW, gallery="neutral"), "write a column and its values"),
    "no such value": (replace(FEW, gallery="expression=sad"), "no scan has expression=sad"),
    "no such column": (replace(FEW, gallery="mood=sad"), "has no column 'mood'"),
    "no such subject": (replace(FEW, subject="name"), "has no column 'name'"),
    "probe alone": (replace(FEW, probe="expression=fear"), "Probes need a gallery"),
    "trained and tested": (replace(FEW, train="expression=fear"), "both tested and learned from"),
    "all learned from": (replace(FEW, train="expression!=sad"), "No subject is left to test"),
    "too many folds": (replace(FEW, folds=7), "cannot be split into 7 folds"),
    "one fold": (replace(FEW, folds=1), "cannot be split into 1 folds"),
    "a score that is none": (replace(FEW, scores=("cosine", "sine")), "not sine"),
    "no score": (replace(FEW, scores=()), "an empty list"),
    "too many modes": (replace(FEW, modes=7), "1 to 6, as there are coefficients, not 7"),
    "no mode": (replace(FEW, curve=(0,)), "1 to 6, as there are coefficients, not 0"),
    "by what is not there": (replace(FEW, by="mood"), "has no column 'mood'"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_asked_is_refused_in_a_sentence(case):
    options, expected = BAD[case]
    with pytest.raises(InputError) as caught:
        verify(cohort(), options)
    text = str(caught.value)
    assert expected in text and text.endswith(".") and "\n" not in text


def test_a_subject_in_both_is_named():
    roles = tuple(("train" if k < 19 else "probe") for k in range(36))
    with pytest.raises(InputError, match="person 0-6 is both tested and learned from"):
        verify(with_columns(cohort(), role=roles), FEW)


@pytest.mark.parametrize(
    ("count", "scans", "expected"), [(3, 2, "at least four are needed"), (8, 1, "no two of the compared scans")]
)
def test_too_few_people_or_scans_are_refused(count, scans, expected):
    with pytest.raises(InputError, match=expected):
        verify(cohort(count, scans), FEW)


def test_a_role_that_is_none_is_refused():
    with pytest.raises(InputError, match="'role' is enrol; it may be gallery, probe or train"):
        verify(with_columns(cohort(), role=("enrol",) * 36), FEW)


@pytest.mark.parametrize(
    "options",
    [
        {"gallery": "Visit #=0", "probe": "expression=fear"},
        {"gallery": "expression=neutral", "probe": "Visit #!=0"},
        {"gallery": "expression=neutral", "train": "`Visit #`=0"},
    ],
)
def test_missing_cells_of_the_columns_of_expressions_are_counted(options):
    visits = ("", *("1" if k % 3 else "0" for k in range(1, 36)))
    shapes = with_columns(cohort(), **{"Visit #": visits})
    with pytest.raises(InputError, match=r"Visit # of 1 of 36 shapes is missing .*missing=drop"):
        trial_of(shapes, replace(FEW, **options))
    if "train" not in options:  # which would be learned from people who are tested
        trial = trial_of(shapes, replace(FEW, drop_missing=True, **options))
        assert len(trial.cohort) == 35 and any("1 of 36 shapes are excluded" in note for note in trial.notes)


def test_scans_of_nobody_are_refused_or_left_out():
    shapes = cohort()
    whose = ("", *shapes.table.texts("subject")[1:])
    shapes = with_columns(shapes, subject=whose)
    with pytest.raises(InputError, match="subject of 1 of 36 shapes is missing"):
        verify(shapes, FEW)
    found = verify(shapes, replace(FEW, drop_missing=True))
    assert len(found.trial.cohort) == 35
    assert any("excluded" in note for note in analysis_report(found).notes)


@pytest.fixture(scope="module")
def found():
    options = replace(FEW, gallery="expression=neutral", by="expression", curve=(1, 3), draws=50)
    return verify(cohort(24, 3), options)


def test_the_plda_score_beats_the_plain_distance_by_a_factor_of_two(found):
    assert found["plda"].eer.value <= 0.5 * found["distance"].eer.value
    assert found["plda"].cllr_min < found["distance"].cllr_min
    assert [one.name for one in found.scores] == ["plda", "cosine", "mahalanobis", "distance"]


def test_figures_of_the_parts_belong_to_the_values_of_the_probes(found):
    for one in found.scores:
        assert set(one.by) == {"smile", "fear"}
        assert sum(part.genuine for part in one.by.values()) == found.pairs.same.sum()
        assert set(one.curve) == {1, 3}
    # The whole shapes are compared, whatever the modes.
    assert set(found["distance"].curve.values()) == {found["distance"].eer.value}


def test_a_rate_that_the_pairs_cannot_show_is_not_stated(found):
    impostors = (~found.pairs.same).sum()
    assert 100 < impostors < 1000
    assert found.scores[0].tar[1e-3].value is None
    assert found.scores[0].tar[1e-2].value is not None
    assert any("30 are needed" in note for note in analysis_report(found).notes)


def test_the_same_seed_gives_the_same_and_another_parts_the_people_anew():
    one, again, other = (verify(cohort(), replace(FEW, seed=seed)).scores[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.score, again.score)
    assert one.eer == again.eer
    assert not np.array_equal(one.score, other.score)


def test_the_order_of_the_table_changes_no_figure():
    shapes = cohort()
    mixed = np.random.default_rng(0).permutation(len(shapes)).tolist()
    one, other = (verify(c, FEW) for c in (shapes, shapes.take(mixed)))
    for score in FEW.scores:
        assert one[score].eer.value == pytest.approx(other[score].eer.value)


def test_an_additive_model_gives_its_identity_alone():
    shapes = cohort()
    fitted = shapes.fitted
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((6, 6)))[0]
    parted = replace(shapes, fitted=replace(fitted, additive=AdditiveModel(fitted.model, turn, 4)))
    found = samples_of(parted, ["a"] * 36, ())
    np.testing.assert_allclose(found.x, fitted.z @ turn[:4].T)
    errors = (fitted.b_stddev / fitted.model.stddev) ** 2
    for row in (0, 7):
        np.testing.assert_allclose(found.variance[row], np.diag(turn[:4] @ np.diag(errors[row]) @ turn[:4].T))
    assert not samples_of(parted, ["a"] * 36, (), uncertainty=False).variance.any()


def test_surfaces_without_fits_are_whitened_by_people_who_are_not_tested():
    told = people(12, 3, error=0.2)
    shapes = 10 * np.random.default_rng(0).standard_normal((1, 20, 3)) + np.pad(told.x, ((0, 0), (0, 54))).reshape(
        36, 20, 3
    )
    surfaces = Cohort.of_shapes(shapes, {"subject": told.subjects}, align=False)
    training = list(range(18))
    found = samples_of(surfaces, told.subjects, training)
    np.testing.assert_allclose(np.cov(found.x[:18].T), np.eye(found.x.shape[1]), atol=1e-6)
    assert not found.variance.any()
    assert verify(surfaces, FEW)["plda"].eer.value < 0.3
    with pytest.raises(InputError, match="at least three are needed"):
        samples_of(surfaces, told.subjects, [0, 1])


def test_identification_enrols_the_first_scan_of_each_person_and_says_so():
    found = identify(cohort(), FEW)
    assert found.enrolled == 3 and found.probes == 24 and found.trained_on == 9
    assert any("first scan of each subject" in note for note in analysis_report(found).notes)
    by_hand = identify(cohort(), replace(FEW, gallery="expression=neutral"))
    np.testing.assert_array_equal(found.scores[0].cmc, by_hand.scores[0].cmc)
    assert found.scores[0].cmc[-1] == 1.0 and (np.diff(found.scores[0].cmc) >= 0).all()


def test_strangers_are_those_who_are_not_enrolled():
    roles = ["train"] * 18 + ["gallery", "probe", "probe"] * 4 + ["probe"] * 6
    found = identify(with_columns(cohort(), role=tuple(roles)), FEW)
    searches = found.scores[0].searches
    assert found.enrolled == 4 and (~searches.enrolled).sum() == 6
    assert found.scores[0].fnir[0.01].value is None
    assert not any("Nobody is a stranger" in note for note in analysis_report(found).notes)


@pytest.mark.parametrize("ask", [verify, identify])
def test_an_answer_is_kept_with_all_that_it_depends_on(ask, tmp_path):
    analysis_report(ask(cohort(), replace(FEW, gallery="expression=neutral", seed=5))).save(tmp_path)
    told = json.loads((tmp_path / "analysis.json").read_text())
    assert told["settings"]["seed"] == 5 and told["settings"]["gallery"] == "expression=neutral"
    assert Analysis.FILE == "analysis.json" and told["question"].startswith("recognise ")
    assert told["model_hashes"]
    rows = (tmp_path / "scans.csv").read_text().splitlines()
    assert len(rows) == 37 and "gallery" in rows[1]
    assert (tmp_path / "figures.csv").read_text().startswith("score,figure,value,low,high")
    arrays = np.load(next(tmp_path.glob("*.npz")))
    assert all(np.isfinite(arrays[name]).all() or name.startswith("own") for name in arrays.files)
