"""The joint posterior: never wider than the prior, wider where less is seen, and tempered as it says."""

from functools import cache

import numpy as np
import pytest

from shapespace.datasets.simulated_scan import Cut, simulate_scan
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import blob_model, raw_scan, similarity

B = np.array([0.5, -0.5, 1.0, 0.0, 0.3])


@cache
def fitted(*, cut: bool = False, noise_mm: float = 0.1) -> FitResult:
    model = blob_model()
    shape = model.mesh(B * model.stddev)
    crop = [Cut(np.median(shape.vertices, axis=0), (1.0, 0.2, 0.0))] if cut else []
    scan = simulate_scan(shape, np.random.default_rng(0), triangles=6_000, noise_mm=noise_mm, crop=crop).scan
    return fit_scan(model, scan, FitConfig())


def test_no_coefficient_is_less_certain_than_before_the_scan() -> None:
    prior = variance_of_new_shapes(blob_model())
    for result in (fitted(), fitted(cut=True), fitted(noise_mm=1.0)):
        assert (result.b_stddev > 0).all()
        assert (result.b_stddev**2 <= prior * (1 + 1e-12)).all()


def test_shrinkage_is_the_share_of_the_variance_that_the_scan_took_away() -> None:
    prior = variance_of_new_shapes(blob_model())
    for result in (fitted(), fitted(cut=True), fitted(noise_mm=1.0)):
        assert (result.shrinkage >= 0).all()
        assert (result.shrinkage <= 1).all()
        np.testing.assert_allclose(result.b_stddev**2, prior * (1.0 - result.shrinkage), rtol=1e-9)


@pytest.mark.parametrize("worse", [{"cut": True}, {"noise_mm": 1.0}])
def test_what_is_missing_or_noisy_is_known_less(worse: dict[str, float]) -> None:
    assert (fitted(**worse).b_stddev > fitted().b_stddev).all()
    assert fitted(**worse).evidence["expected_error_mm"] > fitted().evidence["expected_error_mm"]


def test_the_expected_error_is_about_the_error() -> None:
    model, result = blob_model(), fitted(noise_mm=1.0)
    truth = model.reconstruct(B * model.stddev)
    error = np.sqrt(((result.surface(model).vertices - truth) ** 2).sum(axis=1).mean())
    assert error / 3 < result.evidence["expected_error_mm"] < 3 * error


def test_the_paper_method_tells_shrinkage_too() -> None:
    model = blob_model()
    result = fit_scan(model, raw_scan(B, similarity(2, 10.0)).scan, FitConfig(method="paper", max_iterations=15))
    np.testing.assert_allclose(result.shrinkage, 1.0 - (result.b_stddev / model.stddev) ** 2)


def random_model(people: int, coordinates: int = 300) -> tuple[ShapeModel, np.ndarray]:
    """Return a model of people whose variances fall off like those of faces, and 400 others of the same kind."""
    rng = np.random.default_rng(3)
    spread = 50.0 * np.arange(1.0, coordinates + 1) ** -2.0
    shapes = spread * rng.standard_normal((people + 400, coordinates))
    place = rng.standard_normal((coordinates // 3, 3)) * 50
    meshes = [Mesh(place + shape.reshape(-1, 3)) for shape in shapes]
    return ShapeModel.fit(meshes[:people], align=False), np.stack([mesh.vertices for mesh in meshes[people:]])


@pytest.mark.parametrize("people", [30, 80])
def test_new_shapes_vary_as_foretold(people: int) -> None:
    model, others = random_model(people)
    b = np.stack([model.project(shape, align=False) for shape in others])
    seen = (b**2).mean(axis=0)
    ratio = seen / variance_of_new_shapes(model)
    last = slice(people // 2, None)
    # The model's own variances are far too small there.
    assert np.median(seen[last] / model.stddev[last] ** 2) > 3
    assert 0.8 < np.median(ratio[last]) < 1.25


def test_variances_of_models_of_many_shapes_stay() -> None:
    rng = np.random.default_rng(0)
    spread = np.array([9.0, 5.0, 3.0, 2.0, 1.0, 0.5])
    basis = np.linalg.qr(rng.standard_normal((60, 6)))[0]
    place = 50 * rng.standard_normal((20, 3))
    meshes = [Mesh(place + (basis @ (spread * rng.standard_normal(6))).reshape(-1, 3)) for _ in range(600)]
    model = ShapeModel.fit(meshes, align=False)
    new = variance_of_new_shapes(model)
    assert (new >= model.stddev**2).all()
    assert (new < 1.3 * model.stddev**2).all()
