"""Sizes, units and unusual surfaces of scans in correspondence, by comparison with the other scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shapespace.correspondence.correspondence_result import Corresponding
from shapespace.correspondence.scan_set import unit_ratios
from shapespace.correspondence.scan_status import find_review_reasons

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
