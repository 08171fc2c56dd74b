import numpy as np
import pytest

from shapespace.correspondence.harmonics import Harmonics
from shapespace.types import Mesh
from synthetic_shapes import sphere

RADIUS = 50.0


@pytest.fixture(scope="module")
def ball() -> Mesh:
    directions, faces = sphere(1500)
    return Mesh(RADIUS * directions, faces)


@pytest.fixture(scope="module")
def harmonics(ball: Mesh) -> Harmonics:
    return Harmonics.of(ball, 40)


def test_functions_are_orthonormal_by_area_and_sorted(harmonics: Harmonics) -> None:
    gram = harmonics.functions.T @ (harmonics.area[:, None] * harmonics.functions)
    np.testing.assert_allclose(gram, np.eye(40), atol=1e-8)
    assert (np.diff(harmonics.squared_frequency) > -1e-12).all()


def test_frequencies_of_a_sphere_are_those_of_spherical_harmonics(harmonics: Harmonics) -> None:
    degree = np.repeat(np.arange(6), 2 * np.arange(6) + 1)
    np.testing.assert_allclose(
        harmonics.squared_frequency[:36] * RADIUS**2, degree * (degree + 1), rtol=0.03, atol=1e-3
    )


def test_diffusion_keeps_the_mean_and_damps_by_range(ball: Mesh, harmonics: Harmonics) -> None:
    field = ball.vertices[:, [2]] + 7.0
    after = harmonics.diffused(field, 20.0)
    kept = np.exp(-0.5 * 2 / RADIUS**2 * 20.0**2)
    np.testing.assert_allclose(after - 7.0, kept * (field - 7.0), atol=0.5)


def test_the_same_mesh_gives_the_same_functions(ball: Mesh, harmonics: Harmonics) -> None:
    np.testing.assert_array_equal(Harmonics.of(ball, 40).functions, harmonics.functions)
