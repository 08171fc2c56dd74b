"""The robust fit: its step against plain NumPy, its walks against brute force, and what it promises of scans."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robust_reference import gauss_newton_step
from shapespace.errors import FitError, InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.method_choices import method_named
from shapespace.fit.robust.matching import Matcher, MatchHint, match_vertices
from shapespace.fit.robust.posterior import Estimate
from shapespace.fit.robust.prepared_model import LinearShape, ModelSurface, prepare
from shapespace.fit.robust.robust_icp import Iterate, Problem, in_span
from shapespace.fit.robust.robust_settings import Level, RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.closest import build_engine, on_boundary
from shapespace.geometry.normals import vertex_normals
from shapespace.geometry.similarity import POSE, small_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import blob_model, raw_scan, similarity, training_meshes

Z = np.array([1.5, -1.8, 1.3, 1.6, -1.4])
NEAR = similarity(3, 6.0, 1.0, 2.0)


def problem_at(scan: Mesh, level: Level, b: FloatArray) -> tuple[Problem, Matcher, Iterate, MatchHint]:
    """Return the fit of the blobs to `scan` about to do a step on `level` from coefficients `b`."""
    settings = RobustSettings()
    problem = Problem.of(prepare(blob_model()), ScanTarget(scan), settings, NEAR.scale, with_scale=True)
    iterate, matcher = problem.iterate(Estimate(NEAR, b)), problem.matcher(level)
    return problem, matcher, iterate, matcher.first_hint(iterate.surface, NEAR)


def surface_at(b: FloatArray) -> ModelSurface:
    prepared = prepare(blob_model())
    return LinearShape(prepared.topology, blob_model().mean_vertices, prepared.modes).surface(b)


def error_mm(result, model: ShapeModel, truth: FloatArray, scale: float = 1.0) -> float:
    return float(np.linalg.norm(result.surface(model).vertices - truth, axis=1).mean()) / scale


@pytest.mark.parametrize("modes", [0, 3, 5])
@pytest.mark.parametrize("triangles", [False, True])
def test_a_step_is_that_of_plain_numpy(modes: int, triangles: bool) -> None:
    b = 0.3 * blob_model().stddev * (np.arange(5) < modes)
    level = Level(modes, 400, 200, triangles, 1, 0.0)
    problem, matcher, iterate, hint = problem_at(raw_scan(Z, NEAR, noise_mm=0.3).scan, level, b)
    weighted = problem.match(matcher, iterate, hint)
    expected, hessian = gauss_newton_step(problem, weighted, iterate, modes)
    _, equations = problem.equations(weighted, iterate, modes)
    whole = equations.H + np.diag(equations.D)
    np.testing.assert_allclose(whole, hessian, rtol=1e-4, atol=1e-4 * np.abs(hessian).max())
    step = problem.step(matcher, iterate, hint, modes)
    np.testing.assert_allclose(step.iterate.b[:modes] - b[:modes], expected[POSE:], rtol=2e-3, atol=1e-4)
    assert step.iterate.T_scan_model.scale / NEAR.scale == pytest.approx(np.exp(expected[6]), rel=1e-4)
    moved = NEAR.inverse().apply(step.iterate.T_scan_model.translation)
    np.testing.assert_allclose(moved, expected[3:6], rtol=2e-3, atol=1e-3)


def test_normals_of_a_surface_are_those_of_the_mesh() -> None:
    b = Z * blob_model().stddev
    surface = surface_at(b)
    mesh = blob_model().mesh(b)
    np.testing.assert_allclose(surface.vertices, mesh.vertices, atol=1e-4)
    np.testing.assert_allclose(surface.normals, vertex_normals(mesh), atol=1e-5)


def test_walks_end_where_brute_force_does_near_the_surface() -> None:
    surface = surface_at(Z * blob_model().stddev)
    mesh = blob_model().mesh(Z * blob_model().stddev)
    rng = np.random.default_rng(0)
    points = mesh.vertices[rng.integers(0, len(mesh.vertices), 3000)] + rng.normal(0, 2.0, (3000, 3))
    vertex = rng.integers(0, len(mesh.vertices), 3000).astype(np.int32)
    vertex[:] = surface.vertex_tree().nearest(points)[0]
    triangle = np.full(3000, -1, dtype=np.int32)
    vertex, triangle, weights = surface.closest(points, vertex, triangle)
    found = (weights[:, :, None] * mesh.vertices[mesh.faces[triangle]]).sum(axis=1)
    distance = np.linalg.norm(found - points, axis=1)
    exact = build_engine(mesh).query(points).distance
    assert (distance >= exact - 1e-4).all()
    assert np.mean(distance < exact + 1e-3) > 0.99
    # Once more from there, after a small move, as the next iteration does it.
    points += rng.normal(0, 0.2, points.shape)
    vertex, triangle, weights = surface.closest(points, vertex, triangle)
    found = (weights[:, :, None] * mesh.vertices[mesh.faces[triangle]]).sum(axis=1)
    exact = build_engine(mesh).query(points).distance
    assert np.mean(np.linalg.norm(found - points, axis=1) < exact + 0.05) > 0.98


@pytest.mark.parametrize("triangles", [False, True])
@pytest.mark.parametrize("winding", [1.0, -1.0])
def test_compiled_comparison_of_vertices_is_that_of_plain_numpy(triangles: bool, winding: float) -> None:
    target, vertex = ScanTarget(raw_scan(Z, NEAR, keep=-0.5).scan), np.arange(0, 600, 3, dtype=np.int32)
    surface, rotation = surface_at(0.5 * Z * blob_model().stddev), NEAR.rotation
    engine = target.engine if triangles else target.vertex_engine
    found = match_vertices(
        target=target, engine=engine, T_scan_model=NEAR, surface=surface, vertex=vertex, near=None,
        winding=winding, normal_cosine=0.4,
    )  # fmt: skip
    near = engine.query(NEAR.apply(surface.vertices[vertex]))
    n = surface.normals[vertex]
    to_scan = surface.vertices[vertex] - NEAR.inverse().apply(near.points)
    np.testing.assert_allclose(found.residual, (to_scan * n).sum(axis=1), atol=1e-9)
    if near.triangle is None or near.barycentric is None:
        n_scan = target.normals[near.vertex]
    else:
        corners = target.normals[target.mesh.faces[near.triangle]]
        n_scan = (near.barycentric[:, :, None] * corners).sum(axis=1)
    n_scan = n_scan @ rotation
    agree = winding * (n * n_scan).sum(axis=1) > 0.4 * np.linalg.norm(n_scan, axis=1)
    expected = agree & ~on_boundary(near, target.mesh, target.rim)
    np.testing.assert_array_equal(found.allowed, expected)
    assert 0 < expected.sum() < len(expected) or winding < 0


def test_the_order_of_searches_changes_no_hint() -> None:
    _, matcher, iterate, hint = problem_at(raw_scan(Z, NEAR).scan, Level(0, 400, 200, False, 1, 0.0), np.zeros(5))
    assert sorted(matcher.order) == list(range(len(matcher.points_mm)))
    asked, used = NEAR.inverse().apply(matcher.points_mm), iterate.surface.topology.used
    distance = np.linalg.norm(iterate.surface.vertices[used] - asked[:, None], axis=2)
    np.testing.assert_array_equal(hint.vertex, used[distance.argmin(axis=1)])


def test_a_small_rotation_is_that_of_scipy() -> None:
    for size in (0.0, 1e-6, 9e-4, 0.01, 1.0):
        delta = size * np.array([0.3, -0.8, 0.5, 0.0, 0.0, 0.0, 0.0])
        expected = Rotation.from_rotvec(delta[:3]).as_matrix()
        np.testing.assert_allclose(small_similarity(delta).rotation, expected, atol=1e-15)


def test_what_lies_in_the_span_is_found_again_with_its_pose() -> None:
    model, small = blob_model(), similarity(5, 1.0, 1.01, 0.5)
    shape = model.reconstruct(Z * model.stddev)
    at = Estimate(Similarity.identity(), np.zeros(5))
    told = in_span(prepare(model), small.apply(shape), at, model.stddev, 0.01, 5, with_scale=True)
    np.testing.assert_allclose(told.T_scan_model.apply(model.reconstruct(told.b)), small.apply(shape), atol=0.02)
    np.testing.assert_allclose(told.b, Z * model.stddev, atol=0.05 * model.stddev[0])


def test_a_complete_scan_is_recovered_to_a_tenth_of_a_millimetre() -> None:
    model, T = blob_model(vertices=1500), similarity(8, 15.0, 1.1)
    raw = raw_scan(Z, T, vertices=6000, model_vertices=1500, noise_mm=0.1)
    result = fit_scan(model, raw.scan)
    assert (result.status, result.method) == ("converged", "robust")
    assert error_mm(result, model, raw.truth, T.scale) < 0.15


@pytest.mark.parametrize("keep", [-0.6, -0.2])
def test_a_large_part_missing_does_not_lose_the_scale(keep: float) -> None:
    model, T = blob_model(vertices=1500), similarity(8, 15.0, 1.0)
    raw = raw_scan(Z, T, vertices=6000, model_vertices=1500, noise_mm=0.1, keep=keep)
    result = fit_scan(model, raw.scan)
    assert error_mm(result, model, raw.truth) < 1.0
    assert result.T_scan_model.scale == pytest.approx(1.0, rel=0.02)


def test_reversed_winding_gives_the_same_b() -> None:
    raw = raw_scan(Z, NEAR, noise_mm=0.2, keep=-0.5)
    assert raw.scan.faces is not None
    turned = Mesh(raw.scan.vertices, raw.scan.faces[:, ::-1], name="raw.ply")
    one, two = (fit_scan(blob_model(), scan, FitConfig(unit="mm")) for scan in (raw.scan, turned))
    np.testing.assert_allclose(one.b, two.b, atol=1e-2)


def test_a_tenth_of_outliers_changes_little() -> None:
    model = blob_model(vertices=1500)
    raw = raw_scan(Z, NEAR, vertices=6000, model_vertices=1500, noise_mm=0.1)
    rng = np.random.default_rng(0)
    thrown = raw.scan.vertices.copy()
    thrown[rng.random(len(thrown)) < 0.1] *= 1.12
    result = fit_scan(model, raw.scan.with_vertices(thrown), FitConfig(unit="mm"))
    assert error_mm(result, model, raw.truth) < 0.4


def test_a_point_cloud_is_fitted_without_triangles() -> None:
    model = blob_model(vertices=1500)
    raw = raw_scan(Z, NEAR, vertices=6000, model_vertices=1500, noise_mm=0.2)
    result = fit_scan(model, Mesh(raw.scan.vertices, name="cloud"), FitConfig(unit="mm"))
    assert error_mm(result, model, raw.truth) < 0.4


def test_the_first_modes_reported_are_those_of_the_whole_fit() -> None:
    model = blob_model()
    raw = raw_scan(Z, NEAR, noise_mm=0.1)
    full, first = (fit_scan(model, raw.scan, FitConfig(unit="mm", modes=k)) for k in (None, 3))
    assert first.b.shape == first.z.shape == first.b_stddev.shape == (3,)
    # Better than a model that never had the others.
    short = fit_scan(model.truncate(3), raw.scan, FitConfig(unit="mm"))
    assert np.abs((first.b - full.b[:3]) / model.stddev[:3]).max() < 0.6
    assert error_mm(first, model, raw.truth) <= error_mm(short, model.truncate(3), raw.truth) + 0.05


def test_what_few_shapes_teach_too_little_of_is_told_in_millimetres() -> None:
    few = ShapeModel.fit(list(training_meshes(4, 700, seed=3)))
    raw = raw_scan(Z, NEAR, vertices=5000, noise_mm=0.1)
    assert fit_scan(few, raw.scan, FitConfig(unit="mm"), T_scan_model=NEAR).evidence.beyond_model_mm > 0.2


def test_a_held_scale_is_held() -> None:
    result = fit_scan(blob_model(), raw_scan(Z, similarity(2, 10.0, 1.05)).scan, FitConfig(unit="mm", scale="fixed"))
    assert result.T_scan_model.scale == pytest.approx(1.0, abs=1e-6)


def test_the_cap_ends_each_phase_and_states_follow_each_other() -> None:
    result = fit_scan(blob_model(), raw_scan(Z, NEAR).scan, FitConfig(unit="mm", max_iterations=2))
    assert max(result.iterations.values()) <= 2
    for before, after in pairwise(result.history):
        assert (after.phase, after.iteration) in ((before.phase, before.iteration + 1), (before.phase + 1, 0))


def test_a_model_of_points_is_refused_in_one_sentence() -> None:
    points = ShapeModel.fit([Mesh(m.vertices, name=m.name) for m in training_meshes()])
    with pytest.raises((InputError, FitError), match="needs a model with triangles"):
        fit_scan(points, raw_scan(Z).scan)


def test_the_paper_only_search_is_refused_for_the_robust_method() -> None:
    with pytest.raises(InputError, match="'robust' has no setting 'search'"):
        method_named("robust", search="vertices")
