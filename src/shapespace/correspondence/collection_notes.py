"""Sizes, units and unusual surfaces of scans in correspondence, by comparison with the other scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shapespace.correspondence.correspondence_result import Corresponding
from shapespace.correspondence.scan_status import find_review_reasons
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


_OTHER_SIZE = 2.0  # ratio of sizes: beyond twice the median a scan is probably of another object or unit
_ENOUGH_TO_COMPARE, _FAR = 4, 3.0
"""Times the usual distance (95 % of both directions), sizes divided out."""


def judge_collection(
    scans: Sequence[Corresponding], settled: float, earlier: Sequence[Corresponding] = ()
) -> tuple[Corresponding, ...]:
    """Return the scans with sizes and units, the reasons to review their surfaces, and notes on odd ones.

    Args:
        scans: of one correspondence.
        settled: movement below which a round is the last, share of the size.
        earlier: judged scans that these are added to; none of them changes.
    """
    every = [*earlier, *_sized(scans, earlier)]
    measured = [(k, scan.measures) for k, scan in enumerate(every) if scan.measures is not None]
    reasons = find_review_reasons([measures for _, measures in measured], settled)
    for (k, _), own in zip(measured, reasons, strict=True):
        every[k] = replace(every[k], review=tuple(own))
    # Point clouds are compared with each other, since their distances are those to points.
    far = np.array([(scan.distance[1] or np.nan) / (scan.scale * scan.unit_ratio) for scan in every])
    is_cloud = np.array([scan.area_share is None for scan in every])
    for alike in (is_cloud, ~is_cloud):
        if np.isfinite(far[alike]).sum() >= _ENOUGH_TO_COMPARE:
            for k in np.flatnonzero(alike & (far / np.nanmedian(far[alike]) > _FAR)).tolist():
                times = far[k] / np.nanmedian(far[alike])
                every[k] = every[k].noting(
                    f"Its surface lies {times:.2g} times as far from it as is usual; look at it."
                )
    return tuple(every[len(earlier) :])


def _sized(scans: Sequence[Corresponding], earlier: Sequence[Corresponding]) -> list[Corresponding]:
    """Return the scans with size and unit relative to the others, or to the scans that they are added to."""
    own = {k: scan.T_scan_template.scale for k, scan in enumerate(scans) if scan.T_scan_template is not None}
    usual = [one.T_scan_template.scale / one.unit_ratio for one in earlier if one.T_scan_template is not None]
    groups = [[k] for k in own] if usual else [list(own)]  # added scans do not depend on each other
    sized = list(scans)
    for group in groups if own else []:
        scales, ratios = unit_ratios([*usual, *usual, *(own[k] for k in group)])  # the others are most
        for k, scale, ratio in zip(group, scales[-len(group) :].tolist(), ratios[-len(group) :].tolist(), strict=True):
            sized[k] = replace(scans[k], scale=scale, unit_ratio=ratio)
            if not 1 / _OTHER_SIZE < scale < _OTHER_SIZE:
                sized[k] = sized[k].noting(
                    f"It is {scale:.2g} times as large as most; look whether it is the same kind of object."
                )
    return sized
