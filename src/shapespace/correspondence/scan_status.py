"""Status of scans in correspondence: the probability that a surface is right, learned from simulated and real sets.

After the last round each surface is compared with those of the other scans. A logistic model turns this evidence into
the probability that the surface is wrong (C33).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from shapespace.correspondence.pose_consensus import SAME_POSE_DEG

ScanStatus: TypeAlias = Literal["converged", "doubtful", "excluded"]
_INTERCEPT = -4.81
_CONSENSUS, _RELIEF = 2.32, 9.73
"""Logistic model of the log odds that a surface is wrong, trained on simulated kinds of objects with mirrored and
foreign scans, molars, femora and faces, as in benchmarks/scan_status.py."""
_AMBIGUOUS, _GAP = 4.0, 0.2
"""Log odds that are added where another map along the surface agrees nearly as well, and by how much less it agrees: of
17 maps of simulated figures the gap was 0.23 or more in 6 right ones with another map, 0.05 to 0.18 in 3 wrong ones."""
_DOUBTED = 0.14
"""Probability that a surface is wrong from which it is doubtful."""

_CLEAR = 1.3
"""Agreement of reliefs (a correlation of 0.86) from which nothing is lacking: 33 wrong surfaces of 18 collections had
at most 1.21. Without this limit 10 instead of 5 of 174 right ones were doubtful, as the usual one can be above 1.8."""


@dataclass(frozen=True, kw_only=True)
class ScanEvidence:
    """What the shapes of the other scans say of one surface.

    Args:
        relief_agreement: correlation of its relief with the usual one, transformed to the real line (C35).
        usual_relief_agreement: median of the scans.
        consensus_deg: rotation between its pose and the one on which the comparisons with anchors agree (C32).
        relief_gap: by how much its relief agrees better than that of another map along the surface of an object that
            bends; infinite where there is none.
    """

    relief_agreement: float
    usual_relief_agreement: float
    consensus_deg: float = 0.0
    relief_gap: float = np.inf

    def features(self) -> tuple[float, float]:
        """Return what speaks against the surface, 0 where nothing does: consensus, and what its relief lacks."""
        lacking = max(self.usual_relief_agreement - self.relief_agreement, 0.0)
        return float(self.consensus_deg > SAME_POSE_DEG), lacking if self.relief_agreement < _CLEAR else 0.0


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


def judge(evidence: ScanEvidence) -> Judgement:
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
            "its pose may be wrong: the comparisons with other scans agree on one that is rotated by "
            f"{evidence.consensus_deg:.0f} degrees"
        )
    else:
        own, usual = np.tanh([evidence.relief_agreement, evidence.usual_relief_agreement])
        doubt = (
            "its pose or side may be wrong, or parts of it in wrong places: its bumps and hollows correlate with those "
            f"of the others by {own:.2f} (usual: {usual:.2f})"
        )
    return Judgement("doubtful", right, doubt)
