"""Odd scans are doubted for what is odd about them, and their ordinary counterparts are not."""

from collections.abc import Callable
from dataclasses import astuple, replace
from functools import cache

import numpy as np
import pytest
from test_failure_model import GOOD

from shapespace.datasets.simulated_scan import simulate_scan
from shapespace.fit.diagnostics.failure_model import FitEvidence, chirality_of, find_odd_scan_reasons, with_mirror_image
from shapespace.fit.diagnostics.reasons import Reason, ReasonCode, text_of
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import RobustFitted, last_of
from shapespace.fit.method import FitOutcome
from shapespace.fit.result import FitResult
from shapespace.fit.robust.robust_icp import robust_icp
from shapespace.fit.robust.robust_method import Robust
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.chirality import is_asymmetric
from shapespace.fit.search.initialisation import Start
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity
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


def test_a_scan_is_called_mirrored_only_by_a_model_with_its_training_shapes() -> None:
    without = fit_scan(replace(blob_model(), training=None), mirrored(scanned()))
    assert (without.status, without.chirality) == ("doubtful", "undecidable")
    assert "the scan may be mirrored" in without.reason and "mirror the scan" not in without.reason


def converged(evidence: FitEvidence) -> Reason:
    fitted = replace(last_fit(), evidence=evidence)
    return Robust().reason(
        FitOutcome(blob_model(), Start(Similarity.identity(), "given", np.nan), fitted, {}, {}, 80.0)
    )


@cache
def last_fit() -> RobustFitted:
    start = Start(Similarity.identity(), "given", np.nan)
    return last_of(robust_icp(blob_model(), ScanTarget(scanned()), start, RobustSettings()))


@pytest.mark.parametrize(
    ("log_odds", "expected_mm", "high_mm", "doubted"),
    [(-4.0, 0.9, 2.0, False), (-1.0, 0.9, 58.7, False), (1.0, 58.7, 58.7, True), (4.0, 58.7, 58.7, True)],
)
def test_an_undecidable_side_is_stated_and_its_exchange_is_part_of_the_expected_error(
    log_odds: float, expected_mm: float, high_mm: float, doubted: bool
) -> None:
    evidence = with_mirror_image(replace(GOOD, mirrored_log_odds=log_odds, mirrored_apart_mm=58.7))
    assert (evidence.expected_error_mm, evidence.error_high_mm) == (expected_mm, high_mm)
    reasons = find_odd_scan_reasons(evidence)
    assert [reason.code for reason in reasons] == [ReasonCode.SCAN_MAY_BE_MIRRORED] * doubted
    reason = reasons[0] if doubted else converged(evidence)
    text = text_of(reason.code, reason.data)
    assert "mirrored, the vertices are 58.7 mm off" in text and "mirror the scan" not in text
    assert "mirrored" not in text_of(*astuple(converged(replace(GOOD, mirrored_log_odds=-9.6))))


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


@pytest.mark.parametrize("moved", [lambda x: x + np.array([0.0, 15.0, 0.0]), lambda x: 1.2 * x])
def test_a_displaced_part_is_stated_if_a_similarity_moves_it_onto_the_surface(
    moved: Callable[[FloatArray], FloatArray],
) -> None:
    scan = scanned()
    part = scan.vertices[:, [1]] > 60.0
    odd = fit_scan(blob_model(), scan.with_vertices(np.where(part, moved(scan.vertices), scan.vertices)))
    assert [reason.code for reason in odd.reasons] == [ReasonCode.PARTS_DISPLACED]
    assert "check how the scan was assembled" in odd.reason


@pytest.mark.parametrize(("height", "width_mm"), [(0.25, 12.0), (0.35, 20.0), (0.25, 40.0)])
def test_a_part_that_the_model_does_not_explain_is_not_called_wrongly_assembled(height: float, width_mm: float) -> None:
    scan = scanned()
    x, y, _ = scan.vertices.T
    factor = 1.0 + height * np.clip(y / 60.0 - 0.7, 0.0, 1.0) * np.cos(x / width_mm)
    bent = factor[:, None] * scan.vertices
    odd = fit_scan(blob_model(), scan.with_vertices(bent))
    assert [reason.code for reason in odd.reasons] == [ReasonCode.PARTS_UNEXPLAINED]
    assert "assembled" not in odd.reason


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
