"""Scores as likelihood ratios, and what they cost: Cllr, and Cllr-min of the best monotone calibration.

Cllr is the mean information that is missed, in bits: 0 if all is known, 1 if nothing. Source: Brummer and du Preez,
"Application-independent evaluation of speaker detection", Computer Speech and Language 20, 2006.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from shapespace.lazy import require_package
from shapespace.statistics.identity.rates import Pairs
from shapespace.types import BoolArray, FloatArray, IntArray

_NEEDS, _INSTALL = "Calibration of scores", "'shapespace[statistics]'"


def cllr(llr: FloatArray, same: BoolArray, weights: FloatArray | None = None) -> float:
    """Return the cost of log likelihood ratios (M,), natural, in bits; both kinds of pairs count alike."""
    w = np.ones(len(llr)) if weights is None else weights
    cost = np.logaddexp(0.0, np.where(same, -llr, llr)) / np.log(2.0)
    return float(0.5 * (np.average(cost[same], weights=w[same]) + np.average(cost[~same], weights=w[~same])))


def cllr_min(score: FloatArray, same: BoolArray) -> float:
    """Return the least cost of any rising function of the scores, by pooling adjacent violators.

    Raises:
        ShapespaceError: scikit-learn is not installed.
    """
    isotonic = require_package("sklearn.isotonic", _NEEDS, _INSTALL).IsotonicRegression
    genuine = int(same.sum())
    weights = np.where(same, 0.5 / genuine, 0.5 / (len(same) - genuine))
    rule = isotonic(y_min=0.0, y_max=1.0).fit(score, same.astype(np.float64), sample_weight=weights)
    p = cast(FloatArray, rule.predict(score))
    p = np.clip(p, 0.0, 1.0)
    with np.errstate(divide="ignore"):
        return cllr(np.log(p) - np.log1p(-p), same)


def calibrated(score: FloatArray, pairs: Pairs, group: IntArray) -> FloatArray | None:
    """Return the log likelihood ratio (M,), natural, of each score, by a logistic regression on other people.

    Args:
        score: (M,).
        pairs: of whom.
        group: (P,) of each person; a pair is calibrated by pairs of people of neither's group.

    Returns:
        None where some groups leave no pairs of both kinds to learn from.

    Raises:
        ShapespaceError: scikit-learn is not installed.
    """
    make: Any = require_package("sklearn.linear_model", _NEEDS, _INSTALL).LogisticRegression
    one, other = group[pairs.one], group[pairs.other]
    out = np.full(len(score), np.nan)
    for a, b in sorted({(min(p), max(p)) for p in zip(one.tolist(), other.tolist(), strict=True)}):
        own = ((one == a) & (other == b)) | ((one == b) & (other == a))
        known = ~np.isin(one, (a, b)) & ~np.isin(other, (a, b))
        if pairs.same[known].all() or not pairs.same[known].any():
            return None
        mean, scale = score[known].mean(), score[known].std() or 1.0
        # Both kinds of pairs count alike, so the log odds are the log likelihood ratio.
        rule = make(class_weight="balanced").fit((score[known, None] - mean) / scale, pairs.same[known])
        out[own] = rule.decision_function((score[own, None] - mean) / scale)
    return out
