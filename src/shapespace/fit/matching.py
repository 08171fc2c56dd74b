"""What the robust fit and the dense stage share of matching: vertices to the scan, the winding, what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.fit.kernels import gather_into
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.closest import ClosestPointEngine, ClosestPoints, on_boundary
from shapespace.types import BoolArray, FloatArray, IntArray, Similarity


@dataclass(frozen=True, eq=False)
class VertexMatches:
    """Model vertices matched to the scan, (M,) each; residuals and distances in mm of the model's frame.

    Args:
        vertex: which vertices.
        residual: how far each lies beyond its match along the model's normal.
        distance: to its match.
        allowed: False on the border of the scan, and where the normals disagree.
        near: the matches themselves, for the next search to begin with.
    """

    vertex: IntArray
    residual: FloatArray
    distance: FloatArray
    allowed: BoolArray
    near: ClosestPoints


def match_vertices(
    target: ScanTarget,
    engine: ClosestPointEngine,
    T_scan_model: Similarity,
    vertices: FloatArray,
    normals: FloatArray,
    vertex: IntArray,
    near: ClosestPoints | None,
    *,
    winding: float,
    normal_cosine: float,
) -> VertexMatches:
    """Match some of the model's vertices to the scan.

    Args:
        target: the scan.
        engine: one of its search structures.
        T_scan_model: from the model's frame to the scan's mm frame.
        vertices: (V, 3) in the model's frame,
        normals: (V, 3) their unit normals.
        vertex: (M,) which to match.
        near: what the last search for the same vertices found; None for the first.
        winding: -1 where the scan's normals are reversed, else 1.
        normal_cosine: matches whose normals disagree more than this are not allowed.
    """
    T, x, n = T_scan_model, vertices[vertex], normals[vertex]
    near = engine.query(T.apply(x), near)
    to_scan = x - ((near.points - T.translation) @ T.rotation) / T.scale
    allowed = ~on_boundary(near, target.mesh, target.rim)
    if target.mesh.faces is not None:
        n_scan = target.normals_at(near) @ T.rotation
        cosine = winding * np.einsum("md,md->m", n, n_scan)
        allowed &= cosine > normal_cosine * np.linalg.norm(n_scan, axis=1)
    return VertexMatches(vertex, np.einsum("md,md->m", to_scan, n), near.distance / T.scale, allowed, near)


def winding_of(cosine: FloatArray, covered: BoolArray) -> float:
    """Return -1 where most normals of model and scan are opposed: a scan wound the wrong way round has all reversed."""
    return 1.0 if np.median(cosine[covered] if covered.any() else cosine) >= 0 else -1.0


def unexplained_variance(
    triangle: IntArray,
    barycentric: FloatArray,
    faces: IntArray,
    w: FloatArray,
    residual: FloatArray,
    vertices: int,
    seed: int,
) -> float:
    """Return the variance, mm^2, of the part of the residuals that is no noise; it can come out below zero.

    Scan points fall into two halves at random. Noise is independent between them, so the product of what the two say
    of the same vertex is the variance of the shape that is left.

    Args:
        triangle: (M,) of the model, where each point is matched,
        barycentric: (M, 3) and where on it.
        faces: (F, 3) the model's triangles.
        w: (M,) weights of the matches,
        residual: (M,) and their residuals, mm.
        vertices: how many the model has.
        seed: of the halves.
    """
    half = np.random.default_rng(seed).random(len(w)) < 0.5
    seen, pull = np.zeros((2, vertices)), np.zeros((2, vertices))
    for i, part in enumerate((half, ~half)):
        gather_into(triangle, barycentric, faces, w * part, residual, seen[i], pull[i])
    both = np.minimum(seen[0], seen[1])
    mean = pull / np.maximum(seen, 1e-12)
    return float((both * mean[0] * mean[1]).sum() / max(both.sum(), 1e-12))
