import numpy as np
import pytest

from shapespace.errors import MeshError
from shapespace.geometry.normals import (
    boundary_edges,
    boundary_vertices,
    face_areas,
    faces_of,
    part_of,
    vertex_areas,
    vertex_normals,
)
from shapespace.types import Mesh
from synthetic_shapes import sphere

# Two triangles of areas 0.5 and 1.5 in the plane z = 2, seen from above, and a vertex that nothing uses.
KITE = Mesh(
    np.array([[0, 0, 2.0], [1, 0, 2], [0, 1, 2], [-3, 0, 2], [9, 9, 9]]),
    np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
)
BALL = Mesh(10 * sphere(2000)[0], sphere(2000)[1])


def test_areas_are_those_of_the_triangles_and_shared_by_their_corners() -> None:
    assert np.allclose(face_areas(KITE), [0.5, 1.5])
    assert np.allclose(vertex_areas(KITE), [2 / 3, 0.5 / 3, 2 / 3, 0.5, 0])
    assert face_areas(BALL).sum() == pytest.approx(4 * np.pi * 100, rel=0.005)
    assert vertex_areas(BALL).sum() == pytest.approx(face_areas(BALL).sum())


def test_normals_have_length_one_point_outwards_and_are_zero_where_there_is_no_surface() -> None:
    assert np.allclose(vertex_normals(KITE)[:4], [0, 0, 1])
    assert np.array_equal(vertex_normals(KITE)[4], np.zeros(3))
    normals = vertex_normals(BALL)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (normals * BALL.vertices / 10).sum(axis=1).min() > 0.99
    assert np.allclose(vertex_normals(Mesh(BALL.vertices, BALL.faces[:, ::-1])), -normals)


def test_the_rim_is_where_edges_have_one_triangle() -> None:
    assert {tuple(e) for e in boundary_edges(KITE.faces)} == {(0, 1), (1, 2), (2, 3), (0, 3)}
    assert boundary_vertices(KITE).tolist() == [True, True, True, True, False]
    assert not boundary_vertices(BALL).any()
    assert boundary_vertices(Mesh(BALL.vertices, BALL.faces[1:])).sum() == 3
    assert not boundary_vertices(Mesh(BALL.vertices)).any()


def test_an_edge_of_three_triangles_is_not_rim() -> None:
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]], dtype=np.int32)
    assert (0, 1) not in {tuple(e) for e in boundary_edges(fan)}
    assert len(boundary_edges(fan)) == 6


def test_point_clouds_are_refused_where_triangles_are_needed() -> None:
    for function in (faces_of, face_areas, vertex_normals, vertex_areas):
        with pytest.raises(MeshError, match=r"cloud\.ply has no faces"):
            function(Mesh(np.zeros((3, 3)), name="cloud.ply"))


def test_a_part_has_its_own_triangles_and_all_that_the_mesh_has() -> None:
    vertices, faces = sphere(30)
    colours = np.arange(90, dtype=np.uint8).reshape(30, 3)
    mesh = Mesh(vertices, faces, {"tip": np.ones(3)}, "ball", colours, ("Said.",))
    kept = vertices[:, 2] > 0
    for whole in (mesh, Mesh(vertices, None, mesh.landmarks, "ball", colours, ("Said.",))):
        part = part_of(whole, kept)
        np.testing.assert_array_equal(part.vertices, vertices[kept])
        np.testing.assert_array_equal(np.asarray(part.colours), colours[kept])
        assert (part.name, part.notes, list(part.landmarks)) == ("ball", ("Said.",), ["tip"])
    inside = [face for face in faces if kept[face].all()]
    np.testing.assert_array_equal(part_of(mesh, kept).vertices[part_of(mesh, kept).faces], vertices[inside])
