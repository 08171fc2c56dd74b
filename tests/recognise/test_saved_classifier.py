import io
import json
import pickle
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import skops.io
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline

from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.recognise.classifier_file import FACTS, TRUSTED, SavedClassifier, load_classifier, software_versions
from shapespace.recognise.classifiers import CLASSIFIERS
from synthetic_shapes import blob_model

HASH = "a" * 64


def samples(n=60, k=5, seed=0):
    rng = np.random.default_rng(seed)
    own = np.arange(n) % 3
    return 3.0 * np.eye(k)[own] + rng.standard_normal((n, k)), np.array(["anger", "fear", "smile"])[own]


def trained(name="lda", **changes) -> SavedClassifier:
    z, labels = samples()
    fields = {
        "pipeline": CLASSIFIERS[name](0).fit(z, labels), "classifier": name, "model_hash": HASH, "modes": 5,
        "relative_to_neutral": True, "neutral": "neutral", "classes": ("anger", "fear", "smile"), "confidence": 0.6,
        "temperature": 1.3, "training": {"scans": 60}, "cross_validation": {"macro_accuracy": 0.9},
        "versions": software_versions(),
    }  # fmt: skip
    return SavedClassifier(**(fields | changes))


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "good.skops"
    trained().save(path)
    return path


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_a_classifier_read_back_answers_the_same(name, tmp_path):
    before = trained(name)
    before.save(tmp_path / "c.skops")
    after = load_classifier(tmp_path / "c.skops")
    assert after.facts() == before.facts()
    new, _ = samples(seed=1)
    np.testing.assert_array_equal(after.probabilities(new), before.probabilities(new))


def test_a_saved_classifier_that_refers_to_a_model_has_none_of_its_training_shapes(tmp_path):
    model = blob_model(vertices=200)
    assert model.training is not None
    skops.io.dump({"model": model, "classifier": trained()}, tmp_path / "c.skops")
    with zipfile.ZipFile(tmp_path / "c.skops") as archive:
        content = [archive.read(name) for name in archive.namelist()]
    assert any(model.stddev.tobytes() in one for one in content)  # so that the next line can fail
    assert not any(model.training.coefficients[0].tobytes() in one for one in content)


def test_the_file_says_what_it_is_to_anyone_who_opens_the_archive(good):
    with zipfile.ZipFile(good) as archive:
        facts = json.loads(archive.read(FACTS))
    assert (facts["format"], facts["format_version"]) == ("shapespace classifier", 1)
    assert (facts["model_hash"], facts["modes"], facts["classes"]) == (HASH, 5, ["anger", "fear", "smile"])
    assert facts["versions"]["scikit-learn"]


def test_probabilities_see_the_leading_modes_only(good):
    classifier = load_classifier(good)
    z, _ = samples(seed=2)
    more = np.concatenate([z, np.full((60, 3), 50.0)], axis=1)
    np.testing.assert_array_equal(classifier.probabilities(more), classifier.probabilities(z))
    np.testing.assert_allclose(classifier.probabilities(z).sum(axis=1), 1.0)
    for wrong in (z[:, :4], np.full((1, 5), np.nan)):
        with pytest.raises(InputError, match="at least 5"):
            classifier.probabilities(wrong)


def with_projection(tmp_path: Path) -> Path:
    turned = np.linalg.qr(np.random.default_rng(8).standard_normal((7, 7)))[0][:5]
    trained(projection=turned).save(tmp_path / "e.skops")
    return tmp_path / "e.skops"


def test_a_classifier_of_expressions_keeps_what_parts_them(tmp_path):
    after = load_classifier(with_projection(tmp_path))
    z, _ = samples(seed=4)
    assert after.projection.shape == (5, 7) and after.width == 7
    plain = trained()
    np.testing.assert_allclose(after.probabilities(z @ after.projection), plain.probabilities(z), atol=1e-12)


@pytest.mark.parametrize("damage", ["gone", "pickled", "narrow", "not finite", "header"])
def test_a_damaged_projection_is_refused(tmp_path, damage):
    path, stream = with_projection(tmp_path), io.BytesIO()
    if damage == "pickled":
        np.save(stream, np.array([[{}]], dtype=object), allow_pickle=True)
    elif damage == "narrow":
        np.save(stream, np.eye(7)[:3])
    else:
        np.save(stream, np.full((5, 7), np.nan))
    data = stream.getvalue().replace(b"(5, 7)", b"(10**9") if damage == "header" else stream.getvalue()
    content = {} if damage == "gone" else {"projection.npy": data}
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist() if name != "projection.npy"} | content
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    with pytest.raises(FileFormatError, match="train it again"):
        load_classifier(path)


def test_coefficients_of_another_model_are_refused(good):
    classifier = load_classifier(good)
    classifier.refuse_other_model(HASH)
    with pytest.raises(InputError, match="model aaaaaaaaaaaa, and these are of bbbbbbbbbbbb"):
        classifier.refuse_other_model("b" * 64)


def rewritten(good: Path, folder: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    with zipfile.ZipFile(good) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(folder / "bad.skops", "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return folder / "bad.skops"


def with_facts(**changes):
    def change(members):
        members[FACTS] = json.dumps(json.loads(members[FACTS]) | changes).encode()

    return change


def without(name):
    return lambda members: members.pop(name)


def an_array(members) -> str:
    return next(name for name in members if name.endswith(".npy"))


def cut_array(members):
    members[an_array(members)] = members[an_array(members)][:-3]


def huge_array(members):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**9,)})
    members[an_array(members)] = stream.getvalue()


def object_array(members):
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    members[an_array(members)] = stream.getvalue()


def other_numbers(members):
    for name, data in members.items():
        if name.endswith(".npy"):
            array = np.load(io.BytesIO(data))
            if array.dtype == np.float64 and array.size > 3:
                stream = io.BytesIO()
                np.save(stream, array * 1.5)
                members[name] = stream.getvalue()


def scrambled_schema(members):
    schema = json.loads(members["schema.json"])
    schema["content"] = {"__class__": "dict", "__module__": "builtins", "__loader__": "ObjectNode", "content": 3}
    members["schema.json"] = json.dumps(schema).encode()


def other_type(members):
    members["schema.json"] = members["schema.json"].replace(b'"StandardScaler"', b'"MinMaxScaler"')


def a_function(members):
    schema = json.loads(members["schema.json"])
    schema["extra"] = {"__class__": "system", "__module__": "os", "__loader__": "FunctionNode", "content": "os.system"}
    members["schema.json"] = json.dumps(schema).encode()


def another_loader(members):
    members["schema.json"] = members["schema.json"].replace(b'"TupleNode"', b'"MethodNode"')


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without(FACTS), "no usable shapespace.json"),
        (without("schema.json"), "no usable schema.json"),
        (lambda m: m.update({FACTS: b"{"}), "is damaged"),
        (lambda m: m.update({"schema.json": b"[" * 100_000}), "is damaged"),
        (with_facts(format="other"), "is not a classifier of shapespace"),
        (with_facts(format_version=2), "format version 2"),
        (with_facts(classes=["anger", "anger", "smile"]), "is damaged"),
        (with_facts(classes=["anger", "smile"]), "does not work|gives other answers"),
        (with_facts(classes=["smile", "fear", "anger"]), "gives other answers"),
        (with_facts(modes=4), "does not work|gives other answers"),
        (with_facts(modes="many"), "is damaged"),
        (with_facts(modes=10**9), "is damaged"),
        (with_facts(temperature=0), "is damaged"),
        (with_facts(confidence=float("nan")), "is damaged"),
        (with_facts(training=3), "is damaged"),
        (with_facts(classifier="forest"), "is damaged"),
        (with_facts(probe=[[0.3] * 3] * 4), "gives other answers"),
        (with_facts(probe="x"), "does not work"),
        (cut_array, "cut short"),
        (huge_array, "cut short or contains objects"),
        (object_array, "cut short or contains objects"),
        (other_numbers, "gives other answers"),
        (scrambled_schema, "cannot be read"),
        (other_type, "contains the type 'sklearn.preprocessing._data.MinMaxScaler'"),
        (a_function, r"contains the type 'os\.system'.*do not trust"),
        (another_loader, "contains a 'MethodNode'"),
        (lambda m: m.update({"more.npy": b"nothing"}), "is not an array"),
    ],
)  # fmt: skip
def test_a_damaged_or_hostile_file_is_refused_in_one_sentence(good, tmp_path, change, said):
    path = rewritten(good, tmp_path, change)
    with pytest.raises(FileFormatError, match=said) as refused:
        load_classifier(path)
    sentence = str(refused.value)
    assert sentence.startswith(str(path)) and sentence.endswith(".") and "\n" not in sentence


@pytest.mark.parametrize("content", [b"", b"PK", b"no zip at all", pickle.dumps({"a": 1})])
def test_what_is_no_archive_is_refused(tmp_path, content):
    (tmp_path / "x.skops").write_bytes(content)
    with pytest.raises(FileFormatError, match="is not a classifier of shapespace"):
        load_classifier(tmp_path / "x.skops")
    with pytest.raises(FileError, match="no such file"):
        load_classifier(tmp_path / "absent.skops")


def test_every_cut_and_most_flipped_bytes_are_found(good, tmp_path):
    content = good.read_bytes()
    path = tmp_path / "x.skops"
    rng = np.random.default_rng(0)
    for length in rng.integers(0, len(content), 12):
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError):
            load_classifier(path)
    whole = load_classifier(good).probabilities(samples()[0])
    for place in rng.integers(0, len(content), 40):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        try:
            same = load_classifier(path)
        except FileFormatError:
            continue
        np.testing.assert_allclose(same.probabilities(samples()[0]), whole, atol=1e-5)


def test_an_archive_that_unpacks_to_far_more_than_its_size_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "x.skops", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.npy", bytes(2**21))
    monkeypatch.setattr(zipfile.ZipFile, "read", None)
    with pytest.raises(FileFormatError, match="would unpack to far more than its size"):
        load_classifier(tmp_path / "x.skops")


# What made compiled code read past its arrays, and ended the process, or broadcast small arrays to gigabytes.
@pytest.mark.parametrize(
    ("name", "attribute", "change"),
    [
        ("svm", "_n_support", lambda a: np.concatenate([a, np.zeros(9000, np.int32)])),
        ("svm", "_n_support", lambda a: a * 1000),
        ("svm", "_dual_coef_", lambda a: a[:1]),
        ("svm", "_intercept_", lambda a: a[:1]),
        ("svm", "kernel", lambda _: "precomputed"),
        ("knn", "weights", lambda _: "uniform"),
        ("knn", "_y", lambda a: a[:1]),
        ("lda", "intercept_", lambda a: np.zeros((10_000, 1, 1))),
        ("qda", "whiten_", lambda a: a[:, :1]),
    ],
)
def test_arrays_that_do_not_fit_together_never_reach_compiled_code(name, attribute, change, tmp_path, monkeypatch):
    hostile = trained(name)
    step = hostile.pipeline.steps[-1][1]
    fitted = getattr(step, "machine_", step)
    setattr(fitted, attribute, change(getattr(fitted, attribute)))
    monkeypatch.setattr(SavedClassifier, "probabilities", lambda *_: np.zeros((4, 3)))
    hostile.save(tmp_path / "x.skops")
    with pytest.raises(FileFormatError, match="does not work"):
        load_classifier(tmp_path / "x.skops")


def test_repeated_members_are_refused(good, tmp_path):
    path = tmp_path / "x.skops"
    path.write_bytes(good.read_bytes())
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr(FACTS, "{}")
    with pytest.raises(FileFormatError, match="repeated members"):
        load_classifier(path)


def test_other_estimators_are_refused_though_skops_trusts_them(tmp_path):
    z, labels = samples()
    bayes = make_pipeline(GaussianNB()).fit(z, labels)
    assert not skops.io.get_untrusted_types(data=skops.io.dumps(bayes))
    trained(pipeline=bayes).save(tmp_path / "f.skops")
    with pytest.raises(FileFormatError, match=r"contains the type 'sklearn\.naive_bayes"):
        load_classifier(tmp_path / "f.skops")


def test_the_list_of_types_is_no_longer_than_the_classifiers_need(tmp_path):
    used: set[str] = set()

    def walk(node):
        if isinstance(node, dict):
            if "__class__" in node:
                used.add(f"{node['__module__']}.{node['__class__']}")
            node = list(node.values())
        if isinstance(node, list):
            for item in node:
                walk(item)

    for name in CLASSIFIERS:
        trained(name).save(tmp_path / "c.skops")
        with zipfile.ZipFile(tmp_path / "c.skops") as archive:
            walk(json.loads(archive.read("schema.json")))
    assert used <= TRUSTED
    assert TRUSTED - used <= {"numpy.int64"}  # of older versions of scikit-learn


def test_a_name_that_is_not_of_its_format_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"ends in \.skops"):
        trained().save(tmp_path / "c.pkl")
