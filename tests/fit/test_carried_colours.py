"""The fitted surface takes the scan's colour at its closest point where it follows the scan, and is grey elsewhere."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from shapespace.batch.fit_records import write_fitted_mesh
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import MATCHED
from shapespace.fit.result import FitResult, carried_colours, stage_arrays
from shapespace.geometry.closest import build_engine
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.report.inputs.saved_fits import StagedFit
from shapespace.report.render.scene import pack_fit
from shapespace.types import GREY, FloatArray, Mesh
from synthetic_shapes import blob_model, raw_scan, similarity

Z = np.array([0.5, -1.0, 0.8, -0.6, 0.7])


def shade(points: FloatArray) -> np.ndarray:
    """Return a colour that tells where on the scan a point lies."""
    return np.clip(128 + points, 0, 255).astype(np.uint8)


@cache
def fitted(points_only: bool = False) -> FitResult:
    raw = raw_scan(Z, similarity(scale=1.0, shift=0.0), keep=-0.5)
    scan = Mesh(raw.scan.vertices, None if points_only else raw.scan.faces, colours=shade(raw.scan.vertices))
    return fit_scan(blob_model(), scan, FitConfig(unit="mm", dense=not points_only))


def test_a_vertex_has_the_colour_of_where_it_lies() -> None:
    for points_only, apart in ((False, 4), (True, 12)):
        result = fitted(points_only)
        for stage in result.colours:
            surface = result.surface(stage=stage)
            seen = np.isin(result.regions, MATCHED) if stage == "final" else result.stages[stage].seen
            assert 0.5 < seen.mean() < 0.95
            away = np.abs(surface.colours[seen].astype(int) - shade(surface.vertices[seen]).astype(int))
            assert np.percentile(away, 95) < apart
            assert (surface.colours[~seen] == GREY).all()


def test_between_vertices_the_colour_is_between_theirs() -> None:
    scan = Mesh(np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
    colours = np.array([[0, 0, 0], [200, 0, 0], [0, 100, 0]], dtype=np.uint8)
    at = build_engine(scan).query(np.array([[1.0, 2.0, 3.0], [4, 0, 0], [0, 0, 0]]))
    seen = np.array([True, True, False])
    assert np.array_equal(carried_colours(colours, scan, at, seen), [[50, 50, 0], [200, 0, 0], [GREY] * 3])


def test_files_and_pictures_have_the_colours(tmp_path: Path) -> None:
    result = fitted()
    for stage in ("final", "dense"):
        write_fitted_mesh(tmp_path / "a.ply", result, result.model, stage)
        assert np.array_equal(read_mesh(tmp_path / "a.ply").colours, result.colours[stage])
    staged = StagedFit.of(result.model, result)
    assert np.array_equal(staged.scan.colours, result.scan.colours)
    assert {name for name, mesh in staged.surfaces.items() if mesh.colours is not None} == {"final", "dense"}
    packed, thin = pack_fit(staged), pack_fit(staged, largest_scan=300)
    for name in (b'"scan_colours"', b'"colours_final"', b'"colours_dense"'):
        assert name in packed and name in thin


def test_a_scan_without_colours_leaves_no_trace() -> None:
    raw = raw_scan(Z, vertices=800)
    plain = fit_scan(blob_model(), raw.scan, FitConfig(unit="mm"))
    assert not plain.colours and plain.surface().colours is None
    arrays = stage_arrays(plain, plain.model)
    assert not any("colours" in name for name in arrays)
    assert b"colours" not in pack_fit(StagedFit.of(plain.model, plain))
    painted = fit_scan(blob_model(), replace(raw.scan, colours=shade(raw.scan.vertices)), FitConfig(unit="mm"))
    assert np.array_equal(painted.b, plain.b) and painted.notes == plain.notes
    with_colours = stage_arrays(painted, painted.model)
    assert all(np.array_equal(with_colours[name], values, equal_nan=True) for name, values in arrays.items())


def test_what_the_reader_said_is_in_the_notes() -> None:
    raw = raw_scan(Z, vertices=800)
    result = fit_scan(blob_model(), replace(raw.scan, notes=("It is read without its colours.",)), FitConfig(unit="mm"))
    assert result.notes[0] == "It is read without its colours."
