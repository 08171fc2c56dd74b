"""Closest points on a surface or among its vertices, with a common interface.

An engine is built once per surface and then queried many times. New engines are added to `ENGINES` at the end of this
module; `tests/contracts/test_closest_contract.py` checks each against brute force.

Distances between two surfaces are of both directions: a one-way average is zero for a model that has shrunk to a point
of the scan (Sariyanidi et al., IJCB 2023).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from shapespace.errors import InputError, MeshError
from shapespace.geometry.normals import boundary_vertices, faces_of, part_of, vertex_normals
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, require

if TYPE_CHECKING:
    from shapespace.geometry.kdtree import WarmStart


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """Results of M queries.

    Args:
        points: (M, 3) closest points, in the frame of the surface.
        distance: (M,) distances of the queries from their closest points.
        triangle: (M,) int32 triangle of each closest point, or None if vertices were searched.
        barycentric: (M, 3) weights of the corners of that triangle; None if vertices were searched.
        vertex: (M,) int32 nearest vertex, or if triangles were searched, the corner with the largest weight.
        followed: data of the engine for a warm start of the next query.
    """

    points: FloatArray
    distance: FloatArray
    triangle: IntArray | None
    barycentric: FloatArray | None
    vertex: IntArray
    followed: WarmStart | None = None

    @property
    def rms(self) -> float:
        """Root of the mean squared distance."""
        return float(np.sqrt((self.distance**2).mean()))


class ClosestPointEngine(Protocol):
    """Search structure, built once per surface by `Engine(mesh)`; results are float64 and exact."""

    def query(self, points: FloatArray, near: ClosestPoints | None = None) -> ClosestPoints:
        """Return the closest points of `points` (M, 3).

        Args:
            points: (M, 3) query points in the frame of the surface, finite.
            near: results of this engine for M queries that were probably near these, such as those of the last
                iteration; they save time and do not change the distances.
        """
        ...


def _check_queries(points: FloatArray, near: ClosestPoints | None) -> FloatArray:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"Closest-point queries must have the shape (M, 3), not {points.shape}.")
    if not np.isfinite(points).all():
        raise InputError("Closest-point queries must be finite; the pose or shape that made them has diverged.")
    if near is not None and len(near.vertex) != len(points):
        raise InputError(f"{len(near.vertex)} previous results do not match {len(points)} queries.")
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
        """Indices (V,) of all vertices, in an order that keeps neighbours close to each other."""
        return self._tree.arrays.original

    def query(self, points: FloatArray, near: ClosestPoints | None = None) -> ClosestPoints:
        """Return the nearest vertex of each of `points` (M, 3)."""
        asked = _check_queries(points, near)
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
        asked = _check_queries(points, near)
        triangle, barycentric, point, squared = self._tree.closest(asked, None if near is None else near.triangle)
        vertex = self._faces[triangle, barycentric.argmax(axis=1)]
        return ClosestPoints(point, np.sqrt(squared), triangle, barycentric, vertex)


def on_boundary(matches: ClosestPoints, mesh: Mesh, boundary: BoolArray) -> BoolArray:
    """Return (M,) True for matches on the rim of `mesh`.

    Args:
        matches: closest points on `mesh`.
        mesh: the surface that was searched.
        boundary: (V,) mask of the rim vertices of `mesh`.
    """
    if matches.triangle is None or matches.barycentric is None:
        return boundary[matches.vertex]
    corners = boundary[faces_of(mesh)[matches.triangle]]
    # A point is on the rim if all corners with positive weight are rim vertices.
    inside = ~corners & (matches.barycentric > 1e-9)
    return np.asarray(~inside.any(axis=1))


ENGINES: Mapping[str, Callable[[Mesh], ClosestPointEngine]] = {
    "vertices": VertexEngine,
    "surface": SurfaceEngine,
}
"""Search engines by name; the contract test and `fit` find the engines here."""


def finest_engine(mesh: Mesh) -> str:
    """Return the name of the engine for the triangles of a mesh, or for its vertices if there are no triangles."""
    return "vertices" if mesh.faces is None else "surface"


def build_engine(mesh: Mesh, engine: str = "auto") -> ClosestPointEngine:
    """Return the search structure of `mesh`; `auto` selects its `finest_engine`.

    Raises:
        InputError: there is no engine of that name.
    """
    name = finest_engine(mesh) if engine == "auto" else engine
    if name not in ENGINES:
        raise InputError(f"There is no closest-point engine {name!r}; choose one of {', '.join(ENGINES)}.")
    return ENGINES[name](mesh)


@dataclass(frozen=True)
class DistanceSummary:
    """Summary of the distances in one direction, mm, of `count` points, which are a `fraction` of all points."""

    mean: float
    median: float
    rms: float
    p95: float
    max: float
    count: int
    fraction: float

    @staticmethod
    def of(distance_mm: FloatArray, counted: BoolArray | None = None) -> DistanceSummary:
        """Summarise `distance_mm` (M,) over the points `counted` (M,); not-a-number if there are no such points."""
        used = distance_mm if counted is None else distance_mm[counted]
        nan = float("nan")
        if len(used) == 0:
            return DistanceSummary(mean=nan, median=nan, rms=nan, p95=nan, max=nan, count=0, fraction=0.0)
        return DistanceSummary(
            mean=float(used.mean()),
            median=float(np.median(used)),
            rms=float(np.sqrt((used**2).mean())),
            p95=float(np.percentile(used, 95)),
            max=float(used.max()),
            count=len(used),
            fraction=len(used) / len(distance_mm),
        )


@dataclass(frozen=True, eq=False)
class SurfaceDistances:
    """Closest distances between a model surface and a scan, both ways.

    Args:
        model_to_scan_mm: (V,) distance of each model vertex from the scan.
        scan_to_model_mm: (S,) distance of each scan vertex from the model.
        scan_counted: (S,) False if the closest model point is on the rim of the model: such scan vertices show parts
            that the model does not cover, such as the back of a head.
        outside_of_model: (V,) True if the scan is on the side to which the normal of the model points; all True if the
            model has no triangles.
        scan_outside: (S,) True if the scan vertex is on the side to which the normal of the model points.
        model_counted: (V,) False outside the region to which the distances are restricted; None for the complete
            model.

    Example:
        >>> distances = ss.surface_distances(meshes[0], meshes[1])
        >>> distances.model_to_scan_mm.shape == (len(meshes[0].vertices),)
        True
    """

    model_to_scan_mm: FloatArray
    scan_to_model_mm: FloatArray
    scan_counted: BoolArray
    outside_of_model: BoolArray
    scan_outside: BoolArray
    model_counted: BoolArray | None = None

    __repr__ = short_repr

    @property
    def model_to_scan_signed_mm(self) -> FloatArray:
        """(V,) signed distances, negative if the scan is behind the surface of the model."""
        return np.where(self.outside_of_model, self.model_to_scan_mm, -self.model_to_scan_mm)

    @property
    def scan_to_model_signed_mm(self) -> FloatArray:
        """(S,) signed distances, negative behind the surface of the model; NaN for vertices that do not count."""
        signed = np.where(self.scan_outside, self.scan_to_model_mm, -self.scan_to_model_mm)
        return np.where(self.scan_counted, signed, np.nan)

    @property
    def model_to_scan(self) -> DistanceSummary:
        """Summary over all model vertices that count: the paper's metric."""
        counted = self.model_counted
        return DistanceSummary.of(self.model_to_scan_mm if counted is None else self.model_to_scan_mm[counted])

    @property
    def scan_to_model(self) -> DistanceSummary:
        """Summary over the scan vertices that the model covers."""
        return DistanceSummary.of(self.scan_to_model_mm, self.scan_counted)

    def as_dict(self) -> dict[str, dict[str, float]]:
        """Return both summaries as plain numbers for a result file."""
        return {"model_to_scan": asdict(self.model_to_scan), "scan_to_model": asdict(self.scan_to_model)}


def surface_distances(
    model: Mesh,
    scan: Mesh,
    *,
    scan_engine: ClosestPointEngine | None = None,
    mm_per_length: float = 1.0,
    region: BoolArray | None = None,
) -> SurfaceDistances:
    """Measure closest distances between the vertices of each surface and the other surface.

    Args:
        model: surface of the model, in the frame of the scan.
        scan: surface or point cloud; distances from a point cloud are those from its points.
        scan_engine: search structure of the scan, if it is already built.
        mm_per_length: length of the unit of this frame, mm.
        region: (V,) mask of the vertices of the model that count; the scan is compared with the part between these
            vertices. None for all.

    Example:
        >>> bool(ss.surface_distances(meshes[0], meshes[1]).model_to_scan_mm.mean() > 0)
        True
    """
    require(model, Mesh, "surface_distances", "convert it with shapespace.as_mesh")
    require(scan, Mesh, "surface_distances", "convert it with shapespace.as_mesh")
    engine = scan_engine or build_engine(scan)
    forward = engine.query(model.vertices)
    part = model if region is None else part_of(model, region)
    backward = build_engine(part).query(scan.vertices)
    counted = ~on_boundary(backward, part, boundary_vertices(part))
    outside, scan_outside = np.ones(len(model.vertices), dtype=bool), np.ones(len(scan.vertices), dtype=bool)
    if model.faces is not None:
        normals = vertex_normals(model)
        outside = _is_in_front(forward.points - model.vertices, normals)
        part_normals = normals if region is None else vertex_normals(part)
        scan_outside = _is_in_front(scan.vertices - backward.points, _normals_at(backward, part, part_normals))
    return SurfaceDistances(
        forward.distance * mm_per_length, backward.distance * mm_per_length, counted, outside, scan_outside,
        region,
    )  # fmt: skip


def _is_in_front(away: FloatArray, normals: FloatArray) -> BoolArray:
    return np.asarray(np.einsum("ij,ij->i", away, normals) >= 0.0)


def _normals_at(matches: ClosestPoints, mesh: Mesh, normals: FloatArray) -> FloatArray:
    if matches.triangle is None or matches.barycentric is None or mesh.faces is None:
        return normals[matches.vertex]
    return np.einsum("mc,mcd->md", matches.barycentric, normals[mesh.faces[matches.triangle]])
