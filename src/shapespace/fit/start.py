"""Where to begin: the scan's unit, and a pose of the mean shape from landmarks or from many rotations.

A start with centroids together holds to about 45 degrees. Beyond that many rotations are tried coarsely at fixed scale,
scored both ways with the worst matches trimmed, and the best are refined unless no rotation is clearly best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.errors import FitError, InputError
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh, Similarity

_COARSE_POINTS = (300, 4_000)
_FINE_POINTS = (1_200, 12_000)
_COARSE_ITERATIONS = 15
_FINE_ITERATIONS = 80
_REFINED = 6
_KEPT_SHARE = 0.8
_COARSE_RATE = 5e-3
_FINE_RATE = 5e-4
_SAME_TURN_COSINE = 0.94
_CLEARLY_UPRIGHT = 0.82
_PREFER_UPRIGHT = 0.85
_TYPICAL_COVER = 1.2
_INCH_IS_RARE = 0.5


@dataclass(frozen=True, eq=False)
class Start:
    """A pose to begin from.

    Args:
        T_scan_model: from the model's frame to the scan's frame in mm.
        how: `landmarks`, `upright` (no rotation), `rotations` (another of the rotations tried was better), `given`.
        score_mm: two-way trimmed distance of the mean shape there, mm; not-a-number for landmarks and `given`.
    """

    T_scan_model: Similarity
    how: str
    score_mm: float


def find_unit(model: ShapeModel, scan: Mesh) -> str:
    """Return the unit, a name of `MM_PER_UNIT`, that makes the scan's size most like the model's.

    Raises:
        FitError: no unit brings the sizes within a factor of five.
    """
    ratio = _size(scan.vertices) / _size(model.mean_vertices)
    penalty = {
        unit: abs(np.log(ratio * mm / _TYPICAL_COVER)) + (_INCH_IS_RARE if unit == "inch" else 0.0)
        for unit, mm in MM_PER_UNIT.items()
    }
    unit = min(penalty, key=lambda name: penalty[name])
    if not 0.2 < ratio * MM_PER_UNIT[unit] < 5.0:
        raise FitError(
            f"{scan.name}: in no unit (um, mm, cm, inch, m) is it of the model's size; give its unit, or crop it to "
            "what the model shows."
        )
    return unit


def start_from_landmarks(
    model: ShapeModel, scan_landmarks_mm: Mapping[str, FloatArray], scan_name: str, *, with_scale: bool
) -> Start:
    """Return the least-squares pose of the model's landmarks on those of the scan that share their names.

    Raises:
        FitError: the model has no landmarks, or fewer than three names are shared.
    """
    if not model.landmarks:
        raise FitError(f"The model has no landmarks, so those given for {scan_name} cannot be used; leave them out.")
    names = [name for name in model.landmarks if name in scan_landmarks_mm]
    if len(names) < 3:
        raise FitError(
            f"{scan_name}: only {len(names)} of its landmarks share a name with the model's, and three are needed; "
            f"the model has {', '.join(list(model.landmarks)[:5])} and so on, the scan "
            f"{', '.join(list(scan_landmarks_mm)[:5]) or 'none'}."
        )
    source = model.mean_vertices[[model.landmarks[name] for name in names]]
    target = np.stack([scan_landmarks_mm[name] for name in names])
    try:
        T = fit_similarity(source, target, with_scale=with_scale)
    except InputError as error:
        raise FitError(
            f"{scan_name}: its landmarks give no pose, since they lie on a line or are not finite; check them."
        ) from error
    return Start(T, "landmarks", float("nan"))


def start_from_any_pose(model: ShapeModel, scan_vertices_mm: FloatArray, *, seed: int) -> Start:
    """Return the best pose of the mean shape over no rotation and the 23 other rotations of the cube.

    The scale stays 1 here: a scale that is free finds it cheapest to vanish. No rotation wins unless another is
    clearly better, since scans mostly come upright and a smooth skull fits a face from behind.

    Args:
        model: its mean shape is placed.
        scan_vertices_mm: (S, 3).
        seed: of the subsample that is searched.
    """
    rng = np.random.default_rng(seed)
    coarse = _Points.of(model.mean_vertices, scan_vertices_mm, _COARSE_POINTS, rng)
    fine = _Points.of(model.mean_vertices, scan_vertices_mm, _FINE_POINTS, rng)
    centre_model, centre_scan = model.mean_vertices.mean(axis=0), scan_vertices_mm.mean(axis=0)
    starts = list(Rotation.create_group("O").as_matrix())
    starts.sort(key=lambda R: -np.trace(R))  # no rotation first
    tried: list[tuple[float, Similarity]] = []
    for R in starts:
        T = Similarity(1.0, R, centre_scan - R @ centre_model)
        T = _trimmed_rigid_icp(coarse, T, _COARSE_ITERATIONS, _COARSE_RATE)
        tried.append((_two_way_score(coarse, T), T))
    upright, ranked = tried[0], sorted(tried[1:], key=lambda item: item[0])
    others = _distinct(ranked, upright[1])[: _REFINED - 1]
    if others and upright[0] < _CLEARLY_UPRIGHT * others[0][0]:
        others = []
    # Coarse points cannot tell a face from the back of a head, so the best are compared on fine ones.
    refined: list[tuple[float, Similarity]] = []
    for _, T in [upright, *others]:
        T = _trimmed_rigid_icp(fine, T, _FINE_ITERATIONS, _FINE_RATE)
        refined.append((_two_way_score(fine, T), T))
    best = min(refined, key=lambda item: item[0])
    if best[0] < _PREFER_UPRIGHT * refined[0][0]:
        return Start(best[1], "rotations", best[0])
    return Start(refined[0][1], "upright", refined[0][0])


@dataclass(frozen=True, eq=False)
class _Points:
    """A sample of the mean shape and of the scan to search on, mm."""

    mean: FloatArray
    scan: FloatArray
    tree: cKDTree

    @staticmethod
    def of(mean: FloatArray, scan: FloatArray, counts: tuple[int, int], rng: np.random.Generator) -> _Points:
        thinned = _thin(scan, counts[1], rng)
        return _Points(_thin(mean, counts[0], rng), thinned, cKDTree(thinned))


def _distinct(ranked: list[tuple[float, Similarity]], first: Similarity) -> list[tuple[float, Similarity]]:
    """Return `ranked` without poses that turn nearly as `first` or as a better one does."""
    kept: list[tuple[float, Similarity]] = []
    for score, T in ranked:
        others = [first, *(other for _, other in kept)]
        if all(np.trace(T.rotation @ other.rotation.T) < 1 + 2 * _SAME_TURN_COSINE for other in others):
            kept.append((score, T))
    return kept


def _trimmed_rigid_icp(points: _Points, T: Similarity, iterations: int, rate: float) -> Similarity:
    """Return `T` after rigid ICP that leaves out the farthest fifth of the matches (Chetverikov et al., 2002)."""
    keep = int(np.ceil(_KEPT_SHARE * len(points.mean)))
    before = np.inf
    for _ in range(iterations):
        distance, index = points.tree.query(T.apply(points.mean))
        near = np.argpartition(distance, keep - 1)[:keep]
        error = float(np.asarray(distance)[near].mean())
        if error > (1 - rate) * before:
            break
        before = error
        T = fit_similarity(points.mean[near], points.scan[np.asarray(index)[near]], with_scale=False)
    return T


def _two_way_score(points: _Points, T: Similarity) -> float:
    """Return the trimmed mean distance both ways, mm; of the scan only what lies within the model's reach counts."""
    placed = T.apply(points.mean)
    forward = np.sort(points.tree.query(placed)[0])[: int(np.ceil(_KEPT_SHARE * len(placed)))]
    centre = placed.mean(axis=0)
    reach = np.linalg.norm(placed - centre, axis=1).max()
    near = points.scan[np.linalg.norm(points.scan - centre, axis=1) <= reach]
    if len(near) == 0:
        return float("inf")
    backward = np.sort(cKDTree(placed).query(near)[0])[: int(np.ceil(0.5 * len(near)))]
    return 0.5 * float(forward.mean() + backward.mean())


def _thin(points: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    return points if len(points) <= count else points[rng.choice(len(points), count, replace=False)]


def _size(points: FloatArray) -> float:
    return float(np.sqrt(((points - np.median(points, axis=0)) ** 2).sum(axis=1).mean()))
