"""The relief of surfaces in correspondence: it agrees where the same vertices are the same places."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raw_blobs import raw_blob
from shapespace.correspondence.harmonics import Harmonics, Reliefs, agreement, relief
from shapespace.correspondence.template import resample
from shapespace.types import Mesh, Similarity


@pytest.fixture(scope="module")
def template() -> Mesh:
    return resample(raw_blob(0, points=1500).scan, 600)


def test_relief_does_not_depend_on_pose_and_grows_with_size(template: Mesh) -> None:
    harmonics = Harmonics.of(template, 100)
    own = relief(template.vertices, template, harmonics)
    T = Similarity(2.5, Rotation.from_euler("xyz", [20, 130, -70], degrees=True).as_matrix(), np.array([9.0, -4, 2]))
    moved = relief(T.apply(template.vertices), template, harmonics)
    np.testing.assert_allclose(moved, 2.5 * own, atol=1e-9)
    assert agreement(own, moved, harmonics.area) > 4


def test_reliefs_that_have_nothing_in_common_do_not_agree() -> None:
    a, b = np.random.default_rng(0).standard_normal((2, 4000))
    assert abs(agreement(a, b, np.ones(4000))) < 0.05
    assert agreement(a, np.zeros(4000), np.ones(4000)) == 0.0
    assert agreement(a, -a, np.ones(4000)) < -4


def test_vertices_that_are_not_observed_do_not_count() -> None:
    a = np.random.default_rng(0).standard_normal(400)
    b, seen = a.copy(), np.arange(400) < 300
    b[300:] = 50.0
    assert agreement(a, b, seen.astype(float)) > 4 > agreement(a, b, np.ones(400))


def test_a_surface_whose_vertices_are_elsewhere_falls_short(template: Mesh) -> None:
    harmonics, rng = Harmonics.of(template, 100), np.random.default_rng(1)
    shapes = np.stack([template.vertices + 0.5 * rng.standard_normal(template.vertices.shape) for _ in range(7)])
    centred = template.vertices - template.vertices.mean(axis=0)
    turned = centred @ Rotation.from_euler("z", 180, degrees=True).as_matrix().T
    # The same surface, each vertex moved to where another one was, as after a registration in a wrong pose.
    nearest = ((centred[:, None] - turned) ** 2).sum(axis=2).argmin(axis=1)
    shapes[3] = template.vertices[nearest]
    agreements = Reliefs.of(shapes, np.ones(shapes.shape[:2]), template, harmonics).agreements()
    usual = np.median(agreements)
    assert agreements[3] < usual - 0.5
    assert np.abs(np.delete(agreements, 3) - usual).max() < 0.3
