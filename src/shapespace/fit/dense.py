"""From the fitted surface the rest of the way to the scan, by smooth fields on the model's own triangles.

The field d is a Gaussian process of the Matern kind, written as a stochastic differential equation on the surface
(Lindgren, Rue and Lindstrom, J. R. Stat. Soc. B 73, 2011), so that its precision is sparse. Its posterior mean given
the matches minimises

    sum_i w_i (n_i^T (x_i + d_i - q_i))^2 / noise^2  +  |(kappa^2 - Laplacian) d|^2 / (4 pi kappa^2 amplitude^2)

with the matches of `robust` (both directions, without borders and disagreeing normals, robustly weighted), each
gathered on the vertices that carry it. Only distances along the normals are matched: sideways the surface goes with its
neighbours. First d is a field of vectors whose amplitude goes by what the fit left unexplained; then one along the
normals takes up the details. Where nothing is seen both fade, and the surface stays what the model says.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np

from shapespace.errors import FitError
from shapespace.fit.field_kernels import compare_triangles, less_sag, solve_field
from shapespace.fit.kernels import gather_into, meet_into, normals_into, walk_into
from shapespace.fit.matching import VertexMatches, match_vertices, unexplained_variance, winding_of
from shapespace.fit.moving_model import Topology, prepare
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.settings import DenseSettings
from shapespace.fit.weights import match_weights, spread
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.surface import face_vectors, rms_size, vertex_areas
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

_FEWEST_MATCHES = 30
_FEWEST_PAIRS = 100
_WELL_SHAPED = 0.05
"""Vertices own at least this share of the median area: slivers would be infinitely stiff."""
_HALVINGS = 8
_SEEN = 0.1
"""Matches that together weigh as much show a vertex; a good one weighs 1."""


@dataclass(frozen=True, eq=False)
class DenseSurface:
    """The model's surface on the scan.

    Args:
        vertices_scan_mm: (V, 3) in the scan's mm frame.
        seen: (V,) False where the scan shows nothing and the model stands in.
        noise_mm: of the scan as found, mm of the model's frame.
        unexplained_mm: RMS of what the fit left that is no noise, mm of the model's frame.
        damped: how many vertices were held back so that no triangle folds.
    """

    vertices_scan_mm: FloatArray
    seen: BoolArray
    noise_mm: float
    unexplained_mm: float
    damped: int


def dense_surface(
    model: ShapeModel,
    target: ScanTarget,
    vertices_scan_mm: FloatArray,
    T_scan_model: Similarity,
    settings: DenseSettings,
) -> DenseSurface:
    """Return the surface `vertices_scan_mm` moved onto the scan where the scan shows it.

    No triangle folds: none turns over, or against its neighbours, that does not in `vertices_scan_mm`.

    Args:
        model: gives the triangles, and the mean on which the field is smooth.
        target: the scan in its mm frame.
        vertices_scan_mm: (V, 3) the fitted surface in that frame.
        T_scan_model: from the model's frame to the scan's mm frame; settings are in mm of the former.
        settings: of this stage.

    Raises:
        InputError: the model has no triangles.
        FitError: hardly anything of the scan matches the surface.
    """
    topology, T = prepare(model).topology, T_scan_model
    start = T.inverse().apply(vertices_scan_mm)
    matching = _Matching(topology, target, T, start, settings)
    size_mm = rms_size(model.mean_vertices)

    matching.match(start)
    noise_mm, left_mm = matching.noise_mm(), matching.unexplained_mm()
    moved = np.zeros_like(start)
    if left_mm > settings.least_unexplained_mm:
        coarse = _field(model, settings.range_share * size_mm, settings.amplitude * left_mm)
        for _ in range(settings.rounds):
            seen_at, pull_at = matching.gathered(max(noise_mm, matching.spread_mm()))
            want = seen_at * np.einsum("vd,vd->v", matching.normals, moved) - pull_at
            coarse.solve(seen_at, want, matching.normals, moved, settings)
            matching.match(start + moved)
            # Neighbours also disagree where the surface is steep beside the scan, so the last is the best.
            noise_mm = min(noise_mm, matching.noise_mm())

    fine = _field(model, settings.fine_range_share * size_mm, settings.fine_amplitude_mm)
    base, held = unfolded(start, start, start + moved, topology, settings.turn_cosine)
    out, along = np.zeros((len(start), 1)), np.ones((len(start), 1))
    normals = matching.normals.copy()
    seen_at = np.zeros(len(start))
    for round_ in range(settings.fine_rounds):
        if round_:
            matching.match(base + out * normals)
        seen_at, pull_at = matching.gathered(noise_mm)
        fine.solve(seen_at, seen_at * out[:, 0] - pull_at, along, out, settings)
    kept, held_back = unfolded(start, base, base + out * normals, topology, settings.turn_cosine)
    return DenseSurface(T.apply(kept), seen_at * noise_mm**2 > _SEEN, noise_mm, left_mm, int((held | held_back).sum()))


class _Matching:
    """Matches between a surface on the model's triangles and the scan, in the model's frame."""

    def __init__(
        self, topology: Topology, target: ScanTarget, T: Similarity, start: FloatArray, settings: DenseSettings
    ) -> None:
        self.topology, self.target, self.T, self.settings = topology, target, T, settings
        count = len(target.mesh.vertices)
        if count > settings.scan_points:
            rng = np.random.default_rng(settings.seed)
            chosen = np.sort(rng.choice(count, settings.scan_points, replace=False))
        else:
            chosen = np.arange(count)
        self._points = ((target.mesh.vertices[chosen] - T.translation) @ T.rotation) / T.scale
        self._point_normals = target.normals[chosen] @ T.rotation
        used = topology.used
        self._vertex: IntArray = used[KdTree(start[used]).nearest(self._points)[0]]
        self.triangle = np.full(len(chosen), -1, dtype=np.int32)
        self.barycentric = np.empty((len(chosen), 3))
        self.residual, self.distance = np.empty(len(chosen)), np.empty(len(chosen))
        self._cosine, self._covered = np.empty(len(chosen)), np.empty(len(chosen), dtype=np.bool_)
        self._corners = np.empty((len(topology.faces), 9))
        self.normals = np.empty_like(start)
        self.vertices: VertexMatches | None = None
        self._winding = 0.0

    def match(self, x: FloatArray) -> None:
        """Match scan points to the surface with vertices `x` (V, 3), and its vertices to the scan."""
        t, T = self.topology, self.T
        normals_into(x, t.faces, self._corners, self.normals)
        walk_into(
            self._points, self._vertex, x, self._corners, t.faces, t.ring_start, t.ring, t.fan_start, t.fan,
            self.triangle, self.barycentric,
        )  # fmt: skip
        meet_into(
            self._points, self._point_normals, self.triangle, self.barycentric, x, self.normals, t.faces, t.rim,
            self.residual, self.distance, self._cosine, self._covered,
        )  # fmt: skip
        less_sag(self.triangle, self.barycentric, x, self.normals, t.faces, self.residual)
        if self._winding == 0.0:
            self._winding = winding_of(self._cosine, self._covered)
        self.allowed = self._covered & (self._winding * self._cosine > self.settings.normal_cosine)
        if int(self.allowed.sum()) < _FEWEST_MATCHES:
            raise FitError(f"{self.target.mesh.name}: too little of it matches the fitted surface to go on from there.")

        self.vertices = match_vertices(
            self.target, self.target.engine, T, x, self.normals, t.used, self.vertices and self.vertices.near,
            winding=self._winding, normal_cosine=self.settings.normal_cosine,
        )  # fmt: skip

    def spread_mm(self) -> float:
        """Return the spread of the residuals."""
        return spread(self.residual[self.allowed])

    def noise_mm(self) -> float:
        """Return the noise of the scan: how much points that lie next to each other disagree."""
        points = np.flatnonzero(self.allowed)
        points = points[np.argsort(self._vertex[points], kind="stable")]
        pairs = self._vertex[points[1:]] == self._vertex[points[:-1]]
        apart = np.diff(self.residual[points])[pairs]
        noise = spread(apart) / np.sqrt(2.0) if len(apart) >= _FEWEST_PAIRS else self.spread_mm()
        return max(noise, self.settings.least_noise_mm)

    def unexplained_mm(self) -> float:
        """Return the RMS of the residuals' part that is no noise."""
        w, _ = self._weights(self.spread_mm())
        left = unexplained_variance(
            self.triangle, self.barycentric, self.topology.faces, w, self.residual, len(self.normals),
            self.settings.seed,
        )  # fmt: skip
        return float(np.sqrt(max(left, 0.0)))

    def _weights(self, spread_mm: float) -> tuple[FloatArray, FloatArray]:
        s, vertices = self.settings, self.vertices
        assert vertices is not None
        width = s.width * max(spread_mm, s.least_noise_mm)
        far = s.reach * width + s.reach_mm
        w = match_weights(s.weight, self.residual, self.distance, self.allowed, width, far)
        v = match_weights(s.weight, vertices.residual, vertices.distance, vertices.allowed, width, far)
        return w, s.vertex_share * v

    def gathered(self, spread_mm: float) -> tuple[FloatArray, FloatArray]:
        """Return the precision (V,), mm^-2, of what the scan says of each vertex, and the same times the residual."""
        w, v = self._weights(spread_mm)
        seen_at, pull_at = np.zeros(len(self.normals)), np.zeros(len(self.normals))
        gather_into(self.triangle, self.barycentric, self.topology.faces, w, self.residual, seen_at, pull_at)
        assert self.vertices is not None
        seen_at[self.vertices.vertex] += v
        pull_at[self.vertices.vertex] += v * self.vertices.residual
        return seen_at / spread_mm**2, pull_at / spread_mm**2


@dataclass(frozen=True, eq=False)
class Field:
    """A Matern field on a surface: its precision is A M^-1 A.

    Args:
        topology: whose rings the off-diagonal entries follow.
        off_diagonal: (R,) of A.
        diagonal: (V,) of A.
        inverse_mass: (V,) of M.
        stiffness: (V,) the diagonal of A M^-1 A.
    """

    topology: Topology
    off_diagonal: FloatArray
    diagonal: FloatArray
    inverse_mass: FloatArray
    stiffness: FloatArray

    def solve(
        self, seen_at: FloatArray, pull_at: FloatArray, along: FloatArray, x: FloatArray, settings: DenseSettings
    ) -> int:
        """Bring `x` (V, C) to the posterior mean given precisions `seen_at` (V,) and pulls along `along` (V, C)."""
        t = self.topology
        return solve_field(
            t.ring_start, t.ring, self.off_diagonal, self.diagonal, self.inverse_mass, self.stiffness,
            seen_at, pull_at, along, x, settings.tolerance, settings.iterations,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Laplacian:
    off_diagonal: FloatArray
    diagonal: FloatArray
    area: FloatArray


_LAPLACIANS: weakref.WeakKeyDictionary[ShapeModel, _Laplacian] = weakref.WeakKeyDictionary()


def _field(model: ShapeModel, range_mm: float, amplitude_mm: float) -> Field:
    """Return the field with that standard deviation and range on the mean of `model`."""
    t = prepare(model).topology
    if model not in _LAPLACIANS:
        _LAPLACIANS[model] = _laplacian(model.mean_vertices, t)
    laplacian = _LAPLACIANS[model]
    kappa = np.sqrt(8.0) / range_mm
    tau = 1.0 / (np.sqrt(4.0 * np.pi) * kappa * amplitude_mm)
    off = tau * laplacian.off_diagonal
    diagonal = tau * (laplacian.diagonal + kappa**2 * laplacian.area)
    inverse = 1.0 / laplacian.area
    rows = np.repeat(np.arange(len(diagonal)), np.diff(t.ring_start))
    stiffness = diagonal**2 * inverse + np.bincount(rows, off**2 * inverse[t.ring], len(diagonal))
    return Field(t, off, diagonal, inverse, stiffness)


def _laplacian(x: FloatArray, topology: Topology) -> _Laplacian:
    """Return the cotangent Laplacian (positive) of the surface `x` (V, 3) and the area of each vertex."""
    faces, count = topology.faces.astype(np.int64), len(x)
    keys = np.repeat(np.arange(count), np.diff(topology.ring_start)) * count + topology.ring
    off = np.zeros(len(keys))
    for k in range(3):
        i, j, o = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        u, v = x[i] - x[o], x[j] - x[o]
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        # Obtuse triangles have negative weights, and slivers huge ones.
        half = 0.5 * np.clip(np.einsum("fd,fd->f", u, v) / np.maximum(sine, 1e-12), 0.02, 50.0)
        for a, b in ((i, j), (j, i)):
            off -= np.bincount(np.searchsorted(keys, a * count + b), half, len(keys))
    rows = np.repeat(np.arange(count), np.diff(topology.ring_start))
    diagonal: FloatArray = np.asarray(-np.bincount(rows, off, count), dtype=np.float64)
    area = vertex_areas(Mesh(x, topology.faces))
    area = np.maximum(area, _WELL_SHAPED * np.median(area[topology.used]))
    return _Laplacian(off, diagonal, area)


def unfolded(
    start: FloatArray, base: FloatArray, moved: FloatArray, topology: Topology, turn_cosine: float
) -> tuple[FloatArray, BoolArray]:
    """Return `moved` (V, 3) held back towards `base` where triangles would fold, and (V,) where that is.

    A triangle folds when it turns over, or against its neighbours, and did not do so in `start`.

    Args:
        start: (V, 3) the surface to compare with.
        base: (V, 3) one on which nothing is folded.
        moved: (V, 3) the one that is wanted.
        topology: its triangles.
        turn_cosine: cosine of the angle that no triangle turns further than.
    """
    faces = topology.faces
    before = face_vectors(start, faces)
    before /= np.maximum(np.linalg.norm(before, axis=1, keepdims=True), 1e-300)
    corners, normals = np.empty((len(faces), 9)), np.empty_like(start)
    cosine, was_even, even = np.empty(len(faces)), np.empty(len(faces), np.bool_), np.empty(len(faces), np.bool_)
    normals_into(start, faces, corners, normals)
    compare_triangles(start, normals, faces, before, cosine, was_even)
    share, out, halvings = np.ones(len(start)), moved, 0
    can_turn = cosine > turn_cosine  # all but those without area
    while True:
        normals_into(out, faces, corners, normals)
        compare_triangles(out, normals, faces, before, cosine, even)
        folded = (can_turn & (cosine < turn_cosine)) | (was_even & ~even)
        if not folded.any():
            return out, share < 1.0
        held, beside = np.zeros(len(start), dtype=np.bool_), np.zeros(len(start), dtype=np.bool_)
        held[faces[folded]] = True
        beside[faces[held[faces].any(axis=1)]] = True
        halvings += 1
        if halvings <= _HALVINGS:
            share[held] *= 0.5
            share[beside & ~held] *= 0.75
        else:
            # A triangle is as it is by its neighbours' corners, so with all of them on `base` it is no longer folded.
            share[beside] = 0.0
        out = base + share[:, None] * (moved - base)
