"""Tolerances of float64 rounding that the statistics share."""

from __future__ import annotations

TIE = 1e-9  # relative; statistics nearer than float64 sums are accurate count as equal
RANK = 1e-9  # ratio of singular values; below is float64 rounding
