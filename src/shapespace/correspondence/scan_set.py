"""Comparisons of scans: copies of the same surface, and their units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh

_EQUAL = 1e-4
"""RMS distance, as a share of the size: coordinates stored as float32 far from the origin are no finer."""
_LEAST_RATIO = 8.0
"""Objects of one kind differ in size by less, and so units by more."""
_UNITS = np.array(list(MM_PER_UNIT.values()))
_RATIOS = np.unique((_UNITS[:, None] / _UNITS).ravel())
_RATIOS = _RATIOS[(_RATIOS == 1.0) | (np.abs(np.log(_RATIOS)) > np.log(_LEAST_RATIO))]


def copies(scans: Sequence[Mesh]) -> dict[int, int]:
    """Return which of `scans` are earlier ones again, in any pose and size: the number of each, and of the first."""
    first: dict[object, list[int]] = {}
    copy_of: dict[int, int] = {}
    for i, scan in enumerate(scans):
        alike = first.setdefault((len(scan.vertices), None if scan.faces is None else scan.faces.tobytes()), [])
        same = next((j for j in alike if _equal(scan, scans[j])), None)
        if same is None:
            alike.append(i)
        else:
            copy_of[i] = same
    return copy_of


def _equal(one: Mesh, other: Mesh) -> bool:
    try:
        moved = fit_similarity(one.vertices, other.vertices).apply(one.vertices)
    except InputError:
        return np.array_equal(one.vertices, other.vertices)
    rms = np.sqrt(((moved - other.vertices) ** 2).sum(axis=1).mean())
    return bool(rms < _EQUAL * rms_size(other.vertices))


def unit_ratios(scales: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Return sizes and units relative to those of most scans.

    Args:
        scales: (N,) of scans relative to one template.

    Returns:
        (N,) sizes relative to the median of most scans, in one unit, and (N,) how many times as large as in the unit of
        most the coordinates are, such as 0.001 for metres among millimetres; 1 for most.
    """
    logs = np.log(np.asarray(scales, dtype=np.float64))
    near = np.abs(logs[:, None] - logs) < 0.5 * np.log(_LEAST_RATIO)
    # As many in one unit as in another: the finer one.
    most = max(range(len(logs)), key=lambda i: (int(near[i].sum()), logs[i]))
    relative = logs - np.median(logs[near[most]])
    ratios = _RATIOS[np.abs(relative[:, None] - np.log(_RATIOS)).argmin(axis=1)]
    return np.exp(relative) / ratios, ratios
