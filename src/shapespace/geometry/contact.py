"""Penetration of neighbouring parts of a surface."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from shapespace.geometry.closest import ClosestPoints, build_engine
from shapespace.geometry.normals import boundary_edges
from shapespace.types import IntArray, Mesh

_INSIDE = 0.5  # winding number of a closed surface: 0 outside, 1 inside


@dataclass(frozen=True)
class Penetration:
    """Vertices of one part that lie inside another, closed part.

    Args:
        part: name of the part.
        other: name of the part that contains the vertices.
        share: share of the vertices of `part`.
        depth_mm: largest distance of these vertices from the surface of `other`, in the unit of the surface.
    """

    part: str
    other: str
    share: float
    depth_mm: float


def find_overlaps(
    surface: Mesh, parts: Mapping[str, IntArray]
) -> Iterator[tuple[str, str, IntArray, IntArray, ClosestPoints]]:
    """Yield the vertices of each part that lie inside another, closed part.

    Yields:
        Name of the part, name of the other part, vertices (M,) inside it, the corners (M, 3) of the triangles of their
        closest points on its surface, and these points.

    Args:
        surface: surface with triangles.
        parts: vertices of each part, by its name.
    """
    import igl  # slow to import

    faces = np.asarray(surface.faces)
    for part, other in permutations(parts, 2):
        own = faces[np.isin(faces, parts[other]).all(axis=1)]
        points, walls = surface.vertices[parts[part]], surface.vertices[parts[other]]
        near = ((points >= walls.min(axis=0)) & (points <= walls.max(axis=0))).all(axis=1)
        if not near.any() or len(boundary_edges(own)):
            continue
        winding = np.asarray(igl.fast_winding_number(surface.vertices, own.astype(np.int64), points[near]))
        vertex = parts[part][near][winding > _INSIDE]
        if len(vertex):
            closest = build_engine(Mesh(surface.vertices, own)).query(surface.vertices[vertex])
            yield part, other, vertex, own[closest.triangle], closest


def find_penetrations(surface: Mesh, parts: Mapping[str, IntArray]) -> list[Penetration]:
    """Return the penetrations of the parts of a surface, the deepest first; see `find_overlaps`."""
    found = [
        Penetration(part, other, len(vertex) / len(parts[part]), float(near.distance.max()))
        for part, other, vertex, _, near in find_overlaps(surface, parts)
    ]
    return sorted(found, key=lambda penetration: -penetration.depth_mm)
