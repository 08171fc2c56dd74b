"""The verdict on a result: pose, coefficients and surface must agree with each other, for every method."""

from __future__ import annotations

import numpy as np

from shapespace.fit.diagnostics.reasons import Reason, ReasonCode
from shapespace.fit.method import FitOutcome, Method
from shapespace.fit.result import Status

_FARTHEST_Z = 10.0
"""Standard deviations of new shapes; the plain method reaches 8 on real scans, where faint modes follow details."""
_OTHER_SCALE = 0.05  # logarithm, 5 %: scale that projection onto the modes may change
_MOVED_AWAY, _LEAST_MOVED_SHARE = 1.5, 0.005
"""Ratio to the distance outside the span, and share of the size, by which the projection onto the span may move a
surface; its nearest shape in the span lies about as far from it as that distance."""
_DENSE_MOVED_SHARE = 0.009
"""Share of the size; dense surfaces move along their normals by a quarter of it if the model suits the scan, and most
of those that move further have vertices in wrong positions (docs/dense.md)."""


def judge(method: Method, ended: FitOutcome) -> tuple[Status, tuple[Reason, ...]]:
    """Return status and reasons of a fit: contradictions in the result first, then the method's reasons for doubt."""
    doubts = [*find_contradictions(ended), *method.doubts(ended)]
    if doubts:
        return "doubtful", tuple(doubts)
    for phase in (1, 2):
        if ended.phases[phase].stopped == "cap":
            data = {"phase": phase, "iterations": ended.phases[phase].iteration}
            return "max_iterations", (Reason(ReasonCode.ITERATION_LIMIT, data),)
    return "converged", (method.reason(ended),)


def find_contradictions(ended: FitOutcome) -> list[Reason]:
    """Return the contradictions between pose, coefficients and surface; empty if they agree."""
    from shapespace.fit.robust.posterior import variance_of_new_shapes  # compiled, and loads SciPy

    model, fitted, reasons = ended.model, ended.fitted, list[Reason]()
    z = np.abs(fitted.b) / np.sqrt(variance_of_new_shapes(model)[: len(fitted.b)])
    worst = int(z.argmax())
    if z[worst] > _FARTHEST_Z:
        reasons.append(Reason(ReasonCode.MODE_IMPLAUSIBLE, {"mode": worst + 1, "z": float(z[worst])}))
    scale_ratio = float(fitted.T_scan_model.scale / fitted.T_scan_fitted.scale)
    if abs(np.log(scale_ratio)) > _OTHER_SCALE:
        reasons.append(Reason(ReasonCode.PROJECTED_SCALE, {"scale_ratio": scale_ratio}))
    moved = fitted.vertices_scan_mm - fitted.T_scan_model.apply(model.reconstruct(fitted.b))
    moved_mm = float(np.sqrt((moved**2).sum(axis=1).mean()))
    if moved_mm > _MOVED_AWAY * fitted.outside_mm + _LEAST_MOVED_SHARE * ended.size_mm:
        reasons.append(Reason(ReasonCode.PROJECTED_SURFACE, {"moved_mm": moved_mm}))
    dense = ended.stages.get("dense")
    if dense is not None and dense.moved_mm > _DENSE_MOVED_SHARE * ended.size_mm:
        reasons.append(Reason(ReasonCode.DENSE_SURFACE_MOVED, {"moved_mm": dense.moved_mm}))
    return reasons
