"""Areas, normals, boundary, samples and cotangent Laplacian of a surface, from its vertices and triangles alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import sparse

from shapespace.errors import MeshError
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh


def faces_of(mesh: Mesh) -> IntArray:
    """Return the triangles of `mesh`, (F, 3) int32.

    Raises:
        MeshError: it is a point cloud.
    """
    if mesh.faces is None:
        raise MeshError(
            f"{mesh.name} has no faces, and triangles are needed here; make a mesh of its points, as by MeshLab."
        )
    return mesh.faces


def without_vertices(vertices: FloatArray, faces: IntArray, keep: BoolArray) -> tuple[FloatArray, IntArray]:
    """Return the vertices `keep` (V,) of (V, 3) and, in their numbers, the triangles of (F, 3) between them."""
    number = np.cumsum(keep, dtype=np.int32) - 1
    return vertices[keep], number[faces[keep[faces].all(axis=1)]]


def part_of(mesh: Mesh, keep: BoolArray) -> Mesh:
    """Return a mesh or cloud with its vertices `keep` (V,) and the triangles between them; all else is unchanged."""
    faces = mesh.faces
    if faces is None:
        vertices = mesh.vertices[keep]
    else:
        vertices, faces = without_vertices(mesh.vertices, faces, keep)
    colours = None if mesh.colours is None else mesh.colours[keep]
    observed = None if mesh.observed is None else mesh.observed[keep]
    std = None if mesh.position_std is None else mesh.position_std[keep]
    return replace(mesh, vertices=vertices, faces=faces, colours=colours, observed=observed, position_std=std)


def without_estimates(mesh: Mesh) -> Mesh:
    """Return `mesh` with not-a-number at the vertices that are not observed, and no mask."""
    if mesh.observed is None:
        return mesh
    vertices = np.where(mesh.observed[:, None], mesh.vertices, np.nan)
    return replace(mesh, vertices=vertices, observed=None)


def rms_size(points: FloatArray) -> float:
    """Return the RMS distance of `points` (N, 3) from their mean."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def face_vectors(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (F, 3) cross products: normals of the triangles, as long as twice their areas."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def face_areas(mesh: Mesh) -> FloatArray:
    """Return the area of each triangle, (F,) in squared units of the vertices."""
    return 0.5 * np.linalg.norm(face_vectors(mesh.vertices, faces_of(mesh)), axis=1)


def vertex_normals(mesh: Mesh) -> FloatArray:
    """Return unit normals at the vertices, (V, 3), area-weighted; zero where no triangle gives one."""
    faces = faces_of(mesh)
    vectors = face_vectors(mesh.vertices, faces)
    flat = faces.ravel()
    normals = np.stack([np.bincount(flat, np.repeat(vectors[:, k], 3), len(mesh.vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def vertex_areas(mesh: Mesh) -> FloatArray:
    """Return the area that belongs to each vertex, (V,): a third of each triangle around it."""
    areas = np.repeat(face_areas(mesh) / 3.0, 3)
    return np.asarray(np.bincount(faces_of(mesh).ravel(), areas, len(mesh.vertices)), dtype=np.float64)


def enclosed_volume(vertices: FloatArray, faces: IntArray) -> float:
    """Return the volume that a closed surface encloses; negative if its normals point inwards."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def boundary_edges(faces: IntArray) -> IntArray:
    """Return the edges (E, 2) that belong to exactly one triangle."""
    from shapespace.geometry.topology import single_edges  # compiled

    vertices = int(faces.max()) + 1 if len(faces) else 0
    return single_edges(np.require(faces, np.int32, ["C", "W"]), vertices)


def boundary_vertices(mesh: Mesh) -> BoolArray:
    """Return (V,) True for the vertices on the rim of the surface; all False for a point cloud."""
    mask = np.zeros(len(mesh.vertices), dtype=np.bool_)
    if mesh.faces is not None:
        mask[boundary_edges(mesh.faces).ravel()] = True
    return mask


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
