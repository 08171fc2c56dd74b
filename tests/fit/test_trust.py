"""The verdict on robust fits: doubts what is wrong, in words that name why, and trusts what is right."""

from collections.abc import Mapping

import numpy as np
import pytest

from shapespace.datasets.simulated_scan import Cut, simulate_scan
from shapespace.fit.diagnostics.trust import doubts_of_robust, score
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.types import Mesh
from synthetic_shapes import blob_model

GOOD: Mapping[str, float] = {
    "posterior_error_mm": 0.9, "size_mm": 80.0, "spread_mm": 0.55, "model_near_share": 0.92, "seen_share": 0.5,
    "scan_allowed_share": 0.94, "model_matched_share": 0.7,
    "z2": 1.0, "z2_leading": 1.0, "log_scale": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("posterior_error_mm", 6.0, "6.0 mm off"),
        ("spread_mm", 8.0, "8.0 mm apart"),
        ("model_near_share", 0.03, "3 % of the model has"),
        ("seen_share", 0.02, "2 % of the model's vertices"),
        ("z2", 16.0, "4.0 standard deviations"),
        ("log_scale", np.log(3.0), "3.00 times"),
    ],
)
def test_each_fault_alone_is_doubted_and_named_first(name: str, value: float, said: str) -> None:
    assert doubts_of_robust(GOOD) == []
    assert said in doubts_of_robust({"expected_error_mm": 6.0, **GOOD, name: value})[0]


def test_worse_evidence_never_makes_a_fit_more_trusted() -> None:
    for name in GOOD:
        worse = (
            -1
            if name in ("model_near_share", "seen_share", "scan_allowed_share", "model_matched_share", "size_mm")
            else 1
        )
        steps = [score({**GOOD, name: GOOD[name] * 2.0 ** (worse * k) + (0.2 * k if name == "log_scale" else 0)})
                 for k in range(4)]  # fmt: skip
        assert (np.diff(steps) > 0).all(), name


def test_a_shape_near_the_mean_makes_up_for_nothing() -> None:
    # Where hardly anything matched, the shape stays at the mean.
    assert doubts_of_robust(
        {**GOOD, "posterior_error_mm": 12.0, "expected_error_mm": 12.0, "z2": 1e-5, "z2_leading": 1e-5}
    )


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
    assert all(np.isfinite(value) for name, value in result.evidence.items() if not name.startswith("start"))


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
