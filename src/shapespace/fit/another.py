"""What a scan shows beside what was fitted: another one of the kind, or two surfaces on top of each other.

Both are looked for only where the evidence of the fit leaves room for them: much of the scan far from the fitted
surface, or matched points far apart. All lengths are shares of the model's size.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from scipy.spatial import cKDTree

from shapespace.errors import FitError, InputError
from shapespace.fit.robust import robust_icp
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.settings import RobustSettings
from shapespace.fit.start import Start
from shapespace.fit.state import Fitted, IcpState
from shapespace.fit.trust import score
from shapespace.geometry.closest import build_engine
from shapespace.geometry.similarity import fit_similarity
from shapespace.geometry.surface import part_of, rms_size, vertex_normals
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

# Chosen on fits of `benchmarks/reliability.py`, heads, hair and collars, and a real scan with hair and neck.
_NEAR = 0.05
_EXPLAINED = 0.75
_LEAST_REST = 0.25
_SCORED = 0.075
_AS_GOOD = 2.0
_APART = 0.011
_GLANCED, _PLACES, _ROUNDS, _TRIMMED, _FARTHEST, _CAP = 150, 40, 25, 0.7, 0.5, 0.1
_POINTS, _NEIGHBOURS, _FEWEST = 2_000, 7, 100
_TIGHT, _LEAST_SIDE = 0.5, 2


def another_beside(
    model: ShapeModel, target: ScanTarget, fitted: Fitted, settings: RobustSettings, *, with_scale: bool
) -> str | None:
    """Return a sentence where the scan shows another one that the model fits about as well; None where it does not.

    The model is fitted to what the fit left unexplained, and that fit is judged as any other.

    Args:
        model: the shape space.
        target: the scan in its mm frame.
        fitted: where the fit to it ended.
        settings: of the robust method.
        with_scale: whether the pose has a free scale.
    """
    if fitted.evidence["scan_near_share"] > _EXPLAINED:
        return None
    size_mm, scale = rms_size(model.mean_vertices), fitted.T_scan_fitted.scale
    placed = build_engine(Mesh(fitted.vertices_scan_mm, model.faces))
    far = placed.query(target.mesh.vertices).distance > _NEAR * size_mm * scale
    if far.sum() < max(_FEWEST, _LEAST_REST * len(far)):
        return None
    rest = ScanTarget(part_of(target.mesh, far))
    T = _same_moved(fitted, rest.mesh.vertices, size_mm)
    if T is None:
        return None
    try:
        other = _end(robust_icp(model, rest, Start(T, "given", float("nan")), settings, with_scale=with_scale))
    except (FitError, InputError):
        return None
    if score(other.evidence) > 0.0 or other.evidence["spread_mm"] > _AS_GOOD * fitted.evidence["spread_mm"]:
        return None
    away = np.linalg.norm(other.vertices_scan_mm.mean(axis=0) - fitted.vertices_scan_mm.mean(axis=0)) / scale
    return (
        f"The scan shows another one that the model fits as well, {away:.0f} mm away; crop it to the one you mean "
        "(--crop)."
    )


def layers(model: ShapeModel, target: ScanTarget, fitted: Fitted) -> dict[str, float]:
    """Return over which share of the scan there are two surfaces on top of each other, and how far apart, by name.

    Around a point of such a scan the heights over the fitted surface fall into two tight groups with a gap between.
    Noise leaves no gap, and what is thrown off the surface forms no tight group. Both are zero where matched points lie
    so close that it is not looked for.

    Args:
        model: the shape space.
        target: the scan in its mm frame.
        fitted: where the fit to it ended.
    """
    size_mm, scale = rms_size(model.mean_vertices), fitted.T_scan_fitted.scale
    found = {"layered_share": 0.0, "layers_apart_mm": 0.0}
    if fitted.evidence["spread_mm"] < _APART * size_mm:
        return found
    points = target.mesh.vertices[target.draw(_POINTS, np.random.default_rng(0))]
    surface = Mesh(fitted.vertices_scan_mm, model.faces)
    at = build_engine(surface).query(points)
    near = at.distance < 2 * _NEAR * size_mm * scale
    if near.sum() < _FEWEST:
        return found
    normals = vertex_normals(surface)[at.vertex[near]]
    height = np.einsum("ij,ij->i", (points - at.points)[near], normals)
    feet = at.points[near]
    heights = np.sort(height[cKDTree(feet).query(feet, _NEIGHBOURS)[1]], axis=1)
    gaps = np.diff(heights, axis=1)[:, _LEAST_SIDE - 1 : _NEIGHBOURS - _LEAST_SIDE]
    split = gaps.argmax(axis=1) + _LEAST_SIDE
    rows = np.arange(len(split))
    gap = gaps.max(axis=1)
    widest = np.maximum(heights[rows, split - 1] - heights[:, 0], heights[:, -1] - heights[rows, split])
    layered = widest < _TIGHT * gap
    if layered.any():
        found = {
            "layered_share": float(layered.mean()),
            "layers_apart_mm": float(np.median(gap[layered])) / scale,
        }
    return found


def _same_moved(fitted: Fitted, rest: FloatArray, size_mm: float) -> Similarity | None:
    """Return the pose at which the shape that was fitted, turned much as it is, lies on `rest` (R, 3); None for none.

    It is far cheaper than a search, which a head or a collar around a face would otherwise cost.
    """
    T, tree, rng = fitted.T_scan_fitted, cKDTree(rest), np.random.default_rng(0)
    x = fitted.vertices_scan_mm[rng.choice(len(fitted.vertices_scan_mm), _GLANCED)]

    def score(points: FloatArray, cap: float) -> FloatArray:
        return np.minimum(tree.query(points)[0], cap * size_mm * T.scale).mean(axis=-1)

    places = rest[rng.choice(len(rest), _PLACES)] - x[rng.choice(_GLANCED, _PLACES)]
    places = np.vstack([np.median(rest, axis=0) - np.median(x, axis=0), places])
    move = Similarity(1.0, np.eye(3), places[int(np.argmin(score(x + places[:, None], _FARTHEST)))])
    for _ in range(_ROUNDS):
        distance, nearest = tree.query(move.apply(x))
        kept = np.asarray(distance <= np.quantile(distance, _TRIMMED), dtype=np.bool_)
        move = fit_similarity(x[kept], rest[np.asarray(nearest)[kept]], with_scale=False)
    return move @ T if float(score(move.apply(x), _CAP)) < _SCORED * size_mm * T.scale else None


def _end(states: Generator[IcpState, None, Fitted]) -> Fitted:
    while True:
        try:
            next(states)
        except StopIteration as end:
            return end.value
