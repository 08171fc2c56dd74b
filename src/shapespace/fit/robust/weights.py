"""How much a match counts, by its residual: robust weights of which one is chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from shapespace.types import BoolArray, FloatArray


def welsch(residual: FloatArray, scale: float) -> FloatArray:
    """Return exp(-r^2 / (2 scale^2)): what lies far off counts nothing (Zhang, Yao and Deng, PAMI 2022)."""
    return np.exp(-0.5 * (residual / scale) ** 2)  # R8a


def geman_mcclure(residual: FloatArray, scale: float) -> FloatArray:
    """Return (scale^2 / (scale^2 + r^2))^2, with heavier tails than Welsch's (Zhou, Park and Koltun, ECCV 2016)."""
    return (scale**2 / (scale**2 + residual**2)) ** 2  # R8b


def huber(residual: FloatArray, scale: float) -> FloatArray:
    """Return 1 up to `scale` and scale / |r| beyond: nothing is ever left out (Huber, 1964)."""
    return scale / np.maximum(np.abs(residual), scale)  # R8c


WEIGHTS: Mapping[str, Callable[[FloatArray, float], FloatArray]] = {
    "welsch": welsch,
    "geman_mcclure": geman_mcclure,
    "huber": huber,
}
"""Weights by name: residual (M,) and its scale, both mm -> (M,) in [0, 1], falling from 1 at 0."""


_TAIL = 0.9
"""Quantile that R6b compares with that of normal noise."""


def spread(residual: FloatArray) -> float:
    """Return the robust standard deviation of `residual` (M,) from the median of its absolute values (R6a)."""
    return 1.4826 * float(np.median(np.abs(residual))) if len(residual) else float("inf")


def tails(residual: FloatArray, spread_mm: float) -> float:
    """Return the 90 % quantile of |residual| (M,) over that of normal noise of this spread (R6b)."""
    # What np.quantile returns, bit for bit, in a third of its time.
    place = _TAIL * (len(residual) - 1)
    below = int(place)
    above = min(below + 1, len(residual) - 1)
    ordered = np.partition(np.abs(residual), (below, above))
    low, high, share = float(ordered[below]), float(ordered[above]), place - below
    quantile = low + (high - low) * share if share < 0.5 else high - (high - low) * (1.0 - share)
    return quantile / (1.645 * spread_mm)


def match_weights(
    name: str, residual: FloatArray, distance: FloatArray, allowed: BoolArray, width_mm: float, far_mm: float
) -> FloatArray:
    """Return the weights (M,) of matches by the weight called `name`: residuals against a width, distances against far.

    Args:
        name: of `WEIGHTS`.
        residual: (M,) mm.
        distance: (M,) mm.
        allowed: (M,) False for matches that count nothing.
        width_mm: scale of the residuals.
        far_mm: scale of the distances.
    """
    weight = WEIGHTS[name]
    return weight(residual, width_mm) * weight(distance, far_mm) * allowed
