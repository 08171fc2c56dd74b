"""What a change of shape does to triangles: which fold over, and how much they grow or shrink."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.geometry.normals import face_vectors, faces_of
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


def edge_stretch(vertices: FloatArray, rest: Mesh) -> float:
    """Return the RMS log ratio of the edges of a surface `vertices` (V, 3) and of `rest`, the change of size removed.

    It is 0 where the surface is only bent. Edges without length in either are left out.
    """
    faces = faces_of(rest)
    first, second = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    now: FloatArray = np.linalg.norm(vertices[first] - vertices[second], axis=1)
    before: FloatArray = np.linalg.norm(rest.vertices[first] - rest.vertices[second], axis=1)
    known = (now > 0) & (before > 0)
    logs = np.asarray(np.log(now[known] / before[known]), dtype=np.float64)
    return float(np.sqrt(np.mean((logs - np.median(logs)) ** 2))) if len(logs) else 0.0


def _turned_back(vectors: FloatArray, faces: IntArray, vertices: int) -> BoolArray:
    """Return (F,) whether a triangle's normal points against the mean normal of all that touch it."""
    there = np.where(np.isfinite(vectors), vectors, 0.0)
    flat = faces.ravel()
    sums = np.stack([np.bincount(flat, np.repeat(there[:, k], 3), vertices) for k in range(3)], axis=1)
    around = sums[faces].sum(axis=1) - 3.0 * there
    return (there * around).sum(axis=1) < 0


def flip_factor(vertices: FloatArray, change: FloatArray, faces: IntArray) -> float:
    """Return the smallest factor of `change` at which a triangle flips; infinity if none does.

    A triangle flips if its normal is at 90 degrees or more to that of the same triangle of `vertices`. Its area vector
    is quadratic in the factor, so the first root has a closed form.

    Args:
        vertices: (V, 3) of the surface that is changed.
        change: (V, 3) displacement of each vertex at the factor 1.
        faces: (F, 3).
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    u, v, w = (change[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    linear = np.cross(v - u, c - a) + np.cross(b - a, w - u)
    square = np.cross(v - u, w - u)
    q0, q1, q2 = (np.einsum("fd,fd->f", normal, vector) for vector in (normal, linear, square))
    known = (q0 > 0) & np.isfinite(q1) & np.isfinite(q2)
    q0, q1, q2 = q0[known], q1[known], q2[known]
    inside = q1**2 - 4.0 * q2 * q0
    real = inside >= 0
    # The larger of the two sums in size, so that nothing cancels; its inverse gives the other root.
    half = -0.5 * (q1[real] + np.copysign(np.sqrt(inside[real]), q1[real]))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.concatenate([half / q2[real], q0[real] / half])
    ahead = roots[np.isfinite(roots) & (roots > 0)]
    return float(ahead.min()) if len(ahead) else float("inf")


def factor_to_draw(wanted: float, flips_at: float) -> float:
    """Return the largest of 1, 2, 3, 5, 10, 20, ... and 0.5, 0.3, 0.2, 0.1, ... up to `wanted` and below `flips_at`.

    Args:
        wanted: the factor by which a change would be drawn, positive.
        flips_at: the factor at which the first triangle flips, from `flip_factor`.
    """
    steps = sorted(step * 10.0**power for power in range(-6, 4) for step in (1, 2, 3, 5))
    return max((step for step in steps if step <= wanted * (1 + 1e-9) and step < flips_at), default=steps[0])
