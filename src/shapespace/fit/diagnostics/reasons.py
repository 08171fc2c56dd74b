"""Reasons for the status of a fit: codes with data, and their English text, which no other module makes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any


class ReasonCode(StrEnum):
    """Reasons for the status of a fit; the value is the code in NAME.fit.json, the comment lists the data saved with
    it.

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
    PART_HARDLY_SEEN = "part_hardly_seen"  # seen_share
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
    # reasons of methods outside this package
    OTHER = "other"  # text


@dataclass(frozen=True)
class Reason:
    """One reason for the status of a fit.

    Args:
        code: code of the reason.
        data: numbers of the reason by name, lengths in mm of the scan, see `ReasonCode`; the text of `OTHER`.
    """

    code: ReasonCode
    data: Mapping[str, float | str] = field(default_factory=dict[str, float | str])

    @staticmethod
    def other(text: str) -> Reason:
        """Return a reason without a code of its own, such as one of a method outside this package.

        Args:
            text: text of the reason: for a converged fit a complete sentence, for a doubtful fit a clause without a
                full stop.
        """
        return Reason(ReasonCode.OTHER, {"text": text})


DOUBTFUL = "Do not trust this fit: "
"""Beginning of the sentence on a doubtful fit."""


def _undecidable_side(d: Mapping[str, Any]) -> str:
    if "mirrored_apart_mm" not in d:
        return ""
    return (
        " Whether the scan is mirrored is undecidable: its mirror image fits the model about as well; if it is "
        f"mirrored, the vertices are {d['mirrored_apart_mm']:.1f} mm off on average."
    )


_TEXTS: Mapping[ReasonCode, Callable[[Mapping[str, Any]], str]] = MappingProxyType(
    {
        ReasonCode.CONVERGED: lambda d: (
            f"Converged; robust residual SD {d['spread_mm']:.2f} mm over {100 * d['model_matched_share']:.0f} % of the "
            f"model's vertices.{_undecidable_side(d)}"
        ),
        ReasonCode.CONVERGED_BY_RATE: lambda d: (
            f"Converged; RMS closest distance {d['rms_mm']:.2f} mm: its relative change is below {d['stop_rate']:g} "
            f"and no vertex moved more than {d['stop_motion_mm']:g} mm."
        ),
        ReasonCode.ITERATION_LIMIT: lambda d: f"Phase {d['phase']} was cut off after {d['iterations']} iterations.",
        ReasonCode.MODE_IMPLAUSIBLE: lambda d: (
            f"mode {d['mode']} lies {d['z']:.3g} standard deviations out, which no shape of this kind does; build the "
            "model without its faint modes, or of more shapes"
        ),
        ReasonCode.PROJECTED_SCALE: lambda d: (
            f"projected onto the model's own modes, the fitted surface would be {d['scale_ratio']:.3g} times as large "
            "as it is"
        ),
        ReasonCode.PROJECTED_SURFACE: lambda d: (
            f"projected onto the model's own modes, the surface moves {d['moved_mm']:.2g} mm away from the fitted one"
        ),
        ReasonCode.DENSE_SURFACE_MOVED: lambda d: (
            f"to follow the scan, the dense surface moved by {d['moved_mm']:.2g} mm along its normals, more than the "
            "model should lack, so its vertices may lie in other places than those that correspond"
        ),
        ReasonCode.SCAN_MIRRORED: lambda d: (
            "the scan is mirrored: its mirror image fits the model better; mirror the scan (negate one coordinate of "
            "each vertex and reverse the triangles) and fit it again"
        ),
        ReasonCode.SCAN_MAY_BE_MIRRORED: lambda d: (
            "the scan may be mirrored: its mirror image fits the model better, which may be chance; compare its left "
            "and right with those of the model; if it is mirrored, the vertices are "
            f"{d['mirrored_apart_mm']:.1f} mm off on average"
        ),
        ReasonCode.SCAN_LAYERED: lambda d: (
            f"the scan shows two surfaces on top of each other, about {d['layers_apart_mm']:.1f} mm apart"
        ),
        ReasonCode.INSTANCES_OVERLAP: lambda d: (
            f"the scan shows two overlapping instances, {d['second_instance_mm']:.0f} mm apart; crop it to one of them "
            "(--crop)"
        ),
        ReasonCode.POSE_AMBIGUOUS: lambda d: (
            f"the scan fits the model in two poses about equally well, {d['apart_mm']:.0f} mm apart; give landmarks "
            "(--landmarks)"
        ),
        ReasonCode.PART_HARDLY_SEEN: lambda d: (
            f"the scan shows {100 * d['seen_share']:.0f} % of one of its parts, which can fit in a wrong relative pose"
        ),
        ReasonCode.PARTS_DISPLACED: lambda d: (
            f"{100 * d['displaced_share']:.0f} % of the scan runs along the fitted surface at a distance from it, as "
            "where its parts differ in scale or position; check how the scan was assembled, or crop it (--crop)"
        ),
        ReasonCode.PARTS_UNEXPLAINED: lambda d: (
            f"{100 * d['displaced_share']:.0f} % of the scan runs along the fitted surface at a distance from it and "
            "is not explained by the model: its parts may differ in scale or position, or the model may be too narrow"
        ),
        ReasonCode.POINTS_SCATTERED: lambda d: (
            f"{100 * d['scattered_share']:.0f} % of the scan scatters widely around the fitted surface; remove its "
            "noise first"
        ),
        ReasonCode.SCAN_UNEXPLAINED: lambda d: (
            f"the model does not explain the scan: it lies {d['mismatch_mm']:.2f} mm (RMS of nine tenths) from the "
            f"completed surface, and training shapes lie {d['usual_mm']:.2f} mm from the mean shape; it is probably "
            "another object, or contains parts of others"
        ),
        ReasonCode.SCAN_OFF_MODEL: lambda d: (
            f"the model does not explain the scan: outside of the model it varies {d['off_model']:.0f} times as much "
            "as the model predicts; it is probably another object, or contains parts of others"
        ),
        ReasonCode.NO_SKILL: lambda d: (
            "the missing part is not predicted better than by the mean shape: of "
            f"{d['training_shapes']:.0f} training shapes, each held out in turn, the completion is nearer than the "
            f"mean shape for {d['nearer']:.0f}; build a model of more shapes, or scan more of the object"
        ),
        ReasonCode.FEW_TRAINING_SHAPES: lambda d: (
            f"the model is made of {d['training_shapes']:.0f} shapes, too few to predict how others differ, and this "
            f"shape leaves its span by {d['beyond_model_mm']:.1f} mm; build a model of at least {d['fewest_shapes']} "
            "shapes"
        ),
        ReasonCode.MODEL_TOO_NARROW: lambda d: (
            f"the model is too narrow for this scan: its surface follows it, to {d['spread_mm']:.2f} mm where they "
            f"match, but its coefficients lie {d['z_rms']:.1f} standard deviations out on average, where about 1 is "
            "usual; build a model of more, or more different, shapes, or follow the scan by --dense and look at it"
        ),
        ReasonCode.EXPECTED_ERROR: lambda d: f"its vertices are expected to be {d['expected_error_mm']:.1f} mm off",
        ReasonCode.RESIDUAL_SPREAD: lambda d: f"even the parts that match lie {d['spread_mm']:.1f} mm apart",
        ReasonCode.MODEL_FAR_FROM_SCAN: lambda d: (
            f"only {100 * d['model_near_share']:.0f} % of the model has the scan anywhere near"
        ),
        ReasonCode.MODEL_UNSEEN: lambda d: (
            f"only {100 * d['seen_share']:.0f} % of the model's vertices have a point of the scan"
        ),
        ReasonCode.NORMALS_DISAGREE: lambda d: (
            f"only {100 * d['scan_allowed_share']:.0f} % of the scan faces as the model does"
        ),
        ReasonCode.MODEL_UNMATCHED: lambda d: (
            f"only {100 * d['model_matched_share']:.0f} % of the model lies on the scan"
        ),
        ReasonCode.SHAPE_IMPLAUSIBLE: lambda d: (
            f"the shape is implausible: its coefficients lie {d['z_rms']:.1f} standard deviations out on average, "
            "where about 1 is usual"
        ),
        ReasonCode.LEADING_MODES_IMPLAUSIBLE: lambda d: (
            f"the shape is implausible: its main coefficients lie {d['z_rms']:.1f} standard deviations out on average, "
            "where about 1 is usual"
        ),
        ReasonCode.SCALE_IMPLAUSIBLE: lambda d: (
            f"the scan is {d['scale']:.2f} times as large as the model, where about 1 is usual; check its unit (--unit)"
        ),
        ReasonCode.PROBABLY_FAILED: lambda d: (
            f"its expected vertex error is {d['expected_error_mm']:.1f} mm (90 % interval {d['error_low_mm']:.1f} to "
            f"{d['error_high_mm']:.1f} mm), where {d['limit_mm']:.1f} mm is the limit; build a model of more shapes or "
            "modes"
        ),
        ReasonCode.MODEL_SHRANK: lambda d: (
            "the model shrank while it was fitted, as it does when parts of the scan are missing"
        ),
        ReasonCode.MODEL_DISTANT: lambda d: f"the model stays {d['rms_mm']:.1f} mm (RMS) away from the scan",
        ReasonCode.SCAN_NOT_COVERED: lambda d: (
            f"the model covers only {100 * d['scan_covered_share']:.0f} % of the scan"
        ),
        ReasonCode.DISTANCES_DIFFER: lambda d: (
            f"half of the scan lies over {d['scan_to_model_median_mm']:.1f} mm from the model, while half of the model "
            f"lies within {d['model_to_scan_median_mm']:.1f} mm of the scan"
        ),
        ReasonCode.MAIN_COEFFICIENTS_IMPLAUSIBLE: lambda d: (
            f"the shape is implausible: its {d['coefficients']} main coefficients lie {d['z_rms']:.1f} standard "
            "deviations out on average, where about 1 is usual"
        ),
        ReasonCode.OTHER: lambda d: f"{d['text']}",
    }
)
"""Code -> the text of a reason from its data: a clause without a full stop if the fit is doubtful, else a sentence."""


def text_of(code: str, data: Mapping[str, Any]) -> str:
    """Return the text of one reason.

    Raises:
        ValueError, KeyError, TypeError: the code is unknown, or its data are incomplete, as those of a saved file of
            another version can be.
    """
    return _TEXTS[ReasonCode(code)](data)


def sentence_of(status: str, reasons: Sequence[Reason]) -> str:
    """Return one sentence that explains the status of a fit."""
    text = "; ".join(text_of(reason.code, reason.data) for reason in reasons)
    return f"{DOUBTFUL}{text}." if status == "doubtful" else text
