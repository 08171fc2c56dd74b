"""Placement of named points on a surface: the closest triangle, and barycentric coordinates in this triangle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from shapespace.errors import InputError, MeshError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import rms_size
from shapespace.reprs import first_names
from shapespace.types import RAS_TO_LPS, FloatArray, Mesh, SurfaceLandmarks

_FAR_SHARE = 0.01
"""Share of the size of the object (RMS); a landmark farther than this and a mean edge is probably off the surface."""
_NAMED = 10  # landmarks in a sentence
STRAY = 0.25
"""A landmark at a distance from a surface of more than this share of its size does not belong to the surface."""
_TURNED_RATIO, _TURNED_SHARE, _FEWEST = 3.0, 0.05, 3
"""Landmarks are rotated if their distance (RMS) decreases by this factor by a half turn, and was larger than this share
of the size, or than `STRAY` for fewer than three: a half turn does not remove errors of placement."""
_TURNED = (
    "Its landmarks are a half turn about z from its surface, as between RAS and LPS, so the signs of their x and y are "
    "changed here; export both in LPS, or mark the file of a surface that is in RAS with SPACE=RAS."
)


def place_landmarks(mesh: Mesh, points: Mapping[str, FloatArray], *, precision: float = 1e-12) -> SurfaceLandmarks:
    """Place named points at the closest points of the triangles of a surface.

    Without triangles, each point is placed at the nearest vertex. Missing vertices (not-a-number) and their triangles
    are ignored.

    Args:
        mesh: the surface, in mm.
        points: name -> (3,) coordinates in the frame of `mesh`, mm.
        precision: precision of the coordinates, as a share of the size of the object (RMS); a point closer than this to
            a vertex or to the surface is placed exactly there. The default is the rounding of float64.

    Returns:
        The landmarks; their `distance_mm` are the distances of the points from the surface.

    Raises:
        InputError: a point that is not three finite numbers.
        MeshError: all vertices of the surface are missing.
    """
    if not points:
        return SurfaceLandmarks()
    for name, point in points.items():
        if np.shape(point) != (3,) or not np.isfinite(point).all():
            raise InputError(f"Landmark {name!r} is not three finite numbers; correct or remove it.")
    places = np.stack([np.asarray(point, dtype=np.float64) for point in points.values()])
    there = np.asarray(np.isfinite(mesh.vertices).all(axis=1))
    if not there.any():
        raise MeshError(f"{mesh.name}: it has no vertices on which landmarks could be placed; give another mesh.")
    faces = None if mesh.faces is None else mesh.faces[there[mesh.faces].all(axis=1)]
    if faces is None or not len(faces):
        near = build_engine(Mesh(mesh.vertices[there], name=mesh.name)).query(places)
        vertices = np.flatnonzero(there)[near.vertex].tolist()
        return replace(SurfaceLandmarks.of(dict(zip(points, vertices, strict=True))), distance_mm=near.distance)
    finite_vertices = np.where(there[:, None], mesh.vertices, 0.0)  # no triangle uses the missing vertices
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


def landmarks_in_frame_of(
    mesh: Mesh, points: Mapping[str, FloatArray]
) -> tuple[Mapping[str, FloatArray], tuple[str, ...]]:
    """Return landmarks in the frame of a surface: rotated by a half turn about z if they match the surface only then.

    Args:
        mesh: the surface, in any unit.
        points: name -> (3,) coordinates in the same unit.

    Returns:
        The landmarks, rotated or as given, and a sentence if they were rotated.
    """
    places = np.array(list(points.values()), dtype=np.float64)
    if not points or not np.isfinite(places).all() or not np.isfinite(mesh.vertices).any():
        return points, ()
    both = np.concatenate([places, places * RAS_TO_LPS])
    placed = place_landmarks(mesh, {str(i): point for i, point in enumerate(both)})
    off = placed.distance_mm.reshape(2, -1) / rms_size(mesh.vertices[np.isfinite(mesh.vertices).all(axis=1)])
    off = off[:, off.min(axis=0) <= STRAY]  # a half turn does not explain the others
    if 2 * off.shape[1] < len(places):
        return points, ()
    as_given, turned = np.sqrt((off**2).mean(axis=1))
    if as_given < _TURNED_RATIO * turned or as_given < (_TURNED_SHARE if off.shape[1] >= _FEWEST else STRAY):
        return points, ()
    return dict(zip(points, both[len(places) :], strict=True)), (_TURNED,)


def far_landmarks(mesh: Mesh, landmarks: SurfaceLandmarks) -> list[str]:
    """Return a sentence on landmarks that are too far from the surface to belong to it, if any.

    These are farther than the mean edge and than 1 % of the size of `mesh` (RMS distance from its centre).
    """
    there = np.asarray(np.isfinite(mesh.vertices).all(axis=1))
    limit = _FAR_SHARE * rms_size(mesh.vertices[there])
    if mesh.faces is not None:
        edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
        lengths = np.asarray(np.linalg.norm(edges, axis=2), dtype=np.float64)
        limit = max(limit, float(np.nanmean(lengths)))
    distances = sorted(zip(landmarks.distance_mm.tolist(), landmarks.names, strict=True), reverse=True)
    far = [f"{name} ({distance:.2g})" for distance, name in distances if distance > limit]
    count = "1 landmark is" if len(far) == 1 else f"{len(far)} landmarks are"
    sentence = (
        f"Warning: {count} farther from that surface than 1 % of its size and than its mean edge (distances in its "
        f"unit): {first_names(far, _NAMED)}. Check the names, the unit and the frame of the landmarks."
    )
    return [sentence] if far else []
