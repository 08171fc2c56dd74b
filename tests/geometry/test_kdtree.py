"""The kd-tree gives the answers of brute force, whatever the points and the guesses."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from shapespace.errors import InputError
from shapespace.geometry.kdtree import NOTED, KdTree
from shapespace.types import FloatArray

RNG = np.random.default_rng(0)


def on_a_line() -> FloatArray:
    return RNG.integers(0, 60, (200, 1)) * np.array([[1.0, 2.0, -1.0]])


def grid() -> FloatArray:
    return np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3)


def repeated() -> FloatArray:
    return np.repeat(RNG.standard_normal((40, 3)), 9, axis=0)


CLOUDS = {
    "one": np.array([[1.0, 2.0, 3.0]]),
    "eleven": RNG.standard_normal((11, 3)),
    "scattered": RNG.standard_normal((1_500, 3)) * [30, 1, 80],
    "all equal": np.full((300, 3), 2.5),
    "line": on_a_line(),
    "grid": grid(),
    "repeated": repeated(),
    "far": RNG.standard_normal((500, 3)) + 1e7,
}


def queries(points: FloatArray) -> FloatArray:
    size = max(np.ptp(points, axis=0).max(), 1.0)
    near = points[RNG.integers(0, len(points), 200)]
    return np.vstack([near, near + 0.5, near + RNG.standard_normal((200, 3)) * size, points.mean(axis=0)[None]])


def brute_force(points: FloatArray, asked: FloatArray) -> tuple[np.ndarray, FloatArray]:
    d = points[None] - asked[:, None]
    squared = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]
    return squared.argmin(axis=1), squared.min(axis=1)


@pytest.mark.parametrize("name", CLOUDS)
def test_index_and_distance_are_those_of_brute_force_to_the_last_bit_with_the_lowest_index_of_ties(name: str) -> None:
    points = CLOUDS[name]
    asked = queries(points)
    want, squared_want = brute_force(points, asked)
    tree = KdTree(points)
    for guess in (None, want.astype(np.int32), RNG.integers(-1, len(points), len(asked)).astype(np.int32)):
        index, squared = tree.nearest(asked, guess)
        assert index.dtype == np.int32
        assert np.array_equal(index, want)
        assert np.array_equal(squared, squared_want)


def test_a_large_cloud_agrees_with_scipy() -> None:
    points = RNG.standard_normal((200_000, 3))
    asked = RNG.standard_normal((2_000, 3))
    distance, index = cKDTree(points).query(asked)
    found, squared = KdTree(points).nearest(asked)
    assert np.array_equal(found, index)
    assert np.allclose(np.sqrt(squared), distance, rtol=1e-14)


def test_points_and_queries_are_left_as_they_were_and_may_be_read_only() -> None:
    points, asked = CLOUDS["scattered"].copy(), queries(CLOUDS["scattered"])
    first = KdTree(points).nearest(asked)
    points.setflags(write=False)
    asked.setflags(write=False)
    again = KdTree(points).nearest(asked)
    assert np.array_equal(points, CLOUDS["scattered"])
    assert np.array_equal(first[0], again[0])
    assert KdTree(points).nearest(np.zeros((0, 3)))[0].shape == (0,)


def test_bad_points_queries_and_guesses_are_refused() -> None:
    with pytest.raises(InputError, match="at least one"):
        KdTree(np.zeros((0, 3)))
    with pytest.raises(InputError, match="finite"):
        KdTree(np.array([[0.0, 0.0, np.nan]]))
    tree = KdTree(np.zeros((4, 3)))
    with pytest.raises(InputError, match="shape"):
        tree.nearest(np.zeros((4, 2)))
    for guess in (np.zeros(3, dtype=np.int32), np.array([4, 0], dtype=np.int32), np.array([-2, 0], dtype=np.int32)):
        with pytest.raises(InputError, match="guess"):
            tree.nearest(np.zeros((2, 3)), guess)


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("step", [1e-9, 1e-3, 0.05, 0.5])
def test_followed_queries_have_the_answers_of_brute_force_wherever_they_wander(name: str, step: float) -> None:
    points = CLOUDS[name]
    tree, asked = KdTree(points), queries(points)
    followed = None
    size = max(np.ptp(points, axis=0).max(), 1.0)
    for _ in range(8):
        index, squared, found, followed = tree.follow(asked, followed)
        want, squared_want = brute_force(points, asked)
        assert np.array_equal(index, want)
        assert np.array_equal(squared, squared_want)
        assert np.array_equal(found, points[index])
        asked = asked + step * size * RNG.standard_normal(asked.shape)


def test_followed_queries_that_hardly_move_are_not_searched_again() -> None:
    points = CLOUDS["scattered"]
    tree, asked = KdTree(points), queries(points)
    *_, known = tree.follow(asked)
    tree.follow(asked + 1e-9, known)
    assert (known.anchor == asked).all(axis=1).mean() > 0.9
    tree.follow(asked + 40.0, known)
    assert (known.anchor == asked + 40.0).all(axis=1).mean() > 0.9
    with pytest.raises(InputError, match="warm start of 601 queries"):
        tree.follow(asked[1:], known)


@pytest.mark.parametrize("name", ["grid", "scattered", "eleven", "one"])
def test_no_point_that_is_not_noted_lies_within_reach(name: str) -> None:
    points = CLOUDS[name]
    tree, asked = KdTree(points), queries(points)
    *_, followed = tree.follow(asked)
    d = np.linalg.norm(points[None] - asked[:, None], axis=2)
    for i, rows in enumerate(followed.rows[:, :NOTED]):
        d[i, tree.arrays.original[rows[rows >= 0]]] = np.inf
    assert np.allclose(followed.reach, d.min(axis=1), rtol=1e-14)


def test_a_tree_of_points_that_moved_tells_what_a_new_one_does() -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((500, 3))
    moved, queries = points[::-1] + 0.3 * rng.standard_normal((500, 3)), rng.standard_normal((300, 3))
    told, wanted = KdTree(points).moved(moved).nearest(queries), KdTree(moved).nearest(queries)
    assert np.array_equal(told[0], wanted[0]) and np.array_equal(told[1], wanted[1])
