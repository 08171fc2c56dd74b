"""Penetration of neighbouring parts of a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from shapespace.geometry.closest import build_engine
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


def find_penetrations(surface: Mesh, parts: Mapping[str, IntArray]) -> list[Penetration]:
    """Return the penetrations of the parts of a surface, the deepest first; open parts contain nothing.

    Args:
        surface: surface with triangles.
        parts: vertices of each part, by its name.
    """
    import igl  # slow to import

    found = list[Penetration]()
    faces = np.asarray(surface.faces)
    for part, other in permutations(parts, 2):
        own = faces[np.isin(faces, parts[other]).all(axis=1)]
        points, walls = surface.vertices[parts[part]], surface.vertices[parts[other]]
        near = ((points >= walls.min(axis=0)) & (points <= walls.max(axis=0))).all(axis=1)
        if not near.any() or len(boundary_edges(own)):
            continue
        winding = np.asarray(igl.fast_winding_number(surface.vertices, own.astype(np.int64), points[near]))
        inside = points[near][winding > _INSIDE]
        if len(inside):
            depth = float(build_engine(Mesh(surface.vertices, own)).query(inside).distance.max())
            found.append(Penetration(part, other, len(inside) / len(points), depth))
    return sorted(found, key=lambda penetration: -penetration.depth_mm)
