"""What a change of shape does to triangles: which fold over, and how much they grow or shrink."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.geometry.surface import face_vectors, faces_of
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh


@dataclass(frozen=True, eq=False)
class Distortion:
    """A surface beside another one with the same triangles.

    Args:
        folded: (F,) which triangles turn back against those around them, and do not on the other surface.
        growth: (F,) natural logarithm of the area beside that on the other surface, 0 in the middle (median);
            not-a-number where either has no area.
    """

    folded: BoolArray
    growth: FloatArray

    @staticmethod
    def of(surface: Mesh, rest: Mesh) -> Distortion:
        """Return what became of the triangles of `rest` on `surface`, whose missing vertices are not-a-number.

        Raises:
            MeshError: there are no triangles.
        """
        faces = faces_of(surface)
        now, before = face_vectors(surface.vertices, faces), face_vectors(rest.vertices, faces)
        areas = np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1)
        known = np.isfinite(areas[0]) & (areas[0] > 0) & (areas[1] > 0)
        growth = np.full(len(faces), np.nan)
        growth[known] = np.log(areas[0][known] / areas[1][known])
        if known.any():
            growth -= np.median(growth[known])
        vertices = len(surface.vertices)
        return Distortion(_turned_back(now, faces, vertices) & ~_turned_back(before, faces, vertices), growth)

    @property
    def folded_share(self) -> float:
        """Share of the triangles that are there which fold over; 0 where none is there."""
        known = np.isfinite(self.growth)
        return float(self.folded[known].mean()) if known.any() else 0.0

    @property
    def area_factor(self) -> float:
        """The factor by which 95 % of the triangles grow or shrink at most, the change of size divided out."""
        known = self.growth[np.isfinite(self.growth)]
        return float(np.exp(np.quantile(np.abs(known), 0.95))) if len(known) else float("nan")


def _turned_back(vectors: FloatArray, faces: IntArray, vertices: int) -> BoolArray:
    """Return (F,) whether a triangle's normal points against the mean normal of all that touch it."""
    there = np.where(np.isfinite(vectors), vectors, 0.0)
    flat = faces.ravel()
    sums = np.stack([np.bincount(flat, np.repeat(there[:, k], 3), vertices) for k in range(3)], axis=1)
    around = sums[faces].sum(axis=1) - 3.0 * there
    return (there * around).sum(axis=1) < 0
