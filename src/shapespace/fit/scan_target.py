"""The scan as a fit sees it: its surface to be searched, its normals, its border."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.geometry.closest import ClosestPointEngine, ClosestPoints, build_engine, finest_engine
from shapespace.geometry.surface import boundary_vertices
from shapespace.types import BoolArray, FloatArray, Mesh


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
    def vertex_engine(self) -> ClosestPointEngine:
        """Search structure of the vertices."""
        return build_engine(self.mesh, "vertices")

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
    def normals(self) -> FloatArray:
        """(S, 3) unit normals at the vertices; zero where no triangle gives one."""
        from shapespace.fit.kernels import normals_into  # compiled

        normals = np.zeros(self.mesh.vertices.shape)
        if self.mesh.faces is not None:
            normals_into(
                np.array(self.mesh.vertices), np.array(self.mesh.faces), np.empty((len(self.mesh.faces), 9)), normals
            )
        return normals

    def normals_at(self, matches: ClosestPoints) -> FloatArray:
        """Return the normals (M, 3) at `matches`, interpolated and so not quite of unit length between vertices."""
        if matches.triangle is None or matches.barycentric is None or self.mesh.faces is None:
            return self.normals[matches.vertex]
        return np.einsum("mc,mcd->md", matches.barycentric, self.normals[self.mesh.faces[matches.triangle]])
