"""Every kind of file that we write, damaged: the outcome is a valid object or one sentence, soon and in little memory.

By hand for longer: SHAPESPACE_FUZZ_MINUTES=60 python -m pytest tests/fuzz -x runs each of these for an hour.
"""

import hashlib
import io
import json
import random
import time
import warnings
import zipfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from own_file_fuzz import VALUES, damaged_bytes, damaged_json, fuzzed
from shapespace.batch.fit_records import (
    coefficient_row,
    failed_record,
    fit_record,
    read_record,
    write_coefficients,
    write_record,
    write_stages,
)
from shapespace.errors import FileFormatError, ModelFileError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.formats.face_models import read_flame
from shapespace.formats.gias_monai import read_gias
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise.classifier_file import FACTS, SavedClassifier, load_classifier, software_versions
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.labelled_scans import from_record, read_coefficients
from shapespace.report.inputs.saved_fits import Folder, StagedFit, find_fits
from shapespace.schemas import (
    CORRESPOND_AGAIN,
    Analysis,
    CorrespondenceRecord,
    CorrespondRecord,
    Demo,
    File,
    Quality,
    Recognition,
    json_text,
    read,
)
from shapespace.statistics.predictor import Predictor
from shapespace.store.corresponding import json_of
from synthetic_shapes import blob_model, raw_scan

MOST_SECONDS = 5.0


@contextmanager
def soon() -> Generator[None]:
    start = time.process_time()
    yield
    assert time.process_time() - start < MOST_SECONDS


def refusal(error: ShapespaceError) -> None:
    said = str(error)
    assert said.endswith(".") and "\n" not in said and len(said) < 1000, said


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one good file of each kind."""
    home = tmp_path_factory.mktemp("good")
    model = blob_model(vertices=200)
    model.save(home / "m.h5")
    result = fit_scan(model, raw_scan(np.full(5, 0.3), vertices=150).scan, FitConfig(method="paper", max_iterations=4))
    source = (
        File(name="one.ply", hash="a" * 64, path="../one.ply"),
        File(name="m.h5", hash=model.content_hash, path="m.h5"),
    )
    record = fit_record(result, *source)
    write_record(home / "one.fit.json", record)
    write_stages(home / "one.stages.npz", result, model)
    rows = [coefficient_row(f"scan{k}", structs.replace(record, b=(0.1 * k,) * 5, z=(-0.2 * k,) * 5)) for k in range(4)]
    failed = coefficient_row("bad, very", failed_record(*source, 'It has no "points",\nso scan again.', {}))
    write_coefficients(home / "coefficients.csv", [*rows, failed], 5)
    return home


# Model files


def test_a_model_file_damaged_anywhere_is_refused(home: Path, tmp_path: Path) -> None:
    good = (home / "m.h5").read_bytes()

    @fuzzed(150)
    def run(seed: int) -> None:
        content = damaged_bytes(good, random.Random(seed))
        if content != good:
            (tmp_path / "m.h5").write_bytes(content)
            with soon(), pytest.raises(ModelFileError) as error:
                ShapeModel.load(tmp_path / "m.h5")
            refusal(error.value)

    run()


def structure(content: bytes, model: ShapeModel) -> list[int]:
    """Return the places of bytes that are not numbers of an array."""
    places = set(range(512, len(content)))
    for array in (model.mean, model.basis, model.stddev, model.faces):
        assert array is not None
        at = content.index(array.tobytes())
        places -= set(range(at, at + array.nbytes))
    return sorted(place for place in places if content[place] or content[place - 1] or not place % 8)


def test_a_model_file_whose_checksum_is_made_again_is_the_same_model_or_refused(home: Path, tmp_path: Path) -> None:
    good = (home / "m.h5").read_bytes()
    model = ShapeModel.load(home / "m.h5")
    places = structure(good, model)

    @fuzzed(400)
    def run(seed: int) -> None:
        content = damaged_bytes(good, random.Random(seed), places)[512:]
        digest = hashlib.sha256(content).hexdigest().encode()
        (tmp_path / "m.h5").write_bytes((b"shapespace sha256 " + digest + b"\n").ljust(512, b"\0") + content)
        with soon():
            try:
                assert ShapeModel.load(tmp_path / "m.h5").content_hash == model.content_hash
            except ModelFileError as error:
                refusal(error)

    run()


# Fits


def as_record(path: Path) -> None:
    """Read a record as every reader of it does."""
    for reader in (
        lambda: from_record("one", read_record(path)),
        lambda: Folder(path.parent).json(path.name),
        lambda: read_record(path).to_json(),
    ):
        with soon():
            try:
                reader()
            except ShapespaceError as error:
                refusal(error)
    for fit in find_fits(Folder(path.parent)):
        assert isinstance(fit.expected_error_mm, float) and isinstance(fit.label, str) and fit.reason is not None
        fit.distance_mm("model_to_scan")


def test_a_record_damaged_anywhere_is_read_or_refused(home: Path, tmp_path: Path) -> None:
    good = (home / "one.fit.json").read_bytes()
    content = json.loads(good)

    @fuzzed(200)
    def run(seed: int) -> None:
        rng = random.Random(seed)
        data = damaged_bytes(good, rng) if seed % 3 == 0 else damaged_json(content, rng)
        (tmp_path / "one.fit.json").write_bytes(data)
        as_record(tmp_path / "one.fit.json")

    run()


def staged(folder: Path) -> dict[str, np.ndarray]:
    arrays = Folder(folder).arrays("one.stages.npz")
    (fit,) = find_fits(Folder(folder))
    StagedFit.from_arrays(arrays, fit.record, name="one", label="one")
    return arrays


def test_stages_damaged_anywhere_are_the_same_arrays_or_refused(home: Path, tmp_path: Path) -> None:
    good, whole = (home / "one.stages.npz").read_bytes(), staged(home)
    (tmp_path / "one.fit.json").write_bytes((home / "one.fit.json").read_bytes())
    marks = [at for at in range(len(good)) if good[at : at + 4] in (b"PK\1\2", b"PK\3\4", b"PK\5\6")]
    headers = [at + k for at in marks for k in range(30) if at + k < len(good)]

    @fuzzed(250)
    def run(seed: int) -> None:
        rng = random.Random(seed)
        content = damaged_bytes(good, rng, headers if seed % 4 else None)
        (tmp_path / "one.stages.npz").write_bytes(content)
        with soon():
            try:
                found = staged(tmp_path)
            except ShapespaceError as error:
                refusal(error)
                return
        assert found.keys() == whole.keys()
        assert all(
            np.array_equal(found[name], array, equal_nan=array.dtype.kind == "f") for name, array in whole.items()
        )

    run()


def test_stages_with_any_arrays_are_taken_or_refused(home: Path, tmp_path: Path) -> None:
    whole = staged(home)
    (tmp_path / "one.fit.json").write_bytes((home / "one.fit.json").read_bytes())

    @fuzzed(150)
    def run(seed: int) -> None:
        rng = random.Random(seed)
        arrays = dict(whole)
        for name in rng.sample(sorted(arrays), rng.choice([1, 1, 2])):
            arrays[name] = other_array(arrays[name], rng)
        np.savez(tmp_path / "one.stages.npz", **arrays)
        with soon():
            try:
                staged(tmp_path)
            except ShapespaceError as error:
                refusal(error)

    run()


def other_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Return an array of other values, another shape or another type."""
    kind = rng.choice(["value", "value", "cut", "axis", "scalar", "type", "empty"])
    if kind == "value" and array.size and array.dtype.kind in "iufb":
        array = array.copy()
        most = np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 1
        value = (
            rng.choice([0, 1, most]) if array.dtype.kind in "iub" else rng.choice([np.nan, np.inf, 0.0, -1e30, 1e-30])
        )
        array.flat[rng.randrange(array.size)] = value
        return array
    if kind == "type" and array.dtype.kind != "U":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return array.astype(rng.choice(["f2", "f8", "i8", "u1", "U7", "c16", "?", ">f4"]))
    if kind == "empty":
        return array[:0] if array.ndim else np.zeros((0, 3))
    if kind == "cut" and array.ndim:
        return array[:-1]
    return array[None] if kind == "axis" else array.reshape(-1)[:1].reshape(()) if array.size else array


# Headers of arrays


LENGTHS = (True, False, -1, -8, 0, 1, 3, 2**31, 2**40, 2**63, 10**30, 1.0, 1e300, None, "3", (3,), [3])
"""What a header of .npy may declare as the length of an axis; few of these are lengths."""


def with_headers(path: Path, rng: random.Random) -> Path:
    """Replace the shape that one or two arrays of an .npz file declare, and keep their numbers."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name in rng.sample(sorted(members), rng.choice([1, 1, 2])):
        stream = io.BytesIO(members[name])
        np.lib.format.read_magic(stream)
        _, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        numbers = stream.read()
        shape = tuple(rng.choice(LENGTHS) for _ in range(rng.choice([0, 1, 1, 2, 3])))
        header = io.BytesIO()
        told = {"descr": dtype.str, "fortran_order": fortran, "shape": shape}
        np.lib.format.write_array_header_1_0(header, told)
        kept = rng.choice([len(numbers), dtype.itemsize, 0])
        members[name] = header.getvalue() + numbers[:kept]
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def learned(path: Path) -> Path:
    """Write a small predictor."""
    ways, rows, vertices = 4, 6, 5
    Predictor(
        target="age", gauge="form", model_hash="", method="pls", subjects=rows, lowest=1.0, highest=9.0,
        farthest_mm=4.0, confidence=0.9, mean=np.ones((vertices, 3)), intercepts=np.zeros(ways),
        weights=np.zeros((ways, 3 * vertices)), residuals=np.ones(rows), fold=np.array([1, 2, 3, 1, 2, 3]),
        share=np.ones(rows),
    ).save(path)  # fmt: skip
    return path


def test_headers_of_arrays_that_declare_anything_are_taken_or_refused(home: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3))
    np.savez(
        tmp_path / "smpl.npz", v_template=points, shapedirs=rng.normal(size=(12, 3, 4)), f=np.arange(12).reshape(4, 3)
    )
    np.savez(
        tmp_path / "a.pc.npz", mean=points.ravel(), weights=np.arange(1.0, 4.0), modes=rng.normal(size=(36, 3)),
        projectedWeights=rng.normal(size=(3, 5)),
    )  # fmt: skip
    learned(tmp_path / "age.npz")
    (tmp_path / "one.fit.json").write_bytes((home / "one.fit.json").read_bytes())
    (tmp_path / "one.stages.npz").write_bytes((home / "one.stages.npz").read_bytes())
    readers: dict[str, Callable[[], object]] = {
        "smpl.npz": lambda: read_flame(tmp_path / "smpl.npz"),
        "a.pc.npz": lambda: read_gias(tmp_path / "a.pc.npz"),
        "age.npz": lambda: Predictor.load(tmp_path / "age.npz"),
        "one.stages.npz": lambda: staged(tmp_path),
    }
    whole = {name: (tmp_path / name).read_bytes() for name in readers}
    for reader in readers.values():
        reader()

    @fuzzed(150)
    def run(seed: int) -> None:
        rng = random.Random(seed)
        name = rng.choice(sorted(readers))
        (tmp_path / name).write_bytes(whole[name])
        with_headers(tmp_path / name, rng)
        with soon():
            try:
                readers[name]()
            except ShapespaceError as error:
                refusal(error)

    run()


# Tables


def test_no_number_of_a_table_changes_unseen(home: Path, tmp_path: Path) -> None:
    good, whole = (home / "coefficients.csv").read_bytes(), read_coefficients(home / "coefficients.csv")

    @fuzzed(300)
    def run(seed: int) -> None:
        (tmp_path / "c.csv").write_bytes(damaged_bytes(good, random.Random(seed)))
        with soon():
            try:
                found = read_coefficients(tmp_path / "c.csv")
            except ShapespaceError as error:
                refusal(error)
                return
        assert len(found) <= 2 * len(whole)
        for scan in found:
            (same,) = [other for other in whole if other.name == scan.name]
            assert (scan.status, scan.model_hash) == (same.status, same.model_hash)
            assert np.array_equal(scan.z, same.z) if scan.z is not None else same.z is None

    run()


# Classifiers


@pytest.fixture(scope="module")
def classifiers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("classifiers")
    own = np.arange(36) % 3
    z, labels = 3.0 * np.eye(4)[own] + rng.standard_normal((36, 4)), np.array(["anger", "fear", "smile"])[own]
    for name, make in CLASSIFIERS.items():
        SavedClassifier(
            make(0).fit(z, labels), name, "a" * 64, 4, True, "neutral", ("anger", "fear", "smile"), 0.6, 1.3,
            {"scans": 36}, {"macro_accuracy": 0.9}, software_versions(),
        ).save(folder / f"{name}.skops")  # fmt: skip
    return {path.stem: path.read_bytes() for path in folder.iterdir()}


def test_a_classifier_damaged_anywhere_works_or_is_refused(classifiers: dict[str, bytes], tmp_path: Path) -> None:
    @fuzzed(120)
    def run(seed: int) -> None:
        rng = random.Random(seed)
        good = classifiers[rng.choice(sorted(classifiers))]
        (tmp_path / "c.skops").write_bytes(damaged_bytes(good, rng) if seed % 4 == 0 else other_members(good, rng))
        with soon():
            try:
                loaded = load_classifier(tmp_path / "c.skops")
                json.dumps(loaded.facts(), allow_nan=False)
                assert np.isfinite(loaded.probabilities(np.zeros((2, loaded.width)))).all()
            except FileFormatError as error:
                refusal(error)

    run()


def other_members(good: bytes, rng: random.Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice([FACTS, "schema.json", *(name for name in members if name.endswith(".npy"))])
    if name.endswith(".npy"):
        stream = io.BytesIO()
        np.save(stream, other_array(np.load(io.BytesIO(members[name])), rng))
        members[name] = stream.getvalue()
    else:
        members[name] = damaged_json(json.loads(members[name]), rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


# What studies, demos, correspondences and measures of quality leave

MEASURED = {"mean": [1.0, 0.5], "stddev": [0.1, 0.1], "low": [0.9, 0.4], "high": [1.1, 0.6]}
ENTRY = {"name": "anger", "json": "anger.fit.json", "vertex_error_mm": {"mean": 0.5, "rms": 0.6, "max": 2.0}}
KINDS: dict[str, tuple[dict[str, Any], Callable[[object], object]]] = {
    "quality.json": (
        {"name": "m", "compactness": [0.5, 0.9], "generalisation": MEASURED, "sentences": ["Enough."],
         "settings": {"folds": 3, "seed": [1, {"a": 2.5}]}, "others": [{"specificity": MEASURED}],
         "differences": {"generalisation": MEASURED},
         "generalisation_by_shapes": {"shapes": [4, 8], "mean": [2.0, 1.0], "low": [1.5, 0.5], "high": [2.5, 1.5]}},
        lambda content: read(Quality, content, "quality.json", "measure it again"),
    ),
    "demo.json": (
        {"version": "1", "seed": 3, "versions": {"numpy": "2"}, "seconds": {"all": 3.5},
         "experiment1": {"fits": [ENTRY, ENTRY], "population_z": [[0.5, 1.0], [0.1, 2.0]], "scores": {"a": {"b": [1]}}},
         "experiment2": {"cases": [{"short": "a", "fit": ENTRY, "n_modes": 5}]},
         "paper_table": [{"quantity": "error", "paper": "1 mm", "measured": "2 mm"}]},
        lambda content: read(Demo, content, "demo.json", "run the demo again"),
    ),
    "recognition.json": (
        {"format": "shapespace recognition", "format_version": 1, "title": "T", "summary": ["It works."],
         "targets": [{"what": "accuracy", "met": True}], "versions": {"numpy": "2"}, "parts": [
             {"kind": "text", "text": ["One.", "Two."]},
             {"kind": "table", "columns": [{"name": "a", "kind": "interval"}], "rows": [[[0.1, 0.2]], [None]]},
             {"kind": "confusion", "classes": ["a", "b"], "counts": [[1, 2], [3, 4]]},
             {"kind": "calibration", "bins": [{"low": 0.4, "high": 0.6, "count": 3}], "ece": 0.1},
             {"kind": "curve", "series": [{"x": [1, 2], "y": [0.5, 0.7]}]}]},
        lambda content: Recognition.from_json(content),
    ),
    "analysis.json": (
        {"format": "shapespace analysis", "format_version": 1, "question": "compare", "title": "T",
         "summary": ["They differ."], "notes": ["One is left out."], "settings": {"seed": 3}, "parts": [
             {"kind": "surface_map", "arrays": "a.npz", "mask": "m", "limit": 2.5, "signed": False},
             {"kind": "morph", "arrays": "a.npz", "low_label": "young", "times": 2.0},
             {"kind": "histogram", "edges": [0, 1, 2], "series": [{"counts": [3, 4]}], "observed": 1.5},
             {"kind": "curve", "series": [{"x": [1], "y": [0.5], "low": [None], "high": [0.7], "points": True}],
              "x_scale": "log", "y_scale": "probit", "diagonal": True}]},
        lambda content: Analysis.from_json(content),
    ),
    "one.correspond.json": (
        {"format": "shapespace corresponding", "format_version": 1, "name": "one", "path": "../one.ply", "hash": "ab",
         "status": "converged", "seen_share": 0.9, "notes": ["Holes."], "moved_share": [0.1], "cpu_s": [1, 2]},
        lambda content: read(CorrespondRecord, content, "one.correspond.json", CORRESPOND_AGAIN),
    ),
    "correspondence.json": (
        {"format": "shapespace correspondence", "format_version": 1, "template": "one.ply", "vertices": 500,
         "rounds": [0.1, 0.01], "corresponding": ["one"], "set_aside": {"two": "It is a ball."},
         "settings": {"rounds": 2, "weights": [1.0, {"a": 2}]}, "version": "1", "other_units": {"one": 0.001}},
        lambda content: CorrespondenceRecord.from_json(content),
    ),
}  # fmt: skip


@pytest.mark.parametrize("file", KINDS)
def test_what_runs_say_of_themselves_is_read_or_refused(file: str, tmp_path: Path) -> None:
    content, as_object = KINDS[file]
    as_object(json.loads(json.dumps(content)))
    good, path, folder = json.dumps(content).encode(), tmp_path / file, Folder(tmp_path)

    @fuzzed(120)
    def run(seed: int) -> None:
        rng = random.Random(seed)
        path.write_bytes(damaged_bytes(good, rng) if seed % 4 == 0 else damaged_json(content, rng))
        for plain in (folder.json, lambda name: json_of(tmp_path / name)):
            with soon():
                try:
                    json.loads(json_text(as_object(plain(file))))
                except ShapespaceError as error:
                    refusal(error)

    run()


def test_values_that_json_alone_would_take_are_among_those_tried() -> None:
    assert {"@huge@", "@deep@", "@infinite@"} <= {value for value in VALUES if isinstance(value, str)}
