"""Placing named points on a surface: the triangle that is closest to each, and barycentric coordinates in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from shapespace.errors import InputError, MeshError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import rms_size
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks

_FAR_SHARE = 0.01
"""Share of the object's size (RMS): a landmark farther than this and than a mean edge is probably off the surface."""


def place_landmarks(mesh: Mesh, points: Mapping[str, FloatArray], *, precision: float = 1e-12) -> SurfaceLandmarks:
    """Place named points on a surface: each at the closest point of its triangles.

    Without triangles each is placed at the nearest vertex. Missing vertices (not-a-number) and their triangles are left
    out.

    Args:
        mesh: the surface, in mm.
        points: name -> (3,) in the frame of `mesh`, mm.
        precision: of the coordinates, as a share of the object's size (RMS); a point closer than this to a vertex or to
            the surface is placed exactly there. The default is the rounding of float64.

    Returns:
        The landmarks; their `distance_mm` are the distances of the points from the surface.

    Raises:
        InputError: a point that is not three finite numbers.
        MeshError: no vertex of the surface is there.
    """
    if not points:
        return SurfaceLandmarks()
    for name, point in points.items():
        if np.shape(point) != (3,) or not np.isfinite(point).all():
            raise InputError(f"Landmark {name!r} is not three finite numbers; correct it, or leave it out.")
    places = np.stack([np.asarray(point, dtype=np.float64) for point in points.values()])
    there = np.asarray(np.isfinite(mesh.vertices).all(axis=1))
    if not there.any():
        raise MeshError(f"{mesh.name}: it has no vertices on which landmarks could be placed; give another mesh.")
    faces = None if mesh.faces is None else mesh.faces[there[mesh.faces].all(axis=1)]
    if faces is None or not len(faces):
        near = build_engine(Mesh(mesh.vertices[there], name=mesh.name)).query(places)
        vertices = np.flatnonzero(there)[near.vertex].tolist()
        return replace(SurfaceLandmarks.of(dict(zip(points, vertices, strict=True))), distance_mm=near.distance)
    finite_vertices = np.where(there[:, None], mesh.vertices, 0.0)  # no triangle has those that are not there
    near = build_engine(Mesh(finite_vertices, faces, name=mesh.name)).query(places)
    assert near.triangle is not None and near.barycentric is not None
    corners, weights = faces[near.triangle], np.clip(near.barycentric, 0.0, None)
    weights = weights / weights.sum(axis=1, keepdims=True)
    rounding_mm = precision * rms_size(finite_vertices[there])
    at_vertex = np.linalg.norm(near.points - finite_vertices[near.vertex], axis=1) <= rounding_mm
    weights[at_vertex] = 1.0, 0.0, 0.0
    corners = np.where(at_vertex[:, None], near.vertex[:, None], corners)
    distance = np.where(near.distance <= rounding_mm, 0.0, near.distance)
    return SurfaceLandmarks(tuple(points), corners, weights, distance)


def far_landmarks(mesh: Mesh, landmarks: SurfaceLandmarks) -> dict[str, float]:
    """Return name -> distance, mm, of landmarks that were given too far from the surface to belong to it.

    That is farther than the mean edge and than 1 % of the size of `mesh` (RMS distance from its centre).
    """
    there = np.asarray(np.isfinite(mesh.vertices).all(axis=1))
    limit = _FAR_SHARE * rms_size(mesh.vertices[there])
    if mesh.faces is not None:
        edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
        lengths = np.asarray(np.linalg.norm(edges, axis=2), dtype=np.float64)
        limit = max(limit, float(np.nanmean(lengths)))
    distances = zip(landmarks.names, landmarks.distance_mm, strict=True)
    return {name: float(distance) for name, distance in distances if distance > limit}
