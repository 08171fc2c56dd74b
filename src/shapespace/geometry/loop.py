"""Loop subdivision of a triangle mesh as one sparse matrix, so that a whole basis is refined by one product."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from shapespace.errors import MeshError
from shapespace.types import IntArray


def loop_operator(vertex_count: int, faces: npt.ArrayLike) -> tuple[Any, IntArray]:
    """Return one level of Loop subdivision as a matrix, and the refined triangles.

    Old vertices keep their numbers; the midpoint of every edge follows, edges in ascending order of their two
    vertices. Boundaries and the interior follow Loop's rules with the weights of Warren for interior vertices:
    beta = 3 / (8 n), or 3 / 16 for n = 3. Vertices without a triangle stay where they are.

    Args:
        vertex_count: number V of vertices.
        faces: (F, 3) integer triangles; every edge has one or two of them.

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
    # Half-edge k of a triangle lies opposite its corner k.
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
    # A boundary vertex listens to its boundary neighbours only, so that two patches meet along a shared rim.
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
