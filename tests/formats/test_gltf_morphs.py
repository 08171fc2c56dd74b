"""glTF morph targets: our files read by a plain parser and by trimesh, and files of others as they write them."""

import base64
import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from shapespace.commands.convert import convert
from shapespace.errors import ShapespaceError
from shapespace.formats.gltf_model import read_gltf_model, write_gltf_model
from shapespace.formats.registry import is_known
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import blob_model


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return dataclasses.replace(
        blob_model(300), landmarks={"tip": 7}, gauge="form", provenance="blobs", licence="CC BY 4.0", n_training=41
    )


def parsed(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return JSON and buffer of a .glb by nothing but the layout of the specification."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON") and size % 4 == 0
    more, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and 28 + size + more == length and more % 4 == 0
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def values(tree: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    accessor = tree["accessors"][index]
    view = tree["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
    width = {"VEC3": 3, "SCALAR": 1}[accessor["type"]]
    assert view["byteOffset"] % 4 == 0 and view["byteLength"] == 4 * accessor["count"] * width
    return np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)


def test_a_plain_reader_finds_mean_modes_names_and_normals_in_metres(model: ShapeModel, tmp_path: Path) -> None:
    notes = convert_to(model, tmp_path / "m.glb")
    assert any("metres" in note for note in notes) and any("standard deviation" in note for note in notes)
    tree, binary = parsed(tmp_path / "m.glb")
    (mesh,), (primitive,) = tree["meshes"], tree["meshes"][0]["primitives"]
    mean = values(tree, binary, primitive["attributes"]["POSITION"])
    assert np.allclose(1000 * mean, model.mean_vertices, atol=1e-4)
    assert mesh["weights"] == [0.0] * model.n_modes
    assert mesh["extras"]["targetNames"] == [f"mode {k + 1}" for k in range(model.n_modes)]
    assert tree["asset"]["copyright"] == "CC BY 4.0"
    normals = values(tree, binary, primitive["attributes"]["NORMAL"])
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert ((normals * mean).sum(axis=1) > 0).mean() > 0.95  # a blob around the origin, seen from outside
    for k, target in enumerate(primitive["targets"]):
        moved = model.mesh(model.to_b(np.eye(model.n_modes)[k])).vertices
        step = values(tree, binary, target["POSITION"])
        assert np.allclose(1000 * (mean + step), moved, atol=2e-4)
        said = tree["accessors"][target["POSITION"]]
        assert said["min"] == step.min(axis=0).tolist() and said["max"] == step.max(axis=0).tolist()
        turned = trimesh.Trimesh(moved, model.faces, process=False).vertex_normals
        found = normals + values(tree, binary, target["NORMAL"])
        found /= np.linalg.norm(found, axis=1, keepdims=True)
        assert np.median((found * turned).sum(axis=1)) > 0.999


def convert_to(model: ShapeModel | AdditiveModel, path: Path) -> list[str]:
    source = path.parent / "source.h5"
    model.save(source)
    return convert(source, path).facts["notes"]


def test_trimesh_opens_it(model: ShapeModel, tmp_path: Path) -> None:
    convert_to(model, tmp_path / "m.glb")
    (mesh,) = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    assert np.allclose(1000 * mesh.vertices, model.mean_vertices, atol=1e-4)
    assert np.array_equal(mesh.faces, np.asarray(model.faces))


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
def test_what_the_model_says_comes_back(ending: str, model: ShapeModel, tmp_path: Path) -> None:
    convert_to(model, tmp_path / f"m{ending}")
    again = ShapeModel.load(tmp_path / f"m{ending}")
    assert dict(again.landmarks) == {"tip": 7} and again.n_training == 41
    assert (again.provenance, again.licence) == ("blobs", "CC BY 4.0")
    assert again.total_variance == pytest.approx(model.total_variance, rel=1e-6)


def test_names_alone_part_identity_and_expression(model: ShapeModel, tmp_path: Path) -> None:
    """Blender keeps the names of targets, but not always what else the file says."""
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(model.n_modes, model.n_modes)))[0]
    path = tmp_path / "m.gltf"
    convert_to(AdditiveModel(model, rotation, 2), path)
    tree = json.loads(path.read_text())
    names = tree["meshes"][0]["extras"]["targetNames"]
    assert names == ["identity 1", "identity 2", "expression 1", "expression 2", "expression 3"]
    del tree["meshes"][0]["extras"]["shapespace"]
    tree["meshes"][0]["extras"]["targetNames"] = ["Identity_1", "identity002", "jawOpen", "smile", "frown"]
    path.write_text(json.dumps(tree))
    assert AdditiveModel.load(path).n_identity == 2
    assert read_gltf_model(path).expression.names == ("jawOpen", "smile", "frown")  # pyright: ignore


def blender_like(model: ShapeModel, path: Path) -> None:
    """A corner for each triangle as flat shading has them, sparse targets, shorts as indices, a turned node."""
    faces = np.asarray(model.faces)
    points = (model.mean_vertices / 1000)[faces.ravel()].astype("<f4")
    step = np.zeros((len(model.mean_vertices), 3), "<f4")
    step[:20] = (0.01, 0.0, 0.002)
    steps = step[faces.ravel()]
    touched = np.flatnonzero(steps.any(axis=1)).astype("<u2")
    parts = [points, np.arange(len(points), dtype="<u2"), touched, steps[touched]]
    binary = b"".join(part.tobytes() + b"\0" * (-part.nbytes % 4) for part in parts)
    offsets = np.cumsum([0, *(part.nbytes + -part.nbytes % 4 for part in parts)])
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    n = len(points)
    sparse = {
        "count": len(touched),
        "indices": {"bufferView": 2, "componentType": 5123},
        "values": {"bufferView": 3},
    }
    tree = {
        "asset": {"version": "2.0", "generator": "Khronos glTF Blender I/O v4"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "translation": [0, 1, 0], "scale": [2, 2, 2]}, {"mesh": 1}],
        "meshes": [
            {
                "primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "targets": [{"POSITION": 2}]}],
                "weights": [0.5],
                "extras": {"targetNames": ["Key 1"]},
            },
            {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": n, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": n, "type": "SCALAR"},
            {"componentType": 5126, "count": n, "type": "VEC3", "sparse": sparse},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(at), "byteLength": part.nbytes}
            for at, part in zip(offsets, parts, strict=False)
        ],
        "buffers": [{"byteLength": len(binary), "uri": uri}],
    }
    path.write_text(json.dumps(tree))


def test_seams_are_joined_and_the_shape_at_rest_is_the_mean(model: ShapeModel, tmp_path: Path) -> None:
    path = tmp_path / "blender.gltf"
    blender_like(model, path)
    found = read_gltf_model(path)
    assert len(found.mean) == len(model.mean_vertices)
    order = np.unique(np.asarray(model.faces).ravel(), return_index=True)
    appearance = order[0][np.argsort(order[1])]
    wanted = 2 * model.mean_vertices / 1000 + (0, 1, 0)
    assert np.allclose(found.mean, wanted[appearance], atol=1e-6)
    moved = found.shape.moved.reshape(-1, 3)
    assert np.allclose(moved[appearance < 20], (0.02, 0.0, 0.004), atol=1e-6)
    assert not moved[appearance >= 20].any()
    said = " ".join(found.notes)
    assert (
        "are merged" in said
        and "weights are not zero" in said
        and "omitted (1)" in said
        and "one standard deviation" in said
    )


def test_a_mesh_without_targets_is_no_model(model: ShapeModel, tmp_path: Path) -> None:
    for ending in (".glb", ".gltf"):
        write_mesh(tmp_path / f"scan{ending}", Mesh(model.mean_vertices, model.faces))
        assert not is_known(tmp_path / f"scan{ending}")
        convert_to(model, tmp_path / f"m{ending}")
        assert is_known(tmp_path / f"m{ending}")
    assert len(read_mesh(tmp_path / "m.glb").vertices) == 300  # as a mesh it is its mean


def test_what_an_editor_changed_is_not_taken_for_the_model(model: ShapeModel, tmp_path: Path) -> None:
    path = tmp_path / "m.gltf"
    convert_to(model, path)
    tree = json.loads(path.read_text())
    facts = tree["meshes"][0]["extras"]["shapespace"]
    facts.update(vertices=7, n_training=True, total_variance_mm2=10**400, licence=5, n_identity=10**30)
    path.write_text(json.dumps(tree))
    found = read_gltf_model(path)
    assert not found.landmarks and found.n_training is None and found.shape.total_variance is None
    assert any("landmarks are omitted" in note for note in found.notes)


def test_a_far_model_keeps_its_precision(model: ShapeModel, tmp_path: Path) -> None:
    linear = dataclasses.replace(model.as_linear(), mean=model.mean_vertices + 1e7)
    write_gltf_model(linear, tmp_path / "far.glb")
    assert np.abs(1000 * read_gltf_model(tmp_path / "far.glb").mean - linear.mean).max() < 1e-4


def test_many_targets_on_one_array_are_refused_before_they_are_made(tmp_path: Path) -> None:
    points = np.zeros((3000, 3), "<f4").tobytes()
    uri = "data:;base64," + base64.b64encode(points).decode()
    tree = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0, "targets": [{"POSITION": 0}] * 40_000}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3000, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(points)}],
        "buffers": [{"byteLength": len(points), "uri": uri}],
    }
    path = tmp_path / "bomb.gltf"
    path.write_text(json.dumps(tree))
    with pytest.raises(ShapespaceError, match="expand to more than"):
        read_gltf_model(path)


def test_regions_that_another_format_has_no_place_for_are_said_to_be_left_out(tmp_path: Path) -> None:
    model = dataclasses.replace(blob_model(), regions={"tip": np.arange(9, dtype=np.int32)})
    model.save(tmp_path / "m.h5")
    notes = convert(tmp_path / "m.h5", tmp_path / "m.glb").facts["notes"]
    assert any("region tip" in note and "no place" in note for note in notes)
    assert not any("region" in note for note in convert(tmp_path / "m.h5", tmp_path / "n.h5").facts["notes"])
    assert "tip" in ShapeModel.load(tmp_path / "n.h5").regions
