"""The paper's modified ICP as a method: its settings, its two phases, its doubts."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from shapespace.errors import InputError
from shapespace.fit.diagnostics.reasons import Reason, ReasonCode
from shapespace.fit.iteration_state import Fitted, IcpState, StopRule, all_followed, largest_motion
from shapespace.fit.method import FitOutcome, Limits
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.geometry.closest import ENGINES, ClosestPointEngine
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.pca import modes_for_variance
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Similarity

# Set on simulated scans: clean ones stay far from each bound, cut ones cross at least one.
_SHRUNK_BY_SHAPE = 0.85
_SHRUNK_IN_ALL = 0.7  # ratio of the final scale to that of the start
_LEADING_SHARE = 0.9  # share of variance of the main coefficients
_IMPLAUSIBLE = 1e-5  # probability that a new shape exceeds the bound on its coefficients
_CLOSE_SHARE = 0.01  # share of the size; a surface nearer than this is correct however unusual its coefficients
_FAR_SHARE = 0.05  # share of the size that the model may lie from the scan (RMS)
_GAP_RATIO = 4.0  # ratio of the median distances scan to model and model to scan
_GAP_SHARE = 0.02  # share of the size; smaller medians are good whatever their ratio
_SEEN_SHARE = 0.05  # share of the scan that the model must cover


@dataclass(frozen=True)
class Paper:
    """The paper's method, as corrected: phase 1 moves the mean, phase 2 alternates matches, pose and projection.

    Args:
        search: closest points: `vertices` of the scan, as in the paper, or points on its `surface`, the triangles.
        stop_rate: the paper's tau: stop when the RMS changes by at most this share.
        stop_motion_mm: largest movement of a vertex, mm of the model's frame, up to which the iteration may stop.

    Raises:
        InputError: a search that does not exist, or a rule that cannot stop.
    """

    search: str = "vertices"
    stop_rate: float = 1e-4
    stop_motion_mm: float = 1e-3

    name: ClassVar[str] = "paper"
    calibrated: ClassVar[bool] = False
    goes_on_densely: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.search not in ENGINES:
            raise InputError(f"There is no search {self.search!r}; choose one of {', '.join(ENGINES)}.")
        self.stop_rule(1)

    def stop_rule(self, max_iterations: int) -> StopRule:
        """Return the stopping rule of both phases."""
        return StopRule(self.stop_rate, self.stop_motion_mm, max_iterations)

    def states(
        self, model: ShapeModel, scan: ScanTarget, start: Start, limits: Limits
    ) -> Generator[IcpState, None, Fitted]:
        """Yield the states of phase 1, then those of phase 2, which starts at its end; only `limits.modes` are used."""
        model = model if limits.modes is None else model.truncate(limits.modes)
        stop, engine, T_scan_model = self.stop_rule(limits.max_iterations), scan.search(self.search), start.T_scan_model
        for state in similarity_icp(model, engine, T_scan_model, stop, with_scale=limits.with_scale):
            T_scan_model = state.T_scan_model
            yield state
        b, rms_mm = np.zeros(model.n_modes), np.inf
        for state in shape_icp(model, engine, T_scan_model, stop, with_scale=limits.with_scale):
            T_scan_model, b, rms_mm = state.T_scan_model, state.b, state.rms_mm
            yield state
        b_stddev = posterior_stddev(model, (rms_mm / T_scan_model.scale) ** 2 / 3.0)
        return Fitted(
            T_scan_model=T_scan_model,
            b=b,
            b_stddev=b_stddev,
            shrinkage=1.0 - (b_stddev / model.stddev) ** 2,
            T_scan_fitted=T_scan_model,
            vertices_scan_mm=T_scan_model.apply(model.reconstruct(b)),
            outside_mm=0.0,
            regions=partial(all_followed, model.n_vertices),
        )

    def reason(self, ended: FitOutcome) -> Reason:
        """Return why the iteration stopped."""
        return Reason(
            ReasonCode.CONVERGED_BY_RATE,
            {
                "rms_mm": ended.phases[2].rms_mm,
                "stop_rate": self.stop_rate,
                "stop_motion_mm": self.stop_motion_mm * ended.fitted.T_scan_model.scale,
            },
        )

    def doubts(self, ended: FitOutcome) -> list[Reason]:
        """Return reasons in the distances, the scale and the main coefficients to doubt the fit."""
        model, final, initial = ended.model, ended.stages["final"], ended.stages["initial"]
        forward, backward = final.distances.model_to_scan, final.distances.scan_to_model
        size_mm = ended.size_mm
        reasons: list[Reason] = []
        shrunk = min(
            final.T_scan_model.scale / initial.T_scan_model.scale / _SHRUNK_BY_SHAPE,
            ended.fitted.T_scan_model.scale / ended.start.T_scan_model.scale / _SHRUNK_IN_ALL,
        )
        if shrunk < 1.0:
            reasons.append(Reason(ReasonCode.MODEL_SHRANK))
        if forward.rms > _FAR_SHARE * size_mm:
            reasons.append(Reason(ReasonCode.MODEL_DISTANT, {"rms_mm": forward.rms}))
        if backward.fraction < _SEEN_SHARE:
            reasons.append(Reason(ReasonCode.SCAN_NOT_COVERED, {"scan_covered_share": backward.fraction}))
        elif backward.median > _GAP_RATIO * forward.median and backward.median > _GAP_SHARE * size_mm:
            medians_mm = {
                "scan_to_model_median_mm": backward.median,
                "model_to_scan_median_mm": forward.median,
            }
            reasons.append(Reason(ReasonCode.DISTANCES_DIFFER, medians_mm))
        leading = min(modes_for_variance(model.stddev**2, _LEADING_SHARE), len(final.b))
        z2 = float(((final.b[:leading] / model.stddev[:leading]) ** 2).mean())
        # A surface that lies on the scan everywhere is correct, however extreme its shape is.
        if z2 > _hotelling_bound(leading, model.n_training) and forward.rms > _CLOSE_SHARE * size_mm:
            data = {"coefficients": leading, "z_rms": float(np.sqrt(z2))}
            reasons.append(Reason(ReasonCode.MAIN_COEFFICIENTS_IMPLAUSIBLE, data))
        return reasons


def posterior_stddev(model: ShapeModel, residual_variance: float) -> FloatArray:
    """Return the standard deviation (K,), mm, of the coefficients given a complete surface.

    Probabilistic PCA with orthonormal modes: var_k = lam_k v / (lam_k + v) (Tipping and Bishop, 1999). It assumes that
    the residuals of the coordinates are independent, which they are not, so the result is too small.

    Args:
        model: shape model, with lam_k = stddev_k^2.
        residual_variance: v, mm^2 per coordinate.
    """
    variance = model.stddev**2
    return np.sqrt(variance * residual_variance / (variance + residual_variance))


def _hotelling_bound(k: int, n: int) -> float:
    """Return the mean z^2 of k coefficients that a new shape exceeds with probability `_IMPLAUSIBLE`.

    The variances come from n training shapes, so the bound is Hotelling's for a new sample, not chi-square's.
    """
    from scipy.special import fdtri  # takes a moment; scipy.stats would take half a second

    if n <= k + 1:
        return float("inf")
    return float((n**2 - 1) / (n * (n - k)) * fdtri(k, n - k, 1.0 - _IMPLAUSIBLE))


# Phase 1 (section 3.1 of the paper): similarity ICP of the mean shape


def similarity_icp(
    model: ShapeModel, scan: ClosestPointEngine, T_scan_model: Similarity, stop: StopRule, *, with_scale: bool = True
) -> Iterator[IcpState]:
    """Yield the start and each iteration of phase 1, until the RMS closest distance stops falling.

    Args:
        model: shape model whose mean is moved; its modes are not used.
        scan: search structure of the scan, in the scan's mm frame.
        T_scan_model: the initial pose.
        stop: the stopping rule.
        with_scale: whether the scale is free; False fixes the scale of the start.

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
        yield IcpState(1, iteration, T_scan_model, b, matched.rms, motion_mm, stopped)
        if stopped:
            return


# Phase 2 (section 3.2 of the paper): correspondence, similarity and projection in turn


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

    Each of the three steps never raises sum_j |c_j - y_j|^2, so the RMS in the scan's frame never rises.

    Args:
        model: shape model, with mean and modes.
        scan: search structure of the scan, in the scan's mm frame.
        T_scan_model: the pose at the end of phase 1.
        stop: the stopping rule.
        b: (K,) coefficients to start from, mm; None for the mean.
        with_scale: whether the scale is free; False fixes the scale of the start.

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
        yield IcpState(2, iteration, T_scan_model, b, matched.rms, motion_mm, stopped)
        if stopped:
            return


def fit_pose(source: np.ndarray, target: np.ndarray, before: Similarity, with_scale: bool) -> Similarity:
    """Return the least-squares pose of `source` on `target` (V, 3); `with_scale` False keeps the scale of `before`."""
    if with_scale:
        return fit_similarity(source, target)
    rigid = fit_similarity(before.scale * source, target, with_scale=False)
    return Similarity(before.scale, rigid.rotation, rigid.translation)
