"""How far off a fit says it is: more where the evidence is worse, free of units, near the truth where it is hard."""

from collections.abc import Mapping
from dataclasses import astuple, replace

import numpy as np
import pytest

from shapespace.datasets.simulated_scan import simulate_scan
from shapespace.fit.diagnostics.reliability import INPUTS, WEIGHTS, reliability
from shapespace.fit.fit_scan import fit_scan
from shapespace.fit.robust.posterior import lack_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model, training_meshes

EVIDENCE: Mapping[str, float] = {
    "posterior_error_mm": 0.5, "size_mm": 80.0, "spread_mm": 0.4, "model_spread_mm": 6.0, "model_lack_mm": 0.5,
    "z2": 1.0, "layered_share": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "worse"),
    [
        ("posterior_error_mm", 2.0), ("spread_mm", 2.0), ("model_spread_mm", 0.02), ("model_lack_mm", 3.0),
        ("z2", 9.0), ("layered_share", 0.3),
    ],
)  # fmt: skip
def test_worse_evidence_never_makes_the_expected_error_smaller(name: str, worse: float) -> None:
    good, bad = reliability(EVIDENCE), reliability({**EVIDENCE, name: worse})
    assert all(b >= g for g, b in zip(astuple(good), astuple(bad), strict=True))
    assert all(weight >= 0 for weight in WEIGHTS.values()) and set(WEIGHTS) == set(INPUTS)


def test_the_interval_holds_the_expected_error_and_every_figure_is_free_of_units() -> None:
    told = reliability(EVIDENCE)
    assert 0 < told.error_low_mm < told.expected_error_mm < told.error_high_mm
    assert 0 < told.failure_probability < 1
    larger = reliability({k: 10 * v if k.endswith("_mm") else v for k, v in EVIDENCE.items()})
    np.testing.assert_allclose(larger.expected_error_mm, 10 * told.expected_error_mm)
    np.testing.assert_allclose(larger.failure_probability, told.failure_probability)


def test_evidence_of_nothing_at_all_still_gives_figures() -> None:
    worst = {**EVIDENCE, "posterior_error_mm": 1e9, "spread_mm": 1e6, "z2": 1e12}
    assert reliability(worst).expected_error_mm == worst["size_mm"]
    best = dict.fromkeys(EVIDENCE, 0.0) | {"size_mm": 80.0}
    assert np.isfinite(astuple(reliability(best))).all()


@pytest.mark.parametrize(("width", "noise_mm"), [(1.0, 0.1), (1.0, 1.0), (1.0, 3.0), (1e-2, 0.3), (1e-3, 1.0)])
def test_the_expected_error_is_near_the_truth_for_noise_and_for_models_far_too_narrow(
    width: float, noise_mm: float
) -> None:
    whole = blob_model()
    model = replace(whole, stddev=width * whole.stddev, total_variance=width**2 * whole.total_variance)
    shape = whole.mesh(np.array([0.5, -0.5, 1.0, 0.0, 0.3]) * whole.stddev)
    result = fit_scan(model, simulate_scan(shape, np.random.default_rng(0), triangles=6_000, noise_mm=noise_mm).scan)
    error = float(np.linalg.norm(result.surface().vertices - shape.vertices, axis=1).mean())
    told = result.evidence
    assert error / 4 < told["expected_error_mm"] < 4 * error
    if width < 1.0:
        assert told["posterior_error_mm"] < error / 4


def test_the_lack_of_a_model_is_how_far_shapes_left_out_lie_outside_it() -> None:
    meshes = [m.with_vertices(m.vertices + np.random.default_rng(k).normal(0, 0.5, m.vertices.shape))
              for k, m in enumerate(training_meshes(12))]  # fmt: skip
    outside = []
    for k, mesh in enumerate(meshes):
        model = ShapeModel.fit(meshes[:k] + meshes[k + 1 :], align=False)
        left = model.reconstruct(model.project(mesh, align=False)) - mesh.vertices
        outside.append((left**2).sum() / len(left))
    told = lack_of_new_shapes(ShapeModel.fit(meshes, align=False))
    np.testing.assert_allclose(told, np.sqrt(np.mean(outside)), rtol=0.1)
