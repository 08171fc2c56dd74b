"""glTF 2.0 morph targets: a mesh with the displacement of each mode, for Blender, three.js and game engines."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from shapespace.errors import InputError
from shapespace.formats.model_parts import IDENTITY, KEY, LinearModel, facts_of, json_object, split_modes, with_facts
from shapespace.geometry.normals import vertex_normals
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import read_bytes, write_bytes
from shapespace.io.meshes.gltf_mesh import GltfBuffer, centre_if_far, glb_bytes, gltf_bytes, read_morphs
from shapespace.io.read_limits import LARGEST_MESH_FILE_BYTES
from shapespace.types import FloatArray, IntArray, Mesh

_MM: Final = 1000.0
"""Length of the unit of glTF, a metre, in mm."""
_SUFFIXES = (".glb", ".gltf")
_AGAIN = "export it again"
_TARGETS = b'"targets"'
_POINT_CLOUD, _SURFACE = 0, 4  # glTF 2.0 primitive.mode: POINTS, TRIANGLES


def is_gltf_model(path: Path, head: bytes) -> bool:
    """Return whether a file is glTF and mentions morph targets."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            if head[:4] == b"glTF":
                return content.find(_TARGETS, 20, 20 + int.from_bytes(head[12:16], "little")) >= 0
            return content.find(_TARGETS) >= 0
    except (OSError, ValueError):
        return False


def read_gltf_model(path: Path) -> LinearModel:
    """Read a mesh with morph targets, `.glb` or `.gltf`: a weight of one is one standard deviation."""
    check_file(path, LARGEST_MESH_FILE_BYTES, _AGAIN)
    morphs = read_morphs(read_bytes(path, LARGEST_MESH_FILE_BYTES), path)
    facts = json_object(json_object(morphs.extras).get(KEY))
    mean, faces = morphs.vertices, None if morphs.faces is None else morphs.faces.astype(np.int32)
    displacements = morphs.targets.reshape(len(morphs.targets), -1).T
    notes: list[str] = []
    if facts.get("vertices") != len(mean):
        mean, displacements, faces, merged = _without_seams(mean, displacements, faces)
        if merged:
            notes.append(
                f"{merged} vertices that are equal to another in position and displacements, as at seams, are merged."
            )
    if morphs.n_others:
        notes.append(f"Other meshes of the scene are omitted ({morphs.n_others}).")
    if any(morphs.weights):
        notes.append("Its weights are not zero; the mean is the shape without them.")
    if not facts:
        notes.append("A weight of 1 is interpreted as one standard deviation.")
    n_identity = facts.get("n_identity")
    is_identity = [bool(IDENTITY.fullmatch(name)) for name in morphs.names]
    if not morphs.names and isinstance(n_identity, int):
        is_identity = [k < n_identity for k in range(displacements.shape[1])]
    shape, expression = split_modes(displacements, morphs.names, is_identity)
    return with_facts(
        LinearModel(
            mean=mean,
            shape=shape,
            expression=expression,
            faces=faces,
            mm=_MM,
            licence=morphs.copyright,
            notes=tuple(notes),
        ),
        facts,
    )


def write_gltf_model(model: LinearModel, path: Path) -> Sequence[str]:
    """Write single precision, metres, and normals of mean and targets, see `ModelFormat.write`."""
    tree, binary = _content(model, path)
    write_bytes(path, (gltf_bytes if path.suffix.lower() == ".gltf" else glb_bytes)(tree, binary))
    notes = [
        "Lengths are in metres, as glTF requires, and numbers in single precision.",
        "A weight of 1 is one standard deviation; weights may be negative, so set the range of the sliders to -3 to 3.",
    ]
    if model.faces is None:
        notes.append("It is a point model, so there are no normals.")
    return notes


def _without_seams(
    mean: FloatArray, displacements: FloatArray, faces: IntArray | None
) -> tuple[FloatArray, FloatArray, IntArray | None, int]:
    """Return the arrays with equal vertices merged, in order of first appearance, and the number of removed ones."""
    if faces is None:
        return mean, displacements, faces, 0
    n = len(mean)
    rows = np.ascontiguousarray(np.concatenate([mean, displacements.reshape(n, -1)], axis=1) + 0.0)
    row_keys = rows.view([("", np.void, rows.shape[1] * 8)]).ravel()
    _, first, distinct_of_row = np.unique(row_keys, return_index=True, return_inverse=True)
    if len(first) == n:
        return mean, displacements, faces, 0
    order = np.argsort(first)
    rank = np.empty(len(first), dtype=np.int32)
    rank[order] = np.arange(len(first), dtype=np.int32)
    kept_rows = first[order]
    joined_faces = rank[distinct_of_row.reshape(-1)[faces]]
    flat = (
        (joined_faces[:, 0] == joined_faces[:, 1])
        | (joined_faces[:, 1] == joined_faces[:, 2])
        | (joined_faces[:, 2] == joined_faces[:, 0])
    )
    columns = displacements.reshape(n, 3, -1)[kept_rows].reshape(3 * len(kept_rows), -1)
    return mean[kept_rows], columns, joined_faces[~flat], n - len(kept_rows)


def target_names(model: LinearModel) -> list[str]:
    """Return a name for each mode, those of identity before those of expression."""
    if model.expression is None:
        return list(model.shape.names) or [f"mode {k + 1}" for k in range(model.shape.moved.shape[1])]
    identity = [f"identity {k + 1}" for k in range(model.shape.moved.shape[1])]
    count = model.expression.moved.shape[1]
    return identity + (list(model.expression.names) or [f"expression {k + 1}" for k in range(count)])


def _content(model: LinearModel, path: Path) -> tuple[dict[str, Any], bytes]:
    scale = (model.mm or 1.0) / _MM
    mean = model.mean * scale
    centre, buffer = centre_if_far(mean), GltfBuffer()
    attributes = {"POSITION": buffer.vectors(mean - centre)}
    steps = [column.reshape(-1, 3) for column in (model.moved * scale).T]
    targets = [{"POSITION": buffer.vectors(step)} for step in steps]
    primitive: dict[str, Any] = {"attributes": attributes, "targets": targets, "mode": _POINT_CLOUD}
    if model.faces is not None:
        attributes["NORMAL"] = buffer.vectors(_normals(mean, model.faces, upright=True), bounds=False)
        for target, step in zip(targets, steps, strict=True):
            # Bounds for both signs, since weights may be negative.
            normal_changes = (_normals(mean + step, model.faces) - _normals(mean - step, model.faces)) / 2
            target["NORMAL"] = buffer.vectors(normal_changes, bounds=False)
        primitive |= {"mode": _SURFACE, "indices": buffer.indices(model.faces)}
    if not buffer.is_finite:
        raise InputError(f"{path} cannot be written: the model is too large for the single precision of glTF.")
    extras = {"targetNames": target_names(model), KEY: facts_of(model)}
    mesh = {"name": path.stem, "primitives": [primitive], "weights": [0.0] * len(targets), "extras": extras}
    licence = {"copyright": model.licence} if model.licence else {}
    return buffer.content(mesh, path.stem, centre, **licence)


def _normals(vertices: FloatArray, faces: IntArray, *, upright: bool = False) -> FloatArray:
    normals = vertex_normals(Mesh(vertices, faces))
    if upright:
        # glTF requires unit vectors, also at vertices without a triangle.
        normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals
