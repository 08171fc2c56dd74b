import csv

import numpy as np
import pytest

from shapespace import schemas
from shapespace.batch.fit_records import coefficient_row, failed_record, write_coefficients
from shapespace.cohort.table import Label, Labels, Table
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.labelled_scans import (
    ScanCoefficients,
    from_record,
    one_model,
    read_coefficients,
    relative_to_neutral,
    with_labels,
)
from shapespace.recognise.predict import predict_scans, train_classifier, write_answers
from shapespace.schemas import File, FitRecord

HASH = "a" * 64
NAMES = ("anger", "fear", "smile")


def people(n=8, k=5, seed=0, spread=0.3, identity=3.0):
    """A neutral scan and three expressions of each of n people, whose identity is larger than any expression."""
    rng = np.random.default_rng(seed)
    scans = []
    for person in range(n):
        who = identity * rng.standard_normal(k)
        for axis, name in enumerate((*NAMES, "neutral")):
            z = who + spread * rng.standard_normal(k)
            if name != "neutral":
                z = z + 2.0 * np.eye(k)[axis]
            scans.append(ScanCoefficients(f"p{person}_{name}", "converged", "Fine.", z, HASH, name, f"p{person}"))
    return scans


def changed(scan, **fields):
    return ScanCoefficients(**{**vars(scan), **fields})


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_relative_to_neutral_other_people_are_recognised_whoever_they_are(name):
    saved, notes = train_classifier(people(), classifier=name, relative=True)
    assert saved.classes == NAMES and saved.training["scans"] == 24 and saved.training["subjects"] == 8
    assert saved.cross_validation["macro_accuracy"] > 0.9 and saved.cross_validation["by"] == "subject"
    assert notes == []
    others = people(seed=5)
    right = [
        a.prediction == s.label for a, s in zip(predict_scans(saved, others), others, strict=True) if not a.neutral
    ]
    assert len(right) == 24 and np.mean(right) > 0.8


def test_without_neutral_faces_identity_hides_what_relative_coefficients_show():
    apart, _ = train_classifier([s for s in people(12) if s.label != "neutral"])
    relative, _ = train_classifier(people(12), relative=True)
    assert apart.cross_validation["macro_accuracy"] < relative.cross_validation["macro_accuracy"] - 0.2


def test_labels_of_the_scans_asked_about_do_not_change_the_answers():
    saved, _ = train_classifier(people(), relative=True)
    scans = people(seed=3)
    blind = [changed(s, label="neutral" if s.label == "neutral" else "") for s in scans]
    wrong = [changed(s, label="neutral" if s.label == "neutral" else "fear") for s in scans]
    told = [[a.prediction for a in predict_scans(saved, version)] for version in (scans, blind, wrong)]
    assert told[0] == told[1] == told[2]


def test_each_scan_has_its_row_and_none_is_guessed():
    saved, _ = train_classifier(people(), relative=True, confidence=0.5)
    scans = people(seed=4)
    scans[0] = changed(scans[0], status="failed", reason="It is empty.", z=None)
    scans[1] = changed(scans[1], status="doubtful", reason="It shrank.")
    scans[2] = changed(scans[2], status="max_iterations")
    scans[7] = changed(scans[7], status="doubtful")  # the neutral face of p1
    scans[8] = changed(scans[8], subject="")
    answers = predict_scans(saved, scans)
    assert [a.scan for a in answers] == [s.name for s in scans]
    failed, doubtful, limit, first_neutral, lost, bad_neutral, nameless = (answers[i] for i in (0, 1, 2, 3, 4, 7, 8))
    assert (failed.prediction, failed.probabilities, failed.reason) == ("", None, "It is empty.")
    assert (doubtful.prediction, doubtful.probabilities) == ("unsure", None)
    assert doubtful.reason == "The fit is doubtful: It shrank."
    assert limit.probabilities is not None
    assert first_neutral.neutral and first_neutral.prediction == ""
    assert lost.prediction == "" and "no usable neutral face of p1" in lost.reason
    assert bad_neutral.neutral and bad_neutral.prediction == "" and "doubtful" in bad_neutral.reason
    assert nameless.prediction == "" and "do not name this scan" in nameless.reason


def test_below_the_confidence_the_answer_is_unsure_and_says_why():
    scans = people(20, spread=1.5)
    saved, _ = train_classifier(scans, relative=True, confidence=0.8)
    for answer in predict_scans(saved, people(10, seed=9, spread=1.5)):
        if answer.neutral:
            continue
        best = answer.probabilities.max()
        assert (answer.prediction == "unsure") == (best < 0.8)
        assert bool(answer.reason) == (answer.prediction == "unsure")
        if answer.reason:
            assert f"{best:.2f}, below 0.8" in answer.reason
    never, _ = train_classifier(scans, relative=True, confidence=0.0)
    assert all(a.prediction in NAMES for a in predict_scans(never, scans) if not a.neutral)


def test_probabilities_are_calibrated_on_people_left_out():
    saved, _ = train_classifier(people(150, spread=1.2), relative=True, classifier="logistic", confidence=0.0)
    others = people(200, seed=1, spread=1.2)
    pairs = [(a, s) for a, s in zip(predict_scans(saved, others), others, strict=True) if not a.neutral]
    sure = np.mean([a.probabilities.max() for a, _ in pairs])
    assert sure == pytest.approx(np.mean([a.prediction == s.label for a, s in pairs]), abs=0.05)
    few, _ = train_classifier(people(3, spread=0.01), relative=True)
    assert max(a.probabilities.max() for a in predict_scans(few, people(3)) if not a.neutral) < 0.9999


def test_what_is_left_out_of_training_is_told():
    scans = people()
    scans[0] = changed(scans[0], status="doubtful")
    scans[1] = changed(scans[1], status="failed", z=None)
    scans[2] = changed(scans[2], label="")
    saved, notes = train_classifier(scans, relative=True)
    assert saved.training["left_out"] == {"doubtful": 1, "failed": 1, "without_label": 1}
    assert len(notes) == 3 and "1 of 32 scans have no label" in notes[2]
    assert saved.training["scans"] == 21


def test_without_subjects_scans_are_left_out_instead_of_people_and_that_is_told():
    scans = [changed(s, subject="") for s in people(identity=0.0)]
    saved, notes = train_classifier(scans)
    assert saved.cross_validation["by"] == "scan" and saved.training["subjects"] is None
    assert "name no subjects" in notes[0]
    assert "neutral" in saved.classes


def test_one_person_alone_gives_no_accuracy():
    scans = people(1) + [changed(s, name=f"{s.name}_2") for s in people(1, seed=0, spread=0.4)]
    saved, notes = train_classifier(scans)
    assert saved.cross_validation["macro_accuracy"] is None and saved.temperature == 1.0
    assert "too few subjects" in notes[0]


@pytest.mark.parametrize(
    ("change", "settings", "said"),
    [
        (lambda s: s, {"classifier": "forest"}, "no classifier 'forest'; choose among mean-direction"),
        (lambda s: s, {"confidence": 2.0}, "from 0 to 1"),
        (lambda s: s, {"modes": 6}, "There are 5 coefficients"),
        (lambda s: [changed(x, label="") for x in s], {}, "None of the 32 scans"),
        (lambda s: [changed(x, label="smile") for x in s], {}, "at least two classes"),
        (lambda s: s[:4], {}, "at least two scans each"),
        (lambda s: [], {}, "no fits"),
        (lambda s: [changed(s[0], model_hash="b" * 64), *s[1:]], {}, "2 different models"),
        (lambda s: [changed(x, subject="") for x in s], {"relative": True}, "add a column subject"),
        (lambda s: [x for x in s if x.name != "p3_neutral"], {"relative": True}, "neutral face of p3"),
        (lambda s: [changed(x, label="unsure") if x.label == "fear" else x for x in s], {}, "another name"),
    ],
)
def test_what_cannot_be_trained_is_refused(change, settings, said):
    with pytest.raises(InputError, match=said):
        train_classifier(change(people()), **settings)


def test_coefficients_of_another_model_are_refused():
    saved, _ = train_classifier(people(), relative=True)
    with pytest.raises(InputError, match=r"mean something else"):
        predict_scans(saved, [changed(s, model_hash="b" * 64) for s in people()])


def test_relative_coefficients_are_differences_from_the_own_neutral_face():
    z = np.arange(12.0).reshape(6, 2)
    subjects, neutral = ["a", "a", "a", "b", "b", "b"], [True, False, True, False, False, True]
    expected = z - np.array([(z[0] + z[2]) / 2] * 3 + [z[5]] * 3)
    np.testing.assert_allclose(relative_to_neutral(z, subjects, neutral), expected)
    z[0] = np.nan
    assert np.isnan(relative_to_neutral(z, subjects, neutral)[0]).all()
    np.testing.assert_allclose(relative_to_neutral(z, subjects, neutral)[1], z[1] - z[2])
    with pytest.raises(InputError, match=r"neutral face of b;"):
        relative_to_neutral(z, subjects, [True, True, True, False, False, False])
    many = [f"p{i}" for i in range(8)]
    with pytest.raises(InputError, match="p4 and 3 more"):
        relative_to_neutral(np.zeros((8, 2)), many, [False] * 8)


def test_answers_are_written_in_order_and_harmless_to_spreadsheets(tmp_path):
    saved, _ = train_classifier(people(), relative=True)
    scans = people(seed=4)
    scans[0] = changed(scans[0], name="=cmd()", status="failed", reason="@why", z=None)
    write_answers(tmp_path / "a.csv", predict_scans(saved, scans), saved.classes)
    with (tmp_path / "a.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["scan", "status", "prediction", "p_anger", "p_fear", "p_smile", "reason"]
    assert (rows[0]["scan"], rows[0]["reason"], rows[0]["p_fear"]) == ("'=cmd()", "'@why", "")
    assert sum(float(rows[1][f"p_{name}"]) for name in NAMES) == pytest.approx(1.0, abs=1e-5)


def record(name, status="converged", z=(1.0, 2.0)):
    if status == "failed":
        return failed_record(File(name=f"{name}.ply", hash="x"), File(name="m.h5", hash=HASH), "It is empty.", {})
    content = {
        "scan": {"name": f"{name}.ply"}, "model": {"hash": HASH}, "status": status, "reason": "Fine.", "b": list(z),
        "z": list(z), "b_stddev": list(z), "mm_per_scan_unit": 1.0,
        "T_scan_model": {"scale": 1.0, "rotation": np.eye(3).tolist(), "translation": [0.0] * 3},
        "distances_mm": {"final": {d: dict.fromkeys(("mean", "median", "rms", "p95", "max", "count"), 0.0)
                                   for d in ("model_to_scan", "scan_to_model")}},
    }  # fmt: skip
    return schemas.read(FitRecord, content, name, "")


def test_the_table_gives_the_same_scans_as_the_records(tmp_path):
    records = {"one": record("one"), "=two": record("two", "failed"), "three": record("three", "doubtful")}
    write_coefficients(tmp_path / "c.csv", [coefficient_row(n, r) for n, r in records.items()], 2)
    for scan, (name, content) in zip(read_coefficients(tmp_path / "c.csv"), records.items(), strict=True):
        other = from_record(name, content)
        assert (scan.name, scan.status, scan.reason) == (other.name, other.status, other.reason)
        assert scan.model_hash == other.model_hash == HASH
        assert (scan.z is None and other.z is None) or np.array_equal(scan.z, other.z)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no table of coefficients"),
        ("a,b\n1,2\n", "is no table of coefficients"),
        ("scan,status,reason,z1\nx,converged,,1\n", "does not state the model"),
        ("scan,status,reason,z1,model_hash\n", "has no rows"),
        ("scan,status,reason,z1,model_hash\nx,converged,,one,h\n", "row 1: a coefficient is not a number"),
        ("scan,status,reason,z1,model_hash\nx,converged,,nan,h\n", "not finite"),
        ("scan,status,reason,z1,model_hash\nx,good,,1,h\n", "status 'good'"),
        ("scan,status,reason,z1,model_hash\nx,failed,,,\n", "does not state the model"),
        ('scan,status,reason,z1,model_hash\n"x', "is not a CSV table"),
    ],
)
def test_a_damaged_table_is_refused_in_one_sentence(tmp_path, text, said):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(FileFormatError, match=said) as refused:
        read_coefficients(tmp_path / "c.csv")
    assert "c.csv" in str(refused.value)
    with pytest.raises(FileError, match="no such file"):
        read_coefficients(tmp_path / "absent.csv")


@pytest.mark.parametrize(
    "changes", [{"status": None}, {"z": None}, {"z": "many"}, {"z": []}, {"model": 3}, {"status": "fine"},
                {"z": [[1.0]]}],
)  # fmt: skip
def test_a_damaged_record_is_refused_by_name(changes):
    content = {key: value for key, value in (record("x").to_json() | changes).items() if value is not None}
    with pytest.raises(FileFormatError, match="The record of x"):
        from_record("x", schemas.read(FitRecord, content, "The record of x", "fit it again"))


def test_labels_are_found_by_the_file_of_the_scan_and_by_the_name_of_the_fit():
    scans = [from_record("scan_2", record("anna")), ScanCoefficients("ben", "converged", "", np.ones(2), HASH),
             ScanCoefficients("carl", "converged", "", np.ones(2), HASH)]  # fmt: skip
    table = Table({}, ("in/Anna.ply", "ben", "dora"), "l.csv")
    found, notes = with_labels(
        scans, Labels(table, (Label("smile", None, "Anna"), Label("", None, "Ben"), Label("x"))), "fits"
    )
    assert notes == [
        "1 of 3 rows of l.csv has no specimen in fits and is excluded (dora).",
        "1 of 3 specimens in fits has no row in l.csv (carl).",
    ]
    assert [(s.label, s.subject) for s in found] == [("smile", "Anna"), ("", "Ben"), ("", "")]
    assert one_model(found) == HASH
