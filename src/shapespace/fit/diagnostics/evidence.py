"""Diagnostics of a robust fit, from which its status and its expected error are computed."""

from __future__ import annotations

from dataclasses import asdict, dataclass


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
        posterior_error_mm: RMS vertex error by the posterior, with what is outside the model's modes.
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
    """Diagnostics of the last iterate, of the start and of the whole scan.

    Args:
        training_shapes: number of training shapes of the model; 0 if unknown.
        start_score_mm: score of the start; NaN where no start was searched for.
        start_runner_up_score_mm: score of the best other start; infinite where there is none.
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
        expected_error_mm: median over such fits of the mean vertex error.
        error_low_mm: lower end of the 90 % interval of the mean vertex error.
        error_high_mm: upper end of that interval.
        failure_probability: probability that the fit failed, see `failure_model`.
        mirrored_log_odds: log odds (nats) that the scan is mirrored; None where that was not tested.
        mirrored_apart_mm: mean distance of the vertices from those of the fit to the mirror image, which is by how much
            they are off if the scan is mirrored; None where the mirror image was not fitted.
        mirrored_bound: largest of these log odds of left-out training shapes; None where they were not fitted, as where
            the model does not explain the mirror image either.
        displaced_moved_mm: robust standard deviation of the displaced parts about the fitted surface after a similarity
            moved them onto it; None where no part is displaced, or the model does not explain the rest of the scan.
        displaced_bound: largest `displaced_share` of left-out training shapes; None where they were not fitted.
        second_instance_mm: distance of a second instance in the scan; None where none was found.
        second_instance_gap_mm: gap between the two instances, negative if they overlap; None where none was found.

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
