"""Known shapes, scanned on other triangles, come back: coefficients and vertices near the floor of the method."""

from pathlib import Path

import numpy as np
import pytest

from shapespace.datasets.ict import load_ict
from shapespace.datasets.simulated_scan import Hole, random_similarity, simulate_scan
from shapespace.fit.fit_scan import FitConfig, FitResult, fit_scan
from shapespace.fit.iteration_state import StopRule
from shapespace.fit.method_choices import method_named
from shapespace.fit.paper.paper_method import similarity_icp
from shapespace.geometry.closest import build_engine
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import blob_model, raw_scan, similarity

FACTORS = np.random.default_rng(11).uniform(-1.2, 1.2, (4, 5))


def errors_mm(model: ShapeModel, result: FitResult, truth: FloatArray) -> tuple[float, float]:
    """Return the mean vertex error, mm of the model, and its floor: the best the model can do with true matches."""
    scale = result.T_scan_model.scale
    fitted = np.linalg.norm(result.surface(model).vertices - truth, axis=1).mean() / scale
    best = model.reconstruct(model.project(truth))
    T = fit_similarity(truth, best)
    return float(fitted), float(np.linalg.norm(T.apply(truth) - best, axis=1).mean())


def upright_start(model: ShapeModel, scan: Mesh) -> Similarity:
    """Return a rigid start without rotation: what the plain method makes of it depends on nothing but itself."""
    shift = scan.vertices.mean(axis=0) - model.mean_vertices.mean(axis=0)
    centred = Similarity(1.0, np.eye(3), shift)
    states = similarity_icp(model, build_engine(scan), centred, StopRule(5e-4), with_scale=False)
    return [state.T_scan_model for state in states][-1]


@pytest.mark.parametrize(
    ("method", "search", "typical_mm", "worst_mm"),
    [("robust", None, 0.5, 1.0), ("paper", "vertices", 2.5, 6.0), ("paper", "surface", 0.8, 4.0)],
)
def test_known_blobs_are_recovered_from_noisy_scans(
    method: str, search: str | None, typical_mm: float, worst_mm: float
) -> None:
    model, T = blob_model(vertices=1500), similarity(1, 20.0, 0.9)
    errors, b_errors = [], []
    for z in FACTORS:
        raw = raw_scan(z, T, vertices=6000, model_vertices=1500, noise_mm=0.2)
        result = fit_scan(
            model,
            raw.scan,
            FitConfig(method_named(method, **({"search": search} if search else {})), unit="mm", max_iterations=150),
            T_scan_model=upright_start(model, raw.scan) if method == "paper" else None,
        )
        error, floor = errors_mm(model, result, raw.truth)
        errors.append(error - floor)
        assert result.status in ("converged", "max_iterations"), result.reason
        assert floor < 0.05
        assert result.distances.model_to_scan.mean < 0.5
        b_errors.append(np.sqrt((((result.b - model.project(raw.truth)) / model.stddev) ** 2).mean()))
        assert result.T_scan_model.scale == pytest.approx(0.9, rel=0.02)
    assert np.median(errors) < typical_mm
    # A blob is nearly round, so the worst one slides a little over itself.
    assert max(errors) < worst_mm
    assert np.median(b_errors) < 0.3
    assert max(b_errors) < 0.8


@pytest.fixture(scope="module")
def ict_model(shared_data: Path) -> ShapeModel:
    faces = load_ict(shared_data / "ict-facekit")
    return ShapeModel.fit([faces.mesh(c) for c in faces.draw_people(60, seed=0)], modes=15, gauge="form")


@pytest.mark.parametrize(("person", "measured_mm"), [(0, 2.15), (1, 1.86)])
def test_an_unseen_ict_face_is_recovered_from_a_scan_with_holes(
    ict_model: ShapeModel, shared_data: Path, person: int, measured_mm: float
) -> None:
    rng = np.random.default_rng(person)
    faces = load_ict(shared_data / "ict-facekit")
    face = faces.mesh(faces.draw_people(70, seed=0)[60 + person])
    scan = simulate_scan(
        face, rng, T_scan_model=random_similarity(rng, 15.0, (1.0, 1.0)), noise_mm=0.2, holes=(Hole(8.0),)
    )
    result = fit_scan(ict_model, scan.scan, FitConfig(unit="mm", max_iterations=60))
    error, floor = errors_mm(ict_model, result, scan.truth_vertices)
    mean_error = np.linalg.norm(result.surface(ict_model, "before").vertices - scan.truth_vertices, axis=1).mean()
    assert error < 0.5 * mean_error
    # The floors are 1.77 and 1.73 mm.
    assert floor < error < 1.05 * measured_mm
    assert result.distances.model_to_scan.mean < 1.5
