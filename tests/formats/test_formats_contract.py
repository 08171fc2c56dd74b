"""What every format of model files keeps to: round trips in single precision, and refusals of one sentence."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import ModelFileError, ShapespaceError
from shapespace.formats.model_parts import LinearModel, ModelFormat, Modes
from shapespace.formats.registry import MODEL_FORMATS, READ_ONLY_MODELS, read_linear
from shapespace.model.additive import AdditiveModel
from shapespace.model.build_model import BuildConfig, build_model
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model
from two_parts import VERTICES, two_part_surfaces

ONLY_SHAPE = {"shapeworks"}
"""Formats that hold no expressions apart."""
WRITTEN = list(MODEL_FORMATS.values())
PARTED = [one for one in WRITTEN if one.name not in ONLY_SHAPE]
WITHOUT_PARTS = {"eos"}
TWO_PARTS = {"upper bone": VERTICES, "lower bone": VERTICES}
SINGLE = 2e-6
FLIPS = {"statismo": 5}
"""Damaged files that are tried where it is fewer than `MOST_FLIPS`: of a format that is read in a process apart."""
MOST_FLIPS = 60


def name(one: ModelFormat) -> str:
    return one.name


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return dataclasses.replace(blob_model(300), landmarks={"tip": 7, "left": 120}, gauge="form")


def additive_of(model: ShapeModel) -> AdditiveModel:
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(model.n_modes, model.n_modes)))[0]
    return AdditiveModel(model, rotation, 3)


def covariance_gap(first: ShapeModel, second: ShapeModel) -> float:
    """Return the largest relative gap of what unit directions vary by, in the span of both."""
    spread = [one.vertex_basis * one.stddev for one in (first, second)]
    own, across, other = spread[0].T @ spread[0], spread[0].T @ spread[1], spread[1].T @ spread[1]
    gap2 = (own**2).sum() - 2 * (across**2).sum() + (other**2).sum()
    return float(np.sqrt(max(gap2, 0.0)) / np.linalg.norm(own))


@pytest.mark.parametrize("one", WRITTEN, ids=name)
def test_a_round_trip_keeps_mean_span_and_variances(one: ModelFormat, model: ShapeModel, tmp_path: Path) -> None:
    path = tmp_path / f"model{one.suffixes[0] if one.suffixes else ''}"
    said = one.write(model.as_linear(), path)
    assert all(note.endswith(".") for note in said)
    assert read_linear(path)[0] is one
    again = ShapeModel.load(path)
    extent = float(np.ptp(model.mean_vertices))
    assert np.abs(again.mean_vertices - model.mean_vertices).max() < SINGLE * extent
    assert np.allclose(again.stddev, model.stddev, rtol=2e-5)
    assert covariance_gap(model, again) < 2e-5
    assert np.array_equal(np.asarray(again.faces), np.asarray(model.faces))
    assert again.n_modes == model.n_modes


@pytest.mark.parametrize("one", WRITTEN, ids=name)
def test_parts_of_a_subject_come_back_or_are_named_as_omitted(one: ModelFormat, tmp_path: Path) -> None:
    model, parts = build_model(two_part_surfaces(5, seed=1), BuildConfig(parts=TWO_PARTS)), tuple(TWO_PARTS)
    path = tmp_path / f"model{one.suffixes[0] if one.suffixes else ''}"
    notes = one.write(model.as_linear(), path)
    again = ShapeModel.load(path)
    if one.name in WITHOUT_PARTS:
        assert not again.parts and any(", ".join(parts) in note and "omitted" in note for note in notes)
    else:
        assert again.part_counts == TWO_PARTS and again.regions.keys() == TWO_PARTS.keys()
    assert np.array_equal(np.asarray(again.faces), np.asarray(model.faces))


@pytest.mark.parametrize("one", PARTED, ids=name)
def test_identity_and_expression_come_back_apart(one: ModelFormat, model: ShapeModel, tmp_path: Path) -> None:
    parted = additive_of(model)
    path = tmp_path / f"model{one.suffixes[0] if one.suffixes else ''}"
    one.write(parted.as_linear(), path)
    again = AdditiveModel.load(path)
    assert again.n_identity == parted.n_identity
    # What a and e do to the vertices is the same, though each mode may come back with the other sign.
    for rows in (slice(0, 3), slice(3, None)):
        did, does = (
            (x.shape.vertex_basis * x.shape.stddev) @ x.rotation[rows].T for x in (parted, again)
        )  # fmt: skip
        assert np.linalg.norm(did @ did.T - does @ does.T) < 1e-4 * np.linalg.norm(did @ did.T)


@pytest.mark.parametrize("one", PARTED, ids=name)
def test_what_no_mode_holds_is_kept_where_it_is_of_models_that_are_not_parted(
    one: ModelFormat, model: ShapeModel, tmp_path: Path
) -> None:
    some, ending = model.truncate(4), one.suffixes[0] if one.suffixes else ""
    assert some.total_variance > 1.01 * (some.stddev**2).sum()
    one.write(some.as_linear(), whole := tmp_path / f"whole{ending}")
    one.write(additive_of(some).as_linear(), apart := tmp_path / f"apart{ending}")
    kept = ShapeModel.load(whole).total_variance
    assert AdditiveModel.load(apart).shape.total_variance == pytest.approx(kept, rel=1e-4)


@pytest.mark.parametrize("one", WRITTEN, ids=name)
def test_a_file_cut_short_anywhere_is_refused_in_one_sentence(
    one: ModelFormat, model: ShapeModel, tmp_path: Path
) -> None:
    path = tmp_path / f"model{one.suffixes[0] if one.suffixes else ''}"
    one.write(model.as_linear(), path)
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    data = files[0].read_bytes()
    for share in (0.01, 0.3, 0.7, 0.999):
        files[0].write_bytes(data[: int(share * len(data))])
        with pytest.raises(ShapespaceError) as refused:
            one.read(path).check(path)
        assert str(refused.value).endswith(".") and "\n" not in str(refused.value)


@pytest.mark.parametrize("one", WRITTEN, ids=name)
def test_flipped_bytes_end_in_a_model_or_in_a_sentence(one: ModelFormat, model: ShapeModel, tmp_path: Path) -> None:
    path = tmp_path / f"model{one.suffixes[0] if one.suffixes else ''}"
    one.write(model.as_linear(), path)
    file = path if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())[0]
    data, rng = file.read_bytes(), np.random.default_rng(5)
    for _ in range(FLIPS.get(one.name, MOST_FLIPS)):
        changed = bytearray(data)
        head = rng.random() < 0.7  # where the structure stands
        for at in rng.integers(0, min(len(data), 600) if head else len(data), rng.integers(1, 4)):
            changed[at] = rng.integers(256)
        file.write_bytes(bytes(changed))
        try:
            ShapeModel.load(path)
        except ShapespaceError as error:
            assert "\n" not in str(error)


def test_each_format_has_its_own_name_and_its_endings_are_lower_case() -> None:
    assert not set(MODEL_FORMATS) & set(READ_ONLY_MODELS)
    assert all(
        end == end.lower() and end.startswith(".")
        for one in [*MODEL_FORMATS.values(), *READ_ONLY_MODELS.values()]
        for end in one.suffixes
    )


def test_a_basis_that_is_not_orthonormal_keeps_its_covariance(model: ShapeModel, tmp_path: Path) -> None:
    mixed = np.random.default_rng(1).normal(size=(5, 5))
    linear = dataclasses.replace(model.as_linear(), shape=Modes(model.vertex_basis * model.stddev @ mixed))
    MODEL_FORMATS["eos"].write(linear, tmp_path / "m.bin")
    again = ShapeModel.load(tmp_path / "m.bin")
    wanted = model.vertex_basis * model.stddev @ mixed
    found = again.vertex_basis * again.stddev
    assert np.linalg.norm(wanted @ wanted.T - found @ found.T) < 1e-5 * np.linalg.norm(wanted @ wanted.T)


@pytest.mark.parametrize("change", ["nan", "huge", "faces", "modes", "landmark"])
def test_parts_that_do_not_belong_together_are_refused(change: str, model: ShapeModel) -> None:
    linear = model.as_linear()
    wrong: dict[str, LinearModel] = {
        "nan": dataclasses.replace(linear, mean=np.full_like(linear.mean, np.nan)),
        "huge": dataclasses.replace(linear, shape=Modes(linear.shape.moved * 1e200)),
        "faces": dataclasses.replace(linear, faces=np.array([[0, 1, 300]], dtype=np.int32)),
        "modes": dataclasses.replace(linear, shape=Modes(np.zeros((5, 2)))),
        "landmark": dataclasses.replace(linear, landmarks={"tip": 300}),
    }
    with pytest.raises(ModelFileError, match="not a valid shape model"):
        wrong[change].check(Path("model.bin"))
