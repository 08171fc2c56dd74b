"""Relative poses of parts as data: means of groups with intervals, dispersion, and changes by variables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.cohort.part_cohorts import RELATIVE_POSE, RelativePoses, relative_poses
from shapespace.statistics.compare_shapes import CompareResult
from shapespace.statistics.compare_strata import means_of
from shapespace.types import FloatArray

ALL = "all"
"""Name of the group of all shapes."""
_CONFIDENCE = 0.95  # of intervals, the usual one


@dataclass(frozen=True, eq=False)
class PoseMean:
    """Mean relative pose of a group at a joint: three rotations in degrees, and three translations in mm.

    Args:
        group: class of a variable, such as `sex female`, or `all`.
        joint: name of the joint.
        subjects: number of subjects; several shapes of a subject count once, by their mean.
        mean: (6,) the mean, by the logarithm of the rotations.
        low, high: (6,) ends of the 95 % interval of the mean, by Student's t; NaN for a single subject.
        stddev: (6,) standard deviation between subjects; NaN for a single subject.
    """

    group: str
    joint: str
    subjects: int
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    stddev: FloatArray


def poses_of(result: CompareResult) -> RelativePoses:
    """Return the relative poses of the shapes of a comparison that have all parts."""
    return relative_poses(result.parts[RELATIVE_POSE].cohort, result.config.pose_axes)


def pose_means(result: CompareResult) -> Iterator[PoseMean]:
    """Yield the mean relative pose of all subjects, and of each class of each variable, at each joint."""
    own = result.parts[RELATIVE_POSE]
    poses, blocks = poses_of(result), result.config.blocks
    owners = np.array(own.cohort.names if blocks is None else own.cohort.table.texts(blocks))
    groups: dict[str, Sequence[str]] = {"": [ALL] * len(owners)}
    groups |= {variable.name: own.design.groups_of(variable) for variable in own.design.variables if variable.groups}
    for variable, cells in groups.items():
        for group in sorted(set(cells)):
            rows = np.flatnonzero(np.array(cells) == group)
            codes = np.unique(owners[rows], return_inverse=True)[1]
            for joint, values in zip(poses.joints, poses.numbers[rows].transpose(1, 0, 2), strict=True):
                mean, half, stddev = mean_with_interval(means_of(values, codes))
                name = f"{variable} {group}".strip()
                yield PoseMean(name, joint, int(codes.max()) + 1, mean, mean - half, mean + half, stddev)


def pose_changes(result: CompareResult) -> dict[str, FloatArray]:
    """Return the change (J, 6) of the relative pose by the label of each effect: degrees, then mm, at each joint."""
    own = result.parts[RELATIVE_POSE]
    ends = {f"{end} {effect.label}": values for effect in own.effects
            for end, values in (("low", effect.at_low), ("high", effect.at_high))}  # fmt: skip
    if not ends:
        return {}
    numbers = relative_poses(own.cohort, result.config.pose_axes, ends).numbers
    return dict(zip((effect.label for effect in own.effects), numbers[1::2] - numbers[::2], strict=True))


def mean_with_interval(values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean (6,) of values (n, 6), the half width of its interval, and the standard deviation."""
    from scipy.special import stdtrit  # loads much

    count = len(values)
    stddev = values.std(axis=0, ddof=1) if count > 1 else np.full(values.shape[1], np.nan)
    half = stdtrit(max(count - 1, 1), (1 + _CONFIDENCE) / 2) * stddev / np.sqrt(count)
    return values.mean(axis=0), half, stddev
