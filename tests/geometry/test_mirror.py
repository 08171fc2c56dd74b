"""Mirror images in correspondence."""

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirror_vertices, mirrored


def symmetric() -> np.ndarray:
    rng = np.random.default_rng(0)
    half = rng.uniform([5, -50, 0], [50, 50, 40], (60, 3))
    return rng.permutation(np.concatenate([half, half * [-1, 1, 1], [[0.0, 10.0, 50.0]]]))


def test_the_other_side_of_the_other_side_is_the_vertex_itself() -> None:
    vertices = symmetric()
    other = mirror_vertices(vertices)
    assert np.array_equal(other[other], np.arange(len(vertices)))
    assert np.allclose(mirrored(vertices, other), vertices)


def test_what_is_moved_on_one_side_is_moved_on_the_other_in_the_mirror() -> None:
    vertices = symmetric()
    other = mirror_vertices(vertices)
    lopsided = vertices.copy()
    lopsided[3] += [1.0, 2.0, 3.0]
    image = mirrored(lopsided, other)
    assert np.allclose(image[other[3]] - vertices[other[3]], [-1.0, 2.0, 3.0])
    assert np.allclose(mirrored(image, other), lopsided)


def test_a_lopsided_surface_has_no_mirror() -> None:
    vertices = symmetric()
    vertices[5] += 10.0
    with pytest.raises(InputError, match="not its own mirror image"):
        mirror_vertices(vertices)
