"""Whether the same vertices of surfaces in correspondence have the same relief: bumps, edges and hollows.

The registration brings surfaces near each other, and a smooth surface can be near in a wrong pose too. Its relief is
then elsewhere, which the registration does not use. Equations Cn are those of docs/correspondence.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from shapespace.correspondence.harmonics import Harmonics
from shapespace.geometry.normals import vertex_normals
from shapespace.types import BoolArray, FloatArray, Mesh

_RANGE = 0.05
"""Of the smoothing, share of the square root of the area: of 0.03, 0.05, 0.1 and 0.2 it separated right and wrong
surfaces of 15 simulated kinds best."""
_ENOUGH = 40  # surfaces, at most, whose median is used
_LARGEST = 0.9999  # correlation of copies, so that their agreement is finite


def relief(vertices: FloatArray, template: Mesh, harmonics: Harmonics) -> FloatArray:
    """Return (V,) the height of a surface above its smoothed version, along its normals (C34).

    Args:
        vertices: (V, 3) in correspondence with `template`.
        template: its triangles.
        harmonics: of the template.
    """
    smooth = harmonics.diffused(vertices, _RANGE * float(np.sqrt(harmonics.area.sum())))
    normals = vertex_normals(template.with_vertices(vertices))
    return np.asarray(np.einsum("vd,vd->v", normals, vertices - smooth))  # C34


def agreement(a: FloatArray, b: FloatArray, weights: FloatArray) -> float:
    """Return the correlation of two reliefs (V,), transformed to the real line (C35); 0 where one is flat."""
    weights = weights / max(float(weights.sum()), 1e-12)
    a, b = a - weights @ a, b - weights @ b
    spread = float(np.sqrt((weights @ a**2) * (weights @ b**2)))
    return float(np.arctanh(np.clip((weights * a) @ b / max(spread, 1e-12), -_LARGEST, _LARGEST)))  # C35


@dataclass(frozen=True, eq=False)
class Reliefs:
    """The reliefs of surfaces in correspondence.

    Args:
        heights: (N, V) of each surface.
        observed: (N, V) bool, where a vertex is observed.
        area: (V,) of each vertex.
    """

    heights: FloatArray
    observed: BoolArray
    area: FloatArray

    @staticmethod
    def of(shapes: FloatArray, observed: FloatArray, template: Mesh, harmonics: Harmonics) -> Reliefs:
        """Return the reliefs of `shapes` (N, V, 3), of which some vertices are `observed` (N, V)."""
        heights = np.stack([relief(shape, template, harmonics) for shape in shapes])
        return Reliefs(heights, observed > 0, harmonics.area)

    def median(self, core: npt.NDArray[np.integer] | None = None) -> FloatArray:
        """Return (V,) the median of all or of `core`, at most `_ENOUGH` of them, where they are observed."""
        core = np.arange(len(self.heights)) if core is None else core
        some = core[:: -(-len(core) // _ENOUGH)]
        seen = self.observed[some]
        seen = seen | ~seen.any(axis=0)
        return np.nanmedian(np.where(seen, self.heights[some], np.nan), axis=0)

    def agreements(self, core: npt.NDArray[np.integer] | None = None) -> FloatArray:
        """Return (N,) how well each relief agrees with the median of all or of `core` (C35)."""
        middle = self.median(core)
        return np.array(
            [agreement(own, middle, self.area * seen) for own, seen in zip(self.heights, self.observed, strict=True)]
        )
