"""Meshes in MATLAB files: a structure with `Vertices` and `Faces`, as in MeshMonk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.io.parsing import CUT_SHORT, damage_error, mesh_of
from shapespace.io.sandbox import HDF5_SIGNATURE, FileContent, SandboxError, read_matlab_sandboxed
from shapespace.types import Mesh

_HDF5_AT = 512  # MAT-file 7.3: HDF5 begins after a user block of 512 bytes
_MOST_VARIABLES = 64  # limit of the variables that are read
_SAVE = (
    "save it in MATLAB by s = struct('Vertices', T.Vertices, 'Faces', T.Faces); save('t.mat', '-struct', 's', '-v7')"
)


def read_mat_mesh(data: bytes, path: Path) -> Mesh:
    """Read the mesh of a MATLAB file of version 4 to 7: vertices in rows or columns, triangles that count from 1.

    Args:
        data: complete content of the file.
        path: path of the file, which is read by scipy in a sandboxed process.

    Raises:
        FileFormatError: it contains no such structure (for example, only MATLAB objects), is damaged, or is of version
            7.3.
        MeshError: faces that point past the end of the vertices.
    """
    if HDF5_SIGNATURE in (data[: len(HDF5_SIGNATURE)], data[_HDF5_AT : _HDF5_AT + len(HDF5_SIGNATURE)]):
        raise damage_error(path, f"it is of MATLAB 7.3; {_SAVE}")
    try:
        # The file is read twice: first the names of its variables, then their values.
        names = [name.removeprefix("/") for name in read_matlab_sandboxed(path, ()).groups]
        tree = read_matlab_sandboxed(path, names[:_MOST_VARIABLES])
    except SandboxError as error:
        raise damage_error(path, f"{error}; {CUT_SHORT}") from error
    mesh = _mesh(tree)
    if mesh is None:
        raise damage_error(path, f"it has no structure with Vertices and Faces; {_SAVE}")
    vertices, faces = (np.asarray(array, dtype=np.float64) for array in mesh)
    points = vertices if vertices.shape[1] == 3 else vertices.T
    corners = faces if faces.shape[1] == 3 else faces.T
    if points.shape[1] != 3 or corners.shape[1] != 3 or not np.isfinite(corners).all():
        raise damage_error(path, f"its Vertices have the shape {vertices.shape} and its Faces {faces.shape}; {_SAVE}")
    with np.errstate(invalid="ignore"):
        return mesh_of(points, corners.astype(np.int64) - 1, path)


def _mesh(tree: FileContent) -> tuple[npt.NDArray[Any], npt.NDArray[Any]] | None:
    """Return the vertices and faces of one structure, if there is one."""
    places: dict[str, dict[str, npt.NDArray[Any]]] = {}
    arrays: Mapping[str, npt.NDArray[Any]] = tree.arrays
    for name, array in arrays.items():
        group, _, last = name.rpartition("/")
        if array.ndim == 2:
            places.setdefault(group, {})[last.lower()] = array
    complete = (group for group in places.values() if {"vertices", "faces"} <= group.keys())
    return next(((group["vertices"], group["faces"]) for group in complete), None)
