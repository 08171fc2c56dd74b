import csv
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.batch import run
from shapespace.batch.run import EXECUTORS, Job, fit_files, make_executor, make_jobs
from shapespace.errors import FileError
from shapespace.fit.fit import FitConfig
from shapespace.io.meshes import write_mesh
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model, raw_scan, similarity

CONFIG = FitConfig(max_iterations=5)


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return blob_model(vertices=200)


@pytest.fixture(scope="module")
def model_path(model: ShapeModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "blob.h5"
    model.save(path)
    return path


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, rng = tmp_path_factory.mktemp("scans"), np.random.default_rng(0)
    paths = [folder / f"scan{i}.ply" for i in range(3)]
    for i, path in enumerate(paths):
        write_mesh(path, raw_scan(rng.uniform(-1, 1, 5), similarity(i, 10.0, 1.0), vertices=500).scan)
    return paths


def with_a_bad_one(scans: list[Path], folder: Path) -> list[Path]:
    (folder / "bad.ply").write_text("this is no mesh\n")
    return [scans[0], folder / "bad.ply", folder / "missing.ply", *scans[1:]]


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "coefficients.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def without_times(record: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in record.items() if k != "seconds"}


def test_bad_scans_become_rows_and_the_others_go_on(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    jobs = make_jobs(with_a_bad_one(scans, tmp_path))
    records = fit_files(jobs, model, Path("blob.h5"), tmp_path / "out", CONFIG)
    assert [r["status"] == "failed" for r in records] == [False, True, True, False, False]
    rows = table(tmp_path / "out")
    assert [row["scan"] for row in rows] == ["scan0", "bad", "missing", "scan1", "scan2"]
    assert "bad.ply" in rows[1]["reason"]
    assert "no such file" in rows[2]["reason"]
    assert not rows[1]["b1"]
    written = {p.name for p in (tmp_path / "out").iterdir()}
    assert {"scan0.fit.json", "scan0.fitted.ply", "bad.fit.json", "coefficients.csv"} <= written
    assert "bad.fitted.ply" not in written
    assert not [name for name in written if name.startswith(".")]


def test_an_interruption_loses_nothing_that_was_done(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    def stop(job: Job, record: Mapping[str, Any]) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_files(make_jobs(scans), model, Path("blob.h5"), tmp_path, CONFIG, on_done=stop)
    (row,) = table(tmp_path)
    assert row["scan"] == "scan0"
    assert np.isfinite(float(row["b1"]))

    again: list[str] = []
    original, run.fit_file = run.fit_file, lambda job, *a, **k: (again.append(job.name), original(job, *a, **k))[1]
    try:
        records = fit_files(make_jobs(scans), model, Path("blob.h5"), tmp_path, CONFIG, resume=True)
    finally:
        run.fit_file = original
    assert again == ["scan1", "scan2"]
    assert [r["scan"]["name"] for r in records] == ["scan0.ply", "scan1.ply", "scan2.ply"]
    assert [r["scan"] for r in table(tmp_path)] == ["scan0", "scan1", "scan2"]


@pytest.mark.parametrize("changed", ["nothing", "scan", "model", "settings", "record", "surface", "failed"])
def test_resume_keeps_what_still_holds_and_only_that(
    model: ShapeModel, scans: list[Path], tmp_path: Path, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan, out, config = tmp_path / "s.ply", tmp_path / "out", CONFIG
    scan.write_bytes(scans[0].read_bytes() if changed != "failed" else b"no mesh")
    fit_files(make_jobs([scan]), model, Path("m"), out, config)
    if changed == "scan":
        scan.write_bytes(scans[1].read_bytes())
    elif changed == "model":
        model = model.truncate(4)
    elif changed == "settings":
        config = FitConfig(max_iterations=6)
    elif changed == "record":
        (out / "s.fit.json").write_text('{"format": "shapespace fit"')
    elif changed == "surface":
        (out / "s.fitted.ply").unlink()
    calls: list[str] = []
    original = run.fit_file
    monkeypatch.setattr(run, "fit_file", lambda job, *a, **k: (calls.append(job.name), original(job, *a, **k))[1])
    fit_files(make_jobs([scan]), model, Path("m"), out, config, resume=True)
    assert calls == ([] if changed == "nothing" else ["s"])


@pytest.mark.parametrize("kind", EXECUTORS)
def test_every_executor_gives_what_one_after_the_other_gives(
    kind: str, model: ShapeModel, model_path: Path, scans: list[Path], tmp_path: Path
) -> None:
    jobs = make_jobs(with_a_bad_one(scans, tmp_path))
    here = fit_files(jobs, model, Path("blob.h5"), tmp_path / "here", CONFIG)
    done: list[str] = []
    with make_executor(model_path, 2, kind) as executor:
        there = fit_files(
            jobs, model, Path("blob.h5"), tmp_path / "there", CONFIG, executor=executor,
            on_done=lambda job, _: done.append(job.name),
        )  # fmt: skip
    assert [without_times(r) for r in there] == [without_times(r) for r in here]
    assert sorted(done) == sorted(job.name for job in jobs)
    for name in ("coefficients.csv", "scan0.fitted.ply", "scan2.fitted.ply"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_worker_without_a_model_says_so(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    run._model = None
    with ThreadPoolExecutor(1) as executor, pytest.raises(FileError, match="no model"):
        fit_files(make_jobs(scans[:1]), model, Path("m"), tmp_path, CONFIG, executor=executor)


def test_scans_of_the_same_name_get_names_of_their_own() -> None:
    scans = [Path(p) for p in ("a/face.ply", "b/face.obj", "face_2.ply", "c/face.ply", "x.tar.ply", ".ply")]
    names = [job.name for job in make_jobs(scans)]
    assert len(set(names)) == len(names)
    assert names[:2] == ["face", "face_2"]
    assert [job.scan for job in make_jobs(scans)] == scans


def test_a_folder_that_cannot_be_made_is_named(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileError, match=r"Cannot write .*file"):
        fit_files(make_jobs(scans[:1]), model, Path("m"), tmp_path / "file" / "out", CONFIG)


def test_all_states_are_told_when_fits_run_here(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    told: list[int] = []
    (record,) = fit_files(
        make_jobs(scans[:1]), model, Path("m"), tmp_path, CONFIG, on_state=lambda s: told.append(s.phase)
    )
    assert len(told) == len(record["history"])
