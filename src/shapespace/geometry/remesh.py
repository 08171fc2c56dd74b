"""Finer and coarser triangles on a surface.

Only functions of libigl without known defects are used. Loop subdivision is a sparse matrix, so that a complete basis
is refined by one product.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from shapespace.errors import MeshError
from shapespace.types import FloatArray, IntArray

LongArray = npt.NDArray[np.int64]


def is_sheet(faces: npt.NDArray[np.integer]) -> bool:
    """Return whether no edge of `faces` (F, 3) occurs twice in one direction or joins a vertex to itself.

    Then at most two triangles share an edge, their orientations agree, and each has three different corners.
    """
    ends = np.asarray(faces, dtype=np.int64)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    if not len(ends) or (ends[:, 0] == ends[:, 1]).any():
        return False
    passed = np.sort(ends[:, 0] * (int(ends.max()) + 1) + ends[:, 1])
    return bool((np.diff(passed) != 0).all())


def split(vertices: FloatArray, faces: npt.NDArray[np.integer], name: str) -> tuple[FloatArray, LongArray]:
    """Return vertices and triangles of the surface with each of (F, 3) triangles split into four at the edge midpoints.

    Raises:
        MeshError: `faces` are not a sheet, see `is_sheet`; the message contains `name`.
    """
    prepared = _prepare(vertices, faces, name)
    fine, triangles = _igl().upsample(*prepared, 1)
    return np.asarray(fine, dtype=np.float64), np.asarray(triangles, dtype=np.int64)


def collapse(
    vertices: FloatArray, faces: npt.NDArray[np.integer], triangles: int, name: str
) -> tuple[FloatArray, LongArray, LongArray]:
    """Return vertices (S, 3) and about `triangles` triangles, after collapsing the shortest edges to their midpoints.

    The third result is (S,) an original vertex that was merged into each vertex. If no edge can collapse without a
    fold, more triangles remain.

    Raises:
        MeshError: `faces` are not a sheet, see `is_sheet`, or its borders touch; the message contains `name`.
    """
    prepared = _prepare(vertices, faces, name)
    coarse, left, _, origin = _igl().decimate(*prepared, triangles)
    if not len(left):
        raise MeshError(
            f"{name} cannot be re-triangulated, since its borders touch; clean the mesh in MeshLab (Cleaning) first."
        )
    return np.asarray(coarse, dtype=np.float64), np.asarray(left, dtype=np.int64), np.asarray(origin, dtype=np.int64)


def parted(faces: npt.NDArray[np.integer]) -> tuple[LongArray, LongArray]:
    """Return `faces` (F, 3) with new vertex numbers, and (W,) the original vertex of each new vertex.

    If more than two triangles share an edge, or parts of a surface touch only at a vertex, each part has its own
    vertices; other vertices are unchanged.
    """
    new, origin = _igl().split_nonmanifold(np.ascontiguousarray(faces, dtype=np.int64))
    return np.asarray(new, dtype=np.int64), np.asarray(origin, dtype=np.int64)


def onto(points: FloatArray, vertices: FloatArray, faces: npt.NDArray[np.integer]) -> FloatArray:
    """Return the points (M, 3) on a surface that are nearest to `points` (M, 3)."""
    _, _, nearest = _igl().point_mesh_squared_distance(points, *_contiguous_arrays(vertices, faces))
    return np.asarray(nearest, dtype=np.float64)


def _prepare(vertices: FloatArray, faces: npt.NDArray[np.integer], name: str) -> tuple[FloatArray, LongArray]:
    # libigl 2.6 writes beyond its arrays if an edge occurs twice in one direction.
    if not is_sheet(faces):
        raise MeshError(
            f"{name} cannot be re-triangulated: more than two triangles share an edge, or neighbours disagree on which "
            "side is outside; clean the mesh in MeshLab (Cleaning) first."
        )
    return _contiguous_arrays(vertices, faces)


def _contiguous_arrays(vertices: FloatArray, faces: npt.NDArray[np.integer]) -> tuple[FloatArray, LongArray]:
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64)


def _igl() -> Any:
    import igl  # pyright: ignore[reportMissingTypeStubs]  # half of the import time of the package

    return cast(Any, igl)


def loop_operator(vertex_count: int, faces: npt.ArrayLike) -> tuple[Any, IntArray]:
    """Return one level of Loop subdivision as a matrix, and the refined triangles.

    Old vertices keep their numbers. One new vertex for each edge follows; edges are in ascending order of their smaller
    vertex, then of their larger vertex. Boundaries and the interior follow Loop's rules with the weights of Warren for
    interior vertices:
    beta = 3 / (8 n), or 3 / 16 for n = 3. Vertices without a triangle stay where they are.

    Args:
        vertex_count: number V of vertices.
        faces: (F, 3) integer triangles; every edge belongs to one or two triangles.

    Returns:
        A scipy CSR matrix (V + E, V) float64 whose rows are non-negative and sum to one, and (4F, 3) int32.

    Raises:
        MeshError: a face points outside 0..V-1, or an edge has more than two triangles.

    Source: C. Loop, Smooth Subdivision Surfaces Based on Triangles, 1987; J. Warren, 1995, for beta.
    """
    F = np.asarray(faces, dtype=np.int64)
    if F.ndim != 2 or F.shape[1] != 3:
        raise MeshError(f"Loop subdivision needs triangles of shape (F, 3), not {F.shape}.")
    if F.size and (F.min() < 0 or F.max() >= vertex_count):
        raise MeshError(f"Loop subdivision got a face that points outside its {vertex_count} vertices.")
    n_faces = len(F)
    # Half-edge k of a triangle is opposite its corner k.
    start, end, apex = F[:, [1, 2, 0]].T.ravel(), F[:, [2, 0, 1]].T.ravel(), F.T.ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    key, edge_of, count = np.unique(low * vertex_count + high, return_inverse=True, return_counts=True)
    if len(count) and count.max() > 2:
        raise MeshError("Loop subdivision needs a manifold surface, but an edge has more than two triangles.")
    edges = np.column_stack([key // max(vertex_count, 1), key % max(vertex_count, 1)])
    n_edges = len(edges)
    is_boundary = count == 1

    edge_ids = np.arange(n_edges)
    end_weight = np.where(is_boundary, 0.5, 0.375)
    inner_half = ~is_boundary[edge_of]
    rows = [edge_ids, edge_ids, edge_of[inner_half]]
    cols = [edges[:, 0], edges[:, 1], apex[inner_half]]
    data = [end_weight, end_weight, np.full(int(inner_half.sum()), 0.125)]
    rows = [vertex_count + r for r in rows]

    on_boundary = np.zeros(vertex_count, dtype=bool)
    on_boundary[edges[is_boundary].ravel()] = True
    valence = np.bincount(edges.ravel(), minlength=vertex_count)
    beta = np.where(valence == 3, 3 / 16, 3 / (8 * np.maximum(valence, 1)))
    boundary_valence = np.bincount(edges[is_boundary].ravel(), minlength=vertex_count)
    beta[on_boundary] = (0.25 / np.maximum(boundary_valence, 1))[on_boundary]
    half_edges = np.concatenate([edges, edges[:, ::-1]])
    both_boundary = np.concatenate([is_boundary, is_boundary])
    # A boundary vertex depends on its boundary neighbours only, so that two patches meet along a shared rim.
    used = ~on_boundary[half_edges[:, 0]] | both_boundary
    rows.append(half_edges[used, 0])
    cols.append(half_edges[used, 1])
    data.append(beta[half_edges[used, 0]])
    own_weight = np.ones(vertex_count) - np.bincount(
        half_edges[used, 0], beta[half_edges[used, 0]], minlength=vertex_count
    )
    rows.append(np.arange(vertex_count))
    cols.append(np.arange(vertex_count))
    data.append(own_weight)

    shape = (vertex_count + n_edges, vertex_count)
    triplets = (np.concatenate(data), (np.concatenate(rows), np.concatenate(cols)))
    operator = cast(Any, sp.csr_matrix)(triplets, shape=shape)
    m0, m1, m2 = (vertex_count + edge_of).reshape(3, n_faces)
    a, b, c = F.T
    refined = np.stack(
        [
            np.column_stack([a, m2, m1]),
            np.column_stack([b, m0, m2]),
            np.column_stack([c, m1, m0]),
            np.column_stack([m0, m1, m2]),
        ],
        axis=1,
    ).reshape(-1, 3)
    return operator, refined.astype(np.int32)
