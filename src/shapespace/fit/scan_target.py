"""The scan as a fit sees it: its surface to be searched, its normals, its border."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.geometry.closest import ClosestPointEngine, ClosestPoints, VertexEngine, build_engine, finest_engine
from shapespace.geometry.normals import boundary_vertices
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

_ROUNDS = 4
"""Of finding how much the larger areas must make up for vertices that are drawn for certain."""


def mm_frame(scan: Mesh, mm_per_scan_unit: float) -> Similarity:
    """Return T_mm_scan: from the scan's own frame to mm, near the origin, where float64 is finest."""
    centre = np.median(scan.vertices, axis=0)
    return Similarity(mm_per_scan_unit, np.eye(3), -mm_per_scan_unit * centre)


@dataclass(frozen=True, eq=False)
class ScanTarget:
    """A scan in its mm frame; what is made from it is made once, when it is first needed.

    Args:
        mesh: the scan.
    """

    mesh: Mesh

    @cached_property
    def engine(self) -> ClosestPointEngine:
        """Search structure of the surface itself, or of the points where there are no triangles."""
        return build_engine(self.mesh)

    @cached_property
    def vertex_engine(self) -> VertexEngine:
        """Search structure of the vertices."""
        return VertexEngine(self.mesh)

    def search(self, name: str) -> ClosestPointEngine:
        """Return the engine called `name` in `ENGINES`."""
        if name == "vertices":
            return self.vertex_engine if self.mesh.faces is not None else self.engine
        return self.engine if name == finest_engine(self.mesh) else build_engine(self.mesh, name)

    @cached_property
    def rim(self) -> BoolArray:
        """(S,) True on the border of the scan."""
        return boundary_vertices(self.mesh)

    @cached_property
    def _normals_and_areas(self) -> tuple[FloatArray, FloatArray]:
        from shapespace.fit.robust.kernels import areas_into, normals_into  # compiled

        normals, areas = np.zeros(self.mesh.vertices.shape), np.zeros(len(self.mesh.vertices))
        if self.mesh.faces is None:
            return normals, np.ones(len(areas))
        vertices, faces = np.array(self.mesh.vertices), np.array(self.mesh.faces)
        normals_into(vertices, faces, normals)
        areas_into(vertices, faces, areas)
        return normals, areas

    @property
    def normals(self) -> FloatArray:
        """(S, 3) unit normals at the vertices; zero where no triangle gives one."""
        return self._normals_and_areas[0]

    def draw(self, count: int | None, rng: np.random.Generator) -> IntArray:
        """Return about `count` vertices, spread as evenly by area as that many can be; None for all.

        Scanners and editors sample hair, rims and creases more densely; by number such parts would outvote the rest.
        """
        areas = self._normals_and_areas[1]
        if count is None or count >= len(areas) or areas.sum() <= 0.0:
            return np.arange(len(areas), dtype=np.int32)
        areas = np.minimum(areas, areas.mean())  # what outliers pull into spikes has much area and says little
        share = areas * (count / areas.sum())
        for _ in range(_ROUNDS):
            share *= count / np.minimum(1.0, share).sum()
        reached = np.cumsum(np.minimum(1.0, share)) + rng.random()
        return np.flatnonzero(np.diff(np.floor(reached), prepend=0.0) > 0).astype(np.int32)

    def carriers(self, matches: ClosestPoints) -> tuple[IntArray, FloatArray]:
        """Return the vertices (M, c) that carry `matches`, three or one, and their barycentric weights (M, c)."""
        if matches.triangle is None or matches.barycentric is None or self.mesh.faces is None:
            return matches.vertex[:, None], np.ones((len(matches.vertex), 1))
        return self.mesh.faces[matches.triangle], matches.barycentric
