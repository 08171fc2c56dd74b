"""Expected error and verdict of a robust fit, from its evidence.

Predictors are logarithms and shares without a unit; a larger predictor means a worse fit. The estimate consists of two
linear functions of the predictors, fitted to simulated scans whose truth is known. A fit failed if its mean vertex
error exceeds `FAILED_SHARE` of the model's size, or if the scan shows another object.

- The score is the logit of a failure: above zero a fit is doubtful. Its coefficients were fitted to 560 fits of the
  split "dev", 174 of them wrong, by `benchmarks/trust.py --tune`; the offset leaves 5 % of the good ones doubtful.
- The expected error is a product of powers: error / size = exp(offset) * product of exp(predictor) ** weight. The
  posterior alone assumes that residuals are noise and that shapes vary as in the model, and is too small where that
  is wrong. The interval was counted on fits that took no part in the regression (split-conformal: Papadopoulos et
  al., ECML 2002), by `benchmarks/reliability.py --tune`. The probability of failure is a logistic function of the
  expected error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Generic, Literal, TypeAlias, TypeVar

from shapespace.fit.diagnostics.reasons import Reason, ReasonCode


@dataclass(frozen=True, kw_only=True)
class MatchEvidence:
    """Diagnostics of the last iterate. Lengths are in mm of the scan, shares in [0, 1].

    Args:
        size_mm: RMS distance of the model's mean, at the scale of the fit, from its centroid.
        seen_share: share of the model's vertices at which a point of the scan counts.
        model_matched_share: share of the model's vertices whose match has at least half the largest weight.
        model_allowed_share: share of the model's vertices whose matches may count.
        scan_allowed_share: share of the scan's points whose matches may count.
        scan_near_share: share of the scan's points near the model.
        model_near_share: share of the model's vertices near the scan.
        z2: mean squared coefficient, in variances of new shapes.
        z2_leading: the same over the leading modes.
        log_scale: natural logarithm of the scale of the pose.
        spread_mm: robust standard deviation of the residuals.
        beyond_model_mm: RMS of the residuals that is neither noise nor in the span of the model.
        left_out_mm: RMS distance of the fitted surface from the span of the model.
        model_spread_mm: RMS distance of a training vertex from the mean.
        model_lack_mm: RMS distance of new shapes from the span of the model.
        marks_stddev_mm: standard deviation of the given landmarks; None without landmarks.
        marks_rms_mm: RMS distance of the given landmarks from their places; None without landmarks.
        posterior_error_mm: RMS vertex error from the posterior, including the variation outside the model's modes.
    """

    size_mm: float
    seen_share: float
    model_matched_share: float
    model_allowed_share: float
    scan_allowed_share: float
    scan_near_share: float
    model_near_share: float
    z2: float
    z2_leading: float
    log_scale: float
    spread_mm: float
    beyond_model_mm: float
    left_out_mm: float
    model_spread_mm: float
    model_lack_mm: float
    marks_stddev_mm: float | None = None
    marks_rms_mm: float | None = None
    posterior_error_mm: float


@dataclass(frozen=True, kw_only=True)
class ScanEvidence(MatchEvidence):
    """Diagnostics of the last iterate, of the start and of the complete scan.

    Args:
        training_shapes: number of training shapes of the model; 0 if unknown.
        start_score_mm: score of the start; NaN if no pose search was run.
        start_runner_up_score_mm: score of the best other start; infinite if there is no other start.
        layered_share: share of the scan that consists of two layers.
        layers_apart_mm: distance of these layers.
        displaced_share: share of the scan that runs along the fitted surface at a distance.
        displaced_inward_share: share of the scan that does so inside the surface.
        displaced_purity: `displaced_share` as a share of the unexplained points.
        scattered_share: share of the scan that scatters around the fitted surface.
    """

    training_shapes: float
    start_score_mm: float
    start_runner_up_score_mm: float
    layered_share: float
    layers_apart_mm: float
    displaced_share: float
    displaced_inward_share: float
    displaced_purity: float
    scattered_share: float


@dataclass(frozen=True, kw_only=True)
class FitEvidence(ScanEvidence):
    """All diagnostics of a robust fit; the field names are the keys of `evidence` in NAME.fit.json.

    Args:
        expected_error_mm: median of the mean vertex error over fits with such evidence.
        error_low_mm: lower end of the 90 % interval of the mean vertex error.
        error_high_mm: upper end of that interval.
        failure_probability: probability that the fit failed, see `failure_model`.
        mirrored_log_odds: log odds (nats) that the scan is mirrored; None if that was not tested.
        mirrored_apart_mm: mean distance of the vertices from those of the fit to the mirror image, which is their error
            if the scan is mirrored; None if the mirror image was not fitted.
        mirrored_bound: largest of these log odds over the training shapes, each held out in turn; None if they were not
            fitted, for example because the model does not explain the mirror image either.
        displaced_moved_mm: robust standard deviation of the displaced parts about the fitted surface after a similarity
            moved them onto it; None if no part is displaced, or if the model does not explain the rest of the scan.
        displaced_bound: largest `displaced_share` over the training shapes, each held out in turn; None if they were
            not fitted.
        second_instance_mm: distance of a second instance in the scan; None if none was found.
        second_instance_gap_mm: gap between the two instances, negative if they overlap; None if none was found.

    Example:
        >>> 0 <= fit.evidence.model_matched_share <= 1
        True
    """

    expected_error_mm: float
    error_low_mm: float
    error_high_mm: float
    failure_probability: float
    mirrored_log_odds: float | None = None
    mirrored_apart_mm: float | None = None
    mirrored_bound: float | None = None
    displaced_moved_mm: float | None = None
    displaced_bound: float | None = None
    second_instance_mm: float | None = None
    second_instance_gap_mm: float | None = None

    def to_dict(self) -> dict[str, float]:
        """Return the diagnostics by name, without those that were not measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


FAILED_SHARE = 0.0375
"""A fit failed if its mean vertex error exceeds this share of the model's size (3 mm on a face)."""
COVERAGE = 0.9
"""Share of the fits whose error lies in the interval."""
_PROBABLY_FAILED = 0.5
"""Failure probability above which a fit is doubtful, whatever its score is."""
_SMALLEST = 1e-6
"""Lower bound of a ratio before its logarithm is taken; below the `lowest` of every term."""
_SMALLEST_SHARE = 0.01  # bound of a share before its logarithm, so that no term grows without limit
_LARGEST_LOG_SCALE = 1.0  # bound of the logarithm of the scale, a factor of e, for the same reason
_MOST_REASONS, _STATED_SHARE = 3, 0.4
"""Largest number of stated reasons, and their smallest share of the largest contribution."""
_NEAR_THROUGHOUT = 0.8
"""Share of the model's vertices near the scan from which the model, not the pose, explains large coefficients."""


def _log(ratio: float) -> float:
    return math.log(max(ratio, _SMALLEST))


def _minus_log_share(share: float) -> float:
    return -math.log(max(share, _SMALLEST_SHARE))


def _posterior_error(e: MatchEvidence) -> float:
    return _log(e.posterior_error_mm / e.size_mm)


def _residual_spread(e: MatchEvidence) -> float:
    return _log(e.spread_mm / e.size_mm)


def _all_modes(e: MatchEvidence) -> float:
    return _log(e.z2)


_E = TypeVar("_E", bound=MatchEvidence, contravariant=True)


@dataclass(frozen=True)
class PredictorTerm(Generic[_E]):
    """One term of a linear function of predictors: weight * (max(predictor, lowest) - usual).

    Args:
        predictor: function that computes the predictor from the evidence; larger for worse fits.
        weight: weight of the term, not negative.
        lowest: value of the clearest good fits; smaller predictors count as this value.
        usual: median over good fits; 0 if the offset contains it.
    """

    predictor: Callable[[_E], float]
    weight: float
    lowest: float = -math.inf
    usual: float = 0.0

    def value(self, evidence: _E) -> float:
        """Return the predictor, at least `lowest`."""
        return max(self.predictor(evidence), self.lowest)

    def contribution(self, evidence: _E) -> float:
        """Return the contribution of the term to the linear function."""
        return self.weight * (self.value(evidence) - self.usual)


@dataclass(frozen=True, kw_only=True)
class ScoreTerm(PredictorTerm[MatchEvidence]):
    """A term of the score.

    Args:
        limit: value of the predictor above which a fit is doubtful, whatever its score is.
        reason: function that returns the reason which states the predictor.
    """

    limit: float
    reason: Callable[[FitEvidence], Reason]

    def is_beyond_limit(self, evidence: MatchEvidence) -> bool:
        """Return whether the predictor exceeds the limit."""
        return self.predictor(evidence) > self.limit


def _scale_implausible(e: MatchEvidence) -> Reason:
    return Reason(ReasonCode.SCALE_IMPLAUSIBLE, {"scale": math.exp(e.log_scale)})


SCORE_OFFSET = -3.70  # logit; intercept of the logistic regression whose terms follow
SCORE_TERMS = (
    ScoreTerm(
        _posterior_error,
        weight=1.293,
        lowest=-6.5,
        usual=-4.519,
        limit=-3.0,
        reason=lambda e: Reason(ReasonCode.EXPECTED_ERROR, {"expected_error_mm": e.expected_error_mm}),
    ),
    ScoreTerm(
        _residual_spread,
        weight=0.741,
        lowest=-6.15,
        usual=-4.975,
        limit=-3.0,
        reason=lambda e: Reason(ReasonCode.RESIDUAL_SPREAD, {"spread_mm": e.spread_mm}),
    ),
    ScoreTerm(
        lambda e: _minus_log_share(e.model_near_share),
        weight=1.827,
        lowest=0.02,
        usual=0.084,
        limit=1.2,
        reason=lambda e: Reason(ReasonCode.MODEL_FAR_FROM_SCAN, {"model_near_share": e.model_near_share}),
    ),
    ScoreTerm(
        lambda e: _minus_log_share(e.seen_share),
        weight=1.516,
        lowest=0.2,
        usual=0.688,
        limit=3.5,
        reason=lambda e: Reason(ReasonCode.MODEL_UNSEEN, {"seen_share": e.seen_share}),
    ),
    ScoreTerm(
        lambda e: _minus_log_share(e.scan_allowed_share),
        weight=0.347,
        lowest=0.02,
        usual=0.061,
        limit=2.5,
        reason=lambda e: Reason(ReasonCode.NORMALS_DISAGREE, {"scan_allowed_share": e.scan_allowed_share}),
    ),
    ScoreTerm(
        lambda e: _minus_log_share(e.model_matched_share),
        weight=0.237,
        lowest=0.06,
        usual=0.373,
        limit=3.5,
        reason=lambda e: Reason(ReasonCode.MODEL_UNMATCHED, {"model_matched_share": e.model_matched_share}),
    ),
    ScoreTerm(
        _all_modes,
        weight=3.001,
        lowest=-0.57,
        usual=0.023,
        limit=2.2,
        reason=lambda e: Reason(ReasonCode.SHAPE_IMPLAUSIBLE, {"z_rms": math.sqrt(e.z2)}),
    ),
    ScoreTerm(
        lambda e: _log(e.z2_leading),
        weight=1.064,
        lowest=-0.7,
        usual=-0.047,
        limit=2.5,
        reason=lambda e: Reason(ReasonCode.LEADING_MODES_IMPLAUSIBLE, {"z_rms": math.sqrt(e.z2_leading)}),
    ),
    ScoreTerm(
        lambda e: min(abs(e.log_scale), _LARGEST_LOG_SCALE),
        weight=2.298,
        lowest=0.0,
        usual=0.010,
        limit=0.7,
        reason=_scale_implausible,
    ),
)

# Shares of the scan are no predictors of the error, since hair and collars lower those too.
ERROR_OFFSET = 2.103
ERROR_TERMS: Mapping[str, PredictorTerm[ScanEvidence]] = {
    "posterior error": PredictorTerm(_posterior_error, 0.995, math.log(1e-4)),
    "residual spread": PredictorTerm(_residual_spread, 0.222, math.log(1e-4)),
    "residual spread over model spread": PredictorTerm(
        lambda e: _log(e.spread_mm / max(e.model_spread_mm, 1e-9)), 0.163, math.log(1e-4)
    ),
    "model lack": PredictorTerm(lambda e: _log(e.model_lack_mm / e.size_mm), 0.129, math.log(1e-3)),
    "all modes": PredictorTerm(_all_modes, 0.244, 0.0),
    "layered share": PredictorTerm(lambda e: e.layered_share, 2.762),
}
INTERVAL = 0.594, 2.292
"""Ends of the interval as multiples of the expected error."""
FAILURE_OFFSET, FAILURE_SLOPE = 0.132, 3.429
"""Logit of the failure probability: at an expected error of `FAILED_SHARE`, and per unit of the logarithm."""


@dataclass(frozen=True)
class ErrorEstimate:
    """Expected error of a fit: the mean over the model's vertices, mm of the scan.

    Args:
        expected_error_mm: median error of fits with such evidence.
        error_low_mm: lower end of the interval that contains the error of 90 % of such fits.
        error_high_mm: upper end of that interval.
        failure_probability: probability that the fit failed, for the failure rate of the fits on which the failure
            model was trained.

    Example:
        >>> fit.evidence.error_low_mm <= fit.evidence.expected_error_mm <= fit.evidence.error_high_mm
        True
    """

    expected_error_mm: float
    error_low_mm: float
    error_high_mm: float
    failure_probability: float


def estimate_log_error(evidence: ScanEvidence) -> float:
    """Return the logarithm of the expected error as a share of the model's size, at most 0."""
    return min(ERROR_OFFSET + sum(term.contribution(evidence) for term in ERROR_TERMS.values()), 0.0)


def estimate_error(evidence: ScanEvidence, missing_share: float = 0.0, missing_error_mm: float = 0.0) -> ErrorEstimate:
    """Return the expected error of the fit with this evidence.

    Args:
        evidence: evidence of the fit.
        missing_share: share of the model's vertices that the scan does not show.
        missing_error_mm: expected error of the missing vertices, estimated on the training shapes, as the evidence does
            not contain it; mm of the scan.
    """
    shown_mm = math.exp(estimate_log_error(evidence)) * evidence.size_mm
    expected_mm = (1.0 - missing_share) * shown_mm + missing_share * missing_error_mm
    logit = FAILURE_OFFSET + FAILURE_SLOPE * math.log(expected_mm / (FAILED_SHARE * evidence.size_mm))
    low, high = INTERVAL
    return ErrorEstimate(expected_mm, low * expected_mm, high * expected_mm, 1.0 / (1.0 + math.exp(-logit)))


def with_mirror_image(evidence: FitEvidence) -> FitEvidence:
    """Return the evidence with an expected error that accounts for a possible exchange of left and right.

    Args:
        evidence: evidence of a fit whose chirality is undecidable, with the distance to the fit of the mirror image.
    """
    log_odds, apart_mm = evidence.mirrored_log_odds, evidence.mirrored_apart_mm
    if log_odds is None or apart_mm is None:
        return evidence
    probability = 1.0 / (1.0 + math.exp(-log_odds))
    high_mm, expected_mm = evidence.error_high_mm, evidence.expected_error_mm
    if probability > 0.5 * (1.0 - COVERAGE):
        high_mm = max(high_mm, apart_mm)
    if probability > 0.5:
        expected_mm = max(expected_mm, apart_mm)
    return replace(evidence, error_high_mm=high_mm, expected_error_mm=expected_mm)


def failure_score(evidence: MatchEvidence) -> float:
    """Return the logit of a failure; a fit with a score above zero is doubtful."""
    return SCORE_OFFSET + sum(term.contribution(evidence) for term in SCORE_TERMS)


def find_failure_reasons(evidence: FitEvidence) -> list[Reason]:
    """Return reasons to expect that a fit failed, the largest contribution first; empty without such reasons."""
    if not is_doubtful(evidence):
        return _find_probable_failure(evidence)
    plausible = replace(evidence, z2=min(evidence.z2, 1.0), z2_leading=min(evidence.z2_leading, 1.0))
    if evidence.model_near_share > _NEAR_THROUGHOUT and not is_doubtful(plausible):
        z_rms = math.sqrt(max(evidence.z2, evidence.z2_leading))
        return [Reason(ReasonCode.MODEL_TOO_NARROW, {"spread_mm": evidence.spread_mm, "z_rms": z_rms})]
    if not is_doubtful(replace(evidence, log_scale=0.0)):
        return [_scale_implausible(evidence)]
    ranked = sorted(
        SCORE_TERMS, key=lambda term: (term.is_beyond_limit(evidence), term.contribution(evidence)), reverse=True
    )
    least = _STATED_SHARE * ranked[0].contribution(evidence)
    return [
        term.reason(evidence)
        for term in ranked[:_MOST_REASONS]
        if term.is_beyond_limit(evidence) or term.contribution(evidence) >= least
    ]


def is_doubtful(evidence: MatchEvidence) -> bool:
    """Return whether the score, or one of its predictors alone, makes a fit doubtful."""
    return failure_score(evidence) > 0.0 or any(term.is_beyond_limit(evidence) for term in SCORE_TERMS)


def _find_probable_failure(evidence: FitEvidence) -> list[Reason]:
    if evidence.failure_probability <= _PROBABLY_FAILED:
        return []
    return [
        Reason(
            ReasonCode.PROBABLY_FAILED,
            {
                "expected_error_mm": evidence.expected_error_mm,
                "error_low_mm": evidence.error_low_mm,
                "error_high_mm": evidence.error_high_mm,
                "limit_mm": FAILED_SHARE * evidence.size_mm,
            },
        )
    ]


Chirality: TypeAlias = Literal["as scanned", "mirrored", "undecidable"]
"""Whether left and right of a scan agree with those of the model."""

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
    """Return reasons in the scan or the model to doubt a fit, the most serious first; empty without such reasons."""
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
        mirrored_bound: largest log odds over the training shapes, each compared with the model of the other shapes;
            None if unknown.
    """
    if mirrored_log_odds is None or abs(mirrored_log_odds) < _DECIDED:
        return "undecidable"
    if mirrored_log_odds < 0.0:
        return "as scanned"
    return "mirrored" if mirrored_bound is not None and mirrored_log_odds > mirrored_bound else "undecidable"


def is_side_undecidable(evidence: FitEvidence) -> bool:
    """Return whether the mirror image of the scan was fitted too, and it remains open which of the two is right."""
    is_undecidable = chirality_of(evidence.mirrored_log_odds, evidence.mirrored_bound) == "undecidable"
    return is_undecidable and evidence.mirrored_apart_mm is not None


def converged_reason(spread_mm: float, matched_share: float, evidence: FitEvidence | None) -> Reason:
    """Return the reason of a converged fit, with the vertex distance if the sides of the object may be exchanged.

    Args:
        spread_mm: robust standard deviation of the residuals.
        matched_share: share of the model's vertices that are matched.
        evidence: evidence of the fit; None without diagnostics.
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
    """Return a reason if the shape leaves the span of a model of few shapes."""
    shapes, beyond_mm = evidence.training_shapes, evidence.beyond_model_mm
    if not 0 < shapes < _FEW_SHAPES or beyond_mm < _LEAVES_SPAN * evidence.size_mm:
        return []
    data = {"training_shapes": shapes, "beyond_model_mm": beyond_mm, "fewest_shapes": _FEW_SHAPES}
    return [Reason(ReasonCode.FEW_TRAINING_SHAPES, data)]
