"""What a new user tries at a Python prompt."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shapespace as ss
from shapespace import cli
from shapespace.batch.fit_records import read_record
from shapespace.lazy import LAZY_FUNCTIONS, lazy_import
from shapespace.report.inputs.saved_fits import Folder, find_fits, model_of
from shapespace.report.inputs.saved_fits import raw_scan as saved_scan
from synthetic_shapes import blob_model, raw_scan, training_meshes

LONGEST_REPR = 700


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fïles with a space")
    ss.write_mesh(folder / "scan.ply", raw_scan(np.array([1.0, -1.0, 0.5, 0.0, 0.3]), vertices=900, noise_mm=0.2).scan)
    blob_model().save(folder / "model.h5")
    return folder


@pytest.fixture(scope="module")
def result(files: Path) -> ss.FitResult:
    return ss.fit_scan(str(files / "model.h5"), files / "scan.ply")


def test_tab_completion_shows_every_public_name_before_any_is_loaded() -> None:
    script = (
        "import sys, shapespace as ss; assert not set(ss.__all__) - set(dir(ss)); assert 'scipy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_reprs_stay_short_whatever_the_arrays(result: ss.FitResult, tmp_path: Path) -> None:
    faces = ss.load_faces()
    quality = ss.model.measure_quality(list(training_meshes()[:6]), config=ss.model.QualityConfig(folds=2, samples=2))
    held: list[Any] = [
        result, result.model, result.scan, result.T_scan_model, result.stages["final"], result.history[-1],
        result.distances, quality, quality.compactness, faces,
        ss.io.LabelVolume(np.ones((9, 9, 9), np.uint8), np.eye(4)), ss.model.AdditiveModel(result.model, np.eye(5), 2),
        ss.FitConfig(),
    ]  # fmt: skip
    for each in held:
        told = repr(each)
        assert len(told) < LONGEST_REPR and "\n" not in told and type(each).__name__ in told, told[:2000]
    assert "converged" in repr(result) and "scan.ply" in repr(result)
    assert "700 vertices" in repr(result.model) and "5 modes" in repr(result.model)


def test_a_fit_takes_paths_and_meshes_alike(result: ss.FitResult, files: Path) -> None:
    same = ss.fit_scan(ss.ShapeModel.load(files / "model.h5"), ss.read_mesh(files / "scan.ply"))
    np.testing.assert_array_equal(same.b, result.b)
    additive = ss.model.AdditiveModel(result.model, np.eye(5), 2)
    np.testing.assert_array_equal(ss.fit_scan(additive, files / "scan.ply").b, result.b)


def test_what_is_no_model_and_no_scan_is_refused_by_name(result: ss.FitResult, files: Path) -> None:
    with pytest.raises(ss.ShapespaceError, match=r"by a ShapeModel or by its file, not by int"):
        ss.fit_scan(3, result.scan)  # type: ignore[arg-type]
    with pytest.raises(ss.ShapespaceError, match=r"builtins\.int is not a mesh"):
        ss.fit_scan(result.model, 3)
    with pytest.raises(ss.ShapespaceError, match=r"nowhere\.obj"):
        ss.fit_scan(result.model, files / "nowhere.obj")


def test_save_writes_what_the_command_line_writes(result: ss.FitResult, files: Path, tmp_path: Path) -> None:
    by_hand, by_command = files / "by hand", files / "by command"
    assert result.save(by_hand) == by_hand / "scan.fit.json"
    assert cli.main(["fit", str(files / "model.h5"), str(files / "scan.ply"), "-o", str(by_command), "--quiet"]) == 0
    ours, theirs = (read_record(folder / "scan.fit.json").to_json() for folder in (by_hand, by_command))
    assert ours.pop("seconds").keys() == theirs.pop("seconds").keys()
    assert ours == theirs
    for name in ("scan.fitted.ply", "coefficients.csv"):
        assert (by_hand / name).read_bytes() == (by_command / name).read_bytes()
    assert {file.name for file in by_hand.iterdir()} == {file.name for file in by_command.iterdir()}


def test_a_saved_result_is_one_that_reports_open_and_fits_keep(
    result: ss.FitResult, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = files / "kept"
    result.save(out)
    folder = Folder(out)
    [fit] = find_fits(folder)
    assert model_of(folder, [fit]).content_hash == result.model_hash
    assert len(saved_scan(folder, fit).vertices) == len(result.scan.vertices)
    capsys.readouterr()
    assert cli.main(["fit", str(files / "model.h5"), str(files / "scan.ply"), "-o", str(out)]) == 0
    told = capsys.readouterr()
    assert "valid result" in told.err + told.out


def test_scans_of_one_name_in_memory_are_told_apart(result: ss.FitResult, tmp_path: Path) -> None:
    one = replace(result, scan_name="mesh", files={})
    other = replace(one, scan=one.scan.with_vertices(one.scan.vertices + 1.0))
    first = one.save(tmp_path)
    assert one.save(tmp_path) == first == tmp_path / "mesh.fit.json"
    second = other.save(tmp_path)
    assert second != first and second.is_file()
    assert len((tmp_path / "coefficients.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize("name", ["../up", "a/b", "c:d", ".."])
def test_no_name_leads_out_of_the_folder(result: ss.FitResult, tmp_path: Path, name: str) -> None:
    with pytest.raises(ss.ShapespaceError, match="is not a valid file name"):
        result.save(tmp_path / "out", name)


def test_every_lazy_name_is_there() -> None:
    for name in LAZY_FUNCTIONS:
        assert callable(lazy_import(name))
