"""How far off a robust fit is and whether it failed, from its evidence: an expected error and a verdict.

Predictors are logarithms and shares without a unit, each larger the worse a fit is. Two linear functions of them,
fitted to simulated scans whose truth is known, make the estimate. A fit failed if its mean vertex error exceeds
`FAILED_SHARE` of the model's size, or if the scan shows another object.

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
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from shapespace.fit.diagnostics.evidence import FitEvidence, MatchEvidence, ScanEvidence
from shapespace.fit.diagnostics.reasons import Reason, ReasonCode

FAILED_SHARE = 0.0375
"""A fit failed if its mean vertex error exceeds this share of the model's size (3 mm on a face)."""
COVERAGE = 0.9
"""Share of the fits whose error lies in the interval."""
_PROBABLY_FAILED = 0.5
"""Failure probability above which a fit is doubtful, whatever its score is."""
_SMALLEST = 1e-6
"""Of a ratio before its logarithm is taken; below the `lowest` of every term."""
_SMALLEST_SHARE = 0.01  # bound of a share before its logarithm, so that no term grows without limit
_LARGEST_LOG_SCALE = 1.0  # bound of the logarithm of the scale, a factor of e, for the same reason
_MOST_REASONS, _STATED_SHARE = 3, 0.4
"""At most so many reasons are stated, each with at least this share of the largest contribution."""
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
class Term(Generic[_E]):
    """One term of a linear function of predictors: weight * (max(predictor, lowest) - usual).

    Args:
        predictor: of the evidence; larger for worse fits.
        weight: not negative.
        lowest: value of the clearest good fits; a predictor below it contributes no less.
        usual: median over good fits; 0 where the offset contains it.
    """

    predictor: Callable[[_E], float]
    weight: float
    lowest: float = -math.inf
    usual: float = 0.0

    def value(self, evidence: _E) -> float:
        """Return the predictor, at least `lowest`."""
        return max(self.predictor(evidence), self.lowest)

    def contribution(self, evidence: _E) -> float:
        """Return what the term adds to the linear function."""
        return self.weight * (self.value(evidence) - self.usual)


@dataclass(frozen=True, kw_only=True)
class ScoreTerm(Term[MatchEvidence]):
    """A term of the score.

    Args:
        limit: value of the predictor above which a fit is doubtful, whatever its score is.
        reason: states the predictor.
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
ERROR_TERMS: Mapping[str, Term[ScanEvidence]] = {
    "posterior error": Term(_posterior_error, 0.995, math.log(1e-4)),
    "residual spread": Term(_residual_spread, 0.222, math.log(1e-4)),
    "residual spread over model spread": Term(
        lambda e: _log(e.spread_mm / max(e.model_spread_mm, 1e-9)), 0.163, math.log(1e-4)
    ),
    "model lack": Term(lambda e: _log(e.model_lack_mm / e.size_mm), 0.129, math.log(1e-3)),
    "all modes": Term(_all_modes, 0.244, 0.0),
    "layered share": Term(lambda e: e.layered_share, 2.762),
}
INTERVAL = 0.594, 2.292
"""Ends of the interval as multiples of the expected error."""
FAILURE_OFFSET, FAILURE_SLOPE = 0.132, 3.429
"""Logit of the failure probability: at an expected error of `FAILED_SHARE`, and per unit of the logarithm."""


@dataclass(frozen=True)
class ErrorEstimate:
    """Expected error of a fit: the mean over the model's vertices, mm of the scan.

    Args:
        expected_error_mm: half of such fits have a smaller error.
        error_low_mm: lower end of the interval that holds the error of 90 % of such fits.
        error_high_mm: upper end of that interval.
        failure_probability: that the fit failed, if as many fits fail as among those that the model was fitted to.

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
        evidence: of the fit.
        missing_share: share of the model's vertices that the scan does not show.
        missing_error_mm: their expected error by the training shapes, which the evidence does not contain.
    """
    shown_mm = math.exp(estimate_log_error(evidence)) * evidence.size_mm
    expected_mm = (1.0 - missing_share) * shown_mm + missing_share * missing_error_mm
    logit = FAILURE_OFFSET + FAILURE_SLOPE * math.log(expected_mm / (FAILED_SHARE * evidence.size_mm))
    low, high = INTERVAL
    return ErrorEstimate(expected_mm, low * expected_mm, high * expected_mm, 1.0 / (1.0 + math.exp(-logit)))


def with_mirror_image(evidence: FitEvidence) -> FitEvidence:
    """Return the evidence with an expected error that includes the exchange of the sides of an object.

    Args:
        evidence: of a fit whose chirality is undecidable, with the distance to the fit of the mirror image.
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
    """Return reasons to expect that a fit failed, the largest contribution first; empty where there are none."""
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
