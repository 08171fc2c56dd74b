"""Areas, normals, boundary, samples and cotangent Laplacian of a surface, from its vertices and triangles."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
            f"{mesh.name} has no faces, and triangles are needed; make a mesh of its points, for example with MeshLab."
        )
    return mesh.faces


def without_vertices(vertices: FloatArray, faces: IntArray, keep: BoolArray) -> tuple[FloatArray, IntArray]:
    """Return the vertices `keep` (V,) of (V, 3) and the triangles of (F, 3) between them, renumbered."""
    number = np.cumsum(keep, dtype=np.int32) - 1
    return vertices[keep], number[faces[keep[faces].all(axis=1)]]


def part_of(mesh: Mesh, keep: BoolArray) -> Mesh:
    """Return a mesh or cloud with its vertices `keep` (V,) and the triangles between them; other data are unchanged."""
    faces = mesh.faces
    if faces is None:
        vertices = mesh.vertices[keep]
    else:
        vertices, faces = without_vertices(mesh.vertices, faces, keep)
    colours = None if mesh.colours is None else mesh.colours[keep]
    observed = None if mesh.observed is None else mesh.observed[keep]
    std = None if mesh.position_std is None else mesh.position_std[keep]
    parts = None if mesh.parts is None else mesh.parts[keep]
    return replace(
        mesh, vertices=vertices, faces=faces, colours=colours, observed=observed, position_std=std, parts=parts
    )


def with_triangles(mesh: Mesh, keep: BoolArray, cause: str) -> Mesh:
    """Return `mesh` with its triangles `keep` (F,) and the vertices that they use.

    Raises:
        MeshError: no triangle is kept; the message names the `cause`.
    """
    faces = faces_of(mesh)[keep]
    if not len(faces):
        raise MeshError(f"{mesh.name}: {cause} leaves no triangle; give a scan with a larger part of the surface.")
    used, numbered = np.unique(faces, return_inverse=True)
    kept = part_of(mesh, np.isin(np.arange(len(mesh.vertices)), used))
    return replace(kept, faces=numbered.reshape(-1, 3).astype(np.int32))


def without_estimates(mesh: Mesh) -> Mesh:
    """Return `mesh` with not-a-number at the vertices that are not observed, and without a mask."""
    if mesh.observed is None:
        return mesh
    vertices = np.where(mesh.observed[:, None], mesh.vertices, np.nan)
    return replace(mesh, vertices=vertices, observed=None)


def observed_mask(vertices: FloatArray) -> BoolArray:
    """Return the mask (V,) of `vertices` (V, 3) that are not missing."""
    return np.isfinite(vertices.sum(axis=1))


def drawable(mesh: Mesh, values: FloatArray | None = None) -> tuple[Mesh, FloatArray | None]:
    """Return `mesh` without missing vertices, and the `values` (V,) of the remaining ones."""
    is_observed = observed_mask(mesh.vertices)
    if is_observed.all():
        return mesh, values
    vertices, faces = without_vertices(mesh.vertices, faces_of(mesh), is_observed)
    return Mesh(vertices, faces, name=mesh.name), None if values is None else values[is_observed]


def rms_size(points: FloatArray) -> float:
    """Return the RMS distance of `points` (N, 3) from their mean."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def face_vectors(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return cross products (F, 3): normals of the triangles, with twice the area as length."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.cross(b - a, c - a)


def face_areas(mesh: Mesh) -> FloatArray:
    """Return the area of each triangle, (F,) in squared units of the vertices."""
    return 0.5 * np.linalg.norm(face_vectors(mesh.vertices, faces_of(mesh)), axis=1)


def vertex_normals(mesh: Mesh) -> FloatArray:
    """Return unit normals at the vertices, (V, 3), area-weighted; zero at vertices without a triangle."""
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
"""Smallest area of a vertex, as a share of the median area: slivers would be infinitely stiff."""
COTANGENTS = (0.02, 50.0)
"""Limits of the weights: obtuse triangles have negative weights, and slivers very large ones."""


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
    """Return the area (V,) of each vertex, with a lower limit for slivers."""
    area = vertex_areas(mesh)
    return np.maximum(area, WELL_SHAPED * np.median(area[np.unique(faces_of(mesh))]))


def half_cotangents(
    x: FloatArray, i: npt.NDArray[np.int64], j: npt.NDArray[np.int64], o: npt.NDArray[np.int64]
) -> FloatArray:
    """Return half the cotangent of the angle at the corners `o` (F,), opposite the edges from `i` to `j`."""
    u, v = x[i] - x[o], x[j] - x[o]
    sine = np.linalg.norm(np.cross(u, v), axis=1)
    return 0.5 * np.clip(np.einsum("fd,fd->f", u, v) / np.maximum(sine, 1e-12), *COTANGENTS)


@dataclass(frozen=True, eq=False)
class Distortion:
    """Distortion of a surface relative to a reference surface with the same triangles.

    Args:
        folded: (F,) mask of the triangles whose normal opposes those around them, unlike on the reference surface.
        growth: (F,) natural logarithm of the ratio of the area to that on the reference surface, less its median;
            not-a-number if either area is 0.
    """

    folded: BoolArray
    growth: FloatArray

    @staticmethod
    def of(surface: Mesh, rest: Mesh) -> Distortion:
        """Return the distortion of the triangles of `rest` on `surface`, whose missing vertices are not-a-number.

        Raises:
            MeshError: there are no triangles.
        """
        faces = faces_of(surface)
        now, before = face_vectors(surface.vertices, faces), face_vectors(rest.vertices, faces)
        areas = np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1)
        known = np.isfinite(areas[0]) & (areas[0] > 0) & (areas[1] > 0)
        growth = np.full(len(faces), np.nan)
        growth[known] = np.log(areas[0][known] / areas[1][known])
        if known.any():
            growth -= np.median(growth[known])
        vertices = len(surface.vertices)
        return Distortion(_find_opposing(now, faces, vertices) & ~_find_opposing(before, faces, vertices), growth)

    @property
    def folded_share(self) -> float:
        """Share of folded triangles among those that are not missing; 0 if all are missing."""
        known = np.isfinite(self.growth)
        return float(self.folded[known].mean()) if known.any() else 0.0

    @property
    def area_factor(self) -> float:
        """Largest factor of growth or shrinkage of 95 % of the triangles, without the change of size."""
        known = self.growth[np.isfinite(self.growth)]
        return float(np.exp(np.quantile(np.abs(known), 0.95))) if len(known) else float("nan")


def edge_stretch(vertices: FloatArray, rest: Mesh) -> float:
    """Return the RMS log ratio of the edges of a surface `vertices` (V, 3) and of `rest`, without the change of size.

    It is 0 if the surface is only bent. Edges whose length is 0 on either surface are ignored.
    """
    faces = faces_of(rest)
    first, second = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    now: FloatArray = np.linalg.norm(vertices[first] - vertices[second], axis=1)
    before: FloatArray = np.linalg.norm(rest.vertices[first] - rest.vertices[second], axis=1)
    known = (now > 0) & (before > 0)
    logs = np.asarray(np.log(now[known] / before[known]), dtype=np.float64)
    return float(np.sqrt(np.mean((logs - np.median(logs)) ** 2))) if len(logs) else 0.0


def _find_opposing(vectors: FloatArray, faces: IntArray, vertices: int) -> BoolArray:
    """Return (F,) whether the normal of a triangle opposes the mean normal of all triangles that touch it."""
    there = np.where(np.isfinite(vectors), vectors, 0.0)
    flat = faces.ravel()
    sums = np.stack([np.bincount(flat, np.repeat(there[:, k], 3), vertices) for k in range(3)], axis=1)
    around = sums[faces].sum(axis=1) - 3.0 * there
    return (there * around).sum(axis=1) < 0


def flip_factor(vertices: FloatArray, change: FloatArray, faces: IntArray) -> float:
    """Return the smallest factor of `change` at which a triangle flips; infinity if none does.

    A triangle flips if its normal is at 90 degrees or more to that of the same triangle of `vertices`. Its area vector
    is quadratic in the factor, so the first root has a closed form.

    Args:
        vertices: (V, 3) positions of the surface before the change.
        change: (V, 3) displacement of each vertex for the factor 1.
        faces: (F, 3) triangles.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    u, v, w = (change[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    linear = np.cross(v - u, c - a) + np.cross(b - a, w - u)
    square = np.cross(v - u, w - u)
    q0, q1, q2 = (np.einsum("fd,fd->f", normal, vector) for vector in (normal, linear, square))
    known = (q0 > 0) & np.isfinite(q1) & np.isfinite(q2)
    q0, q1, q2 = q0[known], q1[known], q2[known]
    inside = q1**2 - 4.0 * q2 * q0
    real = inside >= 0
    # The sum with the larger absolute value avoids cancellation; its inverse gives the other root.
    half = -0.5 * (q1[real] + np.copysign(np.sqrt(inside[real]), q1[real]))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.concatenate([half / q2[real], q0[real] / half])
    ahead = roots[np.isfinite(roots) & (roots > 0)]
    return float(ahead.min()) if len(ahead) else float("inf")


def factor_to_draw(wanted: float, flips_at: float) -> float:
    """Return the largest of 1, 2, 3, 5, 10, 20, ... and 0.5, 0.3, 0.2, 0.1, ... up to `wanted` and below `flips_at`.

    Args:
        wanted: preferred factor of the change in a figure, positive.
        flips_at: factor at which the first triangle flips, from `flip_factor`.
    """
    steps = sorted(step * 10.0**power for power in range(-6, 4) for step in (1, 2, 3, 5))
    return max((step for step in steps if step <= wanted * (1 + 1e-9) and step < flips_at), default=steps[0])
