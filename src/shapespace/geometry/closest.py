"""Closest points on a surface or among its vertices, behind one contract.

An engine is built once a surface and then asked many times. `ENGINES` at the end is the one place where a new one
is added; `tests/contracts/test_closest_contract.py` checks each against brute force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
from scipy.spatial import cKDTree

from shapespace.errors import InputError, MeshError
from shapespace.geometry.surface import faces_of
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The answers to M queries.

    Args:
        points: (M, 3) closest points, in the frame of the surface.
        distance: (M,) to them.
        triangle: (M,) int32 triangle they lie in, or None when vertices were searched.
        barycentric: (M, 3) weights of that triangle's corners; None when vertices were searched.
        vertex: (M,) int32 nearest vertex, or when triangles were searched, the corner with the largest weight.
    """

    points: FloatArray
    distance: FloatArray
    triangle: IntArray | None
    barycentric: FloatArray | None
    vertex: IntArray

    @property
    def rms(self) -> float:
        """Root of the mean squared distance."""
        return float(np.sqrt((self.distance**2).mean()))


class ClosestPointEngine(Protocol):
    """Built once a surface by `Engine(mesh)`; answers are float64 and exact."""

    def query(self, points: FloatArray) -> ClosestPoints:
        """Return the closest points of `points` (M, 3)."""
        ...


def _checked(points: FloatArray) -> FloatArray:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"Closest-point queries must have the shape (M, 3), not {points.shape}.")
    if not np.isfinite(points).all():
        raise InputError("Closest-point queries must be finite; the pose or shape that made them has diverged.")
    return np.ascontiguousarray(points)


class VertexEngine:
    """Nearest vertex, by SciPy's kd-tree; works for point clouds too."""

    def __init__(self, mesh: Mesh) -> None:
        if len(mesh.vertices) == 0 or not np.isfinite(mesh.vertices).all():
            raise MeshError(f"{mesh.name}: its vertices are missing or not finite, so it cannot be searched.")
        self._vertices = mesh.vertices
        self._tree = cKDTree(mesh.vertices)

    def query(self, points: FloatArray) -> ClosestPoints:
        """Return the nearest vertex of each of `points` (M, 3)."""
        distance, index = self._tree.query(_checked(points), workers=-1)
        vertex = np.asarray(index, dtype=np.int32)
        return ClosestPoints(self._vertices[vertex], np.asarray(distance), None, None, vertex)


class SurfaceEngine:
    """Closest point on the triangles themselves, by libigl's bounding-box tree."""

    def __init__(self, mesh: Mesh) -> None:
        import igl  # pyright: ignore[reportMissingTypeStubs]  # half of the import time of the package

        self._vertices = np.array(mesh.vertices)
        faces = faces_of(mesh)
        if not np.isfinite(self._vertices).all():
            raise MeshError(f"{mesh.name}: its vertices are not finite, so it cannot be searched.")
        self._faces = faces.astype(np.int64)
        self._tree = cast(Any, igl).AABB()
        self._tree.init(self._vertices, self._faces)

    def query(self, points: FloatArray) -> ClosestPoints:
        """Return the closest surface point of each of `points` (M, 3)."""
        asked = _checked(points)
        squared, index, closest = self._tree.squared_distance(self._vertices, self._faces, asked)
        triangle = cast(FloatArray, index).reshape(-1).astype(np.int32)
        points_on = cast(FloatArray, closest).reshape(-1, 3)
        barycentric = barycentric_coordinates(points_on, *(self._vertices[self._faces[triangle, k]] for k in range(3)))
        vertex = self._faces[triangle, barycentric.argmax(axis=1)].astype(np.int32)
        distance = np.sqrt(cast(FloatArray, squared).reshape(-1))
        return ClosestPoints(points_on, distance, triangle, barycentric, vertex)


def barycentric_coordinates(points: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return (M, 3) weights of the corners `a`, `b`, `c` (M, 3) that give `points` in their triangles.

    In a triangle without area the two ends of its longest edge carry the point.
    """
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    determinant = d00 * d11 - d01 * d01
    flat = determinant <= 1e-14 * d00 * d11
    safe = np.where(flat, 1.0, determinant)
    v, w = (d11 * d20 - d01 * d21) / safe, (d00 * d21 - d01 * d20) / safe
    weights = np.clip(np.stack([1 - v - w, v, w], axis=1), 0.0, 1.0)
    if flat.any():
        weights[flat] = _on_longest_edge(points[flat], np.stack([a[flat], b[flat], c[flat]], axis=1))
    return weights / weights.sum(axis=1, keepdims=True)


def _on_longest_edge(points: FloatArray, corners: FloatArray) -> FloatArray:
    ends = np.roll(corners, -1, axis=1)
    squared = ((ends - corners) ** 2).sum(2)
    start, row = squared.argmax(1), np.arange(len(points))
    edge, length = (ends - corners)[row, start], squared[row, start]
    along = ((points - corners[row, start]) * edge).sum(1)
    t = np.clip(np.divide(along, length, out=np.zeros_like(along), where=length > 0), 0.0, 1.0)
    weights = np.zeros((len(points), 3))
    weights[row, start], weights[row, (start + 1) % 3] = 1 - t, t
    return weights


def on_boundary(matches: ClosestPoints, mesh: Mesh, boundary: BoolArray) -> BoolArray:
    """Return (M,) True where a match lies on the rim of `mesh`.

    Args:
        matches: closest points on `mesh`.
        mesh: the surface that was searched.
        boundary: (V,) its rim vertices.
    """
    if matches.triangle is None or matches.barycentric is None:
        return boundary[matches.vertex]
    corners = boundary[faces_of(mesh)[matches.triangle]]
    # A point is on the rim when the corners that carry it all are.
    inside = ~corners & (matches.barycentric > 1e-9)
    return np.asarray(~inside.any(axis=1))


ENGINES: Mapping[str, Callable[[Mesh], ClosestPointEngine]] = {
    "vertices": VertexEngine,
    "surface": SurfaceEngine,
}
"""Search engines by name; add one here and the contract test and `fit` find it."""


def finest_engine(mesh: Mesh) -> str:
    """Return the name of the engine for the surface itself: its triangles where there are some, else its vertices."""
    return "vertices" if mesh.faces is None else "surface"


def build_engine(mesh: Mesh, engine: str = "auto") -> ClosestPointEngine:
    """Return the search structure of `mesh`: `auto` takes its `finest_engine`.

    Raises:
        InputError: no engine of that name.
    """
    name = finest_engine(mesh) if engine == "auto" else engine
    if name not in ENGINES:
        raise InputError(f"There is no closest-point engine {name!r}; choose one of {', '.join(ENGINES)}.")
    return ENGINES[name](mesh)
