"""FLAME and the SMPL family: a template and blend shapes in metres, as `.npz` or as a pickle."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import LinearModel, Modes
from shapespace.io.containers.archives import read_arrays
from shapespace.io.containers.json_files import check_file
from shapespace.io.sandbox import SandboxError, read_pickle_sandboxed

_AGAIN = "give the file as it was downloaded"
_LARGEST_BYTES = 2**30  # 1 GiB
_MM = 1000.0  # FLAME is in metres
_KEYS: Final = {"template": ("v_template", "default_v"), "modes": ("shapedirs",), "faces": ("f", "faces")}
_JOINTS = ("weights", "J", "joints")
_FAMILY: Final = {5: "FLAME", 16: "MANO", 24: "SMPL", 52: "SMPL+H", 55: "SMPL-X"}
"""By their number of joints."""
_BY_VERTICES: Final = {5023: "FLAME", 778: "MANO", 6890: "SMPL", 10475: "SMPL-X"}
_WITH_EXPRESSION = ("FLAME", "SMPL-X")
_IDENTITY: Final = {150: 100, 20: 10}
"""Modes of identity among so many, the others being of expression; of more than `_MOST_IDENTITY` the first."""
_MOST_IDENTITY = 300  # FLAME: shapedirs has 300 identity modes before the expression modes


def is_flame(path: Path, head: bytes) -> bool:
    """Whether it is named as a pickle, or an .npz with a template and its modes in it."""
    if path.suffix.lower() == ".pkl":
        return True
    return path.suffix.lower() == ".npz" and head.startswith(b"PK") and _has_template(path)


def read_flame(path: Path) -> LinearModel:
    """Read FLAME, SMPL, SMPL+H, SMPL-X or MANO, without the poses."""
    check_file(path, _LARGEST_BYTES, _AGAIN)
    array_names = [name for names in (*_KEYS.values(), _JOINTS) for name in names]
    if path.suffix.lower() == ".npz":
        arrays: Mapping[str, npt.NDArray[Any]] = read_arrays(path, _AGAIN, array_names)
    else:
        arrays = _unpickled(path, array_names)
    members = {role: next((arrays[name] for name in names if name in arrays), None) for role, names in _KEYS.items()}
    template, modes, faces = (members[role] for role in _KEYS)
    if template is None or modes is None:
        raise ModelFileError(f"{path} holds no v_template and shapedirs, as models of the SMPL family do; {_AGAIN}.")
    n = len(template) if template.ndim == 2 else 0
    if not n or template.shape[1] != 3 or modes.shape[:2] != template.shape or modes.ndim != 3:
        raise ModelFileError(
            f"{path} is damaged: its template and modes have the shapes {template.shape} and {modes.shape}; {_AGAIN}."
        )
    if any(array.dtype.kind not in "iuf" for array in (template, modes, *([] if faces is None else [faces]))):
        raise ModelFileError(f"{path} is damaged: its arrays are not of numbers; {_AGAIN}.")
    family = _family(arrays, n)
    displacements = np.asarray(modes, dtype=np.float64).reshape(3 * n, -1)
    n_identity = None
    if family in (*_WITH_EXPRESSION, ""):
        n_modes = displacements.shape[1]
        n_identity = _MOST_IDENTITY if n_modes > _MOST_IDENTITY else _IDENTITY.get(n_modes)
    return LinearModel(
        mean=np.asarray(template, dtype=np.float64),
        shape=Modes(displacements[:, :n_identity]),
        expression=None if n_identity is None else Modes(displacements[:, n_identity:]),
        faces=None if faces is None else faces.astype(np.int32),
        mm=_MM,
        provenance=f"{family or 'SMPL family'} model {path.name}",
        licence=f"{family or 'SMPL family'}: non-commercial research only, unless its own licence allows more",
        notes=(
            "Its pose rig (joints, skinning weights, corrections by pose) is left out; the pose is the template's.",
        ),
    )


def _family(arrays: Mapping[str, npt.NDArray[Any]], n: int) -> str:
    for name in _JOINTS:
        if name in arrays and arrays[name].ndim == 2:
            count = arrays[name].shape[1 if name == "weights" else 0]
            if count in _FAMILY:
                return _FAMILY[count]
    return _BY_VERTICES.get(n, "")


def _has_template(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return {"v_template.npy", "shapedirs.npy"} <= set(archive.namelist())
    except Exception:  # a damaged archive may raise anything at all
        return False


def _unpickled(path: Path, array_names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    try:
        arrays = read_pickle_sandboxed(path, array_names).arrays
    except SandboxError as error:
        raise ModelFileError(f"{path} is not read: {error}; {_AGAIN}.") from error
    return {name.removeprefix("/"): array for name, array in arrays.items()}
