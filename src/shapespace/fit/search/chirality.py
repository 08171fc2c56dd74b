"""Chirality: whether the mirror image of a scan fits a model that is not mirror-symmetric better than the scan does.

Left and right bones, or a scan exported with one axis negated, differ by a reflection that no pose undoes. A model with
enough modes follows the mirror image too, so that the distances alone do not reveal it. Therefore the reflected scan is
fitted as well, and the two are compared by the distances both ways and the prior of the coefficients. The cheap search
of `start_from_any_pose` comes first; only if the reflected scan fits about as well, or better, is it fitted completely.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from shapespace.errors import FitError, InputError
from shapespace.fit.diagnostics.failure_model import failure_score
from shapespace.fit.iteration_state import Fitted, RobustFitted, last_of
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.fit.robust.robust_icp import robust_icp
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.fit.search.left_out_fits import fit_left_out
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import find_mirror
from shapespace.geometry.normals import rms_size
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

# Shares of the size. The means of 60 faces are 0.002 from their mirror images, those of femora, spleens and hippocampi
# 0.04 to 0.09 (`benchmarks/odd_cases.py`).
_LEAST_ASYMMETRY = 0.005
_LEAST_OF_SPREAD = 0.2
"""Asymmetry as a share of the standard deviation of the model's shapes; below it the modes absorb a reflection."""
_CLEARLY_WORSE = 1.1
"""Ratio of the scores of the search above which the reflected scan is not fitted completely."""
_PATCHES = 100.0
"""Number of independent residuals of a surface; the smallest number in `posterior`."""
_FLIP = np.diag([-1.0, 1.0, 1.0])
_CAP, _POINTS, _VERTICES = 0.05, 2_000, 1_000
"""Cap of the distances as a share of the size, and number of points of the scan and vertices of the model."""


@cached_with_owner()
def is_asymmetric(model: ShapeModel) -> bool:
    """Return whether the mean differs from its mirror image by more than the modes can represent.

    It is computed once for each model. A model without triangles counts as symmetric.
    """
    if model.faces is None:
        return False
    spread = math.sqrt(float((model.stddev**2).sum()) / model.n_vertices) / rms_size(model.mean_vertices)
    return find_mirror(model.mesh()).off_share > max(_LEAST_ASYMMETRY, _LEAST_OF_SPREAD * spread)


@dataclass(frozen=True)
class MirrorTest:
    """Comparison of the scan with its mirror image; the fields are those of `FitEvidence`."""

    mirrored_log_odds: float
    mirrored_apart_mm: float | None = None
    mirrored_bound: float | None = None


def compare_with_mirror_image(
    model: ShapeModel, target: ScanTarget, fitted: RobustFitted, settings: RobustSettings, *, with_scale: bool
) -> MirrorTest | None:
    """Return whether the mirror image fits better, and than those of training shapes do; None if undecidable.

    If the model explains neither the scan nor its mirror image, the better fit of the two is chance. Therefore
    the bound is computed only if the mirror image fits better, with a failure score up to zero: training shapes, at the
    vertices that the scan shows, are fitted by the model of the other shapes.

    Args:
        model: the shape model; if its mean is too symmetric, the chirality is undecidable.
        target: the scan in its mm frame.
        fitted: result of the fit to the scan.
        settings: settings of the robust method.
        with_scale: whether the pose has a free scale.
    """
    if not is_asymmetric(model):
        return None
    compared = _compare(model, target, fitted, settings, with_scale=with_scale)
    if compared is None:
        return None
    log_odds, mirror_fit = compared
    if mirror_fit is None:
        return MirrorTest(log_odds)
    apart = np.linalg.norm(mirror_fit.vertices_scan_mm @ _FLIP - fitted.vertices_scan_mm, axis=1)
    test = MirrorTest(log_odds, float(apart.mean()))
    if log_odds <= 0.0 or failure_score(mirror_fit.match_evidence) > 0.0:
        return test
    left_out = fit_left_out(model, fitted, settings, with_scale=with_scale)
    tests = [_compare(*each, settings, with_scale=with_scale) for each in left_out]
    return replace(test, mirrored_bound=max((each[0] for each in tests if each is not None), default=None))


def _compare(
    model: ShapeModel, target: ScanTarget, fitted: Fitted, settings: RobustSettings, *, with_scale: bool
) -> tuple[float, RobustFitted | None] | None:
    """Return the log odds that a scan is mirrored, and the fit to its mirror image.

    The fit is None if the mirror image fits clearly worse, or cannot be fitted. The function returns None if the pose
    search of the scan as given fails.
    """
    from shapespace.fit.search.pose_search import MIDDLE, refine  # compiled

    scan = target.mesh
    reflected = scan.vertices @ _FLIP
    T = fitted.T_scan_fitted
    # The pose search is for scans of the model's size.
    scale, unscaled = T.scale, Similarity(1.0 / T.scale, np.eye(3), np.zeros(3))
    T = unscaled @ T
    scan_pose = refine(model, scan.vertices / scale, [T], with_scale=with_scale)[0]
    starts = [_reflected_pose(T, _FLIP, Q, model.mean_vertices.mean(axis=0)) for Q in _reflections(model)]
    coarse = refine(model, reflected / scale, starts, with_scale=with_scale, step=MIDDLE)
    best = min(coarse, key=lambda pose: pose.score_mm)
    mirrored_pose = refine(model, reflected / scale, [best.T_scan_model], with_scale=with_scale)[0]
    if not math.isfinite(scan_pose.score_mm):
        return None
    ratio = mirrored_pose.score_mm / max(scan_pose.score_mm, 1e-12)
    if ratio > _CLEARLY_WORSE:
        return -_PATCHES * math.log(min(ratio, 1e6)), None
    faces = None if scan.faces is None else scan.faces[:, ::-1]
    mirror = replace(target, mesh=Mesh(reflected, faces, name=scan.name, parts=scan.parts))
    start = Start(unscaled.inverse() @ mirrored_pose.T_scan_model, "given", float("nan"), mirrored_pose.b)
    try:
        mirror_fit = last_of(robust_icp(model, mirror, start, settings, with_scale=with_scale))
    except (FitError, InputError):
        return -_PATCHES * math.log(_CLEARLY_WORSE), None
    return _cost(model, target, fitted) - _cost(model, mirror, mirror_fit), mirror_fit


def _reflections(model: ShapeModel) -> list[FloatArray]:
    """Return four reflections (3, 3) that move the mean least: about its three principal planes, and its centre."""
    x = model.mean_vertices
    axes = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2]
    return [*(np.eye(3) - 2.0 * np.outer(axis, axis) for axis in axes), -np.eye(3)]


def _reflected_pose(T: Similarity, flip: FloatArray, Q: FloatArray, centre: FloatArray) -> Similarity:
    """Return flip T Q, a proper pose of the model on the reflected scan; `Q` leaves `centre` (3,) where it is."""
    R = flip @ T.rotation @ Q
    return Similarity(T.scale, R, flip @ T.apply(centre) - T.scale * R @ centre)


def _cost(model: ShapeModel, target: ScanTarget, fitted: Fitted) -> float:
    """Return the negative log posterior of a fit, in nats, up to a constant of model and scan.

    The standard deviation of the residuals is unknown, so they contribute with the logarithm of their RMS.
    """
    scale = fitted.T_scan_fitted.scale
    cap = _CAP * rms_size(model.mean_vertices) * scale
    points = target.mesh.vertices[target.draw(_POINTS, np.random.default_rng(0))]
    some = slice(None, None, max(1, model.n_vertices // _VERTICES))
    ways = (
        build_engine(Mesh(fitted.vertices_scan_mm, model.faces)).query(points).distance,
        target.engine.query(fitted.vertices_scan_mm[some] + target.vertex_shift(some)).distance,
    )
    rms = sum(float(np.sqrt((np.minimum(way, cap) ** 2).mean())) for way in ways) / scale
    prior_cost = float((fitted.b**2 / variance_of_new_shapes(model)[: len(fitted.b)]).sum())
    return _PATCHES * math.log(max(rms, 1e-12)) + 0.5 * prior_cost
