"""The Laplacian of a surface, by cotangents."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import sparse

from shapespace.geometry.normals import faces_of, vertex_areas
from shapespace.types import FloatArray, Mesh

WELL_SHAPED = 0.05
"""Vertices own at least this share of the median area: slivers would be infinitely stiff."""
COTANGENTS = (0.02, 50.0)
"""Obtuse triangles have negative weights, and slivers huge ones; they are kept within these."""


def cotangent_laplacian(mesh: Mesh) -> tuple[Any, FloatArray]:
    """Return the positive Laplacian, sparse (V, V), and the area (V,) of each vertex (Pinkall and Polthier 1993).

    Raises:
        MeshError: `mesh` has no triangles.
    """
    x, faces, count = mesh.vertices, faces_of(mesh).astype(np.int64), len(mesh.vertices)
    corners = [(faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]) for k in range(3)]
    rows = np.concatenate([np.concatenate([i, j, i, j]) for i, j, _ in corners])
    columns = np.concatenate([np.concatenate([j, i, i, j]) for i, j, _ in corners])
    weights = [half_cotangents(x, *corner) for corner in corners]
    values = np.concatenate([np.concatenate([-half, -half, half, half]) for half in weights])
    laplacian = cast(Any, sparse).coo_array((values, (rows, columns)), shape=(count, count)).tocsr()
    return laplacian, owned_areas(mesh)


def owned_areas(mesh: Mesh) -> FloatArray:
    """Return the area (V,) of each vertex, which for slivers is taken for larger than it is."""
    area = vertex_areas(mesh)
    return np.maximum(area, WELL_SHAPED * np.median(area[np.unique(faces_of(mesh))]))


def half_cotangents(
    x: FloatArray, i: npt.NDArray[np.int64], j: npt.NDArray[np.int64], o: npt.NDArray[np.int64]
) -> FloatArray:
    """Return half the cotangent of the angle at the corners `o` (F,), opposite the edges from `i` to `j`."""
    u, v = x[i] - x[o], x[j] - x[o]
    sine = np.linalg.norm(np.cross(u, v), axis=1)
    return 0.5 * np.clip(np.einsum("fd,fd->f", u, v) / np.maximum(sine, 1e-12), *COTANGENTS)
