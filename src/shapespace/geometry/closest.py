"""Closest points on a surface or among its vertices, behind one contract.

An engine is built once a surface and then asked many times. `ENGINES` at the end is the one place where a new one
is added; `tests/contracts/test_closest_contract.py` checks each against brute force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from shapespace.errors import InputError, MeshError
from shapespace.geometry.normals import faces_of
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

if TYPE_CHECKING:
    from shapespace.geometry.kdtree import Followed


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The answers to M queries.

    Args:
        points: (M, 3) closest points, in the frame of the surface.
        distance: (M,) to them.
        triangle: (M,) int32 triangle they lie in, or None when vertices were searched.
        barycentric: (M, 3) weights of that triangle's corners; None when vertices were searched.
        vertex: (M,) int32 nearest vertex, or when triangles were searched, the corner with the largest weight.
        followed: what the engine needs to answer the next query from this one.
    """

    points: FloatArray
    distance: FloatArray
    triangle: IntArray | None
    barycentric: FloatArray | None
    vertex: IntArray
    followed: Followed | None = None

    @property
    def rms(self) -> float:
        """Root of the mean squared distance."""
        return float(np.sqrt((self.distance**2).mean()))


class ClosestPointEngine(Protocol):
    """Built once a surface by `Engine(mesh)`; answers are float64 and exact."""

    def query(self, points: FloatArray, near: ClosestPoints | None = None) -> ClosestPoints:
        """Return the closest points of `points` (M, 3).

        Args:
            points: (M, 3) in the frame of the surface, finite.
            near: answers of this engine to M queries that were likely near these, such as those of the last
                iteration; they save time and do not change the distances.
        """
        ...


def _checked(points: FloatArray, near: ClosestPoints | None) -> FloatArray:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"Closest-point queries must have the shape (M, 3), not {points.shape}.")
    if not np.isfinite(points).all():
        raise InputError("Closest-point queries must be finite; the pose or shape that made them has diverged.")
    if near is not None and len(near.vertex) != len(points):
        raise InputError(f"{len(near.vertex)} answers cannot be near to {len(points)} queries.")
    return points


class VertexEngine:
    """Nearest vertex, by a kd-tree; works for point clouds too."""

    def __init__(self, mesh: Mesh) -> None:
        from shapespace.geometry.kdtree import KdTree  # compiled

        if len(mesh.vertices) == 0 or not np.isfinite(mesh.vertices).all():
            raise MeshError(f"{mesh.name}: its vertices are missing or not finite, so it cannot be searched.")
        self._vertices = mesh.vertices
        self._tree = KdTree(mesh.vertices)

    @property
    def order(self) -> IntArray:
        """All vertices (V,), those that lie close to each other together."""
        return self._tree.arrays.original

    def query(self, points: FloatArray, near: ClosestPoints | None = None) -> ClosestPoints:
        """Return the nearest vertex of each of `points` (M, 3)."""
        asked = _checked(points, near)
        if near is None:
            vertex, squared = self._tree.nearest(asked)
            return ClosestPoints(self._vertices[vertex], np.sqrt(squared), None, None, vertex)
        vertex, squared, point, followed = self._tree.follow(asked, near.followed)
        return ClosestPoints(point, np.sqrt(squared), None, None, vertex, followed)


class SurfaceEngine:
    """Closest point on the triangles themselves, by a tree of boxes."""

    def __init__(self, mesh: Mesh) -> None:
        from shapespace.geometry.bvh import TriangleTree  # compiled

        self._faces = faces_of(mesh)
        if not np.isfinite(mesh.vertices).all():
            raise MeshError(f"{mesh.name}: its vertices are not finite, so it cannot be searched.")
        self._tree = TriangleTree(mesh.vertices, self._faces)

    def query(self, points: FloatArray, near: ClosestPoints | None = None) -> ClosestPoints:
        """Return the closest surface point of each of `points` (M, 3)."""
        asked = _checked(points, near)
        triangle, barycentric, point, squared = self._tree.closest(asked, None if near is None else near.triangle)
        vertex = self._faces[triangle, barycentric.argmax(axis=1)]
        return ClosestPoints(point, np.sqrt(squared), triangle, barycentric, vertex)


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
