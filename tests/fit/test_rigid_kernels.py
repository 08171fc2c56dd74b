import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.fit import rigid_kernels as kernels
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.surface import vertex_normals
from shapespace.types import FloatArray
from synthetic_shapes import angle_deg, blob, blob_model, sphere

Z = np.array([0.8, -1.0, 0.5, 1.0, -0.7])
TURN = Rotation.from_rotvec([1.2, -0.8, 1.5]).as_matrix()
REACHES = np.geomspace(30.0, 3.0, 80)  # a blob is smooth, so it slides for long


def box(points: FloatArray, cell: float) -> tuple[FloatArray, np.ndarray]:
    low = points.min(axis=0) - 20.0
    return low, (np.ceil((points.max(axis=0) + 20.0 - low) / cell) + 1).astype(np.int32)


def test_the_best_rotation_is_that_of_the_singular_value_decomposition() -> None:
    rng, R = np.random.default_rng(0), np.empty((3, 3))
    for H in [*rng.standard_normal((200, 3, 3)), np.diag([1.0, 2.0, -0.5]), np.diag([3.0, 2.0, 0.0]), -np.eye(3)]:
        U, _, Vt = np.linalg.svd(H)
        wanted = (U * [1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        kernels.best_rotation(H, R)
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert np.allclose(R @ R.T, np.eye(3))
        assert (R * H).sum() == pytest.approx((wanted * H).sum(), abs=1e-9)


def test_thinning_leaves_one_point_in_each_cell_that_has_any() -> None:
    points = np.random.default_rng(1).uniform(0, 50, (3000, 3))
    points[7] = 1e6  # outside the box
    dims = np.array([6, 6, 6], dtype=np.int32)
    kept = kernels.one_in_each_cell(points, np.zeros(3), 9.0, dims)
    cells = np.floor(points / 9.0).astype(int)
    assert 7 not in kept
    assert len(np.unique(cells[kept], axis=0)) == len(kept) == len(np.unique(np.delete(cells, 7, axis=0), axis=0))


def test_the_grid_tells_a_point_nearly_as_near_as_the_nearest() -> None:
    points = blob(sphere(2500)[0], Z)
    low, dims = box(points, 7.0)
    grid = kernels.near_grid(points, low, 7.0, dims)
    middles = low + 7.0 * (np.stack(np.meshgrid(*map(np.arange, dims), indexing="ij"), axis=-1) + 0.5)
    told = np.linalg.norm(points[grid] - middles, axis=-1)
    nearest = np.sqrt(KdTree(points).nearest(middles.reshape(-1, 3))[1]).reshape(told.shape)
    assert (told >= nearest - 1e-9).all()
    # A cell that holds several points keeps one of them, so a cell's diagonal may be lost, and little beyond.
    assert (told - nearest).max() < 7.0 * np.sqrt(3)
    assert np.mean(told - nearest) < 0.5


def near_grid(points: FloatArray) -> kernels.NearGrid:
    low, dims = box(points, 5.0)
    return kernels.NearGrid(kernels.near_grid(points, low, 5.0, dims), low, 5.0)


def search_arguments(R: FloatArray, t: FloatArray) -> tuple:
    model, scan = blob(sphere(900)[0], 0 * Z), blob(sphere(1500, 0.7)[0], 0 * Z)
    scan = scan @ R.T + t
    starts = np.stack([np.eye(3), Rotation.from_rotvec([0.05, -0.05, 0.2]).as_matrix()])
    return (starts, np.zeros((2, 3)), model, scan, scan, near_grid(scan), model, near_grid(model), REACHES, 10.0)


def test_rigid_search_finds_a_small_motion_from_several_starts_and_scores_it_low() -> None:
    R, t = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix(), np.array([8.0, -5.0, 3.0])
    arguments = search_arguments(R, t)
    scores = kernels.rigid_search(*arguments)
    for got_R, got_t in zip(arguments[0], arguments[1], strict=True):
        assert angle_deg(got_R @ R.T) < 6.0
        assert np.linalg.norm(got_t - t) < 3.0
    far = search_arguments(R, t + 400.0)
    assert kernels.rigid_search(*far[:8], np.array([1e-3]), 10.0).min() > 1.5 * scores.max()


def shape_points(side: float = 1.0) -> kernels.ShapePoints:
    model = blob_model()
    points = np.array(model.mean_vertices)
    normals = vertex_normals(model.mesh())
    modes = np.array(model.basis).reshape(-1, 3, model.n_modes)
    return kernels.ShapePoints(points, side * normals, modes, 1 / model.stddev**2, KdTree(points).arrays)


def shape_search(side: float = 1.0, scale_precision: float = 40.0, b_true: float = 1.0) -> tuple:
    """Search for a shape of the model at scale 1.1, from a start some degrees off."""
    model = blob_model()
    b_wanted = b_true * model.stddev * Z
    scan = 1.1 * model.reconstruct(b_wanted) @ TURN.T + [5.0, 2.0, -4.0]
    R, t = TURN @ Rotation.from_rotvec([0.0, 0.15, 0.1]).as_matrix(), np.zeros(3)
    b, out, counts = np.zeros(5), np.empty(3), np.array([700, 700], dtype=np.int32)
    slack = np.array([10.0, 10.0])
    arguments = (KdTree(scan).arrays, counts, REACHES, 1.0, scale_precision, slack, 5.0, out)
    scale = kernels.shape_search(R, t, 1.0, b, shape_points(side), scan, *arguments)
    return scale, R, t, b, out, b_wanted


def test_shape_search_finds_pose_scale_and_modes_together() -> None:
    scale, R, t, b, out, b_wanted = shape_search()
    assert scale == pytest.approx(1.1, rel=0.02)
    assert angle_deg(R @ TURN.T) < 6.0
    assert np.linalg.norm(t - [5.0, 2.0, -4.0]) < 3.0
    assert np.linalg.norm(b - b_wanted) < 0.35 * np.linalg.norm(b_wanted)
    assert out[:2].max() < 1.0
    assert out[2] > 0.97


def test_the_side_that_normals_point_to_does_not_matter() -> None:
    one, other = shape_search(1.0), shape_search(-1.0)
    for a, b in zip(one, other, strict=True):
        assert np.allclose(a, b)


def test_a_scale_that_is_held_stays() -> None:
    scale, _, _, _, out, _ = shape_search(scale_precision=np.inf)
    assert scale == 1.0
    assert out[:2].max() > shape_search()[4][:2].max()


def test_a_search_with_three_points_ends_in_numbers() -> None:
    scan = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [200.0, 0.0, 0.0]])
    R, t, b, out = np.eye(3), np.zeros(3), np.zeros(5), np.empty(3)
    counts, slack = np.array([3, 3], dtype=np.int32), np.array([10.0, 10.0])
    kernels.shape_search(
        R, t, 1.0, b, shape_points(), scan, KdTree(scan).arrays, counts, REACHES, 1.0, 40.0, slack, 5.0, out
    )
    assert np.isfinite(R).all()
    assert np.isfinite(t).all()
    assert np.isfinite(out).all()


def test_machine_code_and_python_agree() -> None:
    R, t = Rotation.from_rotvec([0.2, -0.1, 0.15]).as_matrix(), np.array([8.0, -5.0, 3.0])
    fast, slow = search_arguments(R, t), search_arguments(R, t)
    few = [*fast[:2], fast[2][:15], fast[3][:15], *fast[4:8], REACHES[:3], 10.0]
    same = [*slow[:2], slow[2][:15], slow[3][:15], *slow[4:8], REACHES[:3], 10.0]
    scores = kernels.rigid_search(*few)
    assert np.allclose(scores, kernels.rigid_search.py_func(*same))  # type: ignore[attr-defined]
    assert np.allclose(few[0], same[0])
    assert np.allclose(few[1], same[1])
