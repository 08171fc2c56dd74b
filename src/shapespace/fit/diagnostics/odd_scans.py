"""Find what is odd about a scan or a model that makes a robust fit doubtful, from the evidence of the fit."""

from __future__ import annotations

from typing import Literal, TypeAlias

from shapespace.fit.diagnostics.evidence import FitEvidence, ScanEvidence
from shapespace.fit.diagnostics.failure_model import FAILED_SHARE
from shapespace.fit.diagnostics.reasons import Reason, ReasonCode

Chirality: TypeAlias = Literal["as scanned", "mirrored", "undecidable"]
"""Whether left and right of a scan are as those of the model."""

_LAYERED = 0.16
"""Share of a scan over which it has two surfaces; chosen on fits of `benchmarks/reliability.py`."""
_DISPLACED, _PURE, _PURE_INWARD = 0.035, 0.6, 0.35
"""Share of the scan that is displaced, and of its unexplained parts, above which its parts do not fit together. Correct
fits of the development seeds of `benchmarks/odd_cases.py` stay below one or the other. Hair lies outside the surface
and reaches a purity of 0.49, so parts inside it need less."""
_SCATTERED, _NOISY = 0.35, 0.02
"""Share of the scan that scatters, and spread of the matches as a share of the size, from which noise hides the shape.
Of those seeds, scans with noise of 5 to 15 % of the size reach both, and those with 20 % outliers neither."""
_FEW_SHAPES = 10
"""Fewest shapes of the models that the failure model was calibrated on."""
_LEAVES_SPAN = 0.002
"""Share of the size; shapes in the span of a model leave it by at most 0.0012 (`benchmarks/odd_cases.py`)."""
_DECIDED = 5.0
"""Log odds (nats) from which the chirality counts as decided: odds of 150 to 1. Of `benchmarks/odd_cases.py`, the 25
mirrored scans of the development seeds reach 7 and more, correct fits of unmirrored scans -11 and less."""


def find_odd_scan_reasons(evidence: FitEvidence) -> list[Reason]:
    """Return reasons in the scan or the model to doubt a fit, the most serious first; empty where there are none."""
    return [
        *_find_mirrored(evidence),
        *_find_layers(evidence),
        *_find_inconsistent_parts(evidence),
        *_find_few_shapes(evidence),
    ]


def chirality_of(mirrored_log_odds: float | None, mirrored_bound: float | None) -> Chirality:
    """Return whether the scan is mirrored.

    Args:
        mirrored_log_odds: log odds (nats) that the scan is mirrored; None if that was not tested.
        mirrored_bound: largest log odds of training shapes, each compared by the model of the others; None if unknown.
    """
    if mirrored_log_odds is None or abs(mirrored_log_odds) < _DECIDED:
        return "undecidable"
    if mirrored_log_odds < 0.0:
        return "as scanned"
    return "mirrored" if mirrored_bound is not None and mirrored_log_odds > mirrored_bound else "undecidable"


def is_side_undecidable(evidence: FitEvidence) -> bool:
    """Return whether the mirror image of the scan was fitted, and neither side is clearly the right one."""
    is_undecidable = chirality_of(evidence.mirrored_log_odds, evidence.mirrored_bound) == "undecidable"
    return is_undecidable and evidence.mirrored_apart_mm is not None


def converged_reason(spread_mm: float, matched_share: float, evidence: FitEvidence | None) -> Reason:
    """Return that a fit converged, with the distance of the vertices if the sides of the object may be exchanged.

    Args:
        spread_mm: robust standard deviation of the residuals.
        matched_share: share of the model's vertices that are matched.
        evidence: of the fit.
    """
    data: dict[str, float | str] = {"spread_mm": spread_mm, "model_matched_share": matched_share}
    if evidence is not None and evidence.mirrored_apart_mm is not None and is_side_undecidable(evidence):
        data["mirrored_apart_mm"] = evidence.mirrored_apart_mm
    return Reason(ReasonCode.CONVERGED, data)


def has_displaced_parts(evidence: ScanEvidence) -> bool:
    """Return whether more of the scan runs along the fitted surface at a distance than in correct fits."""
    share, inward = evidence.displaced_share, evidence.displaced_inward_share
    return share > _DISPLACED and evidence.displaced_purity > (_PURE_INWARD if inward > _DISPLACED else _PURE)


def _find_mirrored(evidence: FitEvidence) -> list[Reason]:
    log_odds, apart_mm = evidence.mirrored_log_odds, evidence.mirrored_apart_mm
    if chirality_of(log_odds, evidence.mirrored_bound) == "mirrored":
        return [Reason(ReasonCode.SCAN_MIRRORED)]
    if log_odds is None or apart_mm is None or log_odds <= 0.0 or apart_mm < FAILED_SHARE * evidence.size_mm:
        return []
    return [Reason(ReasonCode.SCAN_MAY_BE_MIRRORED, {"mirrored_apart_mm": apart_mm})]


def _find_layers(evidence: FitEvidence) -> list[Reason]:
    if evidence.layered_share < _LAYERED:
        return []
    return [Reason(ReasonCode.SCAN_LAYERED, {"layers_apart_mm": evidence.layers_apart_mm})]


def _find_inconsistent_parts(evidence: FitEvidence) -> list[Reason]:
    """Find parts that no single instance of the model explains."""
    reasons: list[Reason] = []
    gap_mm, distance_mm = evidence.second_instance_gap_mm, evidence.second_instance_mm
    if gap_mm is not None and distance_mm is not None and gap_mm < 0.0:
        reasons.append(Reason(ReasonCode.INSTANCES_OVERLAP, {"second_instance_mm": distance_mm}))
    is_mirrored = chirality_of(evidence.mirrored_log_odds, evidence.mirrored_bound) == "mirrored"
    if has_displaced_parts(evidence) and not is_mirrored:  # a mirrored scan has parts at a distance everywhere
        share, bound = evidence.displaced_share, evidence.displaced_bound
        is_tested = bound is not None and share > bound
        code = ReasonCode.PARTS_DISPLACED if is_tested else ReasonCode.PARTS_UNEXPLAINED
        reasons.append(Reason(code, {"displaced_share": share}))
    if evidence.scattered_share > _SCATTERED and evidence.spread_mm > _NOISY * evidence.size_mm:
        reasons.append(Reason(ReasonCode.POINTS_SCATTERED, {"scattered_share": evidence.scattered_share}))
    return reasons


def _find_few_shapes(evidence: FitEvidence) -> list[Reason]:
    """Find that the shape leaves the span of a model of few shapes."""
    shapes, beyond_mm = evidence.training_shapes, evidence.beyond_model_mm
    if not 0 < shapes < _FEW_SHAPES or beyond_mm < _LEAVES_SPAN * evidence.size_mm:
        return []
    data = {"training_shapes": shapes, "beyond_model_mm": beyond_mm, "fewest_shapes": _FEW_SHAPES}
    return [Reason(ReasonCode.FEW_TRAINING_SHAPES, data)]
