"""The outer surface of a scan: its triangles that are visible from outside, by depth maps from many directions.

Surfaces of CT scans also contain marrow cavities, trabeculae and canals, which may be connected to the outer surface.
The criterion is therefore the exposure of a triangle: the share of all directions from which it is visible.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from shapespace.compiled import compiled
from shapespace.geometry.normals import face_vectors, faces_of, with_triangles
from shapespace.geometry.remesh import LongArray
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

_AXES, _PIXELS = 64, 768
"""Axes along which depth maps are made, each seen from both ends, and their width: 0.3 mm of 200 mm."""
_FEW_AXES, _FEW_PIXELS = 16, 256  # for the decision whether there are inner surfaces
_EXPOSED = 0.05
"""Exposure of outer triangles: a convex surface has 0.4, the bottom of an orbit about 0.1, and the wall of a canal at a
depth of two radii 0.045."""
_GRAZING = 0.2  # cosine to the direction below which a triangle is not tested, since its depth is uncertain
_CREASE = 0.002
"""Hidden patches on an outer surface with less than this share of the total area are creases, and are kept."""
_SPECK = 0.01
"""Visible patches amid hidden triangles with less than this share of the outer area are seen through an opening."""


def outer_surface(mesh: Mesh) -> Mesh:
    """Return `mesh` without the triangles that are hardly visible from outside; a point cloud is returned unchanged."""
    if mesh.faces is None or not len(mesh.faces):
        return mesh
    is_outer = _without_specks(mesh, _exposure(mesh, _AXES, _PIXELS) >= _EXPOSED)
    if is_outer.all():
        return mesh
    return with_triangles(mesh, is_outer, "the outer surface")


def hidden_share(mesh: Mesh) -> float:
    """Estimate the share of the area of `mesh` that is hardly visible from outside; 0 for a point cloud."""
    if mesh.faces is None or not len(mesh.faces):
        return 0.0
    area = np.nan_to_num(_areas(mesh.vertices, mesh.faces))
    return float(area[_exposure(mesh, _FEW_AXES, _FEW_PIXELS) < _EXPOSED].sum() / max(area.sum(), 1e-300))


def _areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    return 0.5 * np.linalg.norm(face_vectors(vertices, faces), axis=1)


def _exposure(mesh: Mesh, axes: int, pixels: int) -> FloatArray:
    """Return the exposure (F,) of each triangle; 1 for triangles with coordinates that are not finite."""
    faces = faces_of(mesh)
    is_finite = np.asarray(np.isfinite(mesh.vertices[faces]).all(axis=(1, 2)))
    exposure = np.ones(len(faces))
    faces = faces[is_finite]
    if not len(faces):
        return exposure
    x = np.array(mesh.vertices)
    used = x[np.unique(faces)]
    centre, radius = 0.5 * (used.min(axis=0) + used.max(axis=0)), 0.5 * float(np.linalg.norm(np.ptp(used, axis=0)))
    x = np.nan_to_num((x - centre) * (0.5 * (pixels - 2) / max(radius, 1e-300)), posinf=0.0, neginf=0.0)
    area, seen = _areas(x, faces), np.zeros(len(faces), np.int32)
    for frame in _frames(axes):
        _count_visible(x @ frame.T + 0.5 * pixels, faces, area, pixels, seen)
    exposure[is_finite] = seen / (2.0 * axes)
    return exposure


def _frames(count: int) -> FloatArray:
    """Return rotations (N, 3, 3) whose last axes are evenly distributed over a half of the sphere."""
    k = np.arange(count) + 0.5
    height, angle = 1.0 - k / count, np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - height**2)
    axis = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    across = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(count)])
    return np.stack([across, np.cross(axis, across), axis], axis=1)


@compiled
def _count_visible(x: FloatArray, faces: IntArray, area: FloatArray, pixels: int, seen: IntArray) -> None:
    """Add to `seen` (F,) the number of ends of the third axis from which the centroid of each triangle is visible.

    Args:
        x: (V, 3) vertices in pixels, with the third coordinate along the view.
        faces: (F, 3) triangles.
        area: (F,) areas of the triangles, square pixels.
        pixels: width of the depth maps.
        seen: (F,) counts, changed in place.
    """
    near = np.full((pixels, pixels), np.inf)
    far = np.full((pixels, pixels), -np.inf)
    for f in range(len(faces)):
        a, b, c = x[faces[f, 0]], x[faces[f, 1]], x[faces[f, 2]]
        double = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(double) < 1e-9:
            continue
        for i in range(int(min(a[0], b[0], c[0])), int(max(a[0], b[0], c[0])) + 1):
            for j in range(int(min(a[1], b[1], c[1])), int(max(a[1], b[1], c[1])) + 1):
                u = ((b[0] - i - 0.5) * (c[1] - j - 0.5) - (b[1] - j - 0.5) * (c[0] - i - 0.5)) / double
                v = ((c[0] - i - 0.5) * (a[1] - j - 0.5) - (c[1] - j - 0.5) * (a[0] - i - 0.5)) / double
                if u >= -1e-9 and v >= -1e-9 and u + v <= 1.0 + 1e-9:
                    depth = u * a[2] + v * b[2] + (1.0 - u - v) * c[2]
                    near[i, j] = min(near[i, j], depth)
                    far[i, j] = max(far[i, j], depth)
    for f in range(len(faces)):
        a, b, c = x[faces[f, 0]], x[faces[f, 1]], x[faces[f, 2]]
        double = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(double) < 2.0 * _GRAZING * area[f] or double == 0.0:
            continue
        i, j = int((a[0] + b[0] + c[0]) / 3.0), int((a[1] + b[1] + c[1]) / 3.0)
        # The depth of the plane of the triangle at the centre of the pixel.
        u = ((b[0] - i - 0.5) * (c[1] - j - 0.5) - (b[1] - j - 0.5) * (c[0] - i - 0.5)) / double
        v = ((c[0] - i - 0.5) * (a[1] - j - 0.5) - (c[1] - j - 0.5) * (a[0] - i - 0.5)) / double
        depth = u * a[2] + v * b[2] + (1.0 - u - v) * c[2]
        # Neighbours of a pixel are at most about one pixel nearer.
        seen[f] += int(depth <= near[i, j] + 1.0) + int(depth >= far[i, j] - 1.0)


def _without_specks(mesh: Mesh, is_outer: BoolArray) -> BoolArray:
    """Return the mask of outer triangles, with small creases and without small patches seen through an opening."""
    vertices, faces = mesh.vertices, faces_of(mesh)
    area = np.nan_to_num(_areas(vertices, faces))
    pairs = _neighbours(vertices, faces)
    patch, is_mixed = _patches(is_outer, pairs)
    share = np.bincount(patch, area)[patch] / max(float(area.sum()), 1e-300)
    is_outer = is_outer | (is_mixed[patch] & (share < _CREASE))
    patch, is_mixed = _patches(is_outer, pairs)
    share = np.bincount(patch, area)[patch] / max(float(area[is_outer].sum()), 1e-300)
    return is_outer & ~(is_mixed[patch] & (share < _SPECK))


def _neighbours(vertices: FloatArray, faces: IntArray) -> LongArray:
    """Return pairs (M, 2) of triangles that share an edge, by the positions of its ends."""
    place = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces].astype(np.int64)
    ends = np.sort(np.stack([place, place[:, [1, 2, 0]]], axis=2), axis=2).reshape(-1, 2)
    key = ends[:, 0] * (place.max() + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    return np.column_stack([order[same] // 3, order[same + 1] // 3])


def _patches(is_outer: BoolArray, pairs: LongArray) -> tuple[IntArray, BoolArray]:
    """Return the patch (F,) of connected outer or hidden triangles, and whether each patch borders on another patch."""
    alike = is_outer[pairs[:, 0]] == is_outer[pairs[:, 1]]
    ends, count = pairs[alike], len(is_outer)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    number, patch = connected_components(graph, directed=False)
    is_mixed = np.zeros(number, np.bool_)
    is_mixed[patch[pairs[~alike].ravel()]] = True
    return patch, is_mixed
