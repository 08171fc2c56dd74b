"""Models of shapes with missing vertices: what is not shown neither narrows nor bends them, and is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace import cli
from shapespace.errors import InputError
from shapespace.geometry.procrustes import align_in_place
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.missing import ObservedMeshes, with_estimates
from shapespace.model.model_quality import QualityConfig, measure_quality
from shapespace.model.pca import principal_components
from shapespace.model.ppca import ppca
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Mesh
from synthetic_shapes import similarity, training_meshes


def patches(meshes: tuple[Mesh, ...], share: float = 0.25, seed: int = 0) -> BoolArray:
    """Return (N, V) what is shown: each mesh lacks the vertices around one of its own."""
    rng, shown = np.random.default_rng(seed), []
    for mesh in meshes:
        x = mesh.vertices
        far = np.linalg.norm(x - x[rng.integers(len(x))], axis=1)
        shown.append(far > np.quantile(far, share))
    return np.stack(shown)


def holed(meshes: tuple[Mesh, ...], shown: BoolArray) -> list[Mesh]:
    return [
        m.with_vertices(np.where(there[:, None], m.vertices, np.nan)) for m, there in zip(meshes, shown, strict=True)
    ]


def noisy(count: int = 24, vertices: int = 200, seed: int = 1, noise_mm: float = 0.1) -> tuple[Mesh, ...]:
    rng = np.random.default_rng(seed)
    return tuple(
        m.with_vertices(m.vertices + noise_mm * rng.standard_normal(m.vertices.shape))
        for m in training_meshes(count=count, vertices=vertices)
    )


def filled_by_the_mean(shapes: FloatArray, shown: BoolArray) -> FloatArray:
    mean = np.nanmean(np.where(shown[:, :, None], shapes, np.nan), axis=0)
    return np.where(shown[:, :, None], shapes, mean)


@pytest.mark.parametrize("modes", [2, 5, 20])
def test_the_bound_never_falls(modes: int) -> None:
    meshes = noisy()
    shown = patches(meshes)
    found = ppca(filled_by_the_mean(np.stack([m.vertices for m in meshes]), shown), shown, modes)
    assert len(found.bounds) > 3
    assert np.diff(found.bounds).min() > -1e-9 * abs(found.bounds[-1])


def test_known_variances_come_back_where_little_is_shown_and_coefficients_stay_uncertain() -> None:
    rng = np.random.default_rng(2)
    n, vertices, stddev = 400, 8, np.array([4.0, 2.0])
    basis = np.linalg.qr(rng.standard_normal((3 * vertices, 2)))[0]
    shapes = (stddev * rng.standard_normal((n, 2))) @ basis.T + rng.standard_normal((n, 3 * vertices))
    shapes = shapes.reshape(n, vertices, 3)
    shown = rng.random((n, vertices)) > 0.6
    found = ppca(filled_by_the_mean(shapes, shown), shown, 2)
    W = found.W[:, :, :2].reshape(-1, 2)
    variance = np.linalg.eigvalsh(W.T @ W)[::-1]
    # What is faint beside the noise is told too faint, never too strong.
    assert np.allclose(variance, stddev**2, rtol=[0.15, 0.35])
    assert found.noise == pytest.approx(1.0, rel=0.1)
    plain = principal_components(filled_by_the_mean(shapes, shown).reshape(n, -1), 2).variance
    assert plain[0] < 0.5 * stddev[0] ** 2


def test_the_noise_of_what_is_missing_counts_too() -> None:
    meshes = noisy(noise_mm=2.0)
    model = ShapeModel.fit(holed(meshes, patches(meshes, 0.35)), min_seen=0.2)
    assert model.total_variance == pytest.approx(ShapeModel.fit(meshes).total_variance, rel=0.05)


@pytest.mark.parametrize("gauge", ["shape", "form"])
def test_variances_and_mean_of_holed_shapes_are_nearer_those_of_whole_ones_than_with_the_mean_filled_in(
    gauge: str,
) -> None:
    meshes = noisy()
    shown = patches(meshes)
    whole = ShapeModel.fit(meshes, gauge=gauge)
    model = ShapeModel.fit(holed(meshes, shown), gauge=gauge, min_seen=0.3)
    aligned = np.stack([m.vertices for m in meshes])
    align_in_place(aligned, gauge)
    plain = principal_components(filled_by_the_mean(aligned, shown).reshape(len(meshes), -1))
    assert model.n_vertices == whole.n_vertices
    ratio = model.stddev[:5] ** 2 / whole.stddev[:5] ** 2
    assert np.abs(ratio - 1).mean() < 0.4 * np.abs(plain.variance[:5] / whole.stddev[:5] ** 2 - 1).mean()
    assert abs(model.total_variance / whole.total_variance - 1) < 0.05
    assert plain.total_variance / whole.total_variance < 0.9
    off = np.linalg.norm(model.mean_vertices - whole.mean_vertices, axis=1).mean()
    assert off < 0.6 * np.linalg.norm(plain.mean.reshape(-1, 3) - whole.mean_vertices, axis=1).mean()
    cosines = np.linalg.svd(model.basis[:, :5].T @ whole.basis[:, :5], compute_uv=False)
    assert cosines.min() > 0.98


def test_missing_vertices_of_shapes_of_few_modes_are_found_again() -> None:
    meshes = noisy(count=40, vertices=300)
    shapes, shown = np.stack([m.vertices for m in meshes]), patches(meshes)
    found = ppca(filled_by_the_mean(shapes, shown), shown, 20)
    off = [np.linalg.norm(found.estimate(i) - shapes[i][~shown[i]], axis=1) for i in range(len(shapes))]
    by_mean = np.linalg.norm(filled_by_the_mean(shapes, shown) - shapes, axis=2)[~shown]
    assert np.concatenate(off).mean() < 0.3 < by_mean.mean() / 4
    # Five modes made them; the width of the others is that of noise.
    assert (found.width > 0.02 * found.width.max()).sum() == 5


def test_where_nothing_is_missing_the_model_is_the_same_to_the_bit() -> None:
    meshes = noisy()
    model = ShapeModel.fit(meshes, min_seen=0.9)
    assert model.content_hash == ShapeModel.fit(meshes, min_seen=0.1).content_hash
    shapes = np.stack([m.vertices for m in meshes])
    align_in_place(shapes, "form")
    plain = principal_components(shapes.reshape(len(meshes), -1))
    form = ShapeModel.fit(meshes, gauge="form")
    assert np.array_equal(form.mean.ravel(), plain.mean)
    assert np.array_equal(form.stddev**2, np.sqrt(plain.variance[: form.n_modes]) ** 2)


def test_with_hardly_anything_missing_the_model_is_nearly_that_of_the_whole() -> None:
    meshes = noisy(count=40, vertices=300)
    shown = np.ones((40, 300), dtype=bool)
    shown[7, 11] = False
    model, whole = ShapeModel.fit(holed(meshes, shown)), ShapeModel.fit(meshes)
    assert np.allclose(model.stddev, whole.stddev, rtol=1e-3)
    assert np.abs(model.mean - whole.mean).max() < 0.02


@pytest.mark.long
def test_poses_do_not_matter_and_the_same_meshes_give_the_same_model() -> None:
    meshes = noisy(count=20, vertices=300)
    given = holed(meshes, patches(meshes))
    moved = [
        m.with_vertices(similarity(i, 0 if i == 0 else 60.0, 1.0, 200.0).apply(m.vertices)) for i, m in enumerate(given)
    ]
    a, b = ShapeModel.fit(given, min_seen=0.3), ShapeModel.fit(moved, min_seen=0.3)
    assert np.allclose(a.stddev[:5], b.stddev[:5], rtol=1e-3)
    assert a.content_hash == ShapeModel.fit(given, min_seen=0.3).content_hash


def test_seldom_shown_vertices_go_with_their_triangles_and_landmarks() -> None:
    meshes = training_meshes(count=12, vertices=200)
    shown = np.ones((12, 200), dtype=bool)
    shown[:7, 20:30] = False
    shown[:, 5] = False
    model = ShapeModel.fit(holed(meshes, shown), landmarks={"gone": 25, "there": 40})
    assert model.n_vertices == 189
    assert dict(model.landmarks) == {"there": 29}
    assert model.faces is not None and model.faces.max() == 188
    assert ShapeModel.fit(holed(meshes, shown), min_seen=0.4).n_vertices == 199
    assert list(model.dropped_vertices) == [5, *range(20, 30)]


def test_a_model_takes_shapes_of_its_source_also_from_its_file(tmp_path: Path) -> None:
    meshes = training_meshes(count=8, vertices=100)
    shown = np.ones((8, 100), dtype=bool)
    shown[:, 20:30] = False
    given = holed(meshes, shown)
    model = ShapeModel.fit(given, modes=3)
    model.save(tmp_path / "m.h5")
    kept = np.delete(meshes[2].vertices, np.arange(20, 30), axis=0)
    loaded = ShapeModel.load(tmp_path / "m.h5")
    for shape in (given[2], meshes[2].vertices):
        np.testing.assert_array_equal(loaded.project(shape), model.project(kept))
    assert loaded.content_hash == model.content_hash == replace(model, dropped_vertices=[]).content_hash
    b = model.stddev * [1.0, -1.0, 0.5]
    partial = np.insert(model.reconstruct(b), [20] * 10, np.nan, axis=0)
    partial[40:60] = np.nan
    np.testing.assert_allclose(model.project(partial, align=False), b, atol=0.02 * model.stddev[0])


@pytest.mark.parametrize("modes", [3, 0.9, "auto"])
def test_modes_are_chosen_as_for_whole_shapes(modes: object) -> None:
    meshes = noisy()
    model = ShapeModel.fit(holed(meshes, patches(meshes)), modes=modes, min_seen=0.3)
    assert model.n_modes == {3: 3}.get(modes, model.n_modes)
    assert 3 <= model.n_modes <= 10
    assert np.allclose(model.basis.T @ model.basis, np.eye(model.n_modes), atol=1e-9)


def estimated(meshes: list[Mesh]) -> list[Mesh]:
    """Return meshes with missing vertices as complete meshes, far-off estimates in their place, with the mask."""
    return [
        replace(mesh, vertices=np.nan_to_num(mesh.vertices, nan=500.0), observed=np.isfinite(mesh.vertices).all(axis=1))
        for mesh in meshes
    ]


@pytest.mark.parametrize("out_of_core", [False, True])
def test_a_vertex_that_is_not_observed_is_treated_as_missing(out_of_core: bool) -> None:
    meshes = noisy(count=12, vertices=200)
    masked = holed(meshes, patches(meshes))
    if out_of_core:
        for given in (masked, estimated(masked)):
            with pytest.raises(InputError, match="vertices are missing"):
                ShapeModel.fit(given, modes=4, out_of_core=True)
        return
    one, other = (ShapeModel.fit(given, modes=4) for given in (masked, estimated(masked)))
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.basis, other.basis)
    config = QualityConfig(modes=3, samples=6, folds=2)
    first, second = (measure_quality(given, config) for given in (masked, estimated(masked)))
    np.testing.assert_array_equal(first.generalisation.mean, second.generalisation.mean)


def test_estimates_lie_nearer_the_truth_than_the_mean_and_leave_the_observed_vertices() -> None:
    meshes = noisy()
    shown = patches(meshes)
    # Any poses and sizes.
    moved = np.stack([similarity(k).apply(mesh.vertices) for k, mesh in enumerate(meshes)])
    found = with_estimates(np.where(shown[:, :, None], moved, np.nan), [mesh.name for mesh in meshes])
    np.testing.assert_array_equal(found[shown], moved[shown])
    scales = np.array([similarity(k).scale for k in range(len(meshes))])
    off = np.linalg.norm(found - moved, axis=2) / scales[:, None]
    aligned = np.stack([mesh.vertices for mesh in meshes])
    by_mean = np.linalg.norm(filled_by_the_mean(aligned, shown) - aligned, axis=2)
    assert off[~shown].mean() < 0.35 * by_mean[~shown].mean()


def test_two_meshes_with_holes_and_meshes_as_they_stand_make_models() -> None:
    meshes = training_meshes(vertices=200)[:2]
    shown = np.ones((2, 200), dtype=bool)
    shown[0, :20] = False
    model = ShapeModel.fit(holed(meshes, shown))
    assert (model.n_modes, model.n_vertices) == (1, 180)
    many = noisy()
    model = ShapeModel.fit(holed(many, patches(many)), align=False, min_seen=0.3)
    assert np.allclose(model.mean, np.mean([m.vertices for m in many], axis=0), atol=1.0)


def test_what_cannot_be_used_is_refused_in_one_sentence() -> None:
    meshes = training_meshes(vertices=200)[:4]
    nothing = np.ones((4, 200), dtype=bool)
    nothing[2] = False
    with pytest.raises(InputError, match=r"blob_2\.ply: all of its vertices are missing; exclude this mesh"):
        ShapeModel.fit(holed(meshes, nothing))
    nothing[2, :3] = True
    with pytest.raises(InputError, match=r"blob_2\.ply"):
        ShapeModel.fit(holed(meshes, np.where(np.arange(4)[:, None] == 2, np.arange(200) < 2, True)))
    thirds = np.stack([np.arange(200) % 4 == i for i in range(4)])
    with pytest.raises(InputError, match="No vertex is observed by 50 % of the meshes"):
        ShapeModel.fit(holed(meshes, thirds))
    with pytest.raises(InputError, match="share of meshes"):
        ObservedMeshes.of(meshes, 0.0)
    with pytest.raises(InputError, match="20 % of the meshes and by at least two"):
        ShapeModel.fit(holed(meshes, thirds), min_seen=0.2)
    apart = np.stack([np.arange(200) < 120, np.arange(200) < 120, np.arange(200) > 117, np.arange(200) > 117])
    with pytest.raises(InputError, match="too few of its vertices are observed to align it with the other"):
        ShapeModel.fit(holed(meshes, apart))
    equal = [meshes[0], *(meshes[0].with_vertices(meshes[0].vertices) for _ in range(3))]
    with pytest.raises(InputError, match="all equal"):
        ShapeModel.fit(holed(tuple(equal), patches(tuple(equal), 0.1)))


def test_the_command_tells_what_is_missing_and_what_is_taken_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = training_meshes(count=6, vertices=200)
    shown = np.ones((6, 200), dtype=bool)
    shown[:4, 3] = False
    shown[1, 50:70] = False
    for mesh in holed(meshes, shown):
        write_mesh(tmp_path / mesh.name, mesh)
    write_landmark_indices(tmp_path / "landmarks.csv", {"gone": 3, "there": 100})
    assert cli.main(["build", str(tmp_path), "-o", str(tmp_path / "m.h5"), "--modes", "2"]) == 0
    said = capsys.readouterr().err
    assert "24 of 1200 vertices are missing (2.0 %), in 4 of 6 meshes." in said
    assert "1 vertex is removed from the model, since fewer than 50 % of the meshes show" in said
    assert "The model has no gone" in said
    assert dict(ShapeModel.load(tmp_path / "m.h5").landmarks) == {"there": 99}
    assert cli.main(["build", str(tmp_path), "-o", str(tmp_path / "m.h5"), "--modes", "2", "--min-seen", "0.3"]) == 0
    assert "taken out" not in capsys.readouterr().err
    (tmp_path / "l.csv").write_text("file,subject,label\n" + "".join(f"{m.name},a,neutral\n" for m in meshes))
    assert cli.main(["build", str(tmp_path), "-o", str(tmp_path / "m.h5"), "--additive", str(tmp_path / "l.csv")]) == 2
    assert "needs complete meshes" in capsys.readouterr().err
