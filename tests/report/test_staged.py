"""What pictures are made of: fits read back from their files are those that were made."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shapespace.batch.executors import Serial
from shapespace.batch.run import BatchConfig, FolderSink, fit_many, make_jobs
from shapespace.errors import FileFormatError, InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.report.inputs.saved_fits import (
    Folder,
    ScanNotFoundError,
    StagedFit,
    find_fits,
    model_of,
    saved_surfaces,
    staged_fit,
)
from synthetic_shapes import blob_model, raw_scan

CONFIG = FitConfig(method="paper", max_iterations=4)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("staged")
    blob_model().save(home / "model.h5")
    for k in range(2):
        write_mesh(home / f"scan{k}.ply", raw_scan(np.full(5, 0.3 * k), seed=k).scan)
    (home / "broken.ply").write_bytes(b"ply\nnonsense")
    jobs = make_jobs([home / "scan0.ply", home / "scan1.ply", home / "broken.ply"])
    fit_many(
        jobs, BatchConfig(blob_model(), home / "model.h5", CONFIG, stages=True), Serial(), FolderSink(home / "out")
    )
    return home


@pytest.fixture
def home(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "home")
    return tmp_path / "home"


def test_a_saved_fit_is_the_fit_itself(home: Path) -> None:
    folder = Folder(home / "out")
    saved = {fit.name: fit for fit in find_fits(folder)}
    assert {name: fit.status for name, fit in saved.items()}["broken"] == "failed"
    read = staged_fit(folder, saved["scan1"])
    fresh = StagedFit.of(blob_model(), fit_scan(blob_model(), read_mesh(home / "scan1.ply"), CONFIG))
    assert np.allclose(read.scan.vertices, fresh.scan.vertices, atol=1e-5)
    for stage in ("before", "initial", "final"):
        assert np.allclose(read.surfaces[stage].vertices, fresh.surfaces[stage].vertices, atol=1e-5)
        assert np.allclose(read.model_to_scan_mm[stage], fresh.model_to_scan_mm[stage], atol=1e-5)
        assert np.allclose(read.scan_to_model_mm[stage], fresh.scan_to_model_mm[stage], atol=1e-5, equal_nan=True)
    assert np.array_equal(read.b, fresh.b)
    assert len(read.history) == len(fresh.history)


def test_saved_surfaces_and_the_scan_give_the_pictures_of_saved_stages(home: Path) -> None:
    folder = Folder(home / "out")
    before = {fit.name: staged_fit(folder, fit) for fit in find_fits(folder) if fit.fitted}
    for path in (home / "out").glob("*.stages.npz"):
        path.unlink()
    for fit in find_fits(folder):
        if not fit.fitted:
            continue
        drawn, staged = staged_fit(folder, fit), before[fit.name]
        assert list(drawn.surfaces) == ["final"] and drawn.regions is None and drawn.history == ()
        assert np.allclose(drawn.scan.vertices, staged.scan.vertices, atol=1e-4)
        assert np.allclose(drawn.surfaces["final"].vertices, staged.surfaces["final"].vertices, atol=1e-4)
        forward = drawn.model_to_scan_mm["final"], staged.model_to_scan_mm["final"]
        backward = drawn.scan_to_model_mm["final"], staged.scan_to_model_mm["final"]
        for one, other in (forward, backward):
            assert np.allclose(np.abs(one), np.abs(other), atol=1e-3, equal_nan=True)


def test_a_scan_that_has_changed_is_not_drawn_with_an_older_fit(home: Path) -> None:
    folder = Folder(home / "out")
    (home / "out" / "scan0.stages.npz").unlink()
    write_mesh(home / "scan0.ply", raw_scan(np.full(5, 0.9), seed=7).scan)
    (fit,) = [fit for fit in find_fits(folder) if fit.name == "scan0"]
    with pytest.raises(ScanNotFoundError, match="has changed"):
        staged_fit(folder, fit)
    assert list(saved_surfaces(folder, fit)) == ["final"]


def test_the_last_moment_is_the_final_surface(home: Path) -> None:
    folder = Folder(home / "out")
    (read,) = [staged_fit(folder, fit) for fit in find_fits(folder) if fit.name == "scan0"]
    assert np.allclose(read.history[-1].vertices(blob_model()), read.surfaces["final"].vertices, atol=1e-2)


def test_the_model_is_found_where_it_was(home: Path) -> None:
    folder = Folder(home / "out")
    assert model_of(folder, find_fits(folder)).content_hash == blob_model().content_hash


def lose(home: Path) -> Path | None:
    (home / "model.h5").unlink()
    return None


def replace(home: Path) -> Path | None:
    blob_model(modes=4).save(home / "model.h5")
    return None


def give_another(home: Path) -> Path | None:
    blob_model(modes=4).save(home / "other.h5")
    return home / "other.h5"


@pytest.mark.parametrize(
    ("change", "words"), [(lose, "no longer"), (replace, "not the model"), (give_another, "not the model")]
)
def test_another_model_or_none_is_refused(home: Path, change: Callable[[Path], Path | None], words: str) -> None:
    given = change(home)
    folder = Folder(home / "out")
    with pytest.raises(InputError, match=rf"(?s){words}.*--model"):
        model_of(folder, find_fits(folder), given)


def drop(key: str) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda arrays: void(arrays.pop(key))


def void(_: object) -> None: ...


def cut(key: str) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda arrays: arrays.update({key: arrays[key][:-1]})


def spoil(key: str, value: float) -> Callable[[dict[str, np.ndarray]], None]:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays[key] = arrays[key].copy()
        arrays[key].reshape(-1)[0] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        *(drop(key) for key in ("scan", "final", "model_to_scan_final", "regions", "history_T", "format_version")),
        *(cut(key) for key in ("final", "model_to_scan_before", "scan_to_model_final", "regions", "history_b")),
        spoil("final", np.nan),
        spoil("model_to_scan_final", np.nan),
        spoil("scan_to_model_final", np.inf),
        spoil("regions", 9),
        spoil("history_T", np.nan),
        spoil("history_b", np.inf),
        spoil("scan_faces", 10**6),
        spoil("format_version", 1),
    ],
)
def test_damaged_stages_are_refused_in_a_sentence(home: Path, change: Callable[[dict[str, np.ndarray]], None]) -> None:
    path = home / "out" / "scan0.stages.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    change(arrays)
    np.savez_compressed(path, **arrays)
    folder = Folder(home / "out")
    (fit,) = [fit for fit in find_fits(folder) if fit.name == "scan0"]
    with pytest.raises(FileFormatError, match=r"scan0.*--stages\.$"):
        staged_fit(folder, fit)


def test_a_damaged_record_is_told_and_does_not_hide_the_others(home: Path) -> None:
    (home / "out" / "scan0.fit.json").write_text('{"format":')
    found = {fit.name: fit for fit in find_fits(Folder(home / "out"))}
    assert found["scan0"].status == "unreadable"
    assert "scan0.fit.json" in found["scan0"].reason
    assert found["scan1"].status != "unreadable"


def test_a_folder_without_fits_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contains no fits"):
        find_fits(Folder(tmp_path))


def test_names_do_not_lead_out_of_the_folder(home: Path) -> None:
    record = json.loads((home / "out" / "scan0.fit.json").read_text())
    assert record["model"]["path"] == "../model.h5"  # the model may lie elsewhere: it is checked by its hash
    with pytest.raises(FileFormatError, match="leads out"):
        Folder(home / "out").arrays("../model.h5")


def test_a_model_is_not_taken_for_another_of_the_same_shape(home: Path) -> None:
    model = blob_model()
    other = ShapeModel(model.mean + 1.0, model.basis, model.stddev, model.total_variance, model.n_training, model.faces)
    other.save(home / "model.h5")
    with pytest.raises(InputError, match="not the model"):
        model_of(Folder(home / "out"), find_fits(Folder(home / "out")))
