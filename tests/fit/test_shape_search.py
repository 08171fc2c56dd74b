import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.fit.search import shape_search as search
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.normals import vertex_normals
from synthetic_shapes import angle_deg, blob_model

Z = np.array([0.8, -1.0, 0.5, 1.0, -0.7])
TURN = Rotation.from_rotvec([1.2, -0.8, 1.5]).as_matrix()
REACHES = np.geomspace(30.0, 3.0, 80)  # a blob is smooth, so it slides for long


def shape_points(side: float = 1.0) -> search.ShapePoints:
    model = blob_model()
    points = np.array(model.mean_vertices)
    normals = vertex_normals(model.mesh())
    modes = np.array(model.basis).reshape(-1, 3, model.n_modes)
    return search.ShapePoints(points, side * normals, modes, 1 / model.stddev**2, KdTree(points).arrays)


def shape_search(side: float = 1.0, scale_precision: float = 40.0, b_true: float = 1.0) -> tuple:
    """Search for a shape of the model at scale 1.1, from a start some degrees off."""
    model = blob_model()
    b_wanted = b_true * model.stddev * Z
    scan = 1.1 * model.reconstruct(b_wanted) @ TURN.T + [5.0, 2.0, -4.0]
    R, t = TURN @ Rotation.from_rotvec([0.0, 0.15, 0.1]).as_matrix(), np.zeros(3)
    b, out, counts = np.zeros(5), np.empty(3), np.array([700, 700], dtype=np.int32)
    slack = np.array([10.0, 10.0])
    arguments = (KdTree(scan).arrays, counts, REACHES, 1.0, scale_precision, slack, 5.0, out)
    scale = search.shape_search(R, t, 1.0, b, shape_points(side), scan, *arguments)
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
    search.shape_search(
        R, t, 1.0, b, shape_points(), scan, KdTree(scan).arrays, counts, REACHES, 1.0, 40.0, slack, 5.0, out
    )
    assert np.isfinite(R).all()
    assert np.isfinite(t).all()
    assert np.isfinite(out).all()


def test_machine_code_and_python_agree() -> None:
    model = blob_model()
    scan = 1.1 * model.reconstruct(model.stddev * Z)[::40] @ TURN.T
    shape, tree = shape_points(), KdTree(scan).arrays
    ends = []
    for run in (search.shape_search, search.shape_search.py_func):  # type: ignore[attr-defined]
        R, t, b, out = TURN.copy(), np.zeros(3), np.zeros(5), np.empty(3)
        counts, slack = np.array([15, 15], dtype=np.int32), np.array([10.0, 10.0])
        s = run(R, t, 1.0, b, shape, scan, tree, counts, REACHES[:3], 1.0, 40.0, slack, 5.0, out)
        ends.append(np.concatenate([R.ravel(), t, b, out, [s]]))
    assert np.allclose(*ends)
    assert not np.allclose(ends[0][9:12], 0.0)


def test_normal_equations_are_solved_and_singular_ones_refused() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(9, 9))
    A, g = root @ root.T + np.eye(9), rng.normal(size=9)
    wanted, x = np.linalg.solve(A, g), g.copy()
    assert search._solve(A.copy(), x)
    assert np.allclose(x, wanted)
    assert not search._solve(np.zeros((3, 3)), np.ones(3))
    assert not search._solve(np.full((3, 3), np.nan), np.ones(3))
