"""Folds and changes of area are told apart from what is merely another shape."""

import numpy as np
import pytest

from shapespace.errors import MeshError
from shapespace.geometry.normals import Distortion
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, similarity, sphere

D, FACES = sphere(500)
REST = Mesh(blob(D, np.zeros(5)), FACES)


def changed(vertices: FloatArray) -> Distortion:
    return Distortion.of(REST.with_vertices(vertices), REST)


def test_another_shape_pose_and_size_fold_nothing() -> None:
    other = similarity(2, degrees=140, scale=7.0).apply(blob(D, np.array([1.0, -1.0, 0.5, 1.0, -0.5])))
    assert not changed(other).folded.any() and changed(other).folded_share == 0
    np.testing.assert_allclose(changed(7 * REST.vertices).growth, 0, atol=1e-12)
    assert changed(7 * REST.vertices).area_factor == pytest.approx(1)


def test_a_vertex_pushed_over_its_neighbours_folds_triangles_around_it() -> None:
    at = int(D[:, 1].argmax())
    ring = np.unique(FACES[(at == FACES).any(axis=1)])
    other = ring[ring != at][0]
    vertices = np.array(REST.vertices)
    vertices[at] += 2.2 * (vertices[other] - vertices[at])
    folded = changed(vertices).folded
    assert 1 <= folded.sum() <= 6
    assert (at == FACES[folded]).any(axis=1).all()
    assert changed(vertices).folded_share == pytest.approx(folded.sum() / len(FACES))


def test_a_part_that_is_inside_out_is_folded_along_its_rim() -> None:
    turned = REST.with_vertices(REST.vertices)
    dented = np.array(REST.vertices)
    inside = D[:, 2] > 0.9
    dented[inside, 2] = 2 * dented[D[:, 2] > 0.85, 2].min() - dented[inside, 2]
    # A dent turns no triangle against its neighbours, however deep: it is a shape.
    assert changed(dented).folded_share < 0.02
    assert Distortion.of(turned, turned).folded_share == 0


def test_growth_is_the_logarithm_of_areas_beside_the_middle_one() -> None:
    vertices = np.array(REST.vertices)
    top = D[:, 1] > 0.5
    vertices[top] = vertices[top] * [1.5, 1.0, 1.5]
    growth = changed(vertices).growth
    inside = top[FACES].all(axis=1)
    flat = inside & (D[FACES].mean(axis=1)[:, 1] > 0.93)
    assert np.median(growth) == pytest.approx(0, abs=1e-12)
    assert np.exp(growth[flat]).mean() == pytest.approx(1.5**2, rel=0.05)
    assert 1.5 < changed(vertices).area_factor < 2.5


def test_missing_vertices_have_no_folds_and_no_growth() -> None:
    vertices = np.array(REST.vertices)
    vertices[D[:, 1] > 0.3] = np.nan
    found = changed(vertices)
    gone = np.isnan(vertices).any(axis=1)[FACES].any(axis=1)
    np.testing.assert_array_equal(np.isnan(found.growth), gone)
    assert not found.folded.any() and found.area_factor == pytest.approx(1)
    nothing = changed(np.full_like(vertices, np.nan))
    assert nothing.folded_share == 0 and np.isnan(nothing.area_factor)


def test_points_alone_have_no_triangles_to_fold() -> None:
    with pytest.raises(MeshError, match="faces"):
        Distortion.of(Mesh(REST.vertices), REST)
