"""Chirality: whether the mirror image of a scan fits a model that is not mirror-symmetric better than the scan does.

Left and right bones, or a scan exported with one axis negated, differ by a reflection that no pose undoes. A model with
enough modes follows the mirror image too, so that the distances alone do not reveal it. Therefore the reflected scan is
fitted as well, and the two are compared by the distances both ways and the prior of the coefficients. The cheap search
of `any_pose` comes first; only where the reflected scan fits about as well, or better, is it fitted completely.
"""

from __future__ import annotations

import math

import numpy as np

from shapespace.errors import FitError, InputError
from shapespace.fit.iteration_state import Fitted, last_of
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.fit.robust.robust_icp import robust_icp
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
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


def mirrored_log_odds(
    model: ShapeModel, target: ScanTarget, fitted: Fitted, settings: RobustSettings, *, with_scale: bool
) -> float | None:
    """Return the log odds (nats) that the scan is mirrored; None if the model is too symmetric to decide.

    Args:
        model: the shape space.
        target: the scan in its mm frame.
        fitted: result of the fit to it.
        settings: of the robust method.
        with_scale: whether the pose has a free scale.
    """
    from shapespace.fit.search.pose_search import MIDDLE, refine  # compiled

    if not is_asymmetric(model):
        return None
    scan, flip = target.mesh, np.diag([-1.0, 1.0, 1.0])
    reflected = scan.vertices @ flip
    T = fitted.T_scan_fitted
    scan_pose = refine(model, scan.vertices, [T], with_scale=with_scale)[0]
    starts = [_reflected_pose(T, flip, Q, model.mean_vertices.mean(axis=0)) for Q in _reflections(model)]
    coarse = refine(model, reflected, starts, with_scale=with_scale, step=MIDDLE)
    best = min(coarse, key=lambda pose: pose.score_mm)
    mirrored_pose = refine(model, reflected, [best.T_scan_model], with_scale=with_scale)[0]
    if not math.isfinite(scan_pose.score_mm):
        return None
    ratio = mirrored_pose.score_mm / max(scan_pose.score_mm, 1e-12)
    if ratio > _CLEARLY_WORSE:
        return -_PATCHES * math.log(min(ratio, 1e6))
    faces = None if scan.faces is None else scan.faces[:, ::-1]
    mirror = ScanTarget(Mesh(reflected, faces, name=scan.name))
    start = Start(mirrored_pose.T_scan_model, "given", float("nan"), mirrored_pose.b)
    try:
        fit_result = last_of(robust_icp(model, mirror, start, settings, with_scale=with_scale))
    except (FitError, InputError):
        return -_PATCHES * math.log(_CLEARLY_WORSE)
    return _cost(model, target, fitted) - _cost(model, mirror, fit_result)


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
    vertices = fitted.vertices_scan_mm[:: max(1, model.n_vertices // _VERTICES)]
    ways = (
        build_engine(Mesh(fitted.vertices_scan_mm, model.faces)).query(points).distance,
        target.engine.query(vertices).distance,
    )
    rms = sum(float(np.sqrt((np.minimum(way, cap) ** 2).mean())) for way in ways) / scale
    prior_cost = float((fitted.b**2 / variance_of_new_shapes(model)[: len(fitted.b)]).sum())
    return _PATCHES * math.log(max(rms, 1e-12)) + 0.5 * prior_cost
