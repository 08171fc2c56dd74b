import csv
import errno
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from scipy.spatial.transform import Rotation

from shapespace.batch.fit_records import (
    coefficient_row,
    failed_record,
    fit_record,
    read_record,
    source_of,
    write_coefficients,
    write_fitted_mesh,
    write_record,
    write_stages,
)
from shapespace.batch.result_folder import names_for
from shapespace.errors import FileError, FileFormatError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import SHOWN
from shapespace.fit.result import FitResult
from shapespace.geometry.closest import build_engine
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.schemas import File
from shapespace.types import Mesh
from synthetic_shapes import blob_model, raw_scan, similarity

SCAN, MODEL = File(name="raw.ply", hash="a" * 64), File(name="blob.h5", hash="b" * 64)
SUMMARY = {"mean", "median", "rms", "p95", "max", "count"}


@pytest.fixture(scope="module")
def result() -> FitResult:
    scan = raw_scan(np.array([0.5, -0.5, 1.0, 0.0, 0.3]), similarity(2, 10.0, 0.001)).scan
    return fit_scan(blob_model(), scan, FitConfig(max_iterations=15))


def test_the_record_has_the_keys_of_the_contract(result: FitResult) -> None:
    record = fit_record(result, SCAN, MODEL).to_json()
    assert {
        "scan", "model", "status", "reason", "method", "config", "T_scan_model", "mm_per_scan_unit", "b", "z",
        "b_stddev", "distances_mm", "history", "iterations", "seconds",
    } <= set(record)  # fmt: skip
    assert record["scan"] == {"name": "raw.ply", "hash": "a" * 64}
    assert set(record["T_scan_model"]) == {"scale", "rotation", "translation"}
    assert set(record["distances_mm"]) == {"before", "initial", "final"}
    for stage in record["distances_mm"].values():
        assert set(stage) == {"model_to_scan", "scan_to_model"}
        for direction in stage.values():
            assert set(direction) >= SUMMARY
    assert len(record["b"]) == len(record["z"]) == len(record["b_stddev"]) == 5
    assert record["config"]["seed"] == 0
    assert record["config"]["version"]
    assert {(h["phase"], h["iteration"]) for h in record["history"]} >= {(1, 0), (2, 0)}
    assert set(record["iterations"]) <= set(record["seconds"])


def test_the_pose_in_the_record_maps_the_model_onto_the_scan(result: FitResult, tmp_path: Path) -> None:
    write_record(tmp_path / "r.fit.json", fit_record(result, SCAN, MODEL))
    T = read_record(tmp_path / "r.fit.json").T_scan_model
    model_points = blob_model().reconstruct(result.b)
    placed = T.scale * model_points @ np.array(T.rotation).T + T.translation
    write_fitted_mesh(tmp_path / "r.fitted.ply", result, blob_model())
    fitted = read_mesh(tmp_path / "r.fitted.ply")
    assert np.allclose(fitted.vertices, placed, atol=1e-12)
    assert np.array_equal(fitted.faces, blob_model().faces)


def strict(text: str) -> object:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    return json.loads(text, parse_constant=refuse)


def test_numbers_that_are_not_finite_become_null(tmp_path: Path, result: FitResult) -> None:
    record = fit_record(result, SCAN, MODEL)
    assert not math.isfinite(record.history[0].motion_mm)
    write_record(tmp_path / "r.fit.json", structs.replace(record, config={"extra": [float("nan"), (1.0, -math.inf)]}))
    text = (tmp_path / "r.fit.json").read_text()
    assert strict(text)["config"]["extra"] == [None, [1.0, None]]
    assert strict(text)["history"][0]["motion_mm"] is None
    assert np.allclose(read_record(tmp_path / "r.fit.json").b, result.b, rtol=0, atol=0)


def test_the_table_has_the_columns_of_the_contract_in_order(tmp_path: Path, result: FitResult) -> None:
    good = coefficient_row("one", fit_record(result, SCAN, MODEL))
    bad = coefficient_row("two", failed_record(SCAN, MODEL, "two.ply is empty, so re-export it.", {}))
    write_coefficients(tmp_path / "c.csv", [good, bad], 5)
    with (tmp_path / "c.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
        stream.seek(0)
        header = next(csv.reader(stream))
    modes = [f"b{k}" for k in range(1, 6)] + [f"z{k}" for k in range(1, 6)]
    assert header[:15] == ["scan", "status", "reason", *modes, "model_to_scan_mean_mm", "scan_to_model_mean_mm"]
    assert len(header) == len(set(header))
    assert float(rows[0]["b3"]) == result.b[2]
    assert float(rows[0]["z3"]) == result.z[2]
    assert float(rows[0]["model_to_scan_mean_mm"]) == result.distances.model_to_scan.mean
    assert (rows[1]["status"], rows[1]["reason"]) == ("failed", "two.ply is empty, so re-export it.")
    assert header[-1] == "model_hash"
    assert {row["model_hash"] for row in rows} == {MODEL.hash}
    assert all(not rows[1][name] for name in header[3:-1] if name != "checksum")
    assert rows[0]["checksum"] != rows[1]["checksum"]


def test_distances_over_the_overlap_are_in_millimetres_of_the_scan(tmp_path: Path) -> None:
    half = raw_scan(np.array([0.5, -0.5, 1.0, 0.0, 0.3]), similarity(2, 10.0, 1.3), keep=0.0, noise_mm=0.1).scan
    fit = fit_scan(blob_model(), half, FitConfig())
    typed = fit_record(fit, SCAN, MODEL)
    record = typed.to_json()
    shown = record["shown"]
    assert 0.3 < shown["model_seen_share"] < 0.7 and shown["scan_covered_share"] > 0.8
    # Half of the model lies where the scan shows nothing, which is no fault of the fit.
    every = record["distances_mm"]["final"]["model_to_scan"]
    assert shown["model_to_scan"]["mean"] < 0.2 * every["mean"] and shown["model_to_scan"]["count"] < every["count"]
    size = fit.T_scan_model.scale * fit.mm_per_scan_unit
    assert not 0.95 < size < 1.05
    for direction in ("model_to_scan", "scan_to_model"):
        assert set(shown[direction]) == {*SUMMARY, "fraction"}
    surface = fit.surface().vertices[np.isin(fit.regions, SHOWN)]
    nearest_mm = build_engine(half).query(surface).distance * fit.mm_per_scan_unit
    assert shown["model_to_scan"]["mean"] == pytest.approx(nearest_mm.mean())
    row = coefficient_row("one", typed)
    for direction in ("model_to_scan", "scan_to_model"):
        for measure in ("mean", "median"):
            assert row[f"shown_{direction}_{measure}_mm"] == shown[direction][measure]
    assert row["model_seen_share"] == shown["model_seen_share"]
    write_coefficients(tmp_path / "c.csv", [row], 5)
    with (tmp_path / "c.csv").open(newline="") as stream:
        (cells,) = csv.DictReader(stream)
    assert {*row, "checksum"} == set(cells)
    assert all(cells[key] == str(value) for key, value in row.items() if key != "reason")


def test_the_table_tells_pose_size_and_where_the_scan_was(result: FitResult, tmp_path: Path) -> None:
    record = fit_record(result, source_of(tmp_path / "scans" / "raw.ply", "a", tmp_path / "out"), MODEL)
    row = coefficient_row("one", record)
    turn = np.radians([row[f"rotation_{axis}_deg"] for axis in "xyz"])
    assert np.allclose(Rotation.from_rotvec(turn).as_matrix(), result.T_scan_model.rotation)
    assert [row[f"translation_{axis}"] for axis in "xyz"] == result.T_scan_model.translation.tolist()
    assert row["scale"] == result.T_scan_model.scale
    surface = result.surface().vertices * result.mm_per_scan_unit
    assert row["size_mm"] == pytest.approx(np.sqrt(((surface - surface.mean(axis=0)) ** 2).sum(axis=1).mean()))
    assert row["path"] == "../scans/raw.ply"
    for key in ("expected_error_mm", "beyond_model_mm"):
        assert row[key] == getattr(result.evidence, key)


def test_a_record_of_an_earlier_version_still_makes_a_row(result: FitResult) -> None:
    record = structs.replace(fit_record(result, SCAN, MODEL), shown=None, size_mm=None)
    row = coefficient_row("one", record)
    assert row["b1"] == result.b[0] and "model_seen_share" not in row


def test_names_that_look_like_formulas_are_made_harmless(tmp_path: Path) -> None:
    row = coefficient_row("=cmd()", failed_record(SCAN, MODEL, "@why", {}))
    write_coefficients(tmp_path / "c.csv", [row], 1)
    with (tmp_path / "c.csv").open(newline="") as stream:
        said = next(iter(csv.DictReader(stream)))
    assert (said["scan"], said["reason"]) == ("'=cmd()", "'@why")


def test_stages_are_kept_for_figures_in_the_size_of_the_scan(tmp_path: Path, result: FitResult) -> None:
    write_stages(tmp_path / "s.npz", result, blob_model())
    with np.load(tmp_path / "s.npz", allow_pickle=False) as stages:
        size = result.T_scan_model.scale * result.mm_per_scan_unit
        assert np.allclose(stages["final"], size * blob_model().reconstruct(result.b), atol=1e-3)
        assert np.allclose(np.abs(stages["model_to_scan_final"]), result.distances.model_to_scan_mm, rtol=1e-5)
        assert {"before", "initial", "scan_to_model_initial", "faces", "scan", "scan_faces", "regions"} <= set(
            stages.files
        )
        assert np.allclose(stages["scan"], size * result.T_scan_model.inverse().apply(result.scan.vertices), atol=1e-3)


def test_the_iterations_kept_end_in_the_final_surface(tmp_path: Path, result: FitResult) -> None:
    write_stages(tmp_path / "s.npz", result, blob_model())
    with np.load(tmp_path / "s.npz", allow_pickle=False) as stages:
        assert len(stages["history_phase"]) == len(result.history)
        assert stages["history_rms_mm"][-1] == pytest.approx(result.history[-1].rms_mm)
        T = stages["history_T"][-1]
        last = blob_model().reconstruct(stages["history_b"][-1].astype(float)) @ T[:, :3].T + T[:, 3]
        assert np.allclose(last, stages["final"], atol=1e-2)


def test_sources_are_told_relative_to_the_results(tmp_path: Path) -> None:
    source = source_of(tmp_path / "models" / "m.h5", "h", tmp_path / "out")
    assert source == File(name="m.h5", hash="h", path="../models/m.h5")


@pytest.mark.parametrize("content", ["", "{", '{"scan": 1', "[]", '{"format": "other"}', "nonsense"])
def test_what_is_not_a_record_is_refused_by_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "x.fit.json").write_text(content)
    with pytest.raises(FileFormatError, match=r"x\.fit\.json"):
        read_record(tmp_path / "x.fit.json")


def test_a_full_disk_leaves_the_old_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = coefficient_row("one", failed_record(SCAN, MODEL, "why", {}))
    write_coefficients(tmp_path / "c.csv", [row], 1)
    before = (tmp_path / "c.csv").read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FileError, match=r"c\.csv: the disk is full"):
        write_coefficients(tmp_path / "c.csv", [row, row], 1)
    assert (tmp_path / "c.csv").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_a_model_of_points_gives_a_point_cloud(tmp_path: Path) -> None:
    model = blob_model(vertices=200)
    points = type(model)(model.mean, model.basis, model.stddev, model.total_variance, model.n_training)
    result = fit_scan(
        points, Mesh(raw_scan(np.zeros(5)).scan.vertices, name="cloud"), FitConfig(method="paper", max_iterations=3)
    )
    write_fitted_mesh(tmp_path / "p.fitted.ply", result, points)
    write_stages(tmp_path / "p.npz", result, points)
    assert read_mesh(tmp_path / "p.fitted.ply").faces is None


def test_a_hundred_times_as_many_scans_take_a_hundred_times_as_long_to_name(tmp_path: Path) -> None:
    def steps(count: int) -> int:
        counted = 0

        def count_calls(_frame: object, event: str, _: object) -> None:
            nonlocal counted
            counted += event in ("call", "c_call")

        scans = [tmp_path / f"s{k:05d}.ply" for k in range(count)]
        sys.setprofile(count_calls)
        try:
            assert len(set(names_for(scans, tmp_path))) == count
        finally:
            sys.setprofile(None)
        return counted

    assert steps(2000) < 12 * steps(200)
