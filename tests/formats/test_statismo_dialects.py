"""statismo files of every dialect give the model that they were written of."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import statismo_by_hand as by_hand
from statismo_by_hand import Truth, truth

from shapespace.commands.convert import convert
from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import LinearModel, Modes
from shapespace.formats.registry import read_linear
from shapespace.formats.statismo import write_statismo
from shapespace.io import sandbox_child
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel

Write = Callable[[Path, Truth], None]
DIALECTS: list[Write] = [
    by_hand.cpp, by_hand.scalismo, by_hand.version_08, by_hand.gravis, by_hand.in_rows, by_hand.by_catalogue,
]  # fmt: skip


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files that are known to be harmless without a process for each; test_sandbox reads in one."""

    def read(path: Path, leave: tuple[str, ...] = ()) -> Any:
        from shapespace.io.sandbox import FileContent

        found = sandbox_child._FileContent(2**26)
        with h5py.File(path) as file:
            sandbox_child._walk(file, "", found, leave)
        return FileContent(found.arrays, found.texts, found.attributes, tuple(found.groups))

    monkeypatch.setattr("shapespace.formats.statismo.read_hdf5_sandboxed", read)


def covariance(model: ShapeModel) -> Any:
    return (model.basis * model.stddev**2) @ model.basis.T


def is_truth(model: ShapeModel, one: Truth) -> None:
    assert np.array_equal(model.mean_vertices, one.mean)
    assert np.allclose(covariance(model), one.covariance, atol=1e-4)
    assert np.allclose(model.stddev**2, one.variance, rtol=1e-5)
    assert np.array_equal(np.asarray(model.faces), one.faces)


@pytest.mark.parametrize("write", DIALECTS, ids=lambda write: write.__name__)
def test_a_dialect_gives_the_model(write: Write, tmp_path: Path) -> None:
    write(tmp_path / "m.h5", truth())
    is_truth(ShapeModel.load(tmp_path / "m.h5"), truth())


@pytest.mark.parametrize("version", [(0, 91), (1, 0), (1, 4)])
def test_later_versions_are_as_0_9(version: tuple[int, int], tmp_path: Path) -> None:
    by_hand.scalismo(tmp_path / "m.h5", truth(), version=version)
    is_truth(ShapeModel.load(tmp_path / "m.h5"), truth())


@pytest.mark.parametrize("version", [(0, 7), (0, 10), (2, 0)])
def test_another_version_is_refused(version: tuple[int, int], tmp_path: Path) -> None:
    by_hand.scalismo(tmp_path / "m.h5", truth(), version=version)
    with pytest.raises(ModelFileError, match=rf"version {version[0]}\.{version[1]}"):
        ShapeModel.load(tmp_path / "m.h5")


def test_scores_tell_how_many_shapes_it_was_made_of_and_noise_what_no_mode_holds(tmp_path: Path) -> None:
    by_hand.cpp(tmp_path / "m.h5", truth(), noise=0.5, shapes=23)
    model = ShapeModel.load(tmp_path / "m.h5")
    is_truth(model, truth())
    assert model.n_training == 23
    assert np.isclose(model.total_variance, truth().variance.sum() + 0.5 * (18 - 4), rtol=1e-5)


def test_modes_that_are_functions_keep_their_covariance(tmp_path: Path) -> None:
    one = truth()
    basis = 7 * one.basis @ np.random.default_rng(2).normal(size=(4, 4))
    by_hand.scalismo(tmp_path / "m.h5", one, basis)
    model = ShapeModel.load(tmp_path / "m.h5")
    wanted = (basis * one.variance) @ basis.T
    assert np.linalg.norm(covariance(model) - wanted) < 1e-5 * np.linalg.norm(wanted)
    assert np.allclose(model.basis.T @ model.basis, np.eye(4), atol=1e-12)
    assert not model.held_out


def test_a_point_set_has_no_triangles(tmp_path: Path) -> None:
    by_hand.scalismo(tmp_path / "m.h5", truth())
    with h5py.File(tmp_path / "m.h5", "a") as file:
        del file["representer/cells"]
        file["representer"].attrs["datasetType"] = np.array([b"POINT_SET"])
    assert ShapeModel.load(tmp_path / "m.h5").faces is None


def test_of_tetrahedra_the_surface_is_read_seen_from_outside(tmp_path: Path) -> None:
    one = truth()
    mean = np.concatenate([one.mean, [[0, 0, 0]]]).astype(np.float32)  # within
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(21, 4)))[0]
    cells = np.array([[*face, 6] for face in one.faces])
    cells[::2] = cells[::2][:, [1, 0, 2, 3]]  # of either handedness
    by_hand.scalismo(tmp_path / "m.h5", dataclasses.replace(one, mean=mean, basis=basis))
    with h5py.File(tmp_path / "m.h5", "a") as file:
        del file["representer/cells"]
        file["representer/cells"] = cells.T.astype(np.int32)
        file["representer"].attrs["datasetType"] = np.array([b"VOLUME_MESH"])
    _, linear = read_linear(tmp_path / "m.h5")
    assert any("1 interior points are omitted" in note for note in linear.notes)
    assert np.array_equal(linear.mean, one.mean)
    assert linear.shape.moved.shape == (18, 4)

    def turned(faces: Any) -> set[tuple[int, ...]]:
        return {tuple(np.roll(face, -int(np.argmin(face))).tolist()) for face in faces}

    assert turned(linear.faces) == turned(one.faces)


def test_a_model_of_images_is_refused(tmp_path: Path) -> None:
    by_hand.scalismo(tmp_path / "m.h5", truth())
    with h5py.File(tmp_path / "m.h5", "a") as file:
        file["representer"].attrs["datasetType"] = np.array([b"IMAGE"])
    with pytest.raises(ModelFileError, match="a model of images"):
        ShapeModel.load(tmp_path / "m.h5")


def landmark_texts(one: Truth) -> dict[str, tuple[str, str]]:
    entries = [{"id": f"p{v}", "coordinates": one.mean[v].tolist()} for v in (5, 2)]
    lines = [f"p{v} 1 " + " ".join(f"{x:g}" for x in one.mean[v]) for v in (5, 2)]
    away = [{"id": "away", "coordinates": [500.0, 0.0, 0.0]}]
    return {
        "json": ("json", json.dumps(entries + away)),
        "text": ("text", "\n".join([*lines, "away 1 500 0 0", "no 0 0 0 0"])),
    }


@pytest.mark.parametrize("kind", ["json", "text"])
def test_a_morphable_model_parts_identity_and_expression(kind: str, tmp_path: Path) -> None:
    one = truth()
    moving = dataclasses.replace(truth(5, 3), mean=np.full_like(one.mean, 2.0))
    by_hand.momo(tmp_path / "m.h5", one, moving, landmark_texts(one)[kind])
    _, linear = read_linear(tmp_path / "m.h5")
    off = "1 of 3 landmarks lie more than 0.1 % of the extent of the model off its surface and are omitted."
    assert {"Its colour model is omitted.", off} <= set(linear.notes)
    assert linear.mm == 1.0
    model = AdditiveModel.load(tmp_path / "m.h5")
    assert model.n_identity == 4 and model.n_expression == 3
    assert dict(model.shape.landmarks) == {"p5": 5, "p2": 2}
    assert np.array_equal(model.shape.mean_vertices, one.mean + 2)
    assert np.allclose(covariance(model.shape), one.covariance + moving.covariance, atol=1e-4)
    a = np.array([1.0, -2.0, 0.5, 0.3])
    moved = np.abs(model.mesh(a, ()).vertices - one.mean - 2).ravel()
    assert np.allclose(moved, np.abs(one.basis @ (a * np.sqrt(one.variance))), atol=1e-4)


def test_a_face_model_of_199_modes_is_known_to_be_for_research_only_and_says_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(300, 199)))[0]
    one = Truth(rng.normal(size=(100, 3)), basis, np.linspace(9, 1, 199), np.array([[0, 1, 2]]))
    by_hand.momo(
        tmp_path / "model2019_face12.h5", one, Truth(0 * one.mean, basis[:, ::2], one.variance[::2], one.faces)
    )
    for name in ("own.h5", "eos.bin"):
        said = convert(tmp_path / "model2019_face12.h5", tmp_path / name).facts["notes"]
        assert any("Basel Face Model: non-commercial research only" in note for note in said)
    assert "research" in ShapeModel.load(tmp_path / "own.h5").licence


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("mean", "no /model/mean"), ("pcaVariance", "no /model/pcaVariance"), ("short", "the shapes"),
        ("negative", "below 0"), ("cells", "refer to points"), ("points", "its points the shape"),
    ],
)  # fmt: skip
def test_parts_that_are_missing_or_do_not_belong_together_are_named(change: str, told: str, tmp_path: Path) -> None:
    by_hand.scalismo(tmp_path / "m.h5", truth())
    with h5py.File(tmp_path / "m.h5", "a") as file:
        replaced: dict[str, tuple[str, Any]] = {
            "short": ("model/pcaVariance", np.ones(3)), "negative": ("model/pcaVariance", -np.ones(4)),
            "cells": ("representer/cells", np.full((3, 8), 6)), "points": ("representer/points", np.ones((3, 5))),
        }  # fmt: skip
        name, value = replaced.get(change, (f"model/{change}", None))
        del file[name]
        if value is not None:
            file[name] = value
    with pytest.raises(ModelFileError, match=told) as refused:
        ShapeModel.load(tmp_path / "m.h5")
    assert "\n" not in str(refused.value)


def one_of(additive: bool) -> LinearModel:
    one = truth()
    plain = LinearModel(
        mean=one.mean, shape=Modes(one.basis * 5.0),
        faces=one.faces, mm=1.0, landmarks={"tip": 4}, n_training=31, held_out=True, provenance="six points",
        licence="CC0-1.0",
    )  # fmt: skip
    return dataclasses.replace(plain, expression=Modes(truth(5, 3).basis * 2.0)) if additive else plain


@pytest.mark.parametrize("additive", [False, True], ids=["plain", "momo"])
def test_what_we_write_is_laid_out_as_scalismo_and_statismo_ask(additive: bool, tmp_path: Path) -> None:
    write_statismo(one_of(additive), tmp_path / "m.h5")
    with h5py.File(tmp_path / "m.h5") as file:
        f: Any = file
        roots = ["shape/", "color/", "expression/"] if additive else [""]
        assert (f["version/majorVersion"][()], f["version/minorVersion"][()]) == (0, 9)
        for root in roots:
            shapes = {name: f[f"{root}model/{name}"].shape for name in ("mean", "pcaVariance", "noiseVariance")}
            assert shapes["noiseVariance"] == (1,) and shapes["mean"] == (18,)
            assert f[f"{root}model/pcaBasis"].dtype == np.float32
            assert f[f"{root}representer/points"].shape == (3, 6) and f[f"{root}representer/points"].dtype == np.float32
            assert f[f"{root}representer/cells"].shape == (3, 8) and f[f"{root}representer/cells"].dtype == np.int32
            assert f[f"{root}modelinfo/scores"].shape == (1, 1)
            assert {"dataInfo", "parameters"} <= set(f[f"{root}modelinfo/modelBuilder-0"])
            assert not len(f[f"{root}representer/pointData"])
            told = f[f"{root}representer"].attrs
            assert told["datasetType"] == b"POLYGON_MESH"
            # Of fixed length, ended by a zero that is counted: what C++ reads.
            kind = h5py.h5a.open(f[f"{root}representer"].id, b"name").get_type()
            assert (kind.get_strpad(), kind.get_size()) == (h5py.h5t.STR_NULLTERM, len(told["name"]) + 1)
            basis = f[f"{root}model/pcaBasis"][()]
            assert np.allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-6)
    back = read_linear(tmp_path / "m.h5")[1]
    assert (back.n_training, back.held_out, back.provenance, back.licence, dict(back.landmarks), back.mm) == (
        31, True, "six points", "CC0-1.0", {"tip": 4}, 1.0,
    )  # fmt: skip
