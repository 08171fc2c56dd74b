"""Phase 1 (section 3.1 of the paper): similarity ICP of the mean shape."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from shapespace.fit.iteration_state import IcpState, StopRule, largest_motion
from shapespace.geometry.closest import ClosestPointEngine
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Similarity


def similarity_icp(
    model: ShapeModel, scan: ClosestPointEngine, T_scan_model: Similarity, stop: StopRule, *, with_scale: bool = True
) -> Iterator[IcpState]:
    """Yield the start and each iteration of phase 1, until the RMS closest distance stops falling.

    Args:
        model: its mean shape is moved, its modes are not used.
        scan: search structure of the scan, in the scan's mm frame.
        T_scan_model: the start.
        stop: the stopping rule.
        with_scale: False holds the scale of the start.

    Raises:
        InputError: the matches determine no similarity, or the pose has diverged.
    """
    Q_mean, b = model.mean_vertices, np.zeros(model.n_modes)
    p = T_scan_model.apply(Q_mean)
    matched = scan.query(p)
    rms_model_mm = [matched.rms / T_scan_model.scale]
    yield IcpState(1, 0, T_scan_model, b, matched.rms, np.inf)

    for iteration in range(1, stop.max_iterations + 1):
        p_prime = matched.points  # P7: the closest scan point of each model vertex
        T_scan_model = fit_pose(Q_mean, p_prime, T_scan_model, with_scale)  # P8-P18
        moved, p = p, T_scan_model.apply(Q_mean)
        matched = scan.query(p, near=matched)
        rms_model_mm.append(matched.rms / T_scan_model.scale)
        motion_mm = largest_motion(p - moved)
        stopped = stop.why(rms_model_mm, motion_mm / T_scan_model.scale)
        yield IcpState(
            phase=1,
            iteration=iteration,
            T_scan_model=T_scan_model,
            b=b,
            rms_mm=matched.rms,
            motion_mm=motion_mm,
            stopped=stopped,
        )
        if stopped:
            return


def fit_pose(source: np.ndarray, target: np.ndarray, before: Similarity, with_scale: bool) -> Similarity:
    """Return the least-squares pose of `source` on `target` (V, 3); without scale, that of `before` is kept."""
    if with_scale:
        return fit_similarity(source, target)
    rigid = fit_similarity(before.scale * source, target, with_scale=False)
    return Similarity(before.scale, rigid.rotation, rigid.translation)
