"""Published models of faces and bodies: FLAME and the SMPL family, and models in MATLAB files.

FLAME and SMPL have a template and blend shapes in metres, as `.npz` or as a pickle. The Basel Face Model of 2009, LSFM
and LYHM are in `.mat` files, also of version 7.3 (HDF5).
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import LinearModel, Modes, are_measurable, scale_columns
from shapespace.io.containers.archives import read_arrays
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import open_file
from shapespace.io.sandbox import (
    HDF5_SIGNATURE,
    FileContent,
    SandboxError,
    read_hdf5_sandboxed,
    read_matlab_sandboxed,
    read_pickle_sandboxed,
)

_AGAIN = "give the original downloaded file"
_LARGEST_BYTES = 2**30  # 1 GiB
_MM = 1000.0  # FLAME is in metres
_KEYS: Final = {"template": ("v_template", "default_v"), "modes": ("shapedirs",), "faces": ("f", "faces")}
_JOINTS = ("weights", "J", "joints")
_FAMILY: Final = {5: "FLAME", 16: "MANO", 24: "SMPL", 52: "SMPL+H", 55: "SMPL-X"}
"""Number of joints -> name of the model."""
_BY_VERTICES: Final = {5023: "FLAME", 778: "MANO", 6890: "SMPL", 10475: "SMPL-X"}
_WITH_EXPRESSION = ("FLAME", "SMPL-X")
_IDENTITY: Final = {150: 100, 20: 10}
"""Number of modes -> number of identity modes among them; the others are expression modes. A model with more than
`_MOST_IDENTITY` modes begins with that many identity modes."""
_MOST_IDENTITY = 300  # FLAME: shapedirs has 300 identity modes before the expression modes
_LARGEST_MAT_BYTES = 2**31  # 2 GiB
_HDF5_AT = 512  # MAT-file 7.3: HDF5 begins after a user block of 512 bytes


@dataclass(frozen=True)
class _Layout:
    """Variable names of a file format, and their meaning.

    Args:
        title: name of the model, for provenance.
        licence: licence of the model.
        mean, basis, spread, faces: paths of the variables in the file.
        is_stddev: whether `spread` contains standard deviations; False for variances.
        is_clockwise: whether triangles are clockwise seen from outside.
        first_vertex: number of the first vertex in `faces`.
        mm: length of the unit of the file, mm, or None if unknown.
        n_training: number of training shapes, or its path in the file; None if unknown.
        textured: path of the colour model in the file.
    """

    title: str
    licence: str
    mean: str
    basis: str
    spread: str
    faces: str
    is_stddev: bool = False
    is_clockwise: bool = True
    first_vertex: int = 1
    mm: float | None = None
    n_training: int | str | None = None
    textured: str = ""


_LAYOUTS: Final = (
    _Layout(
        "Basel Face Model 2009", "Basel Face Model 2009: non-commercial research only, see its licence",
        "/shapeMU", "/shapePC", "/shapeEV", "/tl", is_stddev=True, mm=1e-3, n_training=200, textured="/texMU",
    ),
    _Layout(
        "LYHM", "Liverpool-York Head Model: for research only, see its licence",
        "/shp/mu", "/shp/eigVec", "/shp/eigVal", "/tri/faces", textured="/tex",
    ),
    _Layout(
        "LSFM", "Large Scale Facial Model: non-commercial research only, see its licence",
        "/mean", "/components", "/eigenvalues", "/trilist", is_clockwise=False, first_vertex=0,
        n_training="/n_training_samples",
    ),
)  # fmt: skip
_WANTED = ("shapeMU", "shapePC", "shapeEV", "tl", "shp", "tri", "mean", "components", "eigenvalues",
           "trilist", "n_training_samples")  # fmt: skip


def is_flame(path: Path, head: bytes) -> bool:
    """Return whether a file has the name of a pickle, or is an .npz with a template and its modes."""
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
        arrays = _read_pickle(path, array_names)
    members = {role: next((arrays[name] for name in names if name in arrays), None) for role, names in _KEYS.items()}
    template, modes, faces = (members[role] for role in _KEYS)
    if template is None or modes is None:
        raise ModelFileError(
            f"{path} contains no v_template and shapedirs, unlike models of the SMPL family; {_AGAIN}."
        )
    n = len(template) if template.ndim == 2 else 0
    if not n or template.shape[1] != 3 or modes.shape[:2] != template.shape or modes.ndim != 3:
        raise ModelFileError(
            f"{path} is damaged: its template and modes have the shapes {template.shape} and {modes.shape}; {_AGAIN}."
        )
    if any(array.dtype.kind not in "iuf" for array in (template, modes, *([] if faces is None else [faces]))):
        raise ModelFileError(f"{path} is damaged: its arrays do not contain numbers; {_AGAIN}.")
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
            "Its pose rig (joints, skinning weights, pose corrections) is omitted; the pose is that of the template.",
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
    except Exception:  # a damaged archive may raise any exception
        return False


def _read_pickle(path: Path, array_names: Sequence[str]) -> dict[str, npt.NDArray[Any]]:
    try:
        arrays = read_pickle_sandboxed(path, array_names).arrays
    except SandboxError as error:
        raise ModelFileError(f"{path} cannot be read: {error}; {_AGAIN}.") from error
    return {name.removeprefix("/"): array for name, array in arrays.items()}


def is_matlab(path: Path, head: bytes) -> bool:
    """Return whether a file has the ending of a MATLAB file."""
    return path.suffix.lower() == ".mat" and bool(head)


def read_matlab(path: Path) -> LinearModel:
    """Read a `.mat` file of a face model."""
    check_file(path, _LARGEST_MAT_BYTES, _AGAIN)
    try:
        tree = _matlab_tree(path)
        layout = next(
            (
                candidate
                for candidate in _LAYOUTS
                if {candidate.mean, candidate.basis, candidate.spread} <= tree.arrays.keys()
            ),
            None,
        )
        if layout is None:
            known = ", ".join(candidate.title for candidate in _LAYOUTS)
            raise ModelFileError(f"{path} contains no supported shape model ({known}).")
        return _matlab_model(tree, layout)
    except SandboxError as error:
        raise ModelFileError(f"{path} is damaged or cut short: {error}; {_AGAIN}.") from error


def _matlab_tree(path: Path) -> FileContent:
    with open_file(path) as stream:
        head = stream.read(_HDF5_AT + len(HDF5_SIGNATURE))
    if not (head.startswith(HDF5_SIGNATURE) or head[_HDF5_AT:] == HDF5_SIGNATURE):
        return read_matlab_sandboxed(path, _WANTED)
    tree = read_hdf5_sandboxed(
        path, leave=("/texMU", "/texPC", "/tex", "/segbin", "/segbb", "/segMM", "/segMB", "/#refs#")
    )
    # MATLAB stores arrays with the last axis first.
    return FileContent({name: array.T for name, array in tree.arrays.items()}, groups=tree.groups)


def _matlab_model(tree: FileContent, layout: _Layout) -> LinearModel:
    mean, basis, spread = (
        np.asarray(tree.arrays[name], dtype=np.float64) for name in (layout.mean, layout.basis, layout.spread)
    )
    mean, spread = mean.ravel(), spread.ravel()
    if basis.shape == (len(spread), len(mean)) != (len(mean), len(spread)):
        basis = basis.T
    if not all(map(are_measurable, (mean, basis, spread))) or not (spread >= 0).all():
        raise SandboxError("its numbers are not finite, too large, or its spread is negative")
    if len(mean) % 3 or basis.shape != (len(mean), len(spread)):
        raise SandboxError(f"its mean, basis and spread have the shapes {mean.shape}, {basis.shape} and {spread.shape}")
    n_training = layout.n_training
    if isinstance(n_training, str):
        training_count = tree.arrays.get(n_training)
        n_training = (
            int(training_count.reshape(-1)[0])
            if training_count is not None and training_count.size == 1 and training_count.reshape(-1)[0] > 1
            else None
        )
    return LinearModel(
        mean=mean.reshape(-1, 3),
        shape=Modes(scale_columns(basis, spread if layout.is_stddev else np.sqrt(spread))),
        faces=_matlab_faces(tree.arrays.get(layout.faces), layout, len(mean) // 3),
        mm=layout.mm,
        n_training=n_training,
        provenance=layout.title,
        licence=layout.licence,
        notes=("Its colour model is omitted.",) if layout.textured in tree.groups else (),
    )


def _matlab_faces(triangles: npt.NDArray[Any] | None, layout: _Layout, n: int) -> npt.NDArray[np.int32] | None:
    if triangles is None or not triangles.size:
        return None
    faces = triangles.T if triangles.ndim == 2 and triangles.shape[0] == 3 != triangles.shape[1] else triangles
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.isfinite(faces).all() or np.abs(faces).max() > n:
        raise SandboxError(f"its triangles have the shape {triangles.shape}, or refer to vertices that do not exist")
    # Files of menpo count from 0, other MATLAB files from 1.
    faces = faces.astype(np.int32) - (layout.first_vertex or int(faces.min() > 0 and faces.max() == n))
    return faces[:, [0, 2, 1]] if layout.is_clockwise else faces
