"""Folders of OBJ files, one per shape, in the layout of ICT-FaceKit: a neutral mesh, identities and expressions."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from shapespace.errors import ModelFileError, ShapespaceError
from shapespace.formats.model_parts import (
    IDENTITY,
    KEY,
    LinearModel,
    facts_of,
    json_object,
    split_modes,
    with_facts,
    write_folder,
)
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import read_bytes
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.meshes.obj import write_obj
from shapespace.types import FloatArray, Mesh, are_same_triangles

_ICT: Final = "generic_neutral_mesh"
_ICT_MM = 10.0
"""Length of the unit of ICT-FaceKit, cm, in mm."""
_NEUTRALS: Final = (_ICT, "neutral", "neutral_mesh")
_FACTS = f"{KEY}.json"
_LICENCES = ("LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "LICENCE.txt")
_MOST_LICENCE_BYTES = 2**16  # 64 KiB
_PROBED_BYTES = 2**26  # 64 MiB
_MOST_SHAPES = 4096  # limit on files that are opened
_AGAIN = "export all files again with the same vertices and triangles"


def is_obj_folder(path: Path, head: bytes) -> bool:
    """Return whether a folder has an OBJ file called neutral and another OBJ file with as many vertices and faces."""
    try:
        neutral, mode_files = _files(path)
        if neutral is None or not mode_files:
            return False
        return _counts(neutral) == _counts(mode_files[0]) != (0, 0)
    except (OSError, ShapespaceError):
        return False


def read_obj_folder(path: Path) -> LinearModel:
    """Read a folder with a neutral mesh, `identity000.obj` and so on, and `<expression>.obj`, with equal triangles."""
    neutral, mode_files = _files(path)
    if neutral is None or not mode_files or len(mode_files) > _MOST_SHAPES:
        raise ModelFileError(
            f"{path} is not a folder of blendshapes: it needs one OBJ file called neutral or {_ICT}, and 1 to "
            f"{_MOST_SHAPES} others."
        )
    neutral_mesh = read_mesh(neutral)
    steps: list[FloatArray] = []
    for file in mode_files:
        shape = read_mesh(file)
        if len(shape.vertices) != len(neutral_mesh.vertices) or not are_same_triangles(shape.faces, neutral_mesh.faces):
            raise ModelFileError(
                f"{file} has other vertices or triangles than {neutral.name}, so they are not blendshapes; {_AGAIN}."
            )
        steps.append((shape.vertices - neutral_mesh.vertices).ravel())
    names = [file.stem for file in mode_files]
    is_identity = [bool(IDENTITY.fullmatch(name)) for name in names]
    shape, expression = split_modes(np.stack(steps, axis=1), names, is_identity)
    facts = json_object(read_json(path / _FACTS, "remove it") if (path / _FACTS).is_file() else None)
    notes: list[str] = []
    if not facts:
        notes.append("Each shape is interpreted as one standard deviation of its mode.")
    ict = neutral.stem.lower() == _ICT
    return with_facts(
        LinearModel(
            mean=neutral_mesh.vertices,
            shape=shape,
            expression=expression,
            faces=neutral_mesh.faces,
            mm=1.0 if facts else _ICT_MM if ict else None,
            provenance=f"{len(mode_files)} blendshapes of {path.name}",
            licence=_licence(path),
            notes=tuple(notes),
        ),
        facts,
    )


def write_obj_folder(model: LinearModel, path: Path) -> Sequence[str]:
    """Write a new folder, in mm, see `ModelFormat.write`."""
    mm = model.mm or 1.0
    mean_mm = model.mean * mm
    files = {f"{_ICT}.obj": write_obj(Mesh(mean_mm, model.faces))}
    notes = ["Each shape is the mean and one standard deviation of a mode, in mm."]
    for word, block in (("identity", model.shape), ("expression", model.expression)):
        if block is None:
            continue
        names = block.names if word == "expression" and _are_file_names(block.names) else ()
        for number, step in enumerate(block.moved.T):
            name = names[number] if names else f"{word}{number:03d}"
            files[f"{name}.obj"] = write_obj(Mesh(mean_mm + step.reshape(-1, 3) * mm, model.faces))
    files[_FACTS] = json.dumps(facts_of(model), indent=1).encode()
    write_folder(path, files)
    return notes


def _files(folder: Path) -> tuple[Path | None, list[Path]]:
    """Return the neutral mesh, if there is exactly one, and the other OBJ files, sorted."""
    if not folder.is_dir():
        return None, []
    obj_files = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".obj" and not p.name.startswith("."))
    neutral = [p for p in obj_files if p.stem.lower() in _NEUTRALS]
    if len(neutral) != 1:
        return None, obj_files
    return neutral[0], [p for p in obj_files if p != neutral[0]]


def _counts(path: Path) -> tuple[int, int]:
    """Return approximate numbers of vertices and faces of an OBJ file, without parsing it."""
    content = b"\n" + read_bytes(path, _PROBED_BYTES)
    return content.count(b"\nv "), content.count(b"\nf ")


def _licence(folder: Path) -> str:
    file = next((folder / name for name in _LICENCES if (folder / name).is_file()), None)
    if file is None:
        return ""
    lines = read_bytes(file, _MOST_LICENCE_BYTES).decode(errors="replace").split("\n")
    return next((line.strip() for line in lines if line.strip()), "")


def _are_file_names(names: Sequence[str]) -> bool:
    plain = all(re.fullmatch(r"\w[\w .-]{0,80}", name) and not IDENTITY.fullmatch(name) for name in names)
    lowered = {name.lower() for name in names}
    return bool(names) and plain and len(lowered) == len(names) and not lowered & set(_NEUTRALS)
