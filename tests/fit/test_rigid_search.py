import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.fit.search import pose_search as rigid
from shapespace.geometry.kdtree import KdTree
from shapespace.types import FloatArray
from synthetic_shapes import angle_deg, blob, sphere

Z = np.array([0.8, -1.0, 0.5, 1.0, -0.7])
REACHES = np.geomspace(30.0, 3.0, 80)  # a blob is smooth, so it slides for long
SIZE = 7.0 / 0.08


def test_the_best_rotation_is_a_rotation_and_no_other_does_better() -> None:
    rng = np.random.default_rng(0)
    H = np.stack([*rng.standard_normal((200, 3, 3)), np.diag([1.0, 2.0, -0.5]), np.diag([3.0, 2.0, 0.0]), -np.eye(3)])
    R = rigid._best_rotations(H)  # pyright: ignore[reportPrivateUsage]
    assert np.allclose(np.linalg.det(R), 1.0)
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3))
    reached = (R * H).sum(axis=(1, 2))
    for other in Rotation.random(300, random_state=1).as_matrix():
        assert ((other @ R * H).sum(axis=(1, 2)) <= reached + 1e-9).all()
    for near in Rotation.from_rotvec(0.02 * rng.standard_normal((50, 3))).as_matrix():
        assert ((near @ R * H).sum(axis=(1, 2)) <= reached + 1e-9).all()


def test_the_grid_tells_a_point_nearly_as_near_as_the_nearest() -> None:
    points = blob(sphere(2500)[0], Z)
    grid = rigid.NearGrid.of(points, SIZE)
    assert grid.cell == pytest.approx(7.0)
    dims = grid.near.shape
    middles = grid.origin[:, 0] + 7.0 * (np.stack(np.meshgrid(*map(np.arange, dims), indexing="ij"), axis=-1) + 0.5)
    places = middles.reshape(-1, 3)
    told = np.linalg.norm(grid.look_up(np.ascontiguousarray(places.T)[None])[0][0].T - places, axis=1)
    nearest = np.sqrt(KdTree(points).nearest(places)[1])
    assert (told >= nearest - 1e-9).all()
    # Cells compare by their middles, so a cell's diagonal may be lost, and little beyond.
    assert (told - nearest).max() < 7.0 * np.sqrt(3)
    assert np.mean(told - nearest) < 0.12 * 7.0


def test_outside_its_box_the_grid_tells_what_its_border_does() -> None:
    points = blob(sphere(400)[0], Z)
    grid = rigid.NearGrid.of(points, SIZE)
    far = grid.look_up(np.array([[[1e6, -1e6], [0.0, 0.0], [0.0, 0.0]]]))[0][0]
    assert np.allclose(far[:, 0], points[points[:, 0].argmax()], atol=30.0)
    assert np.allclose(far[:, 1], points[points[:, 0].argmin()], atol=30.0)


def search(R: FloatArray, t: FloatArray, reaches: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    model, scan = blob(sphere(900)[0], 0 * Z), blob(sphere(1500, 0.7)[0], 0 * Z) @ R.T + t
    starts = np.stack([np.eye(3), Rotation.from_rotvec([0.05, -0.05, 0.2]).as_matrix()])
    grids = rigid.NearGrid.of(model, SIZE), rigid.NearGrid.of(scan, SIZE)
    return rigid.rigid_search(starts, np.zeros((2, 3)), model, scan, *grids, reaches, 10.0)


def test_rigid_search_finds_a_small_motion_from_several_starts_and_scores_it_low() -> None:
    R, t = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix(), np.array([8.0, -5.0, 3.0])
    got_R, got_t, scores = search(R, t, REACHES)
    for k in range(2):
        assert angle_deg(got_R[k] @ R.T) < 6.0
        assert np.linalg.norm(got_t[k] - t) < 3.0
    assert search(R, t + 400.0, np.array([1e-3]))[2].min() > 1.5 * scores.max()
