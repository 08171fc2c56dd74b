"""What a fit returns agrees with itself, or the fit is not called converged: any model, gauge, method and scan."""

from functools import cache

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.method_choices import METHODS
from shapespace.fit.result import FitResult
from shapespace.fit.robust.posterior import Estimate, variance_of_new_shapes
from shapespace.fit.robust.prepared_model import prepare
from shapespace.fit.robust.robust_icp import in_span
from shapespace.geometry.closest import surface_distances
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity
from synthetic_shapes import blob, blob_model, raw_scan, similarity, sphere, training_meshes

INSIDE, OUTSIDE = np.array([0.8, -1.0, 0.5, 1.0, -0.7]), np.array([2.5, 2.5, -2.5, 2.5, -3.0])


@cache
def model_of(shapes: int, gauge: str) -> ShapeModel:
    """Return a model of the first two kinds of bump alone, with every mode that alignment makes of them."""
    d, faces = sphere(700)
    rng = np.random.default_rng(shapes)
    meshes = [Mesh(blob(d, np.pad(rng.standard_normal(2), (0, 3))), faces, name=f"{i}") for i in range(shapes)]
    return ShapeModel.fit(meshes, gauge=gauge)


@cache
def fitted(shapes: int, gauge: str, method: str, outside: bool) -> FitResult:
    raw = raw_scan(OUTSIDE if outside else INSIDE * (np.arange(5) < 2), similarity(1, 8.0, 1.0, 3.0), noise_mm=0.1)
    return fit_scan(model_of(shapes, gauge), raw.scan, FitConfig(method, unit="mm", max_iterations=60))


every = pytest.mark.parametrize(
    ("shapes", "gauge", "method", "outside"),
    [(n, g, m, o) for n in (5, 8, 20, 60) for g in ("form", "shape") for m in METHODS for o in (False, True)],
)


@every
def test_what_is_returned_agrees_or_the_fit_is_not_converged(
    shapes: int, gauge: str, method: str, outside: bool
) -> None:
    result = fitted(shapes, gauge, method, outside)
    model, surface = result.model, result.surface()
    np.testing.assert_array_equal(surface.vertices, result.T_scan_model.apply(model.reconstruct(result.b)))
    np.testing.assert_allclose(result.z * model.stddev, result.b)
    measured = surface_distances(surface, result.scan).model_to_scan
    assert result.distances.model_to_scan.mean == pytest.approx(measured.mean, rel=1e-6)
    if result.status == "converged":
        assert (np.abs(result.b) <= 10 * np.sqrt(variance_of_new_shapes(model))).all()
        assert 0.8 < result.T_scan_model.scale < 1.25
        assert result.overlap_distances.model_to_scan.mean < 3.0


@pytest.mark.parametrize("gauge", ["form", "shape"])
@pytest.mark.parametrize("shapes", [8, 20, 60])
def test_a_scan_outside_the_span_sends_neither_pose_nor_faint_modes_away(shapes: int, gauge: str) -> None:
    result = fitted(shapes, gauge, "robust", True)
    assert result.T_scan_model.scale == pytest.approx(1.0, abs=0.1)
    assert (np.abs(result.b) <= 10 * np.sqrt(variance_of_new_shapes(result.model))).all()


def test_a_mode_inside_the_tangent_of_the_pose_moves_neither() -> None:
    """The mode is nearly a scaling, faint, and the surface has a bump that no mode makes."""
    model = blob_model()
    x = model.mean_vertices - model.mean_vertices.mean(axis=0)
    rng = np.random.default_rng(0)
    spurious = (x + 0.01 * rng.standard_normal(x.shape)).ravel()
    basis = np.linalg.qr(np.column_stack([model.basis, spurious]))[0]
    basis[:, :5] = model.basis
    faint = ShapeModel(
        model.mean, basis, np.append(model.stddev, 0.02), model.total_variance, 40, model.faces, gauge="shape"
    )
    bumped = model.mean_vertices + 0.05 * x * (rng.random((len(x), 1)) < 0.1)
    at = Estimate(Similarity.identity(), np.zeros(6))
    told = in_span(prepare(faint), bumped, at, faint.stddev, 0.3, 6, with_scale=True)
    assert told.T_scan_model.scale == pytest.approx(1.0, abs=0.02)
    assert np.abs(told.b[5]) < 3 * 0.02


@pytest.mark.parametrize("method", METHODS)
def test_faint_modes_that_run_away_are_doubted_by_name(method: str) -> None:
    """Variances of the last mode are a millionth of what they should be, so what the scan shows is impossible."""
    model = blob_model()
    stddev = model.stddev * np.array([1, 1, 1, 1, 1e-3])
    narrow = ShapeModel(model.mean, model.basis, stddev, model.total_variance, 40, model.faces, gauge="shape")
    raw = raw_scan(np.array([0.0, 0.0, 0.0, 0.0, 2.5]), noise_mm=0.1)
    result = fit_scan(narrow, raw.scan, FitConfig(method, unit="mm", max_iterations=60))
    if np.abs(result.b[4]) > 10 * np.sqrt(variance_of_new_shapes(narrow)[4]):
        assert result.status == "doubtful"
        assert "mode 5 lies" in result.reason


def test_a_surface_of_another_model_is_refused_and_the_own_is_known() -> None:
    result = fitted(8, "shape", "robust", False)
    other = ShapeModel.fit(list(training_meshes(12, 700, seed=5)))
    np.testing.assert_array_equal(result.surface().vertices, result.surface(result.model).vertices)
    with pytest.raises(InputError, match="another model"):
        result.surface(other)


def test_distances_over_what_the_scan_shows_leave_out_what_it_does_not() -> None:
    model = blob_model()
    whole, half = (
        fit_scan(model, raw_scan(INSIDE, noise_mm=0.1, keep=keep).scan, FitConfig(unit="mm")) for keep in (None, 0.0)
    )
    assert half.distances.model_to_scan.mean > 5 * half.overlap_distances.model_to_scan.mean
    assert half.overlap_distances.model_to_scan.mean < 2 * whole.overlap_distances.model_to_scan.mean + 0.2
    assert 0.3 < half.overlap_distances.model_seen_share < 0.6 < 0.98 < whole.overlap_distances.model_seen_share
