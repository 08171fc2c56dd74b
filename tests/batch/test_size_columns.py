"""What the table says of size and of how far modes move the surface, beside what the surface itself says."""

from typing import Any

import numpy as np
import pytest

from shapespace.batch.fit_records import coefficient_row, fit_record
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.geometry.normals import face_areas
from shapespace.schemas import File
from shapespace.store.rows import coefficient_columns
from shapespace.types import Mesh
from synthetic_shapes import blob_model, raw_scan, similarity

MODEL = blob_model(700)
Fitted = tuple[FitResult, Mesh, dict[str, Any]]


@pytest.fixture(scope="module", params=[1.0, 0.001])
def fitted(request: pytest.FixtureRequest) -> Fitted:
    """A fit of a scan in mm or in metres, in mm of the scan, and its row of the table."""
    raw = raw_scan(np.array([1.0, -0.5, 0.5, 0.8, -0.3]), similarity(1, 20.0, 1.1), noise_mm=0.1)
    scan = raw.scan.with_vertices(request.param * raw.scan.vertices)
    result = fit_scan(MODEL, scan, FitConfig())
    record = fit_record(result, File(name="scan.ply", hash="0" * 64), File(name="m.h5", hash=MODEL.content_hash))
    return (
        result,
        result.surface().with_vertices(result.surface().vertices / request.param),
        coefficient_row("x", record),
    )


def test_sizes_are_those_of_the_fitted_surface_in_mm_of_the_scan(fitted: Fitted) -> None:
    _, surface, row = fitted
    x = surface.vertices - surface.vertices.mean(axis=0)
    assert row["centroid_size_mm"] == pytest.approx(np.sqrt((x**2).sum()))
    assert row["size_mm"] == pytest.approx(row["centroid_size_mm"] / np.sqrt(len(x)))
    assert row["area_mm2"] == pytest.approx(face_areas(surface).sum())
    # A blob of 140 x 200 x 170 mm with a nose, 1.1 times as large.
    assert 200 < row["length_mm"] < 260 and row["length_mm"] > row["width_mm"] > row["depth_mm"] > 140
    assert row["scale"] != pytest.approx(1.0, abs=0.05), "the scale is that of the pose, as it was fitted"


def test_rms_columns_are_how_far_each_mode_moves_a_vertex(fitted: Fitted) -> None:
    result, _, row = fitted
    scan_mm_per_model_mm = result.T_scan_model.scale * result.mm_per_scan_unit
    for k in range(MODEL.n_modes):
        b = np.zeros(MODEL.n_modes)
        b[k] = result.b[k]
        moved = np.sqrt(((MODEL.reconstruct(b) - MODEL.mean_vertices) ** 2).sum(axis=1).mean())
        assert row[f"b{k + 1}_rms_mm"] == pytest.approx(scan_mm_per_model_mm * moved)
    every = np.sqrt(((MODEL.reconstruct(result.b) - MODEL.mean_vertices) ** 2).sum(axis=1).mean())
    assert row["shape_rms_mm"] == pytest.approx(scan_mm_per_model_mm * every)
    columns = coefficient_columns(MODEL.n_modes)
    assert set(row) - {"reason"} <= set(columns) and columns[-1] == "model_hash"
