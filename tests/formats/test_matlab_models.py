"""Face models in MATLAB files, of versions 5 and 7.3, written by hand."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from statismo_by_hand import Truth, truth

from shapespace.errors import InputError, ModelFileError
from shapespace.formats.matlab import Matlab
from shapespace.formats.registry import read_linear
from shapespace.model.shape_model import ShapeModel


def version_5(path: Path, parts: dict[str, Any]) -> None:
    scipy.io.savemat(path, parts, do_compression=True)


def version_7_3(path: Path, parts: dict[str, Any]) -> None:
    """Write HDF5 as MATLAB does: text in a user block, the last axis first, structures as groups."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in parts.items():
            fields = value if isinstance(value, dict) else {"": value}
            for field, array in fields.items():
                columns = np.atleast_2d(np.asarray(array, dtype=np.float64))
                file.create_dataset(f"{name}/{field}".rstrip("/"), data=columns.T, compression="gzip")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


def clockwise_from_1(faces: Any) -> Any:
    return faces[:, [0, 2, 1]] + 1


def bfm(one: Truth) -> dict[str, Any]:
    """Return the Basel Face Model of 2009: µm, standard deviations, triangles clockwise and from 1."""
    return {
        "shapeMU": 1000 * one.mean.reshape(-1, 1), "shapePC": one.basis,
        "shapeEV": 1000 * np.sqrt(one.variance).reshape(-1, 1), "tl": clockwise_from_1(one.faces).astype(float),
        "texMU": np.full((18, 1), 128.0), "segbin": np.ones((6, 4)),
    }  # fmt: skip


def lyhm(one: Truth) -> dict[str, Any]:
    shp = {"mu": one.mean.reshape(1, -1), "eigVec": one.basis, "eigVal": one.variance.reshape(-1, 1)}
    return {"shp": shp, "tri": {"faces": clockwise_from_1(one.faces)}, "tex": {"mu": np.ones((1, 18))}}


def lsfm(one: Truth) -> dict[str, Any]:
    return {
        "mean": one.mean.reshape(-1, 1), "components": one.basis, "eigenvalues": one.variance, "trilist": one.faces,
        "n_training_samples": 9663,
    }  # fmt: skip


KINDS: list[Callable[[Truth], dict[str, Any]]] = [bfm, lyhm, lsfm]
VERSIONS: list[Callable[[Path, dict[str, Any]], None]] = [version_5, version_7_3]


@pytest.mark.parametrize("version", VERSIONS, ids=lambda one: one.__name__)
@pytest.mark.parametrize("kind", KINDS, ids=lambda one: one.__name__)
def test_a_face_model_is_read_in_mm_and_seen_from_outside(kind: Any, version: Any, tmp_path: Path) -> None:
    one = truth()
    version(tmp_path / "m.mat", kind(one))
    _, linear = read_linear(tmp_path / "m.mat")
    assert "research" in linear.licence
    assert linear.n_training == {bfm: 200, lyhm: None, lsfm: 9663}[kind]
    assert bool(linear.notes) == (kind is not lsfm)  # that colour is left out
    model = ShapeModel.load(tmp_path / "m.mat")
    assert np.allclose(model.mean_vertices, one.mean, atol=1e-5)
    assert np.allclose((model.basis * model.stddev**2) @ model.basis.T, one.covariance, atol=1e-4)
    assert np.array_equal(np.asarray(model.faces), one.faces)


def test_a_file_without_a_known_model_says_which_are_known(tmp_path: Path) -> None:
    version_5(tmp_path / "m.mat", {"anything": np.ones(3)})
    with pytest.raises(ModelFileError, match="Basel Face Model 2009, LYHM, LSFM"):
        ShapeModel.load(tmp_path / "m.mat")


def test_parts_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    version_5(tmp_path / "m.mat", lsfm(truth()) | {"eigenvalues": np.ones(7)})
    with pytest.raises(ModelFileError, match="the shapes"):
        ShapeModel.load(tmp_path / "m.mat")


def test_it_is_only_read(tmp_path: Path) -> None:
    version_5(tmp_path / "m.mat", lsfm(truth()))
    with pytest.raises(InputError, match="only read"):
        Matlab().write(read_linear(tmp_path / "m.mat")[1], tmp_path / "out.mat")
