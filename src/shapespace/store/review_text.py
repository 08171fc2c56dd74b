"""Reasons to review surfaces in correspondence, in English."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

from shapespace.schemas import CorrespondRecord, ReviewCode, ReviewReason, SurfaceReview

_OF_PROVENANCE = re.compile(r"; (\d+ of \d+ surfaces needs? review in the correspondence \([^()]*\))$")

_COUNTED: Mapping[ReviewCode, str] = {
    "doubtful": "doubtful",
    "folded": "with folded triangles",
    "not_settled": "not settled",
    "missing": "with missing parts",
    "unreached": "that do not reach parts of the scan",
    "distance": "far from the scan",
    "area_change": "with large changes of area",
}
"""Each reason after a number of surfaces."""


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"


_DESCRIBED: Mapping[ReviewCode, Callable[[ReviewReason], str]] = {
    "distance": lambda r: (
        f"1 % of its points lie farther off than {_percent(r.value)} of its size, where {_percent(r.usual)} is usual"
    ),
    "folded": lambda r: f"{_percent(r.value)} of its triangles are folded over",
    "missing": lambda r: f"it shows only {100 * (1 - r.value):.0f} % of the mean shape",
    "unreached": lambda r: f"only {100 * (1 - r.value):.0f} % of its points are reached",
    "area_change": lambda r: f"its triangles grow or shrink up to {r.value:.1f} times, where {r.usual:.1f} is usual",
    "not_settled": lambda r: f"its vertices still moved by {_percent(r.value)} of its size in the last round",
}


def describe_review(record: CorrespondRecord) -> tuple[str, ...]:
    """Return the reasons to review a surface as clauses, the doubt about its correspondence first."""
    doubt = (record.doubt,) if record.doubt else ()
    return (*doubt, *(_DESCRIBED[reason.code](reason) for reason in record.review))


def review_summary(review: SurfaceReview) -> str:
    """Return how many surfaces need review and why, as a clause; empty if none needs review."""
    if not review.needs_review:
        return ""
    reasons = ", ".join(f"{count} {_COUNTED[code]}" for code, count in review.reasons.items())
    verb = "needs" if review.needs_review == 1 else "need"
    return f"{review.needs_review} of {review.surfaces} surfaces {verb} review in the correspondence ({reasons})"


def provenance_with_review(provenance: str, review: SurfaceReview) -> str:
    """Return the provenance of a model, with the number of its training surfaces that need review."""
    return f"{provenance}; {summary}" if (summary := review_summary(review)) else provenance


def review_of_provenance(provenance: str) -> str:
    """Return the clause that `provenance_with_review` has added; empty if there is none."""
    found = _OF_PROVENANCE.search(provenance)
    return found[1] if found else ""
