"""Status of scans in correspondence: the probability that a surface is right, learned from simulated and real sets.

After the last round each surface is compared with those of the other scans. A logistic model turns this evidence into
the probability that the surface is wrong (C33). A surface whose quality is unusual needs review, with typed reasons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, nan
from typing import Literal, TypeAlias

import numpy as np

from shapespace.correspondence.pose_consensus import SAME_POSE_DEG
from shapespace.schemas import CorrespondRecord, ReviewCode, ReviewReason
from shapespace.types import FloatArray

ScanStatus: TypeAlias = Literal["converged", "doubtful", "excluded"]
_INTERCEPT = -4.81
_CONSENSUS, _RELIEF = 2.32, 9.73
"""Logistic model of the log odds that a surface is wrong, trained on simulated kinds of objects with mirrored and
foreign scans, molars, femora and faces, as in benchmarks/scan_status.py."""
_AMBIGUOUS, _GAP = 4.0, 0.2
"""Log odds that are added if another map along the surface agrees nearly as well, and its gap in agreement: of
17 maps of simulated figures the gap was 0.23 or more in 6 right ones with another map, 0.05 to 0.18 in 3 wrong ones."""
_DOUBTED = 0.14
"""Probability that a surface is wrong from which it is doubtful."""

_CLEAR = 1.3
"""Agreement of reliefs (a correlation of 0.86) from which none is lacking: 33 wrong surfaces of 18 collections had
at most 1.21. Without this limit 10 instead of 5 of 174 right ones were doubtful, as the usual one can be above 1.8."""
_UNUSUAL = 4.0
"""Robust standard deviations above the median from which a value needs review."""
_LEAST_SPREAD = 0.25  # share of the median that counts as usual variation if all scans are alike
_TO_STDDEV = 1.4826  # MAD to standard deviation of a normal distribution: 1 / 0.6745
MOST_FOLDED = 0.01
"""Share of folded triangles above which a surface needs review whatever the share of the others. The median surface of
eight femora and of eight molars has none, with 1000 and 3000 vertices."""


@dataclass(frozen=True, kw_only=True)
class SurfaceEvidence:
    """Comparison of one surface with the shapes of the other scans.

    Args:
        relief_agreement: correlation of the relief of the surface (its height above its smoothed version) with the
            median relief of the scans, transformed by arctanh (C35).
        usual_relief_agreement: median of this agreement over the scans.
        consensus_deg: rotation between the pose of the surface and the pose on which the comparisons with anchors
            agree (C32).
        relief_gap: relief agreement of the surface minus that of the best other map along an object that bends;
            infinite if there is no other map.
    """

    relief_agreement: float
    usual_relief_agreement: float
    consensus_deg: float = 0.0
    relief_gap: float = np.inf

    def features(self) -> tuple[float, float]:
        """Return the evidence against the surface from its pose and from its relief.

        These are 1 if the pose differs from the consensus, else 0; and the difference of the relief agreement from
        the usual agreement, 0 if the agreement is clear or above the usual.
        """
        lacking = max(self.usual_relief_agreement - self.relief_agreement, 0.0)
        return float(self.consensus_deg > SAME_POSE_DEG), lacking if self.relief_agreement < _CLEAR else 0.0


@dataclass(frozen=True)
class Judgement:
    """The status of a scan in correspondence.

    Args:
        status: converged or doubtful.
        probability: probability that its surface is right, given the other scans.
        doubt: why the surface is doubtful; empty if it is not.
    """

    status: ScanStatus
    probability: float
    doubt: str


def judge(evidence: SurfaceEvidence) -> Judgement:
    """Return the status of a scan (C33)."""
    consensus, relief = evidence.features()
    is_ambiguous = evidence.relief_gap < _GAP
    log_odds = _INTERCEPT + _CONSENSUS * consensus + _RELIEF * relief + _AMBIGUOUS * is_ambiguous  # C33
    right = float(1.0 / (1.0 + np.exp(log_odds)))
    if right > 1.0 - _DOUBTED:
        return Judgement("converged", right, "")
    if is_ambiguous:
        doubt = "its limbs may be exchanged: another assignment of its limbs agrees nearly as well"
    elif consensus:
        doubt = (
            "its pose may be wrong: the comparisons with other scans agree on a pose that is rotated by "
            f"{evidence.consensus_deg:.0f} degrees"
        )
    else:
        own, usual = np.tanh([evidence.relief_agreement, evidence.usual_relief_agreement])
        doubt = (
            "its pose or side may be wrong, or parts of it in wrong places: its bumps and hollows correlate with those "
            f"of the others by {own:.2f} (usual: {usual:.2f})"
        )
    return Judgement("doubtful", right, doubt)


@dataclass(frozen=True, kw_only=True)
class SurfaceMeasures:
    """Measures of a surface in correspondence that decide whether it needs review; not-a-number if unknown.

    Args:
        distance: distance, as a share of the size, that 99 % of the distances between scan and surface are below.
        folded: share of the triangles that are folded, and are not on the mean shape.
        missing: share of the vertices that the scan does not show.
        unreached: share of the scan that the surface does not cover.
        area_change: factor by which 95 % of the triangles grow or shrink at most, the change of size removed.
        not_settled: RMS movement of the vertices in the last round, share of the size.
    """

    distance: float
    folded: float
    missing: float
    unreached: float
    area_change: float
    not_settled: float

    @staticmethod
    def of_record(record: CorrespondRecord, size: float) -> SurfaceMeasures:
        """Return the measures in a record; `size` is the RMS size of the surface in the unit of the scan."""

        def known(value: float | None) -> float:
            return nan if value is None else value

        return SurfaceMeasures(
            distance=known(record.distance_p99) / size,
            folded=known(record.folded_share),
            missing=1.0 - known(record.seen_share),
            unreached=1.0 - known(record.covered_share),
            area_change=record.area_factor or nan,
            not_settled=record.moved_share[-1] if record.moved_share else nan,
        )


def find_review_reasons(surfaces: Sequence[SurfaceMeasures], settled: float) -> list[list[ReviewReason]]:
    """Return for each of the `surfaces` of a collection the reasons to review it, the most unusual first.

    A measure is unusual if it is more than four robust standard deviations above the median of all surfaces. Folded
    triangles, distances and unreached parts also have limits of their own.

    Args:
        surfaces: all surfaces of the collection.
        settled: movement below which a round is the last, share of the size.
    """

    def column(code: ReviewCode) -> FloatArray:
        return np.array([getattr(surface, code) for surface in surfaces], dtype=np.float64)

    def relative_spread(values: FloatArray) -> float:
        return _LEAST_SPREAD * _median(values)

    distance, growth, moved = column("distance"), np.log(column("area_change")), column("not_settled")
    # Values, their least spread, the smallest unusual value, and the limit above which any value needs review.
    measures: dict[ReviewCode, tuple[FloatArray, float, float, float]] = {
        "distance": (distance, relative_spread(distance), 0.0, 0.1),
        "folded": (column("folded"), 0.0005, 0.001, MOST_FOLDED),
        "missing": (column("missing"), 0.03, 0.2, inf),
        "unreached": (column("unreached"), 0.02, 0.1, 0.25),
        "area_change": (growth, relative_spread(growth), 0.0, inf),
        "not_settled": (moved, relative_spread(moved), settled, inf),
    }
    reasons: list[list[ReviewReason]] = [[] for _ in surfaces]
    for code, (values, least_spread, least_value, limit) in measures.items():
        usual = _median(values)
        spread = max(_TO_STDDEV * _median(np.abs(values - usual)), least_spread, 1e-12)
        for own, value in zip(reasons, values.tolist(), strict=True):
            excess = (value - usual) / spread
            if value > limit:
                excess = max(excess, _UNUSUAL * value / limit)
            if excess > _UNUSUAL and value > least_value:
                shown = (exp(value), exp(usual)) if code == "area_change" else (value, usual)
                own.append(ReviewReason(code=code, value=shown[0], usual=shown[1], excess=excess))
    return [sorted(own, key=lambda reason: -reason.excess) for own in reasons]


def _median(values: FloatArray) -> float:
    """Return the median of the finite numbers, NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else nan
