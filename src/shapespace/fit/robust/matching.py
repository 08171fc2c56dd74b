"""Matches in both directions between a surface on the model's triangles and the scan, the same in all stages of a fit.

Each scan point is matched to the closest point of the moving surface, which a walk from the last match finds, and each
vertex of the surface to the closest point of the scan. A robust weight, selected by its name, weighs each match.
Equation numbers are those of docs/robust.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from shapespace.fit.robust.kernels import compare_into, gather_into, on_scan_into
from shapespace.fit.robust.prepared_model import ModelSurface
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.closest import ClosestPointEngine, ClosestPoints
from shapespace.geometry.kdtree import KdTree
from shapespace.types import BoolArray, FloatArray, IntArray, Similarity


def welsch(residual: FloatArray, scale: float) -> FloatArray:
    """Return exp(-r^2 / (2 scale^2)): distant matches do not count (Zhang, Yao and Deng, PAMI 2022)."""
    return np.exp(-0.5 * (residual / scale) ** 2)  # R8a


def geman_mcclure(residual: FloatArray, scale: float) -> FloatArray:
    """Return (scale^2 / (scale^2 + r^2))^2, with heavier tails than Welsch's (Zhou, Park and Koltun, ECCV 2016)."""
    return (scale**2 / (scale**2 + residual**2)) ** 2  # R8b


def huber(residual: FloatArray, scale: float) -> FloatArray:
    """Return 1 up to `scale` and scale / |r| beyond: no match is excluded (Huber, 1964)."""
    return scale / np.maximum(np.abs(residual), scale)  # R8c


WEIGHTS: Mapping[str, Callable[[FloatArray, float], FloatArray]] = {
    "welsch": welsch,
    "geman_mcclure": geman_mcclure,
    "huber": huber,
}
"""Weights by name: residual (M,) and its scale, both mm -> (M,) in [0, 1], falling from 1 at 0."""


_TAIL = 0.9
"""Quantile that R6b compares with that of normal noise."""


def spread(residual: FloatArray) -> float:
    """Return the robust standard deviation of `residual` (M,) from the median of its absolute values (R6a)."""
    return 1.4826 * float(np.median(np.abs(residual))) if len(residual) else float("inf")


def tails(residual: FloatArray, spread_mm: float) -> float:
    """Return the 90 % quantile of |residual| (M,) over that of normal noise of this spread (R6b)."""
    # The same value as np.quantile, bit for bit, in a third of its time.
    place = _TAIL * (len(residual) - 1)
    below = int(place)
    above = min(below + 1, len(residual) - 1)
    ordered = np.partition(np.abs(residual), (below, above))
    low, high, share = float(ordered[below]), float(ordered[above]), place - below
    quantile = low + (high - low) * share if share < 0.5 else high - (high - low) * (1.0 - share)
    return quantile / (1.645 * spread_mm)


def match_weights(
    name: str, residual: FloatArray, distance: FloatArray, allowed: BoolArray, width_mm: float, far_mm: float
) -> FloatArray:
    """Return the weights (M,) of matches by the weight called `name`, from their residuals and distances.

    Args:
        name: name of the weight, one of `WEIGHTS`.
        residual: (M,) residuals, mm.
        distance: (M,) distances, mm.
        allowed: (M,) False for matches that do not count.
        width_mm: scale of the residuals, mm.
        far_mm: scale of the distances, mm.
    """
    weight = WEIGHTS[name]
    return weight(residual, width_mm) * weight(distance, far_mm) * allowed


@dataclass(frozen=True, eq=False)
class PointMatches:
    """Scan points matched to the moving surface, (M,) each; residuals and distances in mm of the model's frame.

    Args:
        triangle: (M,) triangle of the model on which each point is matched.
        barycentric: (M, 3) barycentric coordinates of the match on its triangle.
        nearest: (M,) vertex at which the walk to the match ended.
        residual: (M,) distance by which the model lies beyond each point along the model's normal.
        distance: (M,) distance of each point to its match.
        allowed: (M,) False at the border of the model, and where the normals disagree.
    """

    triangle: IntArray
    barycentric: FloatArray
    nearest: IntArray
    residual: FloatArray
    distance: FloatArray
    allowed: BoolArray


@dataclass(frozen=True, eq=False)
class VertexMatches:
    """Model vertices matched to the scan, (N,) each; residuals and distances in mm of the model's frame.

    Args:
        vertex: (N,) indices of the vertices.
        residual: (N,) distance by which each vertex lies beyond its match along the model's normal.
        distance: (N,) distance of each vertex to its match.
        allowed: (N,) False on the border of the scan, and where the normals disagree.
        near: closest points of the scan, from which the next search starts.
    """

    vertex: IntArray
    residual: FloatArray
    distance: FloatArray
    allowed: BoolArray
    near: ClosestPoints


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of an iterate in both directions.

    Args:
        points: scan points on the model (R4).
        vertices: model vertices on the scan (R5).
        winding: -1 if the scan's normals are reversed, else 1.
    """

    points: PointMatches
    vertices: VertexMatches
    winding: float

    @property
    def hint(self) -> MatchHint:
        """Hint for the next search of the same points and vertices."""
        return MatchHint(self.points.nearest, self.points.triangle, self.vertices.near, self.winding)

    def residuals(self) -> FloatArray:
        """Return the residuals of all allowed matches, in both directions."""
        p, v = self.points, self.vertices
        return np.concatenate([p.residual[p.allowed], v.residual[v.allowed]])

    def weights(self, name: str, width_mm: float, far_mm: float, vertex_share: float) -> Weights:
        """Return the weight of each match (R8, R9), with `width_mm` as scale of residuals and `far_mm` of distances."""
        p, v = self.points, self.vertices
        return Weights(
            match_weights(name, p.residual, p.distance, p.allowed, width_mm, far_mm),
            vertex_share * match_weights(name, v.residual, v.distance, v.allowed, width_mm, far_mm),
            width_mm,
            far_mm,
        )

    def gathered(self, weights: Weights, faces: IntArray, vertices: int) -> Gathered:
        """Return weights and weighted residuals of the matches at the model vertices that carry them (R10)."""
        p, v = self.points, self.vertices
        W, h = np.zeros(vertices), np.zeros(vertices)
        gather_into(p.triangle, p.barycentric, faces, weights.points, p.residual, W, h)
        seen = W > 0.0
        W[v.vertex] += weights.vertices
        h[v.vertex] += weights.vertices * v.residual
        return Gathered(W, h, seen)

    def unexplained_variance(self, weights: Weights, faces: IntArray, vertices: int, seed: int) -> float:
        """Return the variance, mm^2, of the residuals without their noise (R17); it can be below zero.

        Scan points are split into two halves at random. Noise is independent between them, so the mean product of their
        mean residuals at a vertex is the variance of the remaining shape difference.
        """
        p, w = self.points, weights.points
        half = np.random.default_rng(seed).random(len(w)) < 0.5
        W, h = np.zeros((2, vertices)), np.zeros((2, vertices))
        for i, part in enumerate((half, ~half)):
            gather_into(p.triangle, p.barycentric, faces, w * part, p.residual, W[i], h[i])  # R10 of each half
        both = np.minimum(W[0], W[1])
        m = h / np.maximum(W, 1e-12)
        return float((both * m[0] * m[1]).sum() / max(both.sum(), 1e-12))  # R17


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the matches.

    Args:
        points: (M,) weights of the matches of the scan's points.
        vertices: (N,) weights of the matches of the model's vertices.
        width_mm: scale of the residuals for these weights, mm.
        far_mm: scale of the distances for these weights, mm.
    """

    points: FloatArray
    vertices: FloatArray
    width_mm: float
    far_mm: float


@dataclass(frozen=True, eq=False)
class Gathered:
    """Matches gathered on the vertices of the model, (V,) each.

    Args:
        W: (V,) sum of the weights of all matches at each vertex (R10).
        h: (V,) sum of the weighted residuals there, mm (R10).
        seen: (V,) True where a scan point with a positive weight is matched.
    """

    W: FloatArray
    h: FloatArray
    seen: BoolArray


@dataclass(frozen=True, eq=False)
class MatchHint:
    """End of the last search. It shortens the next search of the same points and vertices.

    Args:
        vertex: (M,) vertex of the model near each scan point.
        triangle: (M,) triangle of the model near each scan point; -1 if none is known.
        near: closest points of the scan to the vertices; None if unknown.
        winding: -1 if the scan's normals are reversed, else 1; None if unknown.
    """

    vertex: IntArray
    triangle: IntArray
    near: ClosestPoints | None
    winding: float | None


@dataclass(frozen=True, eq=False)
class Matcher:
    """Matches a sample of scan points and a sample of model vertices, both ways.

    Args:
        target: the scan.
        points_mm: (M, 3) sample of the scan's points, in its mm frame.
        point_normals: (M, 3) normals of these points.
        order: (M,) order of searches for the sample, in which neighbours follow each other. It only reduces their time,
            as the data of a search are then in the processor's cache.
        vertex: (N,) sample of the model's vertices.
        engine: search structure of the scan.
        normal_cosine: cosine of the largest angle between the normals of an allowed match.
        bulging: whether flat triangles represent the smooth surface through their corners.
        parts: (M,) part of each point; None if unknown.
    """

    target: ScanTarget
    points_mm: FloatArray
    point_normals: FloatArray
    order: IntArray
    vertex: IntArray
    engine: ClosestPointEngine
    normal_cosine: float
    bulging: bool = False
    parts: IntArray | None = None

    @staticmethod
    def of(
        target: ScanTarget, points: IntArray, vertex: IntArray, engine: ClosestPointEngine, normal_cosine: float,
        *, bulging: bool = False,
    ) -> Matcher:  # fmt: skip
        """Return the matcher of the scan points `points` (M,) and the model vertices `vertex` (N,)."""
        row_of = np.full(len(target.mesh.vertices), -1, dtype=np.int32)
        row_of[points] = np.arange(len(points), dtype=np.int32)
        order = row_of[target.vertex_engine.order]
        return Matcher(
            target=target,
            points_mm=target.mesh.vertices[points],
            point_normals=target.normals[points],
            order=order[order >= 0],
            vertex=vertex,
            engine=engine,
            normal_cosine=normal_cosine,
            bulging=bulging,
            parts=None if target.mesh.parts is None else target.mesh.parts[points],
        )

    def first_hint(
        self, surface: ModelSurface, T_scan_model: Similarity, tree: KdTree | None = None, winding: float | None = None
    ) -> MatchHint:
        """Return the start of the first search: the closest vertices, and no matches yet.

        Args:
            surface: surface of the model.
            T_scan_model: pose of the model.
            tree: search tree of the vertices of a similar surface; None to build one.
            winding: -1 if the normals of the scan are reversed, else 1; None if unknown.
        """
        used, points = surface.topology.used, self._in_model(T_scan_model)
        if self.target.part_of_vertex is not None:
            # A walk does not leave its part, so that the first match determines the part of all.
            tree = KdTree(surface.vertices[used] + self.target.vertex_shift(used))
            points = points + self.target.shift(self.parts)
        tree = tree or surface.vertex_tree()
        vertex = np.empty(len(points), dtype=np.int32)
        nearest = tree.nearest(points[self.order])[0]
        vertex[self.order] = used[nearest]
        return MatchHint(vertex, np.full_like(vertex, -1), None, winding)

    def _in_model(self, T: Similarity) -> FloatArray:
        return ((self.points_mm - T.translation) @ T.rotation) / T.scale

    def match(self, surface: ModelSurface, T_scan_model: Similarity, hint: MatchHint) -> Matches:
        """Return the matches of `surface` at a pose (R4-R6); their `hint` is that of the next search."""
        q, n = self._in_model(T_scan_model), self.point_normals @ T_scan_model.rotation
        nearest, triangle, barycentric = surface.closest(q, hint.vertex, hint.triangle)
        residual, distance, cosine, covered = surface.meet(q, n, triangle, barycentric, bulging=self.bulging)
        winding = _winding_of(cosine, covered) if hint.winding is None else hint.winding
        agree = winding * cosine > self.normal_cosine
        points = PointMatches(triangle, barycentric, nearest, residual, distance, covered & agree)
        vertices = match_vertices(
            target=self.target,
            engine=self.engine,
            T_scan_model=T_scan_model,
            surface=surface,
            vertex=self.vertex,
            near=hint.near,
            winding=winding,
            normal_cosine=self.normal_cosine,
        )
        return Matches(points, vertices, winding)


def choose_bulging(matcher: Matcher, surface: ModelSurface, T_scan_model: Similarity, hint: MatchHint) -> Matcher:
    """Return the matcher for triangles of a smooth surface, or for flat triangles, such as those of a simulated scan.

    The residuals of the right choice have no pattern within triangles, and therefore the smaller spread.
    """
    tried = [replace(matcher, bulging=bulging) for bulging in (True, False)]
    spreads: list[float] = []
    for candidate in tried:
        points = candidate.match(surface, T_scan_model, hint).points
        residual = points.residual[points.allowed]
        spreads.append(spread(residual - np.median(residual)) if len(residual) else 0.0)
    return tried[int(np.argmin(spreads))]


def match_vertices(
    *, target: ScanTarget, engine: ClosestPointEngine, T_scan_model: Similarity, surface: ModelSurface,
    vertex: IntArray, near: ClosestPoints | None, winding: float, normal_cosine: float,
) -> VertexMatches:  # fmt: skip
    """Match some of the surface's vertices to the scan (R5, R6).

    Args:
        target: the scan.
        engine: search structure of the scan.
        T_scan_model: pose of the model, from the model's frame to the scan's mm frame.
        surface: surface in the model's frame.
        vertex: (N,) indices of the vertices to match.
        near: result of the last search for the same vertices; None for the first search.
        winding: -1 if the scan's normals are reversed, else 1.
        normal_cosine: cosine of the largest angle between the normals of an allowed match.
    """
    T, x, n = T_scan_model, surface.vertices[vertex], surface.normals[vertex]
    shift = target.vertex_shift(vertex)
    near = engine.query(T.apply(x) + shift, near)
    to_scan = x - ((near.points - shift - T.translation) @ T.rotation) / T.scale
    corners, weights = target.carriers(near)
    n_scan, allowed, residual = np.empty_like(x), np.empty(len(x), dtype=np.bool_), np.empty(len(x))
    on_scan_into(corners, weights, target.normals, target.rim, n_scan, allowed)
    n_scan = n_scan @ T.rotation if target.mesh.faces is not None else n_scan[:0]
    compare_into(to_scan, n, n_scan, winding, normal_cosine, residual, allowed)
    if target.shown is not None:
        allowed &= target.shown[vertex]
    return VertexMatches(vertex, residual, near.distance / T.scale, allowed, near)


def _winding_of(cosine: FloatArray, covered: BoolArray) -> float:
    """Return -1 if most normals of model and scan are opposed: a wrong winding of the scan reverses all its normals."""
    return 1.0 if np.median(cosine[covered] if covered.any() else cosine) >= 0 else -1.0
