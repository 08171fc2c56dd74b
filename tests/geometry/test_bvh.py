"""The triangle tree beside brute force in exact terms; the engines' contract test has the odd meshes."""

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.geometry import bvh
from shapespace.geometry.bvh import TriangleTree
from shapespace.types import FloatArray, IntArray
from synthetic_shapes import sphere

RNG = np.random.default_rng(0)


def soup(size: float, count: int = 400) -> tuple[FloatArray, IntArray]:
    vertices = np.repeat(RNG.standard_normal((count, 3)) * 50, 3, axis=0) + RNG.standard_normal((3 * count, 3)) * size
    return vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def bumpy_ball() -> tuple[FloatArray, IntArray]:
    d, faces = sphere(400)
    return 80 * d * (1 + 0.2 * np.sin(5 * d[:, :1])), faces


def flat_ones() -> tuple[FloatArray, IntArray]:
    vertices = RNG.integers(0, 3, (30, 1)) * np.array([[1.0, 2.0, 3.0]]) + RNG.integers(0, 2, (30, 1)) * 40.0
    return vertices, RNG.integers(0, 30, (200, 3)).astype(np.int32)


MESHES = {"big": soup(30.0), "small": soup(0.1), "one": soup(5.0, 1), "five": soup(5.0, 5), "ball": bumpy_ball()}
MESHES["without area"] = flat_ones()


def brute_force(vertices: FloatArray, faces: IntArray, asked: FloatArray, grid: int = 40) -> FloatArray:
    """(M,) distance to the nearest of many points of every triangle: never less than the true one."""
    a, b = np.meshgrid(np.linspace(0, 1, grid), np.linspace(0, 1, grid))
    inside = a + b <= 1 + 1e-12
    weights = np.stack([1 - a[inside] - b[inside], a[inside], b[inside]], axis=1)
    samples = np.einsum("sk,fkd->fsd", weights, vertices[faces]).reshape(-1, 3)
    return np.array([np.linalg.norm(samples - q, axis=1).min() for q in asked])


def queries(vertices: FloatArray) -> FloatArray:
    size = max(np.ptp(vertices, axis=0).max(), 1.0)
    centre = vertices.mean(axis=0)
    return np.vstack([vertices[:20], centre + RNG.standard_normal((40, 3)) * size, vertices[:20] + 0.1])


@pytest.mark.parametrize("name", MESHES)
def test_no_point_of_any_triangle_is_closer_and_the_answer_is_one(name: str) -> None:
    vertices, faces = MESHES[name]
    asked = queries(vertices)
    triangle, barycentric, points, squared = TriangleTree(vertices, faces).closest(asked)
    distance = np.sqrt(squared)
    sampled = brute_force(vertices, faces, asked)
    edge = np.linalg.norm(vertices[faces] - np.roll(vertices[faces], 1, axis=1), axis=2).max()
    assert (distance <= sampled + 1e-9).all()
    assert (distance >= sampled - edge / 39).all()
    assert (barycentric >= 0).all()
    assert np.allclose(barycentric.sum(axis=1), 1.0, atol=1e-12)
    assert np.allclose((barycentric[:, :, None] * vertices[faces[triangle]]).sum(axis=1), points, atol=1e-9)
    assert np.allclose(np.linalg.norm(points - asked, axis=1), distance, atol=1e-9)


@pytest.mark.parametrize("name", MESHES)
def test_the_closest_point_fulfils_the_conditions_of_a_minimum(name: str) -> None:
    """By convexity: no corner of the triangle may lie ahead of the plane through the point, square to the query."""
    vertices, faces = MESHES[name]
    asked = queries(vertices)
    triangle, _, points, squared = TriangleTree(vertices, faces).closest(asked)
    ahead = np.einsum("mkd,md->mk", vertices[faces[triangle]] - points[:, None], asked - points)
    assert (ahead <= 1e-8 * (1 + np.sqrt(squared))[:, None]).all()


@pytest.mark.parametrize("name", MESHES)
def test_a_guess_changes_no_distance(name: str) -> None:
    vertices, faces = MESHES[name]
    tree, asked = TriangleTree(vertices, faces), queries(vertices)
    _, _, _, squared = tree.closest(asked)
    for guess in (RNG.integers(-1, len(faces), len(asked)).astype(np.int32), tree.closest(asked + 0.1)[0]):
        assert np.allclose(tree.closest(asked, guess)[3], squared, rtol=1e-12, atol=1e-18)


def test_bad_triangles_queries_and_guesses_are_refused() -> None:
    vertices, faces = MESHES["five"]
    with pytest.raises(InputError, match="at least one"):
        TriangleTree(vertices, faces[:0])
    bad = vertices.copy()
    bad[4, 1] = np.inf
    with pytest.raises(InputError, match="finite"):
        TriangleTree(bad, faces)
    tree = TriangleTree(vertices, faces)
    with pytest.raises(InputError, match="shape"):
        tree.closest(np.zeros((4, 2)))
    with pytest.raises(InputError, match="guess"):
        tree.closest(np.zeros((1, 3)), np.array([5], dtype=np.int32))


def test_a_face_of_a_surface_is_as_far_as_its_corners_say() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = rng.standard_normal((30, 3)), rng.integers(0, 30, (200, 3)).astype(np.int32)  # some have no area
    corners = vertices[faces].reshape(-1, 9)
    for f, (x, y, z) in enumerate(rng.standard_normal((200, 3))):
        told = bvh.on_face(vertices, faces, f, x, y, z, np.inf)
        assert told == bvh.on_triangle(corners, f, x, y, z, np.inf)
        b, c = bvh.over_face(vertices, faces, f, x, y, z)
        if b > 0.0 and c > 0.0 and b + c < 1.0:
            assert np.allclose((b, c), told[1:])
