"""Local modes: apart from the model's own, as much of them as is left, and where new shapes leave the model."""

import numpy as np
import pytest

from shapespace.model.local_modes import local_modes
from shapespace.types import FloatArray


def world(count: int) -> tuple[FloatArray, FloatArray]:
    """Return a cloud of vertices (200, 3) and smooth shapes (count, 600) on it."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-50, 50, (200, 3))
    waves, phase = rng.normal(0, 0.04, (60, 3)), rng.uniform(0, 6, 60)
    fields = np.cos(x @ waves.T + phase) / np.arange(1.0, 61.0)
    return x, np.einsum("nkc,vk->nvc", 5 * rng.standard_normal((count, 60, 3)), fields).reshape(count, -1)


def made(left_mm2: float, most: int = 40) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    x, shapes = world(300)
    _, size, rows = np.linalg.svd(shapes[:20] - shapes[:20].mean(axis=0), full_matrices=False)
    modes, variance = rows[:19].T, size[:19] ** 2 / 19
    local, local_variance = local_modes(x, modes, variance, left_mm2, most)
    new = shapes[20:] - shapes[:20].mean(axis=0)
    return modes, local, local_variance, new - (new @ modes) @ modes.T


def test_they_are_orthonormal_and_apart_from_the_models_own() -> None:
    modes, local, variance, _ = made(100.0)
    assert local.shape == (600, 40) and (np.diff(variance) <= 0).all() and (variance > 0).all()
    assert np.allclose(local.T @ local, np.eye(40), atol=1e-9) and np.abs(modes.T @ local).max() < 1e-9


def test_they_hold_more_of_what_new_shapes_have_outside_than_any_directions_would() -> None:
    _, local, _, outside = made(100.0)
    held = ((outside @ local) ** 2).sum() / (outside**2).sum()
    assert held > 4 * 40 / (600 - 19)


def test_they_have_no_more_variance_than_is_left() -> None:
    _, _, variance, _ = made(100.0)
    assert 50 < variance.sum() <= 100
    assert np.allclose(made(200.0)[2], 2 * variance)


@pytest.mark.parametrize(("left_mm2", "most"), [(0.0, 40), (100.0, 0), (1e-9, 40)])
def test_there_are_none_where_none_are_wanted_or_nothing_is_left(left_mm2: float, most: int) -> None:
    _, local, variance, _ = made(left_mm2, most)
    assert local.shape == (600, 0) and variance.shape == (0,)
