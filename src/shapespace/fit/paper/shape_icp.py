"""Phase 2 (section 3.2 of the paper): correspondence, similarity and projection in turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from shapespace.fit.iteration_state import IcpState, StopRule, largest_motion
from shapespace.fit.paper.similarity_icp import fit_pose
from shapespace.geometry.closest import ClosestPointEngine
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Similarity


def shape_icp(
    model: ShapeModel,
    scan: ClosestPointEngine,
    T_scan_model: Similarity,
    stop: StopRule,
    *,
    b: FloatArray | None = None,
    with_scale: bool = True,
) -> Iterator[IcpState]:
    """Yield the start and each iteration of phase 2, until the RMS closest distance stops falling.

    Each of the three steps lowers sum_j |c_j - y_j|^2 or leaves it, so the RMS in the scan's frame never rises.

    Args:
        model: mean and modes.
        scan: search structure of the scan, in the scan's mm frame.
        T_scan_model: where phase 1 ended.
        stop: the stopping rule.
        b: (K,) coefficients to start from, mm; None for the mean.
        with_scale: False holds the scale of the start.

    Raises:
        InputError: the matches determine no similarity, or the fit has diverged.
    """
    b = np.zeros(model.n_modes) if b is None else b
    Q = model.reconstruct(b)  # P6
    y = T_scan_model.apply(Q)
    matched = scan.query(y)
    rms_model_mm = [matched.rms / T_scan_model.scale]
    yield IcpState(2, 0, T_scan_model, b, matched.rms, np.inf)

    for iteration in range(1, stop.max_iterations + 1):
        c = matched.points  # step 1: closest points of the current deformed model
        T_scan_model = fit_pose(Q, c, T_scan_model, with_scale)  # step 2: P8-P18
        Q_matched = T_scan_model.inverse().apply(c)  # in model order and in the model's frame
        b = model.project(Q_matched, align=False)  # step 3: b = P^T (Q - Q_bar), P19
        Q = model.reconstruct(b)  # P6: the deformed model
        moved, y = y, T_scan_model.apply(Q)
        matched = scan.query(y, near=matched)
        rms_model_mm.append(matched.rms / T_scan_model.scale)
        motion_mm = largest_motion(y - moved)
        stopped = stop.why(rms_model_mm, motion_mm / T_scan_model.scale)  # step 4
        yield IcpState(
            phase=2,
            iteration=iteration,
            T_scan_model=T_scan_model,
            b=b,
            rms_mm=matched.rms,
            motion_mm=motion_mm,
            stopped=stopped,
        )
        if stopped:
            return
