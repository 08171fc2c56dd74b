"""The compiled helpers of the doctor give what plain NumPy gives, also on hubs, repeats and nothing at all."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from shapespace.geometry import topology
from shapespace.types import IntArray

RNG = np.random.default_rng(0)


def fan(count: int) -> IntArray:
    rim = RNG.permutation(count) + 1
    return np.stack([np.zeros(count, dtype=np.int64), rim, np.roll(rim, 1)], axis=1).astype(np.int32)


FACES = {
    "random": RNG.integers(0, 60, (300, 3)).astype(np.int32),
    "hub": fan(2_000),
    "hub last": (2_000 - fan(2_000)).astype(np.int32),
    "one": np.array([[2, 0, 1]], dtype=np.int32),
    "none": np.zeros((0, 3), dtype=np.int32),
}


def plain_edges(faces: IntArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the different edges (E, 2), sorted, which of them each side (3F,) is, and how often each is used."""
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, index, uses = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    return edges, index.reshape(-1), uses


@pytest.mark.parametrize("name", FACES)
def test_edges_of_one_triangle_are_those_of_a_count(name: str) -> None:
    faces = FACES[name]
    edges, _, uses = plain_edges(faces)
    assert np.array_equal(topology.single_edges(faces, 2_001), edges[uses == 1])


@pytest.mark.parametrize("name", FACES)
def test_triangles_meet_across_the_edges_that_two_share(name: str) -> None:
    faces = FACES[name]
    _, index, uses = plain_edges(faces)
    pairs, same_way, loose, single, many = topology.meeting_triangles(faces, 2_001)
    assert (single, many) == ((uses == 1).sum(), (uses > 2).sum())
    order = np.argsort(index, kind="stable")
    two = order[uses[index[order]] == 2].reshape(-1, 2)
    assert np.array_equal(pairs, two // 3)
    assert np.array_equal(same_way, faces.ravel()[two[:, 0]] == faces.ravel()[two[:, 1]])
    assert np.array_equal(loose, order[uses[index[order]] != 2] // 3)


@pytest.mark.parametrize("count", [0, 1, 40, 3_000])
def test_equal_rows_name_the_first_of_them(count: int) -> None:
    rows = RNG.integers(-3, 4, (count, 3)) * RNG.choice([1, 2**40, -(2**62)])
    _, first, index = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    assert np.array_equal(topology.first_of_equal(rows), first[index.reshape(-1)])


def test_pieces_are_those_of_scipy() -> None:
    for links in (0, 30, 100, 500):
        ties = RNG.integers(0, 200, (links, 2)).astype(np.int32)
        parent = np.arange(200, dtype=np.int32)
        topology.join(parent, ties)
        count, label = topology.labels(parent)
        graph = coo_array((np.ones(links), (ties[:, 0], ties[:, 1])), shape=(200, 200))
        want_count, want = connected_components(graph.tocsr(), directed=False)
        assert count == want_count
        assert np.array_equal(label, want)


def test_areas_and_middles_are_those_of_cross_products() -> None:
    vertices, faces = RNG.standard_normal((60, 3)), FACES["random"]
    middles, normals = topology.middles_and_normals(vertices, faces, np.array([1.0, 2.0, 3.0]))
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert np.allclose(normals, np.cross(b - a, c - a) / 2, atol=1e-13)
    assert np.allclose(middles, (a + b + c) / 3 - [1.0, 2.0, 3.0], atol=1e-13)
    longest = np.max([np.linalg.norm(d, axis=1) for d in (b - a, c - a, c - b)], axis=0) ** 2
    ratio = 2 * np.linalg.norm(normals, axis=1) / np.where(longest > 0, longest, 1.0)
    for tolerance in (1e-12, 0.3):
        assert np.array_equal(topology.flat_triangles(vertices, faces, tolerance), ratio <= tolerance)
