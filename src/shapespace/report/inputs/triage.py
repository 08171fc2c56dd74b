"""Triage of scans in correspondence: scans to review first, with reasons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan

import numpy as np

from shapespace.report.blocks.wording import DASH, plain
from shapespace.report.inputs.correspondence_folder import Corresponded
from shapespace.schemas import CorrespondRecord
from shapespace.store.review_text import describe_review

_DOUBTFUL_WEIGHT = 1e6  # before all other reasons


@dataclass(frozen=True)
class Concern:
    """Reasons to review a scan in correspondence.

    Args:
        weight: how much it stands out, 0 for not at all.
        reasons: in words, the weightiest first.
    """

    weight: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Reasons as a sentence."""
        return sentence("; ".join(self.reasons)) if self.reasons else "Nothing about it stands out."


def concerns_of(folder: Corresponded) -> dict[str, Concern]:
    """Return the concerns about each readable scan in correspondence, by name."""
    concerns: dict[str, Concern] = {}
    for name in folder.population().names:
        record = folder.records[name]
        weight = _DOUBTFUL_WEIGHT if record.doubt else max((reason.excess for reason in record.review), default=0.0)
        concerns[name] = Concern(weight, describe_review(record))
    return concerns


def distance_share(record: CorrespondRecord, statistic: str, size: float) -> float:
    """Return the distance `mean`, `p95`, `p99` or `max` of a record as a share of `size`, which is in its unit."""
    return known(getattr(record, f"distance_{statistic}")) / size


def known(value: float | None) -> float:
    """Return a number that may be absent, NaN for None."""
    return nan if value is None else value


def median(values: Sequence[float]) -> float:
    """Return the median of the finite numbers, NaN if there are none."""
    numbers = [value for value in values if isfinite(value)]
    return float(np.median(numbers)) if numbers else nan


def percent_of(share: float) -> str:
    """Return a small share in percent with two digits or so."""
    return f"{plain(float(f'{100 * share:.2g}'))} %" if isfinite(share) else DASH


def sentence(text: str) -> str:
    """Return `text` from a capital letter to a full stop."""
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith(".") else ".") if text else ""


def scan_status(record: CorrespondRecord, concerns: Mapping[str, Concern]) -> str:
    """Return `converged`, `look` for an unusual scan, `doubtful`, `excluded`, or `unreadable`."""
    if record.is_excluded:
        return "excluded"
    concern = concerns.get(record.name)
    if concern is None:
        return "unreadable"
    return "doubtful" if record.status == "doubtful" else "look" if concern.reasons else "converged"
