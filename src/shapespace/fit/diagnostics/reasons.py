"""Why a fit has its status, as codes with data; `reason_text` makes sentences of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class ReasonCode(StrEnum):
    """Reasons for a status; the value is the code in NAME.fit.json, the comment lists the data.

    Example:
        >>> [reason.code for reason in fit.reasons if reason.code is ss.fit.ReasonCode.OTHER]
        []
    """

    # status converged
    CONVERGED = "converged"  # spread_mm, model_matched_share; mirrored_apart_mm if the chirality is undecidable
    CONVERGED_BY_RATE = "converged_by_rate"  # rms_mm, stop_rate, stop_motion_mm
    # status max_iterations
    ITERATION_LIMIT = "iteration_limit"  # phase, iterations
    # status doubtful: pose, coefficients and surface contradict each other
    MODE_IMPLAUSIBLE = "mode_implausible"  # mode (from 1), z
    PROJECTED_SCALE = "projected_scale"  # scale_ratio
    PROJECTED_SURFACE = "projected_surface"  # moved_mm
    DENSE_SURFACE_MOVED = "dense_surface_moved"  # moved_mm
    # status doubtful: the scan
    SCAN_MIRRORED = "scan_mirrored"
    SCAN_MAY_BE_MIRRORED = "scan_may_be_mirrored"  # mirrored_apart_mm
    SCAN_LAYERED = "scan_layered"  # layers_apart_mm
    INSTANCES_OVERLAP = "instances_overlap"  # second_instance_mm
    POSE_AMBIGUOUS = "pose_ambiguous"  # apart_mm
    PARTS_DISPLACED = "parts_displaced"  # displaced_share
    PARTS_UNEXPLAINED = "parts_unexplained"  # displaced_share
    POINTS_SCATTERED = "points_scattered"  # scattered_share
    # status doubtful: a completion, by the training shapes
    SCAN_UNEXPLAINED = "scan_unexplained"  # mismatch_mm, usual_mm
    SCAN_OFF_MODEL = "scan_off_model"  # off_model, in units of the predicted standard deviation
    NO_SKILL = "no_skill"  # training_shapes, nearer
    # status doubtful: the model
    FEW_TRAINING_SHAPES = "few_training_shapes"  # training_shapes, beyond_model_mm, fewest_shapes
    MODEL_TOO_NARROW = "model_too_narrow"  # spread_mm, z_rms
    # status doubtful: the failure model
    EXPECTED_ERROR = "expected_error"  # expected_error_mm
    RESIDUAL_SPREAD = "residual_spread"  # spread_mm
    MODEL_FAR_FROM_SCAN = "model_far_from_scan"  # model_near_share
    MODEL_UNSEEN = "model_unseen"  # seen_share
    NORMALS_DISAGREE = "normals_disagree"  # scan_allowed_share
    MODEL_UNMATCHED = "model_unmatched"  # model_matched_share
    SHAPE_IMPLAUSIBLE = "shape_implausible"  # z_rms
    LEADING_MODES_IMPLAUSIBLE = "leading_modes_implausible"  # z_rms
    SCALE_IMPLAUSIBLE = "scale_implausible"  # scale
    PROBABLY_FAILED = "probably_failed"  # expected_error_mm, error_low_mm, error_high_mm, limit_mm
    # status doubtful: the paper's method
    MODEL_SHRANK = "model_shrank"
    MODEL_DISTANT = "model_distant"  # rms_mm
    SCAN_NOT_COVERED = "scan_not_covered"  # scan_covered_share
    DISTANCES_DIFFER = "distances_differ"  # scan_to_model_median_mm, model_to_scan_median_mm
    MAIN_COEFFICIENTS_IMPLAUSIBLE = "main_coefficients_implausible"  # coefficients, z_rms
    # of other methods
    OTHER = "other"  # text


@dataclass(frozen=True)
class Reason:
    """One reason for the status of a fit.

    Args:
        code: the kind of reason.
        data: its numbers by name, lengths in mm of the scan, see `ReasonCode`; the text of `OTHER`.
    """

    code: ReasonCode
    data: Mapping[str, float | str] = field(default_factory=dict[str, float | str])

    @staticmethod
    def other(text: str) -> Reason:
        """Return a reason that has no code of its own, such as one of a method outside this package.

        Args:
            text: for a converged fit a whole sentence, for a doubtful one a clause without a full stop.
        """
        return Reason(ReasonCode.OTHER, {"text": text})
