"""What every representation must do; a new entry of REPRESENTATIONS is tested by being there."""

import numpy as np
import pytest

from shapespace.model.representation import REPRESENTATIONS
from synthetic_shapes import training_meshes


def shapes() -> np.ndarray:
    return np.stack([mesh.vertices for mesh in training_meshes()[:3]])


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_a_surface_that_is_held_comes_back(name: str) -> None:
    coder = REPRESENTATIONS[name]()
    held = coder.decode(coder.encode(shapes()))
    np.testing.assert_allclose(coder.decode(coder.encode(held)), held, atol=1e-9)
    assert held.shape[-1] == 3


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_one_shape_is_coded_as_among_many(name: str) -> None:
    coder = REPRESENTATIONS[name]()
    many = coder.encode(shapes())
    assert many.ndim == 2
    np.testing.assert_array_equal(coder.encode(shapes()[1]), many[1])
    np.testing.assert_array_equal(coder.decode(many[1]), coder.decode(many)[1])


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_coding_is_linear(name: str) -> None:
    coder = REPRESENTATIONS[name]()
    a, b, _ = shapes()
    np.testing.assert_allclose(coder.encode(2 * a - b), 2 * coder.encode(a) - coder.encode(b), atol=1e-9)
    u, v = coder.encode(a), coder.encode(b)
    np.testing.assert_allclose(coder.decode(2 * u - v), 2 * coder.decode(u) - coder.decode(v), atol=1e-9)


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_what_is_coded_is_left_as_it_was(name: str) -> None:
    coder = REPRESENTATIONS[name]()
    given = shapes()
    coder.encode(given)
    np.testing.assert_array_equal(given, shapes())
