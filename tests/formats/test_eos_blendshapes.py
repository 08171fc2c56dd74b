"""Blendshapes that eos keeps in a file of their own, written here byte by byte."""

import struct
from pathlib import Path

import numpy as np
import pytest

from shapespace.commands.convert import convert
from shapespace.errors import InputError, ModelFileError
from shapespace.formats.eos import read_blendshapes, write_eos
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model


def blendshapes(path: Path, moved: np.ndarray, names: list[str]) -> Path:
    """As cereal writes a vector of names and single-column matrices."""
    out = struct.pack("<Q", len(names))
    for name, column in zip(names, moved.T, strict=True):
        out += struct.pack("<Q", len(name)) + name.encode() + struct.pack("<ii", len(column), 1)
        out += column.astype("<f4").tobytes()
    path.write_bytes(out)
    return path


@pytest.fixture
def model(tmp_path: Path) -> ShapeModel:
    whole = blob_model(300)
    write_eos(whole.as_linear(), tmp_path / "shape.bin")
    return whole


def smiles(n: int = 300) -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.normal(size=(3 * n, 2))


def test_shape_and_blendshapes_of_two_files_are_one_additive_model(model: ShapeModel, tmp_path: Path) -> None:
    file = blendshapes(tmp_path / "expressions.bin", smiles(), ["smile", "frown"])
    found = read_blendshapes(file)
    assert found.names == ("smile", "frown") and np.allclose(found.moved, smiles(), atol=1e-6)
    said = convert(tmp_path / "shape.bin", tmp_path / "face.h5", expressions=file).facts["notes"]
    assert any("2 blendshapes is one standard deviation" in note for note in said)
    face = AdditiveModel.load(tmp_path / "face.h5")
    assert (face.n_identity, face.n_expression) == (model.n_modes, 2)
    moved = face.mesh((), (0.0, 1.0)).vertices - face.mesh((), ()).vertices
    gap = min(np.abs(moved.ravel() - sign * smiles()[:, k]).max() for k in (0, 1) for sign in (1, -1))
    assert gap < 1e-4


def test_blendshapes_alone_are_no_model(tmp_path: Path) -> None:
    file = blendshapes(tmp_path / "expressions.bin", smiles(), ["smile", "frown"])
    with pytest.raises(
        ModelFileError,
        match="contains only the blendshapes of an eos model; give the model, and this file with --expressions",
    ):
        ShapeModel.load(file)


def test_expressions_of_another_model_are_refused(model: ShapeModel, tmp_path: Path) -> None:
    shape, out = tmp_path / "shape.bin", tmp_path / "out.h5"
    other = blendshapes(tmp_path / "other.bin", smiles(20), ["a", "b"])
    with pytest.raises(ModelFileError, match="has 20 vertices"):
        convert(shape, out, expressions=other)
    with pytest.raises(ModelFileError, match="no blendshapes of eos"):
        convert(shape, out, expressions=shape)
    whole = other.read_bytes()
    for length in (4, 30, len(whole) - 1):
        other.write_bytes(whole[:length])
        with pytest.raises(ModelFileError, match="no blendshapes of eos"):
            read_blendshapes(other)
    model.save(tmp_path / "ours.h5")
    with pytest.raises(InputError, match="goes with the models of eos"):
        convert(tmp_path / "ours.h5", out, expressions=other)
