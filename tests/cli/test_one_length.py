"""A length is the same number of mm of the scan wherever it is read; the scan is 0.7 times as large as the model."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Outcome, Run
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import SHOWN
from shapespace.fit.result import FitResult
from shapespace.geometry.closest import build_engine
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.report.blocks.wording import mm
from shapespace.viewer.model_view import ModelView
from synthetic_shapes import blob_model, raw_scan, similarity

SCALE = 0.7
WAYS = ("model_to_scan", "scan_to_model")


def write_scan(path: Path, scale: float) -> Path:
    raw = raw_scan(np.array([1.0, -0.5, 0.5, 0.8, -0.3]), similarity(2, 10.0, scale), noise_mm=0.3, keep=-0.3)
    write_mesh(path, raw.scan)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    blob_model().save(tmp_path / "model.h5")
    write_scan(tmp_path / "small.ply", SCALE)
    return tmp_path


@pytest.fixture
def terminal(run: Run, folder: Path) -> Outcome:
    """The output of the command line that fits the scan."""
    options = ("-o", folder / "fits", "--stages", "--unit", "mm", "--quiet")
    outcome = run("fit", folder / "model.h5", folder / "small.ply", *options)
    assert outcome.code == 0
    return outcome


@pytest.fixture
def result(folder: Path) -> FitResult:
    """The same fit in Python."""
    return fit_scan(ShapeModel.load(folder / "model.h5"), read_mesh(folder / "small.ply"), FitConfig(unit="mm"))


def record_in(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "fits" / "small.fit.json").read_text())


def row_in(folder: Path) -> dict[str, str]:
    with (folder / "fits" / "coefficients.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    return row


def facts_of(packed: bytes) -> dict[str, Any]:
    length = int.from_bytes(packed[:4], "little")
    return json.loads(packed[4 : 4 + length])["facts"]


def test_distances_are_one_number_everywhere(run: Run, folder: Path, terminal: Outcome, result: FitResult) -> None:
    assert result.T_scan_model.scale == pytest.approx(SCALE, rel=0.03)
    shown = np.isin(result.regions, SHOWN)
    assert 0.3 < shown.mean() < 0.9, "the scan shows only a part of the model"
    nearest_mm = build_engine(read_mesh(folder / "small.ply")).query(result.surface().vertices).distance[shown]
    overlap = result.overlap_distances
    assert overlap.model_to_scan.mean == pytest.approx(nearest_mm.mean())

    record, row, view = record_in(folder), row_in(folder), ModelView.open(folder / "fits")
    (listed,) = view.fit_list()
    drawn = [facts_of(view.packed_fit("small"))["mean_mm"]["final"]]
    assert run("report", folder / "fits", "--no-open", "-o", folder / "report.html").code == 0
    report, notebook = (folder / "report.html").read_text(), result._repr_html_()
    (folder / "fits" / "small.stages.npz").unlink()
    drawn.append(facts_of(ModelView.open(folder / "fits").packed_fit("small"))["mean_mm"]["final"])
    for way, seen in zip(WAYS, ("model", "scan"), strict=True):
        mean = getattr(overlap, way).mean
        assert f"{mean:.2f} mm (" in terminal.out
        assert record["shown"][way]["mean"] == pytest.approx(mean)
        assert float(row[f"shown_{way}_mean_mm"]) == pytest.approx(mean)
        assert listed["shown"][way]["mean"] == pytest.approx(mean)
        assert [each[seen] for each in drawn] == pytest.approx([mean, mean], rel=1e-4), "with and without stages"
        assert mm(mean) in report and f"{mm(mean)} mean" in notebook
        whole = getattr(result.distances, way).mean
        assert record["distances_mm"]["final"][way]["mean"] == pytest.approx(whole)
        assert float(row[f"{way}_mean_mm"]) == pytest.approx(whole)


def test_the_expected_error_and_the_reason_are_one_number_everywhere(
    run: Run, folder: Path, terminal: Outcome, result: FitResult
) -> None:
    assert terminal.code == 0 and result.evidence is not None
    expected_mm = result.evidence.expected_error_mm
    record, row = record_in(folder), row_in(folder)
    (listed,) = ModelView.open(folder / "fits").fit_list()
    assert run("report", folder / "fits", "--no-open", "-o", folder / "report.html").code == 0
    assert record["evidence"]["expected_error_mm"] == pytest.approx(expected_mm)
    assert float(row["expected_error_mm"]) == pytest.approx(expected_mm)
    assert listed["expected_error_mm"] == pytest.approx(expected_mm)
    assert mm(expected_mm) in (folder / "report.html").read_text() and mm(expected_mm) in result._repr_html_()
    assert result.status == "converged"
    sentence = f"robust residual SD {result.evidence.spread_mm:.2f} mm"
    assert all(sentence in text for text in (repr(result), record["reason"], row["reason"], listed["reason"]))


def test_standard_deviations_of_landmarks_are_one_number_everywhere(
    folder: Path, terminal: Outcome, result: FitResult
) -> None:
    assert terminal.code == 0 and result.landmark_stddev_mm
    found = record_in(folder)["found_landmarks"]
    with (folder / "fits" / "small.landmarks.csv").open(newline="") as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    for name, stddev_mm in result.landmark_stddev_mm.items():
        np.testing.assert_allclose(found[name]["stddev_mm"], stddev_mm, rtol=1e-6)
        np.testing.assert_allclose([float(rows[name][f"stddev_{axis}_mm"]) for axis in "xyz"], stddev_mm, rtol=1e-3)


def test_every_length_of_a_fit_is_proportional_to_the_size_of_the_scan(tmp_path: Path) -> None:
    """The same scan at two sizes: lengths are 0.7 times as large, and the verdict is the same."""
    config = FitConfig(unit="mm", dense=True)
    large, small = (
        fit_scan(blob_model(), read_mesh(write_scan(tmp_path / f"{scale}.ply", scale)), config)
        for scale in (1.0, SCALE)
    )
    assert large.evidence is not None and small.evidence is not None
    theirs, ours = large.evidence.to_dict(), small.evidence.to_dict()
    assert ours.keys() == theirs.keys()
    # The search begins with the size of the model, so its poses and their scores differ.
    lengths = [name for name in ours if name.endswith("_mm") and not name.startswith("start_")]
    assert len(lengths) >= 10
    for name in lengths:
        assert ours[name] == pytest.approx(SCALE * theirs[name], rel=0.02, abs=1e-6), name
    assert small.evidence.failure_probability == pytest.approx(large.evidence.failure_probability, rel=0.05)
    for stage in small.stages:
        assert small.stages[stage].moved_mm == pytest.approx(SCALE * large.stages[stage].moved_mm, rel=0.02)
        for way in WAYS if stage != "before" else ():  # before the fit the model has its own size
            a, b = (getattr(one.stages[stage].distances, way).mean for one in (small, large))
            assert a == pytest.approx(SCALE * b, rel=0.02), (stage, way)
    assert small.history[-1].rms_mm == pytest.approx(SCALE * large.history[-1].rms_mm, rel=0.02)
    np.testing.assert_allclose(small.z, large.z, atol=0.02)
    assert small.status == large.status and small.reasons[0].data["spread_mm"] == small.evidence.spread_mm
