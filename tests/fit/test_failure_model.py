"""The failure model doubts wrong fits by name, trusts right ones, and expects an error near the truth."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from shapespace.datasets.simulated_scan import Cut, simulate_scan
from shapespace.fit.diagnostics.failure_model import (
    ERROR_TERMS,
    SCORE_TERMS,
    FitEvidence,
    estimate_error,
    failure_score,
    find_failure_reasons,
)
from shapespace.fit.diagnostics.reasons import ReasonCode, text_of
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.fit.robust.posterior import lack_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import blob_model, training_meshes

GOOD = FitEvidence(
    size_mm=80.0, seen_share=0.5, model_matched_share=0.7, model_allowed_share=0.9, scan_allowed_share=0.94,
    scan_near_share=0.9, model_near_share=0.92, z2=1.0, z2_leading=1.0, log_scale=0.0, spread_mm=0.55,
    beyond_model_mm=0.1, left_out_mm=0.1, model_spread_mm=6.0, model_lack_mm=0.5, posterior_error_mm=0.9,
    training_shapes=40.0, start_score_mm=1.0, start_runner_up_score_mm=2.0, layered_share=0.0, layers_apart_mm=0.0,
    displaced_share=0.0, displaced_inward_share=0.0, displaced_purity=0.0, scattered_share=0.0,
    expected_error_mm=0.9, error_low_mm=0.5, error_high_mm=2.0, failure_probability=0.01,
)  # fmt: skip
LENGTHS = [name for name in GOOD.to_dict() if name.endswith("_mm")]
SCORED = (
    "posterior_error_mm", "size_mm", "spread_mm", "model_near_share", "seen_share", "scan_allowed_share",
    "model_matched_share", "z2", "z2_leading", "log_scale",
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "code", "text"),
    [
        ("posterior_error_mm", 6.0, ReasonCode.EXPECTED_ERROR, "6.0 mm off"),
        ("spread_mm", 8.0, ReasonCode.RESIDUAL_SPREAD, "8.0 mm apart"),
        ("model_near_share", 0.03, ReasonCode.MODEL_FAR_FROM_SCAN, "3 % of the model has"),
        ("seen_share", 0.02, ReasonCode.MODEL_UNSEEN, "2 % of the model's vertices"),
        ("z2", 16.0, ReasonCode.MODEL_TOO_NARROW, "4.0 standard deviations"),
        ("log_scale", np.log(3.0), ReasonCode.SCALE_IMPLAUSIBLE, "3.00 times"),
    ],
)
def test_each_fault_alone_is_doubted_and_named_first(name: str, value: float, code: ReasonCode, text: str) -> None:
    assert find_failure_reasons(GOOD) == []
    first = find_failure_reasons(replace(GOOD, **{"expected_error_mm": 6.0, name: value}))[0]
    assert first.code == code and text in text_of(first.code, first.data)


def test_worse_evidence_never_makes_a_fit_more_trusted() -> None:
    for name in SCORED:
        worse = -1 if name.endswith("_share") or name == "size_mm" else 1
        values = [getattr(GOOD, name) * 2.0 ** (worse * k) + (0.2 * k if name == "log_scale" else 0) for k in range(4)]
        steps = [failure_score(replace(GOOD, **{name: value})) for value in values]
        assert (np.diff(steps) > 0).all(), name


def test_a_shape_near_the_mean_makes_up_for_nothing() -> None:
    # Where hardly anything matched, the shape stays at the mean.
    assert find_failure_reasons(
        replace(GOOD, posterior_error_mm=12.0, expected_error_mm=12.0, z2=1e-5, z2_leading=1e-5)
    )


@pytest.mark.parametrize(("probability", "doubted"), [(0.49, False), (0.59, True)])
def test_a_fit_that_has_probably_failed_is_doubted(probability: float, doubted: bool) -> None:
    codes = [reason.code for reason in find_failure_reasons(replace(GOOD, failure_probability=probability))]
    assert codes == [ReasonCode.PROBABLY_FAILED] * doubted


@pytest.mark.parametrize(
    ("name", "worse"),
    [
        ("posterior_error_mm", 2.0), ("spread_mm", 2.0), ("model_spread_mm", 0.02), ("model_lack_mm", 3.0),
        ("z2", 9.0), ("layered_share", 0.3),
    ],
)  # fmt: skip
def test_worse_evidence_never_makes_the_expected_error_smaller(name: str, worse: float) -> None:
    good, bad = estimate_error(GOOD), estimate_error(replace(GOOD, **{name: worse}))
    assert all(b >= g for g, b in zip(astuple(good), astuple(bad), strict=True))
    assert all(term.weight >= 0 for term in (*ERROR_TERMS.values(), *SCORE_TERMS))


def test_the_interval_holds_the_expected_error_and_every_figure_is_free_of_units() -> None:
    estimate = estimate_error(GOOD)
    assert 0 < estimate.error_low_mm < estimate.expected_error_mm < estimate.error_high_mm
    assert 0 < estimate.failure_probability < 1
    larger = estimate_error(replace(GOOD, **{name: 10 * getattr(GOOD, name) for name in LENGTHS}))
    np.testing.assert_allclose(larger.expected_error_mm, 10 * estimate.expected_error_mm)
    np.testing.assert_allclose(larger.failure_probability, estimate.failure_probability)


def test_evidence_of_nothing_at_all_still_gives_figures() -> None:
    worst = replace(GOOD, posterior_error_mm=1e9, spread_mm=1e6, z2=1e12)
    assert estimate_error(worst).expected_error_mm == worst.size_mm
    best = FitEvidence(**(dict.fromkeys(GOOD.to_dict(), 0.0) | {"size_mm": 80.0}))
    assert np.isfinite(astuple(estimate_error(best))).all()


def cut_blob(*, missing: bool) -> Mesh:
    model = blob_model()
    shape = model.mesh(np.array([0.5, -0.5, 1.0, 0.0, 0.3]) * model.stddev)
    crop = [Cut(np.median(shape.vertices, axis=0) + np.array([12.0, 0.0, 0.0]), (1.0, 0.2, 0.0))] if missing else []
    return simulate_scan(shape, np.random.default_rng(0), triangles=6_000, noise_mm=0.2, crop=crop).scan


def fitted(scan: Mesh) -> FitResult:
    return fit_scan(blob_model(), scan, FitConfig())


@pytest.mark.parametrize("missing", [False, True])
def test_a_good_fit_is_trusted(missing: bool) -> None:
    result = fitted(cut_blob(missing=missing))
    assert result.status == "converged", result.reason
    values = result.evidence.to_dict()
    assert all(np.isfinite(value) for name, value in values.items() if not name.startswith("start"))


def test_a_box_is_doubted() -> None:
    n = 40
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(-80, 80, n), np.linspace(-80, 80, n)))
    flat = np.stack([u, v, np.full_like(u, 80.0)], axis=1)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    grid = np.concatenate(
        [np.stack([corner, corner + 1, corner + n], 1), np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    )
    sides = np.concatenate([flat, flat[:, [2, 0, 1]], flat[:, [1, 2, 0]]])
    faces = np.concatenate([grid + k * n * n for k in range(3)]).astype(np.int32)
    result = fitted(Mesh(sides, faces, name="box"))
    assert result.status == "doubtful"
    assert result.reason.startswith("Do not trust this fit: ")


@pytest.mark.parametrize(("width", "noise_mm"), [(1.0, 0.1), (1.0, 1.0), (1.0, 3.0), (1e-2, 0.3), (1e-3, 1.0)])
def test_the_expected_error_is_near_the_truth_for_noise_and_for_models_far_too_narrow(
    width: float, noise_mm: float
) -> None:
    whole = blob_model()
    model = replace(whole, stddev=width * whole.stddev, total_variance=width**2 * whole.total_variance)
    shape = whole.mesh(np.array([0.5, -0.5, 1.0, 0.0, 0.3]) * whole.stddev)
    result = fit_scan(model, simulate_scan(shape, np.random.default_rng(0), triangles=6_000, noise_mm=noise_mm).scan)
    error = float(np.linalg.norm(result.surface().vertices - shape.vertices, axis=1).mean())
    evidence = result.evidence
    assert error / 4 < evidence.expected_error_mm < 4 * error
    if width < 1.0:
        assert evidence.posterior_error_mm < error / 4


def test_the_lack_of_a_model_is_how_far_shapes_left_out_lie_outside_it() -> None:
    meshes = [m.with_vertices(m.vertices + np.random.default_rng(k).normal(0, 0.5, m.vertices.shape))
              for k, m in enumerate(training_meshes(12))]  # fmt: skip
    outside = []
    for k, mesh in enumerate(meshes):
        model = ShapeModel.fit(meshes[:k] + meshes[k + 1 :], align=False)
        left = model.reconstruct(model.project(mesh, align=False)) - mesh.vertices
        outside.append((left**2).sum() / len(left))
    predicted = lack_of_new_shapes(ShapeModel.fit(meshes, align=False))
    np.testing.assert_allclose(predicted, np.sqrt(np.mean(outside)), rtol=0.1)
