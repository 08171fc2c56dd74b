"""Decimation of surfaces and point clouds for transfer, without new points."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from shapespace.errors import MeshError
from shapespace.geometry.remesh import collapse
from shapespace.types import IntArray, Mesh

_MOST_COLLAPSED = 150_000  # triangles; larger scans are clustered on a grid first, which is faster


def decimate(scan: Mesh, largest: int) -> tuple[Mesh, npt.NDArray[np.intp]]:
    """Return `scan` with at most `largest` triangles (or points), and the indices of the remaining vertices.

    No new point is made, so what was measured at a vertex stays true of it. Of surfaces, the shortest edges are
    collapsed. Points, surfaces that branch, and very large ones, which would take long, are thinned by a cubic grid
    instead (Rossignac and Borrel 1993): of each cell the vertex nearest to the mean stays.

    Args:
        scan: any surface or points.
        largest: at least 1.

    Returns:
        The mesh, and (S',) indices into the vertices of `scan`.
    """
    if _count(scan) <= largest:
        return scan, np.arange(len(scan.vertices))
    if scan.faces is not None and len(scan.faces) <= _MOST_COLLAPSED:
        collapsed = _collapsed(scan, scan.faces, largest)
        if collapsed is not None:
            return collapsed
    cell = float(np.ptp(scan.vertices, axis=0).max()) / math.sqrt(largest)
    best: tuple[Mesh, npt.NDArray[np.intp]] | None = None
    # Of a surface, what is left goes with the inverse square of the cell, so a few steps come close to `largest`.
    for _ in range(8):
        trial = _clustered(scan, cell)
        left = _count(trial[0])
        if left <= largest and (best is None or left > _count(best[0])):
            best = trial
            if left >= 0.9 * largest:
                break
        cell *= math.sqrt(max(left, 1) / (0.95 * largest))
    while best is None:
        cell *= 2.0
        trial = _clustered(scan, cell)
        best = trial if _count(trial[0]) <= largest else None
    return best


def _collapsed(scan: Mesh, faces: IntArray, largest: int) -> tuple[Mesh, npt.NDArray[np.intp]] | None:
    """Return the surface after edge collapse and its remaining vertices; None for a non-manifold surface."""
    try:
        _, triangles, source_rows = collapse(scan.vertices, faces, largest, scan.name)
    except MeshError:
        return None
    if len(triangles) > largest:
        return None
    return Mesh(scan.vertices[source_rows], triangles.astype(np.int32), name=scan.name), source_rows


def _count(mesh: Mesh) -> int:
    return len(mesh.vertices) if mesh.faces is None else len(mesh.faces)


def _clustered(scan: Mesh, cell: float) -> tuple[Mesh, npt.NDArray[np.intp]]:
    points = scan.vertices
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    side = cells.max(axis=0) + 1
    _, group = np.unique((cells[:, 0] * side[1] + cells[:, 1]) * side[2] + cells[:, 2], return_inverse=True)
    size = np.bincount(group)
    middle = np.stack([np.bincount(group, points[:, k]) / size for k in range(3)], axis=1)
    squared_distance = ((points - middle[group]) ** 2).sum(axis=1)
    order = np.lexsort((squared_distance, group))
    first = np.r_[0, np.cumsum(size)[:-1]]
    representatives = order[first]
    if scan.faces is None:
        return Mesh(points[representatives], None, name=scan.name), representatives
    faces = group[scan.faces].astype(np.int32)
    is_whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[is_whole]
    _, unique_rows = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh(points[representatives], faces[np.sort(unique_rows)], name=scan.name), representatives
