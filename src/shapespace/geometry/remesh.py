"""Finer and coarser triangles on a surface, by libigl, which is asked only what it answers without fault."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import MeshError
from shapespace.types import FloatArray

LongArray = npt.NDArray[np.int64]


def is_sheet(faces: npt.NDArray[np.integer]) -> bool:
    """Whether no edge of `faces` (F, 3) is passed twice in one direction, and none leads back to its own vertex.

    So at most two triangles share an edge, they agree on the side that is outside, and each has three corners.
    """
    ends = np.asarray(faces, dtype=np.int64)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    if not len(ends) or (ends[:, 0] == ends[:, 1]).any():
        return False
    passed = np.sort(ends[:, 0] * (int(ends.max()) + 1) + ends[:, 1])
    return bool((np.diff(passed) != 0).all())


def split(vertices: FloatArray, faces: npt.NDArray[np.integer], name: str) -> tuple[FloatArray, LongArray]:
    """Return vertices and triangles of the surface with each of (F, 3) triangles parted into four at mid-edge.

    Raises:
        MeshError: `faces` are no sheet, as `is_sheet` has it; `name` says whose.
    """
    asked = _asked(vertices, faces, name)
    fine, triangles = _igl().upsample(*asked, 1)
    return np.asarray(fine, dtype=np.float64), np.asarray(triangles, dtype=np.int64)


def collapse(
    vertices: FloatArray, faces: npt.NDArray[np.integer], triangles: int, name: str
) -> tuple[FloatArray, LongArray, LongArray]:
    """Return vertices (S, 3) and about `triangles`, the shortest edges collapsed, each to its middle.

    Also returned is (S,) a vertex of the surface from which each is made. Where no edge can collapse without a fold,
    more triangles are left.

    Raises:
        MeshError: `faces` are no sheet, as `is_sheet` has it, or borders of it touch; `name` says whose.
    """
    asked = _asked(vertices, faces, name)
    coarse, left, _, origin = _igl().decimate(*asked, triangles)
    if not len(left):
        raise MeshError(
            f"{name} cannot be re-triangulated, since borders of it touch; clean the mesh in MeshLab (Cleaning) first."
        )
    return np.asarray(coarse, dtype=np.float64), np.asarray(left, dtype=np.int64), np.asarray(origin, dtype=np.int64)


def parted(faces: npt.NDArray[np.integer]) -> tuple[LongArray, LongArray]:
    """Return `faces` (F, 3) in numbers of new vertices, and (W,) which vertex each of those is.

    Where more than two triangles share an edge, or parts of a surface touch at a vertex alone, each part has its own
    vertices; nothing else changes.
    """
    new, origin = _igl().split_nonmanifold(np.ascontiguousarray(faces, dtype=np.int64))
    return np.asarray(new, dtype=np.int64), np.asarray(origin, dtype=np.int64)


def onto(points: FloatArray, vertices: FloatArray, faces: npt.NDArray[np.integer]) -> FloatArray:
    """Return the points (M, 3) of a surface nearest to `points` (M, 3)."""
    _, _, nearest = _igl().point_mesh_squared_distance(points, *_plain(vertices, faces))
    return np.asarray(nearest, dtype=np.float64)


def _asked(vertices: FloatArray, faces: npt.NDArray[np.integer], name: str) -> tuple[FloatArray, LongArray]:
    # libigl 2.6 writes beyond its tables where an edge is passed twice in one direction.
    if not is_sheet(faces):
        raise MeshError(
            f"{name} cannot be re-triangulated: more than two triangles share an edge, or neighbours disagree on which "
            "side is outside; clean the mesh in MeshLab (Cleaning) first."
        )
    return _plain(vertices, faces)


def _plain(vertices: FloatArray, faces: npt.NDArray[np.integer]) -> tuple[FloatArray, LongArray]:
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64)


def _igl() -> Any:
    import igl  # pyright: ignore[reportMissingTypeStubs]  # half of the import time of the package

    return cast(Any, igl)
