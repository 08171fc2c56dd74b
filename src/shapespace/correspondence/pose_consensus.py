"""Poses on which the comparisons between scans agree, so that a single ambiguous template cannot flip a scan (C32).

Each scan is compared with some scans and the template, the anchors, by a pose search. A wrong comparison contradicts
others: the poses a -> b, b -> c and c -> a do not close. The poses of the scans are those that agree with most
comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.geometry.mirror_plane import FLIP
from shapespace.types import FloatArray, Similarity

TEMPLATE = -1
"""Number of the template among the anchors."""
SAME_POSE_DEG = 35.0
"""Rotation up to which two poses agree: 79 of 84 comparisons between blobs of six kinds were within 36 degrees of the
truth, and the others beyond 120."""
_EQUAL = 1e-9  # difference of supports that is rounding error
_STEPS = 10  # maximum number of passes over all scans; poses stop changing after two or three


@dataclass(frozen=True, eq=False)
class PoseComparison:
    """The pose of a scan in relation to an anchor, by a pose search.

    Args:
        anchor: number of the anchor among the scans, or `TEMPLATE`.
        scan: number of the scan.
        T_scan_anchor: similarity from the frame of the anchor to that of the scan.
        T_image_anchor: similarity from the frame of the anchor to that of the scan's mirror image; None if not
            compared.
    """

    anchor: int
    scan: int
    T_scan_anchor: Similarity
    T_image_anchor: Similarity | None

    def between_sides(self, mirrored: Mapping[int, bool]) -> Similarity | None:
        """Return the pose from the anchor to the scan, each reflected if it is `mirrored`."""
        reflected = mirrored[self.anchor]
        T = self.T_scan_anchor if mirrored[self.scan] == reflected else self.T_image_anchor
        return T if T is None or not reflected else _mirror_pose(T)


def angle_deg(a: Similarity, b: Similarity) -> float:
    """Return the rotation between two poses, degrees."""
    cosine = (np.trace(a.rotation @ b.rotation.T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def consensus_poses(comparisons: Sequence[PoseComparison], mirrored: Mapping[int, bool]) -> dict[int, Similarity]:
    """Return for each scan the pose of the template in it that agrees with most comparisons (C32).

    Args:
        comparisons: comparisons of scans with anchors, the template among them.
        mirrored: whether each scan is reflected, by its number; for the template whether it was reflected after the
            comparisons. Poses are those of the reflected scans and template.
    """
    edges: dict[int, list[tuple[int, Similarity]]] = {TEMPLATE: []}
    for comparison in comparisons:
        T = comparison.between_sides(mirrored)
        if T is not None and comparison.anchor != comparison.scan:
            edges.setdefault(comparison.scan, []).append((comparison.anchor, T))
            edges.setdefault(comparison.anchor, []).append((comparison.scan, T.inverse()))
    anchors = sorted({comparison.anchor for comparison in comparisons} & edges.keys())
    order = [*anchors, *sorted(edges.keys() - set(anchors))]
    solutions = [_poses_from(root, order, edges) for root in anchors]
    if not solutions:
        return {}
    poses = max(solutions, key=lambda poses: sum(_find_support(poses, edges, i)[2] for i in order))
    gauge = poses.pop(TEMPLATE).inverse()
    return {i: T @ gauge for i, T in poses.items()}


def _poses_from(
    root: int, order: Sequence[int], edges: Mapping[int, Sequence[tuple[int, Similarity]]]
) -> dict[int, Similarity]:
    """Return poses from the comparisons with one anchor, each then replaced by the pose that most others support."""
    poses = {root: Similarity.identity()} | dict(edges[root])
    for _ in range(_STEPS):
        is_changed = False
        for i in order:
            support, proposed, own = _find_support(poses, edges, i)
            if i != root and len(support) and support.max() > own + _EQUAL:
                poses[i] = proposed[int(support.argmax())]
                is_changed = True
        if not is_changed:
            break
    return poses


def _find_support(
    poses: Mapping[int, Similarity], edges: Mapping[int, Sequence[tuple[int, Similarity]]], i: int
) -> tuple[FloatArray, list[Similarity], float]:
    """Return the support of each pose that neighbours propose for `i`, these poses, and the support of its own."""
    proposed = [T @ poses[j] for j, T in edges[i] if j in poses]
    if not proposed:
        return np.zeros(0), [], 0.0
    rotations = np.stack([T.rotation for T in proposed]).reshape(len(proposed), 9)
    own = _support(rotations @ poses[i].rotation.ravel()).sum() if i in poses else -1.0
    return _support(rotations @ rotations.T).sum(axis=1), proposed, float(own)


def _support(trace: FloatArray) -> FloatArray:
    """Return the support of poses for each other, from 1 if they are equal to 0 if they do not agree."""
    limit = 1 + 2 * np.cos(np.radians(SAME_POSE_DEG))
    return np.clip((trace - limit) / (3 - limit), 0.0, 1.0)


def _mirror_pose(T: Similarity) -> Similarity:
    """Return the pose `T` as seen in the mirror images of its two frames."""
    return Similarity(T.scale, FLIP[:, None] * T.rotation * FLIP, T.translation * FLIP)
