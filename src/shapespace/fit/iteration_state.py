"""State of an iteration, stopping rule, and the parts of the model that the scan determines: shared by both phases."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from shapespace.errors import InputError
from shapespace.fit.diagnostics.failure_model import FitEvidence, MatchEvidence
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, IntArray, Similarity


@dataclass(frozen=True, eq=False)
class IcpState:
    """The state after one iteration, in the scan's mm frame.

    Args:
        phase: 1 or 2.
        iteration: number of the iteration in its phase; 0 is the start.
        T_scan_model: similarity from the model's frame to the scan's mm frame.
        b: (K,) coefficients, mm; zero throughout phase 1.
        rms_mm: RMS distance from the sampled vertices of the model (all of them in the paper's method), whether their
            matches count or not, to their closest scan points, mm of the scan.
        motion_mm: largest movement of a model vertex in this iteration, mm of the scan.
        stopped: None while running, else the reason of the stop: `rate`, or `cap`.
    """

    phase: int
    iteration: int
    T_scan_model: Similarity
    b: FloatArray
    rms_mm: float
    motion_mm: float
    stopped: str | None = None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Fitted:
    """End of a method, in the scan's mm frame.

    Args:
        T_scan_model: similarity from the model's frame to the scan's mm frame.
        b: (K,) coefficients, mm.
        b_stddev: (K,) standard deviations of the coefficients, mm.
        shrinkage: (K,) in [0, 1]: 1 where the scan determines the coefficient, 0 where only the prior does.
        T_scan_fitted: pose of the surface that was fitted, before its projection onto the model's modes.
        vertices_scan_mm: (V, 3) fitted surface in the scan's mm frame; it may leave the span of the model.
        outside_mm: RMS distance of the fitted surface from the span of the model, mm of the scan.
        regions: function that finds the code of each vertex, (V,), in `REGIONS`.
        evidence: diagnostics from which the status is computed; None of a method without diagnostics.
        b_covariance: (K, K) covariance of the coefficients, mm^2; None if the method does not estimate it.
        notes: sentences on problems of the scan.
        landmark_covariance: (L, 3, 3) covariance of the positions of the model's landmarks in that frame, mm^2, in the
            model's order; None if the method does not estimate it.
    """

    T_scan_model: Similarity
    b: FloatArray
    b_stddev: FloatArray
    shrinkage: FloatArray
    T_scan_fitted: Similarity
    vertices_scan_mm: FloatArray
    outside_mm: float
    regions: Callable[[], IntArray] = field(repr=False)
    evidence: FitEvidence | None = None
    b_covariance: FloatArray | None = None
    notes: Sequence[str] = ()
    landmark_covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class RobustFitted(Fitted):
    """End of the robust method, with the diagnostics of its last iterate."""

    match_evidence: MatchEvidence = field(kw_only=True)


_F = TypeVar("_F", bound=Fitted)


def last_of(states: Generator[IcpState, None, _F]) -> _F:
    """Run a fit to its end, and return its result."""
    while True:
        try:
            next(states)
        except StopIteration as end:
            return end.value


@dataclass(frozen=True)
class StopRule:
    """The paper's rule on the rate of change of the RMS (step 4), with a cap.

    Args:
        rate: stop when |e_k - e_(k-1)| is at most this share of e_(k-1).
        motion_mm: largest movement of a vertex, mm of the model's frame, up to which the iteration may stop; the RMS
            alone does not detect sliding (erratum to step 4). Infinity gives the rule as printed.
        max_iterations: cap of each phase.

    Raises:
        InputError: a rate or a motion that is not positive, or no iterations.
    """

    rate: float = 1e-4
    motion_mm: float = float("inf")
    max_iterations: int = 200

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.motion_mm > 0 and self.max_iterations >= 1):
            raise InputError("A stopping rule needs a positive rate and motion and at least one iteration.")

    def why(self, rms_mm: Sequence[float], motion_mm: float) -> str | None:
        """Return `rate` or `cap` if the rule stops after `rms_mm`, else None; both in mm of the model's frame."""
        if len(rms_mm) >= 2:
            change = abs(rms_mm[-1] - rms_mm[-2])
            if change <= self.rate * max(rms_mm[-2], 1e-12) and motion_mm <= self.motion_mm:
                return "rate"
        return "cap" if len(rms_mm) > self.max_iterations else None


def largest_motion(moved: FloatArray) -> float:
    """Return the length of the longest of `moved` (V, 3)."""
    return float(np.sqrt(np.einsum("ij,ij->i", moved, moved).max()))


REGIONS = ("followed", "rejected", "border", "unseen")
"""Codes 0 to 3: the match counted; the scan shows another surface there; it ends there; it shows nothing there."""

FOLLOWED, REJECTED, BORDER, UNSEEN = range(4)
SHOWN = (FOLLOWED, REJECTED)
"""Regions where the scan shows a surface, whether the model follows it or not."""

MATCHED = (FOLLOWED, BORDER)
"""Regions where the model follows the scan, up to its border."""


def all_followed(vertices: int) -> IntArray:
    """Return the codes (V,) of a method that counts every vertex as matched."""
    return np.full(vertices, FOLLOWED, dtype=np.int32)
