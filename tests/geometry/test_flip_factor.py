"""The factor at which the first triangle turns over, by trying factors."""

import numpy as np
import pytest

from shapespace.geometry.normals import face_vectors, factor_to_draw, flip_factor
from synthetic_shapes import training_meshes


def turned_over(vertices: np.ndarray, change: np.ndarray, faces: np.ndarray, factor: float) -> bool:
    before, after = face_vectors(vertices, faces), face_vectors(vertices + factor * change, faces)
    return bool(((before * after).sum(axis=1) <= 0).any())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_triangle_turns_over_before_the_factor_and_one_does_at_it(seed: int, sign: float) -> None:
    mesh = next(iter(training_meshes(vertices=300)))
    assert mesh.faces is not None
    change = sign * np.random.default_rng(seed).normal(size=mesh.vertices.shape)
    factor = flip_factor(mesh.vertices, change, mesh.faces)
    assert 0 < factor < np.inf
    assert not any(
        turned_over(mesh.vertices, change, mesh.faces, share * factor) for share in np.linspace(0, 0.999, 60)
    )
    assert turned_over(mesh.vertices, change, mesh.faces, 1.001 * factor)


def test_a_surface_that_only_moves_never_turns_over() -> None:
    mesh = next(iter(training_meshes(vertices=100)))
    assert mesh.faces is not None
    moved = np.broadcast_to([3.0, -1.0, 2.0], mesh.vertices.shape)
    assert flip_factor(mesh.vertices, moved, mesh.faces) == np.inf
    assert flip_factor(mesh.vertices, 0.5 * mesh.vertices, mesh.faces) == np.inf
    # Towards its middle it vanishes at the factor 1.
    assert flip_factor(mesh.vertices, -mesh.vertices, mesh.faces) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("wanted", "flips_at", "drawn"),
    [(1.0, np.inf, 1.0), (7.0, np.inf, 5.0), (7.0, 2.5, 2.0), (1.0, 1.0, 0.5), (1.0, 0.04, 0.03), (100.0, 1.01, 1.0)],
)
def test_a_change_is_drawn_by_a_round_factor_at_which_nothing_turns_over(
    wanted: float, flips_at: float, drawn: float
) -> None:
    assert factor_to_draw(wanted, flips_at) == pytest.approx(drawn)
