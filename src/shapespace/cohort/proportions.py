"""Intervals of shares near 0 and 1, where the bootstrap over subjects has no spread.

The bootstrap of a share without a single error is the interval [0, 0]. The exact interval of Clopper and Pearson
("The use of confidence or fiducial limits", Biometrika 26, 1934) for 0 errors among n independent units ends at
1 - (alpha / 2)^(1 / n); the rule of three, 3 / n, is its one-sided approximation. The units are subjects, since pairs
and scans of one subject depend on each other. The share of errors is at most the share of subjects with whom errors
happen, where each subject counts alike, so the bound is valid for it too.
"""

from __future__ import annotations

import numpy as np

from shapespace.types import FloatArray


def zero_bound(subjects: int, level: float = 0.95) -> float:
    """Return the upper end of the exact interval of an error share if none of `subjects` has an error.

    Args:
        subjects: number of independent units; if it is 0, the bound is 1.
        level: level of the two-sided interval.
    """
    return 1.0 - float((0.5 * (1.0 - level)) ** (1.0 / subjects)) if subjects > 0 else 1.0


def widen_share(
    low: FloatArray | float, high: FloatArray | float, subjects: int, level: float = 0.95
) -> tuple[FloatArray, FloatArray]:
    """Return intervals of shares that are at least as wide as the exact ones without an error.

    The upper end is at least `zero_bound`, and the lower end at most 1 - `zero_bound`, also if there are some errors.

    Args:
        low, high: ends of bootstrap intervals, of any shape; NaN stays NaN.
        subjects: number of independent units.
        level: level of the intervals.
    """
    bound = zero_bound(subjects, level)
    return np.asarray(np.minimum(low, 1.0 - bound)), np.asarray(np.maximum(high, bound))
