"""The diagnostics of a fit in English: a label and a format for each key of `evidence` in a record."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

from shapespace.report.blocks.blocks import Facts
from shapespace.report.blocks.wording import mm, percent, setting, words

_Entry = tuple[str, Callable[[float], str]]


def _size(log_scale: float) -> str:
    return f"{math.exp(log_scale):.3f} times" if abs(log_scale) < math.log(1000) else f"log {log_scale:.3g}"


def _plain(value: float) -> str:
    return f"{value:.3g}"


EVIDENCE: Mapping[str, _Entry] = MappingProxyType(
    {
        "expected_error_mm": ("Expected distance of a vertex from its true place", mm),
        "error_low_mm": ("... 90 % interval from", mm),
        "error_high_mm": ("... to", mm),
        "failure_probability": ("Probability that the fit failed", percent),
        "seen_share": ("Share of the model that the scan shows", percent),
        "model_matched_share": ("Share of the model's vertices with a match", percent),
        "model_allowed_share": ("Share of the model's vertices whose matches may count", percent),
        "scan_allowed_share": ("Share of the scan's points whose matches may count", percent),
        "model_near_share": ("Share of the model near the scan", percent),
        "scan_near_share": ("Share of the scan near the model", percent),
        "spread_mm": ("Robust residual SD", mm),
        "model_spread_mm": ("RMS distance of a vertex from the mean, over the training shapes", mm),
        "model_lack_mm": ("Off-model variation of new shapes (RMS)", mm),
        "beyond_model_mm": ("Off-model variation of this scan (RMS)", mm),
        "left_out_mm": ("Distance of the fitted surface from the span of the modes (RMS)", mm),
        "posterior_error_mm": ("Vertex error by the posterior (RMS)", mm),
        "z2": ("Mean squared coefficient, in variances of new shapes (about 1 is usual)", _plain),
        "z2_leading": ("... of the leading modes", _plain),
        "log_scale": ("Scale of the fit relative to the model", _size),
        "size_mm": ("Size of the mean at the scale of the fit: RMS distance from its centroid", mm),
        "start_score_mm": ("Score of the start (lower is better)", mm),
        "start_runner_up_score_mm": ("... of the best other start", mm),
        "layered_share": ("Share of the scan with two layers", percent),
        "layers_apart_mm": ("... distance of these layers", mm),
        "displaced_share": ("Share of the scan that runs along the surface at a distance from it", percent),
        "displaced_inward_share": ("... inside the surface", percent),
        "displaced_bound": ("... largest of left-out training shapes", percent),
        "displaced_moved_mm": ("... robust residual SD after a similarity moved it onto the surface", mm),
        "displaced_purity": ("... of the unexplained parts of the scan", percent),
        "scattered_share": ("Share of the scan that scatters widely around the surface", percent),
        "second_instance_mm": ("Distance of a second instance in the scan", mm),
        "second_instance_gap_mm": ("... gap between the two (negative: they overlap)", mm),
        "mirrored_log_odds": ("Log odds that the scan is mirrored (nats; above 5: mirrored, below -5: not)", _plain),
        "mirrored_bound": ("... largest of left-out training shapes (mirrored only above it)", _plain),
        "mirrored_apart_mm": ("... vertex error if it is mirrored (mean)", mm),
        "training_shapes": ("Number of training shapes of the model", _plain),
        "marks_stddev_mm": ("Standard deviation of the landmarks given", mm),
        "marks_rms_mm": ("RMS distance from the landmarks given", mm),
    }
)
"""Key -> its label, and the function that formats its value."""


def evidence_facts(values: Mapping[str, object], caption: str) -> Facts:
    """Return the evidence of a fit with labels, in the order of `EVIDENCE`; keys of other versions unchanged."""
    known = {key: value for key, value in values.items() if key in EVIDENCE and isinstance(value, int | float)}
    rows = [(EVIDENCE[key][0], EVIDENCE[key][1](float(known[key]))) for key in EVIDENCE if key in known]
    rows += [(words(key), setting(value)) for key, value in values.items() if key not in known]
    return Facts(rows, caption)
