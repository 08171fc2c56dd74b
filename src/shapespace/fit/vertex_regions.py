"""Which parts of the model the scan decided: followed, rejected, at the scan's border, or not seen at all."""

from __future__ import annotations

import numpy as np

from shapespace.types import IntArray

REGIONS = ("followed", "rejected", "border", "unseen")
"""Codes 0 to 3: the match counted; the scan shows something else there; it ends there; it shows nothing there."""

FOLLOWED, REJECTED, BORDER, UNSEEN = range(4)
SHOWN = (FOLLOWED, REJECTED)
"""Where the scan shows something, be it what the model follows or not."""

MATCHED = (FOLLOWED, BORDER)
"""Where the model follows the scan, up to its border."""


def all_followed(vertices: int) -> IntArray:
    """Return the codes (V,) of a method that takes every vertex for matched."""
    return np.full(vertices, FOLLOWED, dtype=np.int32)
