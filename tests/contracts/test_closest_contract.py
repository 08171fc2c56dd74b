"""What every closest-point engine must do; a new entry of ENGINES is tested by being there."""

import numpy as np
import pytest

from shapespace.errors import InputError, MeshError
from shapespace.geometry.closest import ENGINES, build_engine, on_boundary
from shapespace.geometry.normals import boundary_vertices
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

EXACT_MM = 1e-9
SEARCHES_VERTICES = {"vertices"}


def closest_on_segments(p: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(M, F, 3) closest points of p (M, 1, 3) on the segments from a to b (1, F, 3)."""
    ab = b - a
    length = (ab * ab).sum(-1)
    t = ((p - a) * ab).sum(-1) / np.where(length > 0, length, 1.0)
    return a + np.clip(t, 0, 1)[..., None] * ab


def brute_force(points: FloatArray, mesh: Mesh) -> FloatArray:
    """(M,) distance to every triangle's plane, where the foot is inside, and to every edge; about the query."""
    p = np.zeros((len(points), 1, 3))
    corners = mesh.vertices[mesh.faces][None] - points[:, None, None]  # exact for near things, far from the origin
    a, b, c = (corners[:, :, k] for k in range(3))
    best = np.minimum.reduce(
        [np.linalg.norm(closest_on_segments(p, s, e), axis=-1) for s, e in ((a, b), (b, c), (c, a))]
    )
    n = np.cross(b - a, c - a)
    area = np.linalg.norm(n, axis=-1, keepdims=True)
    n = np.divide(n, area, out=np.zeros_like(n), where=area > 0)
    foot = (a * n).sum(-1, keepdims=True) * n
    inside = area[..., 0] > 0
    for s, e in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(e - s, foot - s) * n).sum(-1) >= 0
    return np.where(inside, np.abs((a * n).sum(-1)), best).min(axis=1)


def expected(name: str, points: FloatArray, mesh: Mesh) -> FloatArray:
    if name in SEARCHES_VERTICES:
        return np.linalg.norm(points[:, None] - mesh.vertices[None], axis=-1).min(axis=1)
    return brute_force(points, mesh)


def ball(count: int = 300) -> Mesh:
    d, faces = sphere(count)
    return Mesh(80 * d * (1 + 0.2 * np.sin(5 * d[:, :1])), faces)


def soup() -> Mesh:
    rng = np.random.default_rng(1)
    return Mesh(rng.standard_normal((240, 3)) * 50, np.arange(240, dtype=np.int32).reshape(-1, 3))


def with_degenerate_triangles() -> Mesh:
    mesh = ball(100)
    v = np.vstack([mesh.vertices, [[200, 0, 0], [220, 0, 0], [210, 0, 0], [0, 200, 0], [0, 200, 0], [0, 200, 0]]])
    extra = [[100, 101, 102], [103, 104, 105], [0, 0, 1], [7, 7, 7], [100, 101, 101]]
    return Mesh(v, np.vstack([mesh.faces, extra]).astype(np.int32))


def slivers() -> Mesh:
    x = np.arange(12.0) * 10
    rows = [np.stack([x, np.full(12, h), np.zeros(12)], axis=1) for h in (0.0, 1e-6)]
    v = np.vstack(rows)
    i = np.arange(11)
    return Mesh(
        v, np.concatenate([np.stack([i, i + 1, i + 12], 1), np.stack([i + 1, i + 13, i + 12], 1)]).astype(np.int32)
    )


def duplicated() -> Mesh:
    mesh = ball(100)
    return Mesh(np.vstack([mesh.vertices, mesh.vertices]), np.vstack([mesh.faces, mesh.faces + 100, mesh.faces]))


def one_triangle() -> Mesh:
    return Mesh(np.array([[0, 0, 0], [30.0, 0, 0], [0, 20, 5]]), np.array([[0, 1, 2]]))


MESHES = {f.__name__: f for f in (ball, soup, with_degenerate_triangles, slivers, duplicated, one_triangle)}


def queries(mesh: Mesh) -> FloatArray:
    rng = np.random.default_rng(0)
    centre, extent = mesh.vertices.mean(axis=0), np.ptp(mesh.vertices, axis=0).max()
    corners = mesh.vertices[mesh.faces]
    return np.vstack(
        [
            centre + rng.standard_normal((120, 3)) * 0.5 * extent,
            centre + rng.standard_normal((20, 3)) * 20 * extent,
            mesh.vertices[:40],
            corners.mean(axis=1)[:60],
            corners[:60, :2].mean(axis=1) + rng.standard_normal((min(60, len(corners)), 3)),
        ]
    )


@pytest.mark.parametrize("shape", MESHES)
@pytest.mark.parametrize("name", ENGINES)
def test_answers_are_those_of_brute_force(name: str, shape: str) -> None:
    mesh = MESHES[shape]()
    asked = queries(mesh)
    found = ENGINES[name](mesh).query(asked)
    want = expected(name, asked, mesh)
    assert found.distance.dtype == found.points.dtype == np.float64
    assert np.abs(found.distance - want).max() < EXACT_MM * np.maximum(1, want / 1e3).max()
    assert (
        np.abs(np.linalg.norm(asked - found.points, axis=1) - want).max() < EXACT_MM * np.maximum(1, want / 1e3).max()
    )


@pytest.mark.parametrize("shape", MESHES)
@pytest.mark.parametrize("name", ENGINES)
def test_earlier_answers_nearby_change_no_distance(name: str, shape: str) -> None:
    mesh = MESHES[shape]()
    engine, asked = ENGINES[name](mesh), queries(mesh)
    rng, near = np.random.default_rng(2), None
    for step in (0.0, 30.0, 1.0, 1e-2, 1e-2, 1e-4, 1e-6, 5.0):
        asked = asked + step * rng.standard_normal(asked.shape)
        near = engine.query(asked, near=near)
        fresh = engine.query(asked)
        assert np.allclose(near.distance, fresh.distance, rtol=1e-14, atol=1e-12)
        assert np.abs(np.linalg.norm(near.points - asked, axis=1) - fresh.distance).max() < 1e-9
        if near.triangle is None:
            assert np.array_equal(near.vertex, fresh.vertex)
    with pytest.raises(InputError, match="previous results do not match"):
        engine.query(asked[:-1], near=near)


@pytest.mark.parametrize("name", ENGINES)
def test_a_million_millimetres_from_the_origin_costs_only_rounding(name: str) -> None:
    mesh = ball()
    far = mesh.with_vertices(mesh.vertices + np.array([1e6, -1e6, 1e6]))
    asked = queries(far)
    found = ENGINES[name](far).query(asked)
    # Coordinates there are 1e-10 mm apart.
    assert np.abs(found.distance - expected(name, asked, far)).max() < 1e-8


@pytest.mark.parametrize("shape", MESHES)
@pytest.mark.parametrize("name", sorted(set(ENGINES) - SEARCHES_VERTICES))
def test_triangle_and_barycentrics_give_the_point(name: str, shape: str) -> None:
    mesh = MESHES[shape]()
    found = ENGINES[name](mesh).query(queries(mesh))
    assert (found.barycentric >= 0).all()
    assert np.allclose(found.barycentric.sum(axis=1), 1.0, atol=1e-12)
    corners = mesh.vertices[mesh.faces[found.triangle]]
    assert np.abs((found.barycentric[:, :, None] * corners).sum(axis=1) - found.points).max() < 1e-7
    assert (found.vertex[:, None] == mesh.faces[found.triangle]).any(axis=1).all()


@pytest.mark.parametrize("name", sorted(SEARCHES_VERTICES))
def test_vertex_engines_name_the_vertex_and_take_point_clouds(name: str) -> None:
    mesh = ball()
    found = ENGINES[name](Mesh(mesh.vertices)).query(queries(mesh))
    assert found.triangle is None
    assert found.barycentric is None
    assert np.array_equal(mesh.vertices[found.vertex], found.points)


@pytest.mark.parametrize("name", ENGINES)
def test_queries_that_are_not_finite_or_not_points_are_refused(name: str) -> None:
    engine = ENGINES[name](ball())
    for bad in (np.nan, np.inf):
        with pytest.raises(InputError, match="finite"):
            engine.query(np.array([[0.0, 1.0, bad]]))
    with pytest.raises(InputError, match="shape"):
        engine.query(np.zeros((4, 2)))
    assert engine.query(np.zeros((0, 3))).distance.shape == (0,)


@pytest.mark.parametrize("name", ENGINES)
def test_surfaces_that_are_not_finite_are_refused_by_name(name: str) -> None:
    vertices = np.array(ball().vertices)
    vertices[5, 2] = np.nan
    with pytest.raises(MeshError, match=r"bad\.ply"):
        ENGINES[name](Mesh(vertices, ball().faces, name="bad.ply"))


@pytest.mark.parametrize("name", ENGINES)
def test_the_mesh_is_left_as_it_was_and_queries_do_not_disturb_each_other(name: str) -> None:
    mesh = ball()
    before, asked = mesh.vertices.copy(), queries(mesh)
    engine = ENGINES[name](mesh)
    first = engine.query(asked).distance.copy()
    engine.query(asked[:10] + 100)
    assert np.array_equal(engine.query(asked).distance, first)
    assert np.array_equal(mesh.vertices, before)


def test_auto_takes_triangles_where_there_are_some_and_unknown_names_are_refused() -> None:
    assert build_engine(ball()).query(np.zeros((1, 3))).triangle is not None
    assert build_engine(Mesh(ball().vertices)).query(np.zeros((1, 3))).triangle is None
    with pytest.raises(InputError, match="magic"):
        build_engine(ball(), "magic")
    with pytest.raises(MeshError, match="no faces"):
        build_engine(Mesh(ball().vertices), "surface")


@pytest.mark.parametrize("name", ENGINES)
def test_matches_on_the_rim_are_known(name: str) -> None:
    mesh = one_triangle()
    asked = np.array([[5.0, 4.0, 9.0], [-5.0, -5.0, 0.0], [15.0, -4.0, 0.0], [40.0, 0.0, 0.0]])
    rim = on_boundary(ENGINES[name](mesh).query(asked), mesh, boundary_vertices(mesh))
    # The only triangle has rim corners only, so every match is carried by rim vertices.
    assert rim.all()
    fan = Mesh(
        np.vstack([np.zeros(3), [[10 * np.cos(t), 10 * np.sin(t), 0] for t in np.arange(6) * np.pi / 3]]),
        np.array([[0, k, k % 6 + 1] for k in range(1, 7)]),
    )
    asked = np.array([[1.0, 1.0, 3.0], [20.0, 1.0, 0.0], [0.0, -30.0, 2.0]])
    found = ENGINES[name](fan).query(asked)
    assert on_boundary(found, fan, boundary_vertices(fan)).tolist() == [False, True, True]
