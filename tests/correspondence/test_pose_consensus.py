"""Poses on which comparisons between scans agree: single wrong comparisons turn no scan over."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.correspondence.pose_consensus import TEMPLATE, PoseComparison, angle_deg, consensus_poses
from shapespace.geometry.mirror_plane import FLIP
from shapespace.types import Similarity

SCANS, ANCHORS = 12, (TEMPLATE, 0, 1)


def random_pose(rng: np.random.Generator) -> Similarity:
    R = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return Similarity(float(rng.uniform(0.5, 2.0)), R, rng.standard_normal(3))


def conjugated(T: Similarity) -> Similarity:
    return Similarity(T.scale, FLIP[:, None] * T.rotation * FLIP, T.translation * FLIP)


def compared(
    poses: dict[int, Similarity], mirrored: dict[int, bool], wrong: set[tuple[int, int]], rng: np.random.Generator
) -> list[PoseComparison]:
    """Return comparisons of all scans with the anchors; the side that is compared correctly depends on both."""
    found: list[PoseComparison] = []
    for a in ANCHORS:
        for i in range(SCANS):
            if i == a:
                continue
            T = random_pose(rng) if (a, i) in wrong else poses[i] @ poses[a].inverse()
            T = conjugated(T) if mirrored[a] else T
            own, image = (T, random_pose(rng)) if mirrored[a] == mirrored[i] else (random_pose(rng), T)
            found.append(PoseComparison(a, i, own, image))
    return found


@pytest.mark.parametrize("seed", range(5))
def test_poses_are_the_true_ones_although_a_third_of_the_comparisons_with_one_anchor_is_wrong(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = {TEMPLATE: Similarity.identity()} | {i: random_pose(rng) for i in range(SCANS)}
    mirrored = dict.fromkeys(poses, False)
    found = consensus_poses(compared(poses, mirrored, {(TEMPLATE, i) for i in (3, 5, 7, 11)}, rng), mirrored)
    assert all(angle_deg(found[i], poses[i]) < 1e-3 for i in range(SCANS))
    assert found[3].scale == pytest.approx(poses[3].scale)


def test_poses_of_reflected_scans_are_those_of_their_mirror_images() -> None:
    rng = np.random.default_rng(0)
    poses = {TEMPLATE: Similarity.identity()} | {i: random_pose(rng) for i in range(SCANS)}
    for template_mirrored in (False, True):
        mirrored = {TEMPLATE: template_mirrored} | {i: i in (1, 4, 6) for i in range(SCANS)}
        found = consensus_poses(compared(poses, mirrored, {(0, 5), (TEMPLATE, 6)}, rng), mirrored)
        assert all(angle_deg(found[i], poses[i]) < 1e-3 for i in range(SCANS))


def test_without_comparisons_there_is_no_pose() -> None:
    assert consensus_poses([], {TEMPLATE: False}) == {}
