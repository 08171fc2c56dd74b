"""Status of scans in correspondence: the probability that a surface is right, learned from simulated and real sets.

After the last round, each scan is compared once more with the shapes of the others: its pose with the best other pose,
and with its mirror image. A logistic model turns this evidence into the probability that the surface is wrong (C33).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from shapespace.correspondence.pose_consensus import SAME_POSE_DEG

ScanStatus: TypeAlias = Literal["converged", "doubtful", "excluded"]
_INTERCEPT = -4.03
_WEIGHTS: Mapping[str, float] = {"pose": 4.23, "mirrored": 1.33, "distance": 4.95, "consensus": 1.69}
"""Logistic model of the log odds that a surface is wrong, trained on 402 surfaces of 30 collections, 44 of them wrong:
simulated kinds of objects with mirrored and foreign scans, molars, femora and faces, as in
benchmarks/scan_status.py."""
_LARGEST_RATIO = 3.0
"""Ratio of scores that counts at most: a pose or side that is so much worse is ruled out."""
_ASYMMETRIC = 1.15
"""Usual ratio of the scores of mirror images and scans from which objects are asymmetric."""
_DOUBTED = 0.2
"""Probability that a surface is wrong from which it is doubtful: 5 % of the right surfaces of the training reach it."""


@dataclass(frozen=True, kw_only=True)
class ScanEvidence:
    """What the shapes of the other scans say of one surface; scores and distances are those of the pose search and C14.

    Args:
        other_pose_ratio: score of the best other pose, in scores of its own; infinite where all others are far worse.
        other_pose_deg: rotation between the two.
        mirrored_ratio: score of the best pose of its mirror image, in scores of its own.
        distance_ratio: distance from its prediction by the others (C14), in medians of all scans.
        consensus_deg: rotation between its pose and the one on which the comparisons with anchors agree (C32).
        usual_other_pose_ratio, usual_mirrored_ratio: medians of the scans; not-a-number if unknown, and the ratios are
            no evidence then.
    """

    other_pose_ratio: float
    other_pose_deg: float
    mirrored_ratio: float
    distance_ratio: float
    consensus_deg: float
    usual_other_pose_ratio: float = np.nan
    usual_mirrored_ratio: float = np.nan

    def features(self) -> dict[str, float]:
        """Return the features of the logistic model: 0 where nothing speaks against the surface."""
        return {
            "pose": _shortfall(self.other_pose_ratio, self.usual_other_pose_ratio),
            "mirrored": _shortfall(self.mirrored_ratio, 1.0) if self.usual_mirrored_ratio > _ASYMMETRIC else 0.0,
            "distance": float(np.log(max(self.distance_ratio, 1.0))),
            "consensus": float(self.consensus_deg > SAME_POSE_DEG),
        }


@dataclass(frozen=True)
class Judgement:
    """The status of a scan in correspondence.

    Args:
        status: converged or doubtful.
        probability: that its surface is right, as far as the other scans show.
        doubt: why it is doubtful; empty where it is not.
    """

    status: ScanStatus
    probability: float
    doubt: str


def usual_ratios(evidence: Sequence[ScanEvidence]) -> tuple[float, float]:
    """Return the medians of the ratios of other poses and of mirror images."""
    ratios = np.array([(one.other_pose_ratio, one.mirrored_ratio) for one in evidence])
    other_pose, mirrored = np.median(np.minimum(ratios, _LARGEST_RATIO), axis=0).tolist()
    return other_pose, mirrored


def judge(evidence: ScanEvidence) -> Judgement:
    """Return the status of a scan (C33)."""
    shares = {name: _WEIGHTS[name] * value for name, value in evidence.features().items()}
    wrong = float(1.0 / (1.0 + np.exp(-_INTERCEPT - sum(shares.values()))))  # C33
    if wrong < _DOUBTED:
        return Judgement("converged", 1.0 - wrong, "")
    return Judgement("doubtful", 1.0 - wrong, _doubt(max(shares, key=lambda name: shares[name]), evidence))


def _shortfall(ratio: float, usual: float) -> float:
    """Return by how much a ratio of scores is below the usual one, as a logarithm."""
    return 0.0 if np.isnan(usual) else float(np.log(max(usual / min(ratio, _LARGEST_RATIO), 1.0)))


def _doubt(feature: str, evidence: ScanEvidence) -> str:
    """Return the clause on the feature that speaks most against a surface."""
    if feature == "consensus":
        return (
            "its pose may be wrong: the comparisons with other scans agree on one that is rotated by "
            f"{evidence.consensus_deg:.0f} degrees"
        )
    if feature == "pose":
        return (
            f"its pose may be wrong: one that is rotated by {evidence.other_pose_deg:.0f} degrees is only "
            f"{evidence.other_pose_ratio:.2f} times as far from the shapes of the others (usual: "
            f"{evidence.usual_other_pose_ratio:.2f})"
        )
    if feature == "mirrored":
        return (
            f"its side may be wrong: its mirror image is only {evidence.mirrored_ratio:.2f} times as far from the "
            f"shapes of the others (usual: {evidence.usual_mirrored_ratio:.2f} times)"
        )
    return (
        f"its shape is unusual: {evidence.distance_ratio:.1f} times as far as usual from its prediction by the others"
    )
