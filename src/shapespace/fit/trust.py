"""Whether to trust a robust fit."""

from __future__ import annotations

from collections.abc import Mapping

from shapespace.fit.start import Start


def start_evidence(start: Start) -> dict[str, float]:
    """Return what the search for a start says, by name; not-a-number where nothing was searched."""
    return {"start_score_mm": start.score_mm, "start_runner_up_score_mm": start.runner_up_score_mm}


def doubts_of_robust(evidence: Mapping[str, float]) -> list[str]:
    """Return reasons."""
    return []
