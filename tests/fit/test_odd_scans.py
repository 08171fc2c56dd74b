"""Odd scans are doubted for what is odd about them, and their ordinary counterparts are not."""

from functools import cache

import numpy as np
import pytest

from shapespace.datasets.simulated_scan import simulate_scan
from shapespace.fit.diagnostics.odd_scans import chirality_of
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.fit.search.chirality import is_asymmetric
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob_model, sphere, training_meshes

FIRST, SECOND = np.array([0.5, -0.5, 1.0, 0.0, 0.3]), np.array([-0.8, 0.6, -0.5, 1.0, -1.2])
FLIP = np.array([-1.0, 1.0, 1.0])


def scanned(z: FloatArray = FIRST, *, noise_mm: float = 0.2, model: ShapeModel | None = None) -> Mesh:
    model = model or blob_model()
    shape = model.mesh(z[: model.n_modes] * model.stddev)
    return simulate_scan(shape, np.random.default_rng(0), triangles=6_000, noise_mm=noise_mm).scan


def mirrored(scan: Mesh) -> Mesh:
    return Mesh(scan.vertices * FLIP, scan.faces[:, ::-1], name="mirrored")


def together(one: Mesh, two: Mesh) -> Mesh:
    faces = np.concatenate([one.faces, two.faces + len(one.vertices)]).astype(np.int32)
    return Mesh(np.concatenate([one.vertices, two.vertices]), faces)


@cache
def symmetric_model() -> ShapeModel:
    d, faces = sphere(500)
    d = np.concatenate([d, d * FLIP])[np.concatenate([d[:, 0] > 0, d[:, 0] > 0])]
    from scipy.spatial import ConvexHull

    faces = ConvexHull(d).simplices
    a, b, c = (d[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    rng = np.random.default_rng(0)
    size, nose = np.array([60.0, 100.0, 80.0]), np.exp((d[:, 2:] - 1) / 0.05)
    meshes = [
        Mesh(d * size * np.exp(0.08 * rng.standard_normal(3)) * (1 + (0.3 + 0.1 * rng.standard_normal()) * nose),
             faces.astype(np.int32)) for _ in range(15)
    ]  # fmt: skip
    return ShapeModel.fit(meshes)


def test_a_mirrored_scan_of_an_asymmetric_shape_is_doubted_and_the_scan_itself_is_not() -> None:
    model = blob_model()
    assert is_asymmetric(model)
    right, wrong = fit_scan(model, scanned()), fit_scan(model, mirrored(scanned()))
    assert (right.status, right.chirality) == ("converged", "as scanned")
    assert (wrong.status, wrong.chirality) == ("doubtful", "mirrored")
    assert "mirror the scan" in wrong.reason
    assert fit_scan(model, mirrored(mirrored(scanned()))).chirality == "as scanned"


def test_a_symmetric_model_leaves_the_chirality_undecidable_and_doubts_nothing() -> None:
    model = symmetric_model()
    assert not is_asymmetric(model)
    scan = scanned(model=model, z=np.array([0.5, -0.5, 1.0, 0.3, 0.0, 0.0]))
    for each in (scan, mirrored(scan)):
        result = fit_scan(model, each)
        assert (result.status, result.chirality) == ("converged", "undecidable"), result.reason
        assert result.evidence.mirrored_log_odds is None


@pytest.mark.parametrize(
    ("log_odds", "bound", "decided"),
    [
        (4.9, -20.0, "undecidable"), (-4.9, None, "undecidable"), (5.1, -20.0, "mirrored"), (-5.1, None, "as scanned"),
        (5.1, 5.2, "undecidable"), (50.0, None, "undecidable"), (50.0, 49.0, "mirrored"),
    ],
)  # fmt: skip
def test_chirality_is_decided_by_odds_of_150_to_1_and_more_than_those_of_training_shapes(
    log_odds: float, bound: float | None, decided: str
) -> None:
    assert chirality_of(log_odds, bound) == decided


def test_halves_of_different_scale_are_doubted() -> None:
    scan = scanned()
    far = scan.vertices[:, [1]] > 0
    odd = fit_scan(blob_model(), scan.with_vertices(np.where(far, 1.2, 1.0) * scan.vertices))
    assert odd.status == "doubtful" and "runs along the fitted surface" in odd.reason


def test_two_overlapping_instances_are_doubted() -> None:
    second = scanned(SECOND)
    odd = fit_scan(
        blob_model(), together(scanned(), second.with_vertices(second.vertices + np.array([50.0, 20.0, 20.0])))
    )
    assert odd.status == "doubtful" and "overlapping instances" in odd.reason
    assert odd.evidence.second_instance_gap_mm < 0


def test_strong_noise_is_doubted() -> None:
    assert fit_scan(blob_model(), scanned(noise_mm=9.0)).status == "doubtful"


def of_few_shapes(scan: Mesh) -> FitResult:
    return fit_scan(ShapeModel.fit(list(training_meshes(3))), scan, FitConfig(unit="mm"))


def test_a_shape_outside_a_model_of_three_is_doubted_and_one_inside_is_not() -> None:
    few = ShapeModel.fit(list(training_meshes(3)))
    inside = scanned(np.array([0.5, -0.5]), model=few)
    assert of_few_shapes(inside).status == "converged"
    odd = of_few_shapes(scanned(SECOND))
    assert odd.status == "doubtful" and "made of 3 shapes" in odd.reason
