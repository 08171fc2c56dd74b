"""Model files that other programs wrote: converted both ways, fitted and looked at as they are."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from shapespace import cli
from shapespace.commands.convert import convert
from shapespace.errors import ModelFileError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.formats.model_parts import ModelFormat
from shapespace.formats.registry import MODEL_FORMATS
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.report.inputs.saved_fits import Folder, find_fits, model_of
from shapespace.viewer.model_view import ModelView

MODELS = Path(os.environ.get("SHAPESPACE_DATA", "/nowhere")) / "models"
FEMUR = MODELS / "femur_gp_model_50-components.h5"
FILES = ["femur_gp_model_50-components.h5", "scalismo_asm_model.h5"]
pytestmark = pytest.mark.skipif(not MODELS.is_dir(), reason="needs SHAPESPACE_DATA with the folder models")


def covariance_gap(first: ShapeModel, second: ShapeModel) -> float:
    """Return how far apart two covariances are, relative to the first, without making either."""
    one, two = (model.basis * model.stddev for model in (first, second))
    own, across, other = one.T @ one, one.T @ two, two.T @ two
    gap2 = (own**2).sum() - 2 * (across**2).sum() + (other**2).sum()
    return float(np.sqrt(max(gap2, 0.0)) / np.linalg.norm(own))


@pytest.mark.parametrize("one", MODEL_FORMATS.values(), ids=lambda one: one.name)
@pytest.mark.parametrize("file", FILES)
def test_each_converts_to_our_format_and_to_all_that_are_written_and_back(
    one: ModelFormat, file: str, tmp_path: Path
) -> None:
    convert(MODELS / file, tmp_path / "own.h5")
    own = ShapeModel.load(tmp_path / "own.h5")
    there = tmp_path / f"there{one.suffixes[0] if one.suffixes else ''}"
    convert(tmp_path / "own.h5", there, to=one.name)
    convert(there, tmp_path / "back.h5")
    back = ShapeModel.load(tmp_path / "back.h5")
    extent = float(np.ptp(own.mean_vertices))
    assert np.abs(back.mean_vertices - own.mean_vertices).max() < 2e-6 * extent
    assert np.allclose(back.stddev, own.stddev, rtol=2e-5)
    assert np.array_equal(np.asarray(back.faces), np.asarray(own.faces))
    assert covariance_gap(own, back) < 2e-5


def test_a_file_that_is_cut_short_is_refused_in_one_sentence() -> None:
    with pytest.raises(ModelFileError, match="damaged or cut short") as refused:
        ShapeModel.load(MODELS / "scalismo_tetra_model.h5")
    assert "\n" not in str(refused.value)


def test_a_femur_is_fitted_by_a_gaussian_process_as_well_as_it_says() -> None:
    model, scan = ShapeModel.load(FEMUR), read_mesh(MODELS / "femur_target.stl")
    reference = read_mesh(MODELS / "femur_reference.stl")  # of the model's mean, in the order of the target
    vertex = cKDTree(model.mean_vertices).query(reference.vertices)[1]
    truth = np.empty_like(scan.vertices)
    truth[vertex] = scan.vertices
    result = fit_scan(model, scan, FitConfig())
    error_mm = np.linalg.norm(result.surface(model).vertices - truth, axis=1).mean()
    assert result.status == "converged"
    assert result.distances.model_to_scan.mean < 0.25
    # Taken as variances of new shapes, those of the file promise less than 1.08 mm, which it is.
    assert not model.held_out
    assert result.evidence.error_low_mm < error_mm < result.evidence.error_high_mm


def test_commands_take_a_file_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = "scalismo_asm_model.h5"
    model = ShapeModel.load(MODELS / file)
    b = np.random.default_rng(0).normal(size=5) * model.stddev[:5]
    write_mesh(tmp_path / "scan.ply", model.mesh(b))
    out = tmp_path / "out"
    assert cli.main(["fit", str(MODELS / file), str(tmp_path / "scan.ply"), "-o", str(out), "--quiet"]) == 0
    assert cli.main(["info", str(MODELS / file)]) == 0
    assert cli.main(["quality", str(MODELS / file), "-o", str(tmp_path / "quality")]) == 0
    assert "compactness" in capsys.readouterr().out
    # What report and viewer begin with.
    assert model_of(Folder(out), find_fits(Folder(out))).content_hash == model.content_hash
    assert ModelView.open(out).model.content_hash == ModelView.open(MODELS / file).model.content_hash
    fitted = find_fits(Folder(out))[0]
    assert fitted.status == "converged"
