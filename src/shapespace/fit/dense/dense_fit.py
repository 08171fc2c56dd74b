"""Dense stage of a fit: smooth displacement fields from the fitted surface to the scan, on the model's triangles.

The field d is a Gaussian process with a Matern covariance, written as a stochastic differential equation on the surface
(Lindgren, Rue and Lindstrom, J. R. Stat. Soc. B 73, 2011), so that its precision is sparse. Its posterior mean given
the matches minimises

    sum_i w_i (n_i^T (x_i + d_i - q_i))^2 / noise^2  +  |(kappa^2 - Laplacian) d|^2 / (4 pi kappa^2 amplitude^2)

with the matches of `robust` (both directions, without borders and disagreeing normals, robustly weighted), each
gathered on the vertices that carry it. Only distances along the normals are matched: tangentially each vertex follows
its neighbours. First d is a vector field whose amplitude depends on the unexplained residual of the fit; then a field
along the normals adds the details. Where nothing is observed both fields fade, and the surface follows the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.compiled import compiled
from shapespace.errors import FitError
from shapespace.fit.robust.kernels import normals_into
from shapespace.fit.robust.matching import Matcher, Matches, MatchHint, Weights, choose_bulging, spread
from shapespace.fit.robust.prepared_model import ModelSurface, Topology, prepare
from shapespace.fit.robust.robust_settings import DenseSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.normals import face_vectors, half_cotangents, owned_areas, rms_size
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity


@compiled
def compare_triangles(
    vertices: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    normals_before: FloatArray,
    cosine: FloatArray,
    even: BoolArray,
) -> None:
    """Compute the rotation of each triangle, and whether it agrees with its neighbours.

    Args:
        vertices: (V, 3) vertices.
        normals: (V, 3) unit normals of the vertices.
        faces: (F, 3) triangles.
        normals_before: (F, 3) unit normals of the triangles before.
        cosine: (F,) output: cosine of the angle between the normals before and now; 0 without area.
        even: (F,) output: whether each triangle lies within 90 degrees of the normals at its corners.
    """
    n = np.empty(3)
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        length, along = 0.0, 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            n[k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
            length += n[k] * n[k]
            along += n[k] * normals_before[f, k]
        cosine[f] = along / np.sqrt(length) if length > 0.0 else 0.0
        even[f] = True
        for corner in range(3):
            v = faces[f, corner]
            if n[0] * normals[v, 0] + n[1] * normals[v, 1] + n[2] * normals[v, 2] <= 0.0:
                even[f] = False


@compiled
def _multiply_into(
    x: FloatArray,
    ring_start: IntArray,
    ring: IntArray,
    off_diagonal: FloatArray,
    diagonal: FloatArray,
    scale: FloatArray,
    out: FloatArray,
) -> None:
    """Write the rows of A x, each times its `scale` (V,)."""
    if x.shape[1] == 3:
        for v in range(len(x)):
            a, b, c = diagonal[v] * x[v, 0], diagonal[v] * x[v, 1], diagonal[v] * x[v, 2]
            for entry in range(ring_start[v], ring_start[v + 1]):
                w, r = off_diagonal[entry], ring[entry]
                a += w * x[r, 0]
                b += w * x[r, 1]
                c += w * x[r, 2]
            out[v, 0], out[v, 1], out[v, 2] = scale[v] * a, scale[v] * b, scale[v] * c
    else:
        for v in range(len(x)):
            a = diagonal[v] * x[v, 0]
            for entry in range(ring_start[v], ring_start[v + 1]):
                a += off_diagonal[entry] * x[ring[entry], 0]
            out[v, 0] = scale[v] * a


@compiled
def _condition_into(
    left: FloatArray, along: FloatArray, seen_at: FloatArray, stiffness: FloatArray, out: FloatArray
) -> float:
    """Write (k I + s n n^T)^-1 left for each vertex, and return its product with `left`."""
    product = 0.0
    for v in range(len(left)):
        k, s, pull = stiffness[v], seen_at[v], 0.0
        for d in range(left.shape[1]):
            pull += along[v, d] * left[v, d]
        pull *= s / (k + s)
        for d in range(left.shape[1]):
            out[v, d] = (left[v, d] - pull * along[v, d]) / k
            product += out[v, d] * left[v, d]
    return product


@compiled
def solve_field(
    ring_start: IntArray,
    ring: IntArray,
    off_diagonal: FloatArray,
    diagonal: FloatArray,
    inverse_mass: FloatArray,
    stiffness: FloatArray,
    seen_at: FloatArray,
    pull_at: FloatArray,
    along: FloatArray,
    x: FloatArray,
    tolerance: float,
    iterations: int,
) -> int:
    """Solve (D + A M^-1 A) x = r by preconditioned conjugate gradients from `x`; return the iterations done.

    D consists of s_v n_v n_v^T for each vertex v, and r of p_v n_v.

    Args:
        ring_start: (V + 1,) start of the neighbours of each vertex in `ring`.
        ring: (R,) neighbours of the vertices.
        off_diagonal: (R,) off-diagonal entries of the symmetric matrix A.
        diagonal: (V,) diagonal of A.
        inverse_mass: (V,) inverse of the diagonal mass matrix M.
        stiffness: (V,) diagonal of A M^-1 A.
        seen_at: (V,) s, the precision of the data at each vertex.
        pull_at: (V,) p, the displacement along the normal that the data suggest, times s.
        along: (V, C) unit vectors n; C is 3, or 1 for a field without direction.
        x: (V, C) start, which is overwritten.
        tolerance: size of the error at which the solver stops, as a share of the first error from a field of zeros.
        iterations: maximum number of iterations.
    """
    ones = np.ones(len(x))
    left, image, between, z = np.empty_like(x), np.empty_like(x), np.empty_like(x), np.empty_like(x)
    for v in range(len(x)):
        for d in range(x.shape[1]):
            left[v, d] = pull_at[v] * along[v, d]
    size = _condition_into(left, along, seen_at, stiffness, z)
    _multiply_into(x, ring_start, ring, off_diagonal, diagonal, inverse_mass, between)
    _multiply_into(between, ring_start, ring, off_diagonal, diagonal, ones, image)
    for v in range(len(x)):
        inner = 0.0
        for d in range(x.shape[1]):
            inner += along[v, d] * x[v, d]
        for d in range(x.shape[1]):
            left[v, d] -= image[v, d] + seen_at[v] * inner * along[v, d]
    product = _condition_into(left, along, seen_at, stiffness, z)
    direction = z.copy()
    for iteration in range(iterations):
        if product <= tolerance * tolerance * size:
            return iteration
        _multiply_into(direction, ring_start, ring, off_diagonal, diagonal, inverse_mass, between)
        _multiply_into(between, ring_start, ring, off_diagonal, diagonal, ones, image)
        curvature = 0.0
        for v in range(len(x)):
            inner = 0.0
            for d in range(x.shape[1]):
                inner += along[v, d] * direction[v, d]
            for d in range(x.shape[1]):
                image[v, d] += seen_at[v] * inner * along[v, d]
                curvature += direction[v, d] * image[v, d]
        step = product / curvature
        for v in range(len(x)):
            for d in range(x.shape[1]):
                x[v, d] += step * direction[v, d]
                left[v, d] -= step * image[v, d]
        previous_product, product = product, _condition_into(left, along, seen_at, stiffness, z)
        keep = product / previous_product
        for v in range(len(x)):
            for d in range(x.shape[1]):
                direction[v, d] = z[v, d] + keep * direction[v, d]
    return iterations


_FEWEST_MATCHES = 30  # with fewer no robust standard deviation is estimated
_FEWEST_PAIRS = 100  # with fewer the noise is not separated from the residual
_HALVINGS = 8  # number of times the step of a folded vertex is halved before it is undone: 1/256 of the step
_SEEN = 0.1
"""Total weight of the matches of a vertex from which on the vertex counts as observed; a good match weighs 1."""


@dataclass(frozen=True, eq=False)
class DenseSurface:
    """The fitted surface displaced onto the scan.

    Args:
        vertices_scan_mm: (V, 3) vertices in the scan's mm frame.
        seen: (V,) False where the scan shows nothing and the vertex follows the model.
        noise_mm: estimated noise of the scan, mm of the model's frame.
        unexplained_mm: RMS of the residuals of the fit without the noise, mm of the model's frame.
        damped: number of vertices that were held back so that no triangle folds.
        moved_mm: RMS displacement of the observed vertices along their normals, mm of the model's frame.
    """

    vertices_scan_mm: FloatArray
    seen: BoolArray
    noise_mm: float
    unexplained_mm: float
    damped: int
    moved_mm: float


def dense_surface(
    model: ShapeModel,
    target: ScanTarget,
    vertices_scan_mm: FloatArray,
    T_scan_model: Similarity,
    settings: DenseSettings,
) -> DenseSurface:
    """Displace the surface `vertices_scan_mm` onto the scan where the scan observes it.

    No triangle folds: a triangle turns over, or against its neighbours, only if it does so in `vertices_scan_mm`.

    Args:
        model: shape model with the triangles, and with the mean on which the field is smooth.
        target: the scan in its mm frame.
        vertices_scan_mm: (V, 3) the fitted surface in that frame.
        T_scan_model: transform from the model's frame to the scan's mm frame; settings are in mm of the model's frame.
        settings: settings of this stage.

    Raises:
        InputError: the model has no triangles.
        FitError: hardly any point of the scan matches the surface.
    """
    topology, T = prepare(model).topology, T_scan_model
    start = T.inverse().apply(vertices_scan_mm)
    surface = ModelSurface.of(topology, start)
    up = surface.normals
    size_mm = rms_size(model.mean_vertices)
    matcher, matches = _first_matches(target, surface, T, settings)
    noise_mm, left_mm = matches.noise_mm, matches.unexplained_mm
    displacement = np.zeros_like(start)
    if left_mm > settings.least_unexplained_mm:
        coarse = _matern_field(model, settings.range_share * size_mm, settings.amplitude * left_mm)
        for _ in range(settings.rounds):
            seen_at, pull_at = matches.gathered(max(noise_mm, matches.spread_mm))
            want = seen_at * np.einsum("vd,vd->v", surface.normals, displacement) - pull_at
            coarse.solve(seen_at, want, surface.normals, displacement, settings)
            surface = ModelSurface.of(topology, start + displacement)
            matches = _match_surface(matcher, surface, T, matches.matches.hint, settings)
            # Neighbours also disagree where the surface is steep compared with the scan, so the last is the best.
            noise_mm = min(noise_mm, matches.noise_mm)

    fine = _matern_field(model, settings.fine_range_share * size_mm, settings.fine_amplitude_mm)
    base, is_folded = revert_folds(start, start, start + displacement, topology, settings.turn_cosine)
    out, along, normals = np.zeros((len(start), 1)), np.ones((len(start), 1)), surface.normals
    seen_at = np.zeros(len(start))
    for round_ in range(settings.fine_rounds):
        if round_:
            surface = ModelSurface.of(topology, base + out * normals)
            matches = _match_surface(matcher, surface, T, matches.matches.hint, settings)
        seen_at, pull_at = matches.gathered(noise_mm)
        fine.solve(seen_at, seen_at * out[:, 0] - pull_at, along, out, settings)
    is_unfolded, held_back = revert_folds(start, base, base + out * normals, topology, settings.turn_cosine)
    is_determined, damped = seen_at * noise_mm**2 > _SEEN, int((is_folded | held_back).sum())
    along_mm = np.einsum("vd,vd->v", up[is_determined], (is_unfolded - start)[is_determined])
    moved_mm = float(np.sqrt((along_mm**2).sum() / max(len(along_mm), 1)))
    return DenseSurface(T.apply(is_unfolded), is_determined, noise_mm, left_mm, damped, moved_mm)


@dataclass(frozen=True, eq=False)
class FieldMatches:
    """Matches of the surface, with the spread and the noise of their residuals.

    Args:
        matches: matches of both directions.
        faces: (F, 3) triangles of the surface.
        vertices: number of vertices of the surface.
        settings: settings of the stage.
        spread_mm: robust standard deviation of the residuals of the scan's points, mm of the model's frame.
        noise_mm: noise of the scan, mm of the model's frame.
    """

    matches: Matches
    faces: IntArray
    vertices: int
    settings: DenseSettings
    spread_mm: float
    noise_mm: float

    def _weights(self, spread_mm: float) -> Weights:
        s = self.settings
        width_mm = s.width * max(spread_mm, s.least_noise_mm)
        return self.matches.weights(s.weight, width_mm, s.reach * width_mm + s.reach_mm, s.vertex_share)

    @property
    def unexplained_mm(self) -> float:
        """RMS of the residuals without the noise."""
        weights = self._weights(self.spread_mm)
        left = self.matches.unexplained_variance(weights, self.faces, self.vertices, self.settings.seed)
        return float(np.sqrt(max(left, 0.0)))

    def gathered(self, spread_mm: float) -> tuple[FloatArray, FloatArray]:
        """Return the precision (V,), mm^-2, of the matches at each vertex, and the precision times the residual."""
        gathered = self.matches.gathered(self._weights(spread_mm), self.faces, self.vertices)
        return gathered.W / spread_mm**2, gathered.h / spread_mm**2


def _first_matches(
    target: ScanTarget, surface: ModelSurface, T: Similarity, settings: DenseSettings
) -> tuple[Matcher, FieldMatches]:
    """Return the matcher and the first matches; it measures distances from flat triangles, or from a smooth surface.

    Raises:
        FitError: hardly any point of the scan matches the surface.
    """
    matcher = _build_matcher(target, surface.topology, settings)
    hint = matcher.first_hint(surface, T)
    matcher = choose_bulging(matcher, surface, T, hint)
    return matcher, _match_surface(matcher, surface, T, hint, settings)


def _build_matcher(target: ScanTarget, topology: Topology, settings: DenseSettings) -> Matcher:
    count = len(target.mesh.vertices)
    chosen = np.arange(count, dtype=np.int32)
    if count > settings.scan_points:
        chosen = np.sort(np.random.default_rng(settings.seed).choice(chosen, settings.scan_points, replace=False))
    return Matcher.of(
        target=target,
        points=chosen,
        vertex=topology.used,
        engine=target.engine,
        normal_cosine=settings.normal_cosine,
    )


def _match_surface(
    matcher: Matcher, surface: ModelSurface, T: Similarity, hint: MatchHint, settings: DenseSettings
) -> FieldMatches:
    """Return the matches of the surface, and the spread and the noise of their residuals.

    Raises:
        FitError: hardly any point of the scan matches the surface.
    """
    matches = matcher.match(surface, T, hint)
    points = np.flatnonzero(matches.points.allowed)
    if len(points) < _FEWEST_MATCHES:
        raise FitError(f"{matcher.target.mesh.name}: too few of its points match the fitted surface to displace it.")
    residual = matches.points.residual
    spread_mm = spread(residual[points])
    # Noise is estimated from the disagreement of neighbouring points.
    nearest = matches.points.nearest
    points = points[np.argsort(nearest[points], kind="stable")]
    pairs = nearest[points[1:]] == nearest[points[:-1]]
    differences = np.diff(residual[points])[pairs]
    noise_mm = spread(differences) / np.sqrt(2.0) if len(differences) >= _FEWEST_PAIRS else spread_mm
    return FieldMatches(
        matches, surface.topology.faces, len(surface.vertices), settings, spread_mm,
        max(noise_mm, settings.least_noise_mm),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MaternField:
    """A Matern field on a surface, with precision A M^-1 A.

    Args:
        topology: triangles and vertex neighbours of the surface; the off-diagonal entries are in the order of `ring`.
        off_diagonal: (R,) off-diagonal entries of A.
        diagonal: (V,) diagonal of A.
        inverse_mass: (V,) inverse of the diagonal of M.
        stiffness: (V,) diagonal of A M^-1 A.
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


def _matern_field(model: ShapeModel, range_mm: float, amplitude_mm: float) -> MaternField:
    """Return the field with that standard deviation and range on the mean of `model`."""
    t = prepare(model).topology
    laplacian = _mean_laplacian(model)
    kappa = np.sqrt(8.0) / range_mm
    tau = 1.0 / (np.sqrt(4.0 * np.pi) * kappa * amplitude_mm)
    off_diagonal = tau * laplacian.off_diagonal
    diagonal = tau * (laplacian.diagonal + kappa**2 * laplacian.area)
    inverse = 1.0 / laplacian.area
    rows = np.repeat(np.arange(len(diagonal)), np.diff(t.ring_start))
    stiffness = diagonal**2 * inverse + np.bincount(rows, off_diagonal**2 * inverse[t.ring], len(diagonal))
    return MaternField(t, off_diagonal, diagonal, inverse, stiffness)


@cached_with_owner()
def _mean_laplacian(model: ShapeModel) -> _Laplacian:
    return _laplacian(model.mean_vertices, prepare(model).topology)


def _laplacian(x: FloatArray, topology: Topology) -> _Laplacian:
    """Return the cotangent Laplacian (positive) of the surface `x` (V, 3) and the area of each vertex."""
    faces, count = topology.faces.astype(np.int64), len(x)
    keys = np.repeat(np.arange(count), np.diff(topology.ring_start)) * count + topology.ring
    off_diagonal = np.zeros(len(keys))
    for k in range(3):
        i, j, o = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        half = half_cotangents(x, i, j, o)
        for a, b in ((i, j), (j, i)):
            off_diagonal -= np.bincount(np.searchsorted(keys, a * count + b), half, len(keys))
    rows = np.repeat(np.arange(count), np.diff(topology.ring_start))
    diagonal: FloatArray = np.asarray(-np.bincount(rows, off_diagonal, count), dtype=np.float64)
    return _Laplacian(off_diagonal, diagonal, owned_areas(Mesh(x, topology.faces)))


def revert_folds(
    start: FloatArray, base: FloatArray, displaced: FloatArray, topology: Topology, turn_cosine: float
) -> tuple[FloatArray, BoolArray]:
    """Return `displaced` (V, 3), pulled back towards `base` where triangles would fold, and the mask (V,) of that.

    A triangle folds when it turns over, or against its neighbours, and did not do so in `start`.

    Args:
        start: (V, 3) the surface to compare with.
        base: (V, 3) a surface without folds.
        displaced: (V, 3) the requested surface.
        topology: triangles of the surface.
        turn_cosine: cosine of the largest angle by which a triangle may turn.
    """
    faces = topology.faces
    normals_before = face_vectors(start, faces)
    normals_before /= np.maximum(np.linalg.norm(normals_before, axis=1, keepdims=True), 1e-300)
    normals = np.empty_like(start)
    cosine, was_even, even = np.empty(len(faces)), np.empty(len(faces), np.bool_), np.empty(len(faces), np.bool_)
    normals_into(start, faces, normals)
    compare_triangles(start, normals, faces, normals_before, cosine, was_even)
    share, out, halvings = np.ones(len(start)), displaced, 0
    can_turn = cosine > turn_cosine  # all but those without area
    while True:
        normals_into(out, faces, normals)
        compare_triangles(out, normals, faces, normals_before, cosine, even)
        folded = (can_turn & (cosine < turn_cosine)) | (was_even & ~even)
        if not folded.any():
            return out, share < 1.0
        is_held, is_neighbour = np.zeros(len(start), dtype=np.bool_), np.zeros(len(start), dtype=np.bool_)
        is_held[faces[folded]] = True
        is_neighbour[faces[is_held[faces].any(axis=1)]] = True
        halvings += 1
        if halvings <= _HALVINGS:
            share[is_held] *= 0.5
            share[is_neighbour & ~is_held] *= 0.75
        else:
            # Only the corners of its neighbours decide whether a triangle is folded; with all on `base`, it is not.
            share[is_neighbour] = 0.0
        out = base + share[:, None] * (displaced - base)
