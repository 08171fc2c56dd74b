"""Modes that no shape made are left out: what alignment makes of few shapes, and what rounding makes of equal ones."""

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.model.choose_modes import rounding_mm
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import training_meshes


def linear_shapes(count: int, modes: int, seed: int = 0) -> list[Mesh]:
    """Return shapes of few modes about a ball, of which alignment to second order makes further ones."""
    rng = np.random.default_rng(seed)
    x = 100.0 * rng.standard_normal((200, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True) / 100.0
    bumps = rng.standard_normal((modes, 200, 3)) * np.linspace(8.0, 3.0, modes)[:, None, None]
    return [Mesh(x + np.tensordot(b, bumps, 1)) for b in rng.standard_normal((count, modes))]


def tangent_share(model: ShapeModel) -> FloatArray:
    x = model.mean_vertices
    moves = [np.cross(axis, x) for axis in np.eye(3)] + [np.tile(axis, (len(x), 1)) for axis in np.eye(3)] + [x]
    tangent = np.linalg.qr(np.stack([move.ravel() for move in moves], axis=1))[0]
    return ((tangent.T @ model.vertex_basis) ** 2).sum(axis=0)


@pytest.mark.parametrize("count", [20, 40])
def test_no_mode_has_anything_of_the_tangent_of_the_pose(count: int) -> None:
    model = ShapeModel.fit(linear_shapes(count, 5))
    assert tangent_share(model).max() < 1e-6
    assert (model.stddev[:5] > 10 * model.stddev[5]).all()  # those of the shapes are all there


def test_shapes_taken_as_they_stand_keep_what_pose_made() -> None:
    meshes = linear_shapes(20, 5)
    turned = [Mesh(mesh.vertices * size) for mesh, size in zip(meshes, np.linspace(0.9, 1.1, 20), strict=True)]
    model = ShapeModel.fit(turned, align=False)
    assert model.left_out == 0
    assert tangent_share(model).max() > 0.3


@pytest.mark.parametrize(("decimals", "mm"), [(3, 1.0), (5, 10.0), (6, 1000.0)])
def test_the_precision_of_decimals_is_seen_in_any_unit(decimals: int, mm: float) -> None:
    x = np.random.default_rng(0).uniform(-100, 100, (300, 3)) / mm
    assert rounding_mm(np.round(x, decimals) * mm) == pytest.approx(10.0**-decimals * mm / np.sqrt(12))


def test_single_precision_is_seen_and_double_is_not() -> None:
    x = np.random.default_rng(0).uniform(-100, 100, (300, 3))
    assert 5e-7 < rounding_mm(x.astype(np.float32).astype(float)) < 5e-6
    assert rounding_mm(x) == 0.0


def test_modes_of_rounding_alone_are_left_out() -> None:
    rng = np.random.default_rng(0)
    x, bump = rng.uniform(-100, 100, (300, 3)), rng.standard_normal((300, 3))
    shapes = [Mesh(np.round(x + size * bump, 3)) for size in rng.standard_normal(20)]
    model = ShapeModel.fit(shapes, align=False)
    assert model.n_modes == 1
    assert model.left_out == 18


def test_meshes_that_differ_by_their_rounding_alone_are_refused() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-100, 100, (300, 3))
    with pytest.raises(InputError, match="no variation"):
        ShapeModel.fit([Mesh(np.round(x + 2e-4 * rng.standard_normal(x.shape), 3)) for _ in range(8)])


def test_modes_of_shapes_that_vary_widely_are_all_kept() -> None:
    model = ShapeModel.fit(list(training_meshes(20, 700, seed=3)))
    assert (model.stddev[:5] > 10).all()
