"""Folders of OBJ blendshapes: ICT-FaceKit's layout, what is told by names, and folders of scans that are no models."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import InputError, ModelFileError
from shapespace.formats.model_parts import Modes
from shapespace.formats.obj_folder import read_obj_folder, write_obj_folder
from shapespace.formats.registry import is_known
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model

ICT = Path(os.environ.get("SHAPESPACE_DATA", "data")) / "ict-facekit" / "FaceXModel"


def obj(path: Path, vertices: np.ndarray, *polygons: tuple[int, ...]) -> None:
    """Write OBJ as Maya does: groups, normals, quads."""
    lines = ["# exported", "g default", *(f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices), "vn 0 0 1"]
    path.write_text("\r\n".join([*lines, *("f " + " ".join(f"{i + 1}//1" for i in p) for p in polygons), ""]))


QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "face"
    path.mkdir()
    for number, name in enumerate(["generic_neutral_mesh", "identity000", "identity001", "browUp_L", "jawOpen"]):
        shape = QUAD.copy()
        shape[number % 4, 2] += number
        obj(path / f"{name}.obj", shape, (0, 1, 2, 3))
    return path


def test_the_layout_of_ict_facekit_is_an_additive_model_in_cm(folder: Path) -> None:
    (folder / "LICENSE").write_text("\nMIT License\n\nCopyright\n")
    found = read_obj_folder(folder)
    assert found.expression is not None and found.mm == 10
    assert found.shape.names == ("identity000", "identity001") and found.expression.names == ("browUp_L", "jawOpen")
    assert np.array_equal(found.mean, QUAD) and found.licence == "MIT License"
    assert np.array_equal(found.shape.moved[:, 0].reshape(4, 3), [[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0]])
    assert np.array_equal(np.asarray(found.faces), [[0, 1, 2], [0, 2, 3]])
    assert AdditiveModel.load(folder).n_identity == 2
    assert ShapeModel.load(folder).mean_vertices[1, 0] == 10


def test_a_neutral_and_shapes_of_any_name_are_one_block_in_mm(folder: Path) -> None:
    (folder / "generic_neutral_mesh.obj").rename(folder / "Neutral.obj")
    for name in ("identity000", "identity001"):
        (folder / f"{name}.obj").unlink()
    found = read_obj_folder(folder)
    assert found.expression is None and found.mm is None and found.shape.names == ("browUp_L", "jawOpen")
    assert any("one standard deviation" in note for note in found.notes)


@pytest.mark.parametrize("change", ["no neutral", "two neutrals", "mean", "other vertices", "no others", "no folder"])
def test_ordinary_scans_are_no_model(change: str, folder: Path) -> None:
    neutral = folder / "generic_neutral_mesh.obj"
    if change == "no neutral":
        neutral.unlink()
    elif change == "two neutrals":
        (folder / "neutral.obj").write_bytes(neutral.read_bytes())
    elif change == "mean":
        neutral.rename(folder / "mean.obj")  # of a training set
    elif change == "other vertices":
        obj(folder / "browUp_L.obj", np.vstack([QUAD, QUAD]), (0, 1, 2, 3))
    elif change == "no others":
        for path in folder.glob("*.obj"):
            if path != neutral:
                path.unlink()
    else:
        folder = neutral
    assert not is_known(folder)


def test_shapes_of_another_topology_are_refused_by_name(folder: Path) -> None:
    obj(folder / "jawOpen.obj", QUAD, (0, 1, 3, 2))
    assert is_known(folder)
    with pytest.raises(ModelFileError, match=r"jawOpen\.obj has other vertices or triangles than generic_neutral"):
        read_obj_folder(folder)


def test_what_is_written_says_mm_and_keeps_names_and_facts(tmp_path: Path) -> None:
    model = dataclasses.replace(blob_model(300), landmarks={"tip": 7}, n_training=41)
    linear = model.as_linear()
    moved = linear.shape.moved
    parted = dataclasses.replace(
        linear, shape=Modes(moved[:, :2]), expression=Modes(moved[:, 2:4], ("jaw open", "smile"))
    )
    path = tmp_path / "new" / "face"
    write_obj_folder(parted, path)
    assert sorted(p.name for p in path.iterdir()) == [
        "generic_neutral_mesh.obj", "identity000.obj", "identity001.obj", "jaw open.obj", "shapespace.json",
        "smile.obj",
    ]  # fmt: skip
    again = read_obj_folder(path)
    assert again.mm == 1 and again.n_training == 41 and dict(again.landmarks) == {"tip": 7}
    assert np.array_equal(again.mean, linear.mean)
    with pytest.raises(InputError, match="already exists"):
        write_obj_folder(parted, path)


def test_names_that_are_no_file_names_do_not_become_any(tmp_path: Path) -> None:
    linear = blob_model(300).as_linear()
    for names in (("../up", "b"), ("same", "Same"), ("neutral", "b"), ("identity1", "b")):
        block = Modes(linear.shape.moved[:, :2], names)
        path = tmp_path / f"of {len(list(tmp_path.iterdir()))}"
        write_obj_folder(dataclasses.replace(linear, expression=block), path)
        assert {"expression000.obj", "expression001.obj"} <= {p.name for p in path.iterdir()}


@pytest.mark.skipif(not ICT.is_dir(), reason="ICT-FaceKit is not here")
def test_the_published_files_are_read(tmp_path: Path) -> None:
    assert is_known(ICT)
    for name in ("generic_neutral_mesh", "identity000", "jawOpen"):
        (tmp_path / f"{name}.obj").symlink_to(ICT / f"{name}.obj")
    found = read_obj_folder(tmp_path)
    assert found.mean.shape == (26719, 3)
    assert found.expression is not None and "jawOpen" in found.expression.names
