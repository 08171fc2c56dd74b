"""Modes that no shape made: what the alignment left of itself, and what is finer than the meshes are written.

Procrustes takes out of the shapes what a similarity does to the mean, to first order. What remains to second order is
along the scale, and is scaled away before PCA (`scale_to_tangent`) where all vertices carried the alignment. What comes
out all the same as modes in the tangent of the similarity group at the mean is left out: there a fit cannot tell
them from its pose. Sources: Goodall, JRSS B 53(2), 1991, section 4; for the edge of a spectrum of pure noise Marchenko
and Pastur, Math. USSR-Sbornik 1(4), 1967.
"""

from __future__ import annotations

import numpy as np

from shapespace.geometry.procrustes import Gauge
from shapespace.geometry.similarity import small_poses
from shapespace.types import MM_PER_UNIT, BoolArray, FloatArray, IntArray

_TANGENT_SHARE = 0.1
"""Modes of shapes lie in the tangent by less than a fiftieth; those of alignment by a third and more, unless mixed."""
_COARSE = 2.0
"""Rounding to one of two neighbours spreads almost twice as far as rounding over a whole step."""
_MOST_DECIMALS = 6  # decimals that files of rounded coordinates have at most; more are not tested for
_ROUNDING = 1e-14  # relative; some units in the last place of float64


def made_by_alignment(
    mean_vertices: FloatArray, vertex_basis: FloatArray, gauge: Gauge, alignment_vertices: IntArray | None
) -> BoolArray:
    """Return which modes (K,) lie in the tangent of the group that the shapes were aligned by.

    Args:
        mean_vertices: (V, 3) mm.
        vertex_basis: (3V, K), orthonormal.
        gauge: `form`, rigid motions; `shape`, similarities.
        alignment_vertices: indices of those that carried the alignment; None for all.
    """
    used = np.arange(len(mean_vertices)) if alignment_vertices is None else np.unique(alignment_vertices)
    moves = small_poses(mean_vertices[used])  # rotations, translations, and the scale last
    tangent = np.linalg.qr(moves if gauge == "shape" else moves[:, :-1])[0]
    rows = (3 * used[:, None] + np.arange(3)).ravel()
    return ((tangent.T @ vertex_basis[rows]) ** 2).sum(axis=0) > _TANGENT_SHARE


def below_precision(variance: FloatArray, n: int, coordinates: int, rounding_mm: float) -> BoolArray:
    """Return which of the variances (K,), mm^2, n shapes of that many coordinates can have by rounding alone."""
    return variance <= (_COARSE * rounding_mm * (1.0 + np.sqrt(coordinates / max(n - 1, 1)))) ** 2


def rounding_mm(vertices: FloatArray) -> float:
    """Return the standard deviation of the rounding with which coordinates (V, 3), mm, were written; 0 if not seen.

    They may have been written in any unit, as decimals or in single precision.
    """
    rounding = 0.0
    for mm in MM_PER_UNIT.values():
        y = vertices / mm
        near = np.maximum(np.abs(y), 1e-300) * _ROUNDING
        for decimals in range(_MOST_DECIMALS + 1):
            step = 10.0**-decimals
            if (np.abs(y - np.rint(y / step) * step) <= near + _ROUNDING).all():
                rounding = max(rounding, step * mm / np.sqrt(12.0))
                break
        with np.errstate(over="ignore"):  # absurd coordinates are in no single precision
            single = y.astype(np.float32)
        if (np.abs(y - single) <= near).all():
            rounding = max(
                rounding, float(np.sqrt((np.spacing(np.abs(single)).astype(np.float64) ** 2).mean() / 12.0)) * mm
            )
    return rounding
