"""The dense stage lies on the scan where the scan shows the surface, and leaves the rest to the model."""

from dataclasses import replace

import numpy as np
import pytest

from shapespace.errors import FitError, InputError
from shapespace.fit.dense.dense_fit import _laplacian, _matern_field, dense_surface, revert_folds
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.prepared_model import prepare
from shapespace.fit.robust.robust_settings import DenseSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import face_vectors, vertex_areas, vertex_normals
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import blob, blob_model, raw_scan, similarity, sphere

SETTINGS = DenseSettings()
Z = np.array([0.5, -1.0, 0.8, -0.6, 0.7])
DENT = np.array([0.0, 0.3, 1.0]) / np.linalg.norm([0.0, 0.3, 1.0])


def model() -> ShapeModel:
    return blob_model(vertices=2500)


def bumpy(d: FloatArray, height_mm: float = 2.0) -> FloatArray:
    """Return the blob in directions `d` (M, 3) with smooth bumps along d that no mode of the model can make."""
    bumps = np.sin(6 * d[:, 0]) * np.cos(5 * d[:, 1] + 1) + np.exp((d @ DENT - 1) / 0.02)
    return blob(d, Z) + height_mm * bumps[:, None] * d


def scanned(noise_mm: float = 0.0, count: int = 6000, seed: int = 0) -> Mesh:
    d, faces = sphere(count, turn=0.7)
    scan = Mesh(bumpy(d), faces)
    along = vertex_normals(scan) * np.random.default_rng(seed).standard_normal((count, 1))
    return Mesh(scan.vertices + noise_mm * along, faces, name="bumpy.ply")


def fitted() -> FloatArray:
    """Return the best that the model itself can do, vertices (V, 3)."""
    m = model()
    return m.reconstruct(m.project(blob(sphere(m.n_vertices)[0], Z), align=False))


def truth() -> FloatArray:
    return bumpy(sphere(model().n_vertices)[0])


def dense(scan: Mesh, settings: DenseSettings = SETTINGS, start: FloatArray | None = None):
    begin = fitted() if start is None else start
    return dense_surface(model(), ScanTarget(scan), begin, Similarity.identity(), settings)


def error_mm(x: FloatArray, where: np.ndarray | slice = slice(None)) -> float:
    return float(np.linalg.norm((x - truth())[where], axis=1).mean())


def turned(before: FloatArray, after: FloatArray) -> int:
    faces = model().faces
    assert faces is not None
    return int(((face_vectors(before, faces) * face_vectors(after, faces)).sum(axis=1) <= 0).sum())


def without(scan: Mesh, gone: np.ndarray) -> Mesh:
    assert scan.faces is not None
    used, faces = np.unique(scan.faces[~gone[scan.faces].any(axis=1)], return_inverse=True)
    return Mesh(scan.vertices[used], faces.reshape(-1, 3).astype(np.int32), name=scan.name)


def test_it_lies_on_a_scan_that_the_model_cannot_make_and_nearer_to_the_true_vertices() -> None:
    scan = scanned()
    surface = dense(scan)
    engine = build_engine(scan)
    assert engine.query(fitted()).distance.mean() > 0.5
    assert engine.query(surface.vertices_scan_mm).distance.mean() < 0.03
    assert error_mm(surface.vertices_scan_mm) < 0.6 * error_mm(fitted())
    assert surface.seen.all()


def test_noise_is_measured_and_mostly_not_followed() -> None:
    scan = scanned(noise_mm=0.5, count=20_000)
    surface = dense(scan)
    assert surface.noise_mm == pytest.approx(0.5, rel=0.15)
    faces = model().faces
    left = build_engine(Mesh(truth(), faces)).query(surface.vertices_scan_mm).distance
    followed = build_engine(scan).query(truth()).distance
    assert left.mean() < 0.7 * followed.mean()


def test_a_scan_the_model_explains_is_hardly_changed() -> None:
    raw = raw_scan(Z, vertices=20_000, model_vertices=2500, noise_mm=0.2)
    surface = dense(raw.scan, start=raw.truth)
    assert surface.unexplained_mm < SETTINGS.least_unexplained_mm
    assert np.linalg.norm(surface.vertices_scan_mm - raw.truth, axis=1).mean() < 0.1


def test_a_hole_stays_with_the_model_and_its_rim_does_not_pull() -> None:
    d = sphere(6000, turn=0.7)[0]
    away = np.array([0.9, 0.4, 0.3]) / np.linalg.norm([0.9, 0.4, 0.3])
    holed = without(scanned(), d @ away > 0.85)
    height = sphere(model().n_vertices)[0] @ away
    inside, deep = height > 0.88, height > 0.97
    surface = dense(holed)
    assert not surface.seen[deep].any() and surface.seen[height < 0.8].all()
    moved = np.linalg.norm(surface.vertices_scan_mm - fitted(), axis=1)
    assert moved[deep].max() < 2.0
    assert error_mm(surface.vertices_scan_mm, inside) < 1.05 * error_mm(fitted(), inside)
    assert error_mm(surface.vertices_scan_mm, height < 0.8) < 0.6 * error_mm(fitted(), height < 0.8)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_neither_pull_nor_fold(share: float) -> None:
    rng, scan = np.random.default_rng(1), scanned(count=12_000)
    thrown = (
        (rng.random(len(scan.vertices)) < share)
        * rng.uniform(3, 15, len(scan.vertices))
        * rng.choice([-1, 1], len(scan.vertices))
    )
    spiky = Mesh(scan.vertices + thrown[:, None] * vertex_normals(scan), scan.faces, name="spiky.ply")
    surface = dense(spiky)
    assert turned(fitted(), surface.vertices_scan_mm) == 0
    assert error_mm(surface.vertices_scan_mm) < 0.75 * error_mm(fitted())


def test_a_crumpled_patch_does_not_fold_the_surface() -> None:
    scan, d = scanned(count=12_000), sphere(12_000, turn=0.7)[0]
    crumpled = (d @ DENT > 0.9)[:, None] * np.random.default_rng(2).normal(0, 15.0, scan.vertices.shape)
    # Weights that trust everything, and details as rough as they come: the worst that settings can ask for.
    reckless = replace(
        SETTINGS, normal_cosine=-1.0, width=50.0, reach_mm=50.0, fine_amplitude_mm=20.0, fine_range_share=0.02
    )
    surface = dense(Mesh(scan.vertices + crumpled, scan.faces, name="crumpled.ply"), reckless)
    assert surface.damped > 0
    assert turned(fitted(), surface.vertices_scan_mm) == 0
    assert not (against_neighbours(surface.vertices_scan_mm) & ~against_neighbours(fitted())).any()


def against_neighbours(x: FloatArray) -> np.ndarray:
    """Return (F,) True for triangles that face away from the surface at one of their corners; the slow way."""
    faces = model().faces
    normals = vertex_normals(Mesh(x, faces))
    return (np.einsum("fkd,fd->fk", normals[faces], face_vectors(x, faces)) <= 0).any(axis=1)


@pytest.mark.parametrize("step", [(0.0, 30.0, 10.0), (0.0, 0.0, 25.0), (6.0, 12.0, 0.0)])
def test_unfolding_holds_back_only_where_triangles_fold(step: tuple[float, float, float]) -> None:
    topology, start = prepare(model()).topology, fitted()
    moved = start + 0.1
    tip = int(start[:, 2].argmax())
    moved[tip] -= step
    assert turned(start, moved) > 0 or against_neighbours(moved).any()
    kept, held = revert_folds(start, start, moved, topology, SETTINGS.turn_cosine)
    assert turned(start, kept) == 0 and not (against_neighbours(kept) & ~against_neighbours(start)).any()
    assert held[tip] and held.sum() < 60
    assert np.array_equal(kept[~held], moved[~held])


@pytest.mark.parametrize("roughness_mm", [3.0, 300.0])
def test_unfolding_always_ends_without_a_fold(roughness_mm: float) -> None:
    start = fitted()
    moved = start + np.random.default_rng(4).normal(0, roughness_mm, start.shape)
    kept, _ = revert_folds(start, start, moved, prepare(model()).topology, SETTINGS.turn_cosine)
    assert turned(start, kept) == 0 and not (against_neighbours(kept) & ~against_neighbours(start)).any()


def test_a_scan_coarser_than_the_model_is_met_between_its_vertices() -> None:
    scan = scanned(count=700)
    surface = dense(scan)
    engine = build_engine(scan)
    assert engine.query(surface.vertices_scan_mm).distance.mean() < 0.25 * engine.query(fitted()).distance.mean()


def test_a_point_cloud_will_do() -> None:
    scan = scanned(noise_mm=0.1, count=20_000)
    surface = dense(Mesh(scan.vertices, name="cloud.ply"))
    assert build_engine(scan).query(surface.vertices_scan_mm).distance.mean() < 0.15
    assert error_mm(surface.vertices_scan_mm) < 0.6 * error_mm(fitted())


@pytest.mark.parametrize(("height_mm", "doubted"), [(0.2, False), (3.0, True)])
def test_a_surface_that_moved_further_than_a_model_should_lack_is_doubted(height_mm: float, doubted: bool) -> None:
    d, faces = sphere(6000, turn=0.7)
    result = fit_scan(model(), Mesh(bumpy(d, height_mm), faces), FitConfig(dense=True, unit="mm"))
    assert ("the dense surface moved" in result.reason) is doubted
    surface = dense(Mesh(bumpy(d, height_mm), faces))
    mesh = Mesh(fitted(), model().faces)
    off_mm = bumpy(sphere(model().n_vertices)[0], height_mm) - mesh.vertices
    along_mm = np.einsum("vd,vd->v", vertex_normals(mesh), off_mm)
    assert surface.moved_mm == pytest.approx(np.sqrt((along_mm**2).mean()), rel=0.2)


def test_a_reversed_scan_gives_the_same_surface() -> None:
    scan = scanned()
    assert scan.faces is not None
    there = dense(scan).vertices_scan_mm
    assert np.abs(dense(Mesh(scan.vertices, scan.faces[:, ::-1])).vertices_scan_mm - there).max() < 1e-6


def test_it_is_the_same_every_time_and_in_every_frame() -> None:
    scan, T = scanned(noise_mm=0.1), similarity(3, degrees=170.0, scale=1.3)
    once = dense(scan).vertices_scan_mm
    assert np.array_equal(once, dense(scan).vertices_scan_mm)
    elsewhere = dense_surface(
        model(), ScanTarget(scan.with_vertices(T.apply(scan.vertices))), T.apply(fitted()), T, SETTINGS
    )
    assert np.abs(T.inverse().apply(elsewhere.vertices_scan_mm) - once).max() < 0.01


def test_the_field_solves_its_normal_equations() -> None:
    m, rng = blob_model(vertices=200), np.random.default_rng(0)
    field, count = _matern_field(m, 60.0, 2.0), m.n_vertices
    t = field.topology
    A = np.diag(field.diagonal)
    rows = np.repeat(np.arange(count), np.diff(t.ring_start))
    A[rows, t.ring] = field.off_diagonal
    assert np.allclose(A, A.T)
    along = rng.standard_normal((count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    seen, pull = rng.random(count) * (rng.random(count) < 0.7), rng.standard_normal(count)
    Q = np.kron(A @ np.diag(field.inverse_mass) @ A, np.eye(3))
    for v in range(count):
        Q[3 * v : 3 * v + 3, 3 * v : 3 * v + 3] += seen[v] * np.outer(along[v], along[v])
    exact = np.linalg.solve(Q, (pull[:, None] * along).ravel()).reshape(-1, 3)
    x = np.zeros((count, 3))
    field.solve(seen, pull, along, x, replace(SETTINGS, tolerance=1e-10, iterations=5000))
    assert np.abs(x - exact).max() < 1e-6 * np.abs(exact).max()


def test_the_laplacian_knows_constants_and_a_sphere() -> None:
    d, faces = sphere(2000)
    m = ShapeModel.fit([Mesh(d * s, faces) for s in (1.0, 1.1, 1.2)], gauge="form")
    topology = prepare(m).topology
    laplacian = _laplacian(d, topology)
    rows = np.repeat(np.arange(len(d)), np.diff(topology.ring_start))

    def of(f: FloatArray) -> FloatArray:
        neighbours = np.bincount(rows, laplacian.off_diagonal * f[topology.ring], len(f))
        return (laplacian.diagonal * f + neighbours) / vertex_areas(Mesh(d, faces))

    assert np.abs(of(np.ones(len(d)))).max() < 1e-9
    # The first spherical harmonics are eigenfunctions with eigenvalue 2.
    assert np.median(np.abs(of(d[:, 2]) - 2 * d[:, 2])) < 0.02


def test_nothing_to_match_is_said() -> None:
    with pytest.raises(FitError, match=r"bumpy\.ply: too few of its points match"):
        dense(scanned(count=20))


def test_after_the_papers_method_it_is_refused() -> None:
    with pytest.raises(InputError, match="robust method"):
        FitConfig(method="paper", dense=True)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_fit_ends_in_it_in_the_scans_own_frame_and_unit(unit: str) -> None:
    scan, mm = scanned(), {"mm": 1.0, "m": 1000.0}[unit]
    small = scan.with_vertices(similarity(1, degrees=15.0, scale=1.0 / mm, shift=20.0 / mm).apply(scan.vertices))
    result = fit_scan(model(), small, FitConfig(dense=True))
    assert list(result.stages) == ["before", "initial", "final", "dense"]
    surface = result.surface(model(), "dense")
    assert build_engine(small).query(surface.vertices).distance.mean() * mm < 0.05
    assert result.stages["dense"].distances.model_to_scan.mean < 0.05
    assert np.array_equal(surface.landmarks["tip"], surface.vertices[model().landmarks["tip"]])
    plain = fit_scan(model(), small)
    assert np.array_equal(plain.b, result.b)
    assert "dense" not in plain.stages
