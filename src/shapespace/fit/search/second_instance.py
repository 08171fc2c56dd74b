"""Parts of a scan that the fit does not explain: a second instance, overlapping surfaces, displaced parts.

They are searched for only if the evidence of the fit suggests them: much of the scan far from the fitted
surface, or matched points far apart. All lengths are shares of the model's size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shapespace.errors import FitError, InputError
from shapespace.fit.diagnostics.failure_model import failure_score, is_doubtful
from shapespace.fit.iteration_state import RobustFitted, last_of
from shapespace.fit.robust.matching import spread
from shapespace.fit.robust.robust_icp import robust_icp
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.fit.search.left_out_fits import fit_left_out
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import boundary_vertices, part_of, vertex_normals
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

# Chosen on fits of `benchmarks/reliability.py`, heads, hair and collars, and a real scan with hair and neck.
_NEAR = 0.05
_EXPLAINED = 0.75  # share of the scan near the fit above which no second instance is sought
_LEAST_REST = 0.25  # smallest share of the scan that a second instance may have
_SCORED = 0.075  # largest mean capped distance of a second instance, as a share of its size
_AS_GOOD = 2.0  # ratio of residual standard deviations up to which the second fit counts as an equal
_APART = 0.011  # residual standard deviation, share of the size, below which one surface explains the scan
# trimmed ICP: model points, start positions, iterations, inlier share, distance caps (share of the size)
_GLANCED, _PLACES, _ROUNDS, _TRIMMED, _FARTHEST, _CAP = 150, 40, 25, 0.7, 0.5, 0.1
# sampled scan points, nearest points of each (with itself), fewest points to judge by
_POINTS, _NEIGHBOURS, _FEWEST = 2_000, 7, 100
_TIGHT, _LEAST_SIDE = 0.5, 2  # two layers: largest width of one relative to the gap, and fewest points on each side

# displaced points, fewer cannot show whether a similarity explains them; iterations, a shift along the surface is slow
_FEWEST_MOVED, _MOVES = 30, 100
_LARGEST_SCALE = 2.0  # scale of a part moved onto the surface, or its inverse; another shape would shrink to a point

# Chosen on the development seeds of `benchmarks/odd_cases.py`, and on 42 heads with hair.
_ALL_EXPLAINED = 0.97
_DISPLACED = (0.04, 0.45)  # range of the distance to the fit, as shares of the model's size
# distance in residual sd, relative variation among neighbours, cosine to the normal
_SPREADS, _ALIKE, _ALONG_NORMAL = 3.0, 0.35, 0.8


@dataclass(frozen=True)
class SecondInstance:
    """A second instance of the object in the scan.

    Args:
        away_mm: distance of its centroid from that of the first, mm of the scan.
        gap_mm: gap between the two along the line through their centroids, mm of the scan; negative if they
            overlap.

    Example:
        >>> fit.evidence.second_instance_mm is None  # a second face in the scan
        True
    """

    away_mm: float
    gap_mm: float

    @property
    def note(self) -> str:
        """Sentence for the notes of a fit."""
        return (
            f"The scan shows a second instance that the model fits as well, {self.away_mm:.0f} mm away; crop it to one "
            "of them (--crop)."
        )


def find_second_instance(
    model: ShapeModel, target: ScanTarget, fitted: RobustFitted, settings: RobustSettings, *, with_scale: bool
) -> SecondInstance | None:
    """Return a second instance that the model fits about as well as the first, or None.

    The model is fitted to the unexplained part of the scan, and the status of that fit is estimated as usual.

    Args:
        model: the shape model.
        target: the scan in its mm frame.
        fitted: result of the fit to the scan.
        settings: settings of the robust method.
        with_scale: whether the pose has a free scale.
    """
    if fitted.match_evidence.scan_near_share > _EXPLAINED:
        return None
    size_mm = fitted.match_evidence.size_mm
    placed = build_engine(Mesh(fitted.vertices_scan_mm, model.faces))
    is_far = placed.query(target.mesh.vertices).distance > _NEAR * size_mm
    if is_far.sum() < max(_FEWEST, _LEAST_REST * len(is_far)):
        return None
    remaining_target = ScanTarget(part_of(target.mesh, is_far))
    T = _fit_pose_again(fitted, remaining_target.mesh.vertices, size_mm)
    if T is None:
        return None
    try:
        second_fit = last_of(
            robust_icp(model, remaining_target, Start(T, "given", float("nan")), settings, with_scale=with_scale)
        )
    except (FitError, InputError):
        return None
    own, second_evidence = fitted.match_evidence, second_fit.match_evidence
    if failure_score(second_evidence) > 0.0 or second_evidence.spread_mm / second_evidence.size_mm > (
        _AS_GOOD * own.spread_mm / own.size_mm
    ):
        return None
    first, second = fitted.vertices_scan_mm, second_fit.vertices_scan_mm
    offset = second.mean(axis=0) - first.mean(axis=0)
    away = float(np.linalg.norm(offset))
    towards = offset / max(away, 1e-12)
    gap = float((second @ towards).min() - (first @ towards).max())
    return SecondInstance(away, gap)


@dataclass(frozen=True)
class Displaced:
    """Unexplained parts of a scan; the fields are those of `ScanEvidence`."""

    displaced_share: float = 0.0
    displaced_inward_share: float = 0.0
    displaced_purity: float = 0.0
    scattered_share: float = 0.0


@dataclass(frozen=True)
class DisplacedTest:
    """Comparison of displaced parts with the fitted surface; the fields are those of `FitEvidence`."""

    displaced_moved_mm: float | None = None
    displaced_bound: float | None = None


@dataclass(frozen=True)
class Layers:
    """Two surfaces of a scan on top of each other; the fields are those of `ScanEvidence`."""

    layered_share: float = 0.0
    layers_apart_mm: float = 0.0


def find_displaced(model: ShapeModel, target: ScanTarget, fitted: RobustFitted) -> Displaced:
    """Return the shares of the scan that run along the fitted surface at a distance, and that scatter.

    If the parts of a scan differ in scale or pose, the fit follows one part, and the others run along the surface at
    a distance. Around a displaced point the heights over the fitted surface are alike, and little else of the scan is
    unexplained. Outliers, noise and loose hair scatter: heights around a point differ. All shares are zero if the fit
    explains nearly all of the scan.

    Args:
        model: the shape model.
        target: the scan in its mm frame.
        fitted: result of the fit to the scan.
    """
    return _displaced_points(model, target, fitted)[0]


def compare_displaced(
    model: ShapeModel, target: ScanTarget, fitted: RobustFitted, settings: RobustSettings, *, with_scale: bool
) -> DisplacedTest:
    """Move the displaced part onto the fitted surface, and compare its share with those of held-out training shapes.

    If a part was assembled wrongly, the model explains the rest, and a similarity moves the part onto the surface.
    Training shapes, at the vertices that the scan shows, are fitted by the model of the other shapes: a model of few
    shapes leaves parts of a new shape at a distance too.

    Args:
        model: the shape model.
        target: the scan in its mm frame.
        fitted: result of the fit to the scan.
        settings: settings of the robust method.
        with_scale: whether the pose has a free scale.
    """
    points = _displaced_points(model, target, fitted)[1]
    if len(points) < _FEWEST_MOVED or is_doubtful(fitted.match_evidence):
        return DisplacedTest()
    surface = Mesh(fitted.vertices_scan_mm, model.faces)
    engine, T = build_engine(surface), Similarity.identity()
    nearest = engine.query(points)
    for _ in range(_MOVES):
        T = fit_similarity(points, nearest.points)
        nearest = engine.query(T.apply(points), nearest)
    if not 1.0 / _LARGEST_SCALE < T.scale < _LARGEST_SCALE:
        return DisplacedTest()
    offset = T.apply(points) - nearest.points
    moved_mm = spread(np.einsum("ij,ij->i", offset, vertex_normals(surface)[nearest.vertex]))
    if moved_mm > _AS_GOOD * fitted.match_evidence.spread_mm:
        return DisplacedTest(moved_mm)
    left_out = fit_left_out(model, fitted, settings, with_scale=with_scale)
    return DisplacedTest(moved_mm, max((find_displaced(*each).displaced_share for each in left_out), default=None))


def _displaced_points(model: ShapeModel, target: ScanTarget, fitted: RobustFitted) -> tuple[Displaced, FloatArray]:
    """Return the shares, and the displaced points (M, 3), mm of the scan."""
    # Heights are compared with those of neighbours; fewer points than these have too few neighbours.
    if len(target.mesh.vertices) < _NEIGHBOURS or fitted.match_evidence.scan_near_share > _ALL_EXPLAINED:
        return Displaced(), np.zeros((0, 3))
    size, spread_mm = fitted.match_evidence.size_mm, fitted.match_evidence.spread_mm
    points = target.mesh.vertices[target.draw(_POINTS, np.random.default_rng(0))]
    surface = Mesh(fitted.vertices_scan_mm, model.faces)
    nearest = build_engine(surface).query(points)
    height = np.einsum("ij,ij->i", points - nearest.points, vertex_normals(surface)[nearest.vertex])
    around = height[np.asarray(cKDTree(points).query(points, _NEIGHBOURS)[1], dtype=np.int32)[:, 1:]]
    alike = np.median(np.abs(around - height[:, None]), axis=1) < _ALIKE * np.abs(height)
    inside = ~boundary_vertices(surface)[nearest.vertex]
    limit = max(_DISPLACED[0] * size, _SPREADS * spread_mm)
    is_displaced = (np.abs(height) > limit) & (nearest.distance < _DISPLACED[1] * size) & alike & inside
    is_displaced &= np.abs(height) > _ALONG_NORMAL * nearest.distance
    far_share = max(float((nearest.distance > limit).mean()), 1.0 / len(points))
    shares = Displaced(
        displaced_share=float(is_displaced.mean()),
        displaced_inward_share=float((is_displaced & (height < 0.0)).mean()),
        displaced_purity=float(is_displaced.mean() / far_share),
        scattered_share=float(((nearest.distance > _DISPLACED[0] * size) & inside & ~alike).mean()),
    )
    return shares, points[is_displaced]


def find_layers(model: ShapeModel, target: ScanTarget, fitted: RobustFitted) -> Layers:
    """Return the share of the scan with two surfaces on top of each other, and their distance.

    Around a point of such a scan the heights over the fitted surface fall into two tight groups with a gap between.
    Noise leaves no gap, and points scattered off the surface form no tight group. Share and distance are zero if no
    such points are found, or if the matched points are so close to the surface that the search is skipped.

    Args:
        model: the shape model.
        target: the scan in its mm frame.
        fitted: result of the fit to the scan.
    """
    size_mm = fitted.match_evidence.size_mm
    if fitted.match_evidence.spread_mm < _APART * size_mm:
        return Layers()
    points = target.mesh.vertices[target.draw(_POINTS, np.random.default_rng(0))]
    surface = Mesh(fitted.vertices_scan_mm, model.faces)
    nearest = build_engine(surface).query(points)
    is_near = nearest.distance < 2 * _NEAR * size_mm
    if is_near.sum() < _FEWEST:
        return Layers()
    normals = vertex_normals(surface)[nearest.vertex[is_near]]
    height = np.einsum("ij,ij->i", (points - nearest.points)[is_near], normals)
    feet = nearest.points[is_near]
    heights = np.sort(height[cKDTree(feet).query(feet, _NEIGHBOURS)[1]], axis=1)
    gaps = np.diff(heights, axis=1)[:, _LEAST_SIDE - 1 : _NEIGHBOURS - _LEAST_SIDE]
    split = gaps.argmax(axis=1) + _LEAST_SIDE
    rows = np.arange(len(split))
    gap = gaps.max(axis=1)
    widest = np.maximum(heights[rows, split - 1] - heights[:, 0], heights[:, -1] - heights[rows, split])
    layered = widest < _TIGHT * gap
    if not layered.any():
        return Layers()
    return Layers(float(layered.mean()), float(np.median(gap[layered])))


def _fit_pose_again(fitted: RobustFitted, remaining_points: FloatArray, size_mm: float) -> Similarity | None:
    """Return the pose, of similar rotation, at which the fitted shape lies on `remaining_points` (R, 3), or None.

    It is far faster than a search, which a head or a collar around a face would otherwise require.
    """
    T, tree, rng = fitted.T_scan_fitted, cKDTree(remaining_points), np.random.default_rng(0)
    x = fitted.vertices_scan_mm[rng.choice(len(fitted.vertices_scan_mm), _GLANCED)]

    def score(points: FloatArray, cap: float) -> FloatArray:
        return np.minimum(tree.query(points)[0], cap * size_mm).mean(axis=-1)

    places = remaining_points[rng.choice(len(remaining_points), _PLACES)] - x[rng.choice(_GLANCED, _PLACES)]
    places = np.vstack([np.median(remaining_points, axis=0) - np.median(x, axis=0), places])
    move = Similarity(1.0, np.eye(3), places[int(np.argmin(score(x + places[:, None], _FARTHEST)))])
    for _ in range(_ROUNDS):
        distance, nearest = tree.query(move.apply(x))
        is_near = np.asarray(distance <= np.quantile(distance, _TRIMMED), dtype=np.bool_)
        move = fit_similarity(x[is_near], remaining_points[np.asarray(nearest)[is_near]], with_scale=False)
    return move @ T if float(score(move.apply(x), _CAP)) < _SCORED * size_mm else None
