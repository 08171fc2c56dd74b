import csv
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.batch.executors import Executor, Local, Serial
from shapespace.batch.fit_work import FitJob
from shapespace.batch.on_dask import OnDask
from shapespace.batch.run import BatchConfig, FolderSink, Plan, fit_many, make_jobs
from shapespace.errors import FileError
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.iteration_state import IcpState
from shapespace.io.files import atomic_path
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import FitRecord
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


def fit_into(
    folder: Path, jobs: Sequence[FitJob], model: ShapeModel, config: FitConfig = CONFIG, *,
    file: Path = Path("blob.h5"), executor: Executor | None = None, stages: bool = False, reuse: bool = False,
    on_plan: Callable[[Plan], None] | None = None,
    on_done: Callable[[FitJob, FitRecord], None] | None = None,
    on_state: Callable[[IcpState], None] | None = None,
) -> list[FitRecord]:  # fmt: skip
    """Fit `jobs` into a folder, and return their records."""
    sink, batch = FolderSink(folder), BatchConfig(model, file, config, stages, reuse)
    fit_many(jobs, batch, executor or Serial(), sink, on_plan=on_plan, on_done=on_done, on_state=on_state)
    return [sink.records[job.name] for job in jobs]


def without_times(record: FitRecord) -> dict[str, Any]:
    return {k: v for k, v in record.to_json().items() if k != "seconds"}


def test_bad_scans_become_rows_and_the_others_go_on(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    jobs = make_jobs(with_a_bad_one(scans, tmp_path))
    records = fit_into(tmp_path / "out", jobs, model)
    assert [r.status == "failed" for r in records] == [False, True, True, False, False]
    rows = table(tmp_path / "out")
    assert [row["scan"] for row in rows] == ["scan0", "bad", "missing", "scan1", "scan2"]
    assert "bad.ply" in rows[1]["reason"]
    assert "no such file" in rows[2]["reason"]
    assert not rows[1]["b1"]
    written = {p.name for p in (tmp_path / "out").iterdir()}
    assert {"scan0.fit.json", "scan0.fitted.ply", "bad.fit.json", "coefficients.csv"} <= written
    assert "bad.fitted.ply" not in written
    assert not [name for name in written if name.startswith(".")]


def test_an_interruption_loses_nothing_that_was_done(
    model: ShapeModel, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(job: FitJob, record: FitRecord) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_into(tmp_path, make_jobs(scans), model, on_done=stop)
    (row,) = table(tmp_path)
    assert row["scan"] == "scan0"
    assert np.isfinite(float(row["b1"]))

    again = count_fits(monkeypatch)
    records = fit_into(tmp_path, make_jobs(scans), model, reuse=True)
    assert again == ["scan1", "scan2"]
    assert [r.scan.name for r in records] == ["scan0.ply", "scan1.ply", "scan2.ply"]
    assert [r["scan"] for r in table(tmp_path)] == ["scan0", "scan1", "scan2"]


@pytest.mark.parametrize("changed", ["nothing", "scan", "model", "settings", "record", "surface", "failed"])
def test_valid_results_are_reused_and_only_those(
    model: ShapeModel, scans: list[Path], tmp_path: Path, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan, out, config = tmp_path / "s.ply", tmp_path / "out", CONFIG
    scan.write_bytes(scans[0].read_bytes() if changed != "failed" else b"no mesh")
    fit_into(out, make_jobs([scan]), model, config)
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
    calls = count_fits(monkeypatch)
    fit_into(out, make_jobs([scan]), model, config, reuse=True)
    assert calls == ([] if changed == "nothing" else ["s"])


@pytest.mark.parametrize("kind", ["local", "dask"])
def test_every_executor_gives_what_one_after_the_other_gives(
    kind: str, model: ShapeModel, model_path: Path, scans: list[Path], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    executor = Local(2) if kind == "local" else OnDask(request.getfixturevalue("cluster"))
    jobs = make_jobs(with_a_bad_one(scans, tmp_path))
    here = fit_into(tmp_path / "here", jobs, model)
    done: list[str] = []
    there = fit_into(
        tmp_path / "there", jobs, model, file=model_path, executor=executor, on_done=lambda j, _: done.append(j.name)
    )
    told = [{**without_times(r), "model": r.model.hash} for r in there]
    assert told == [{**without_times(r), "model": r.model.hash} for r in here]
    assert sorted(done) == sorted(job.name for job in jobs)
    for name in ("coefficients.csv", "scan0.fitted.ply", "scan2.fitted.ply"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_model_that_is_another_one_by_now_is_not_fitted(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "model.h5"
    model.truncate(3).save(file)
    with pytest.raises(FileError, match=r"model\.h5 has changed since this run began"):
        fit_into(tmp_path / "out", make_jobs(scans), model, file=file, executor=Local(2))


def test_each_scan_is_called_by_its_file_where_no_other_has_that_name() -> None:
    scans = [Path(p) for p in ("a/face.ply", "b/other.obj", "face_2.ply", "x.tar.ply", ".ply")]
    assert [job.name for job in make_jobs(scans)] == ["face", "other", "face_2", "x.tar", ".ply"]
    assert [job.scan for job in make_jobs(scans)] == scans


SAME = (
    "a/face.ply",
    "b/face.ply",
    "b/face.obj",
    "x/b/Face.ply",
    "x_b/face.ply",
    "y/b/hand.ply",
    "y/c/hand.ply",
    "z/y_c_hand.ply",
    "b_hand.ply",
)


def test_scans_of_the_same_name_are_told_apart_by_their_path_in_any_order(tmp_path: Path) -> None:
    scans = [tmp_path / name for name in SAME]
    names = dict(zip(scans, (job.name for job in make_jobs(scans)), strict=True))
    assert len({name.casefold() for name in names.values()}) == len(names)
    assert all(name.endswith(("face", "Face", "face.ply", "Face.ply", "face.obj")) for name in list(names.values())[:5])
    assert (names[scans[-1]], names[scans[-2]]) == ("b_hand", "y_c_hand"), "a name that stands alone keeps it"
    assert all(name.endswith(("_y_b_hand", "_y_c_hand")) for name in list(names.values())[5:7])
    for order in (reversed(scans), np.random.default_rng(0).permutation(np.array(scans, dtype=object)).tolist()):
        again = list(order)
        assert dict(zip(again, (job.name for job in make_jobs(again)), strict=True)) == names
    # The same file by another way is the same scan.
    assert [job.name for job in make_jobs([scans[0], scans[0].parent / ".." / "a" / "face.ply"])] == ["face", "face"]


def test_names_do_not_change_when_scans_of_the_same_name_are_added(
    model: ShapeModel, scans: list[Path], tmp_path: Path
) -> None:
    paths = [tmp_path / folder / "face.ply" for folder in ("a", "b", "c")]
    for path, scan in zip(paths, scans, strict=True):
        path.parent.mkdir()
        path.write_bytes(scan.read_bytes())
    out = tmp_path / "out"
    for given in ([paths[0]], [paths[1], paths[0]], [paths[2], paths[1], paths[0]], paths):
        fit_into(out, make_jobs(given, folder=out), model, reuse=True)
    assert sorted(row["scan"] for row in table(out)) == ["b_face", "c_face", "face"]
    assert {row["scan"]: row["path"] for row in table(out)} == {
        "face": "../a/face.ply", "b_face": "../b/face.ply", "c_face": "../c/face.ply",
    }  # fmt: skip
    # A scan that was moved is still the same.
    paths[0].rename(tmp_path / "face.ply")
    assert [job.name for job in make_jobs([tmp_path / "face.ply"], folder=out)] == ["face"]
    # Another one in its place is not, though the name would be free.
    (tmp_path / "face.ply").write_bytes(scans[1].read_bytes())
    assert [job.name for job in make_jobs([tmp_path / "face.ply"], folder=out)] != ["face"]


def test_a_scan_given_twice_is_fitted_once(
    model: ShapeModel, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = count_fits(monkeypatch)
    records = fit_into(tmp_path, make_jobs([scans[0], scans[1], scans[0]]), model)
    assert calls == ["scan0", "scan1"]
    assert [record.scan.name for record in records] == ["scan0.ply", "scan1.ply", "scan0.ply"]
    assert [row["scan"] for row in table(tmp_path)] == ["scan0", "scan1"]


def count_fits(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    calls: list[str] = []
    original = FitJob.readable

    def noted(job: FitJob) -> AbstractContextManager[Path]:
        calls.append(job.name)
        return original(job)

    monkeypatch.setattr(FitJob, "readable", noted)
    return calls


@pytest.mark.parametrize("reuse", [True, False])
def test_further_scans_are_added_to_the_table_and_the_same_replaced(
    reuse: bool, model: ShapeModel, scans: list[Path], tmp_path: Path
) -> None:
    fit_into(tmp_path, make_jobs(scans[1:]), model)
    before = {row["scan"]: row for row in table(tmp_path)}
    assert list(before) == ["scan1", "scan2"]
    fit_into(tmp_path, make_jobs(scans[:1]), model, reuse=reuse)
    after = {row["scan"]: row for row in table(tmp_path)}
    assert list(after) == ["scan1", "scan2", "scan0"]
    assert {name: after[name] for name in before} == before
    fit_into(tmp_path, make_jobs(scans[1:2]), model, FitConfig(max_iterations=2), reuse=reuse)
    replaced = {row["scan"]: row for row in table(tmp_path)}
    assert list(replaced) == ["scan0", "scan2", "scan1"]
    assert replaced["scan1"]["b1"] != before["scan1"]["b1"] and replaced["scan2"] == before["scan2"]
    # A row whose record is gone goes too.
    (tmp_path / "scan2.fit.json").unlink()
    fit_into(tmp_path, make_jobs(scans[:1]), model, reuse=reuse)
    assert [row["scan"] for row in table(tmp_path)] == ["scan1", "scan0"]
    assert len(table(tmp_path)) == len(list(tmp_path.glob("*.fit.json")))


def test_fits_of_a_smaller_model_do_not_cut_the_table(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    fit_into(tmp_path, make_jobs(scans[:1]), model)
    fit_into(tmp_path, make_jobs(scans[1:2]), model.truncate(3))
    rows = {row["scan"]: row for row in table(tmp_path)}
    assert rows["scan0"]["b5"] and rows["scan1"]["b3"] and not rows["scan1"]["b4"]
    assert rows["scan0"]["model_hash"] != rows["scan1"]["model_hash"]


def test_damaged_records_of_earlier_runs_do_not_stop_a_fit(
    model: ShapeModel, scans: list[Path], tmp_path: Path
) -> None:
    for name, content in (("x", "{"), ("y", '{"format": "shapespace fit", "scan": 3, "b": [1]}')):
        (tmp_path / f"{name}.fit.json").write_text(content)
    fit_into(tmp_path, make_jobs(scans[:1], folder=tmp_path), model)
    assert [row["scan"] for row in table(tmp_path)] == ["scan0"]


def test_an_interruption_waits_for_what_runs_and_the_table_has_it(
    model: ShapeModel, model_path: Path, scans: list[Path], tmp_path: Path
) -> None:
    def stop(job: FitJob, record: FitRecord) -> None:
        raise KeyboardInterrupt

    many = [tmp_path / f"s{k}.ply" for k in range(12)]
    for k, path in enumerate(many):
        path.write_bytes(scans[k % 3].read_bytes())
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        fit_into(out, make_jobs(many), model, file=model_path, executor=Local(3), on_done=stop)
    records = {path.name.removesuffix(".fit.json") for path in out.glob("*.fit.json")}
    assert 2 <= len(records) < 12, "the others were running when it stopped"
    assert {row["scan"] for row in table(out)} == records


DENSE = replace(CONFIG, dense=True)


@pytest.mark.parametrize(("first", "then", "refitted"), [
    ((DENSE, False), (CONFIG, True), True),
    ((CONFIG, True), (DENSE, False), True),
    ((DENSE, True), (CONFIG, False), False),
    ((DENSE, False), (CONFIG, False), False),
    ((CONFIG, False), (CONFIG, True), True),
])  # fmt: skip
def test_reuse_removes_nothing_that_is_valid(
    first: tuple[FitConfig, bool], then: tuple[FitConfig, bool], refitted: bool, model: ShapeModel,
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    jobs = make_jobs(scans[:1])
    fit_into(tmp_path, jobs, model, first[0], stages=first[1])
    before = {path.name for path in tmp_path.iterdir()}
    calls = count_fits(monkeypatch)
    (record,) = fit_into(tmp_path, jobs, model, then[0], stages=then[1], reuse=True)
    after = {path.name for path in tmp_path.iterdir()}
    assert bool(calls) == refitted and before <= after
    assert ("scan0.dense.ply" in after) == record.config["dense"] == (first[0].dense or then[0].dense)
    assert ("scan0.stages.npz" in after) == (first[1] or then[1])
    # Of another scan it would be wrong.
    scan = tmp_path / "scan0.ply"
    scan.write_bytes(scans[1].read_bytes())
    fit_into(tmp_path, [FitJob("scan0", scan)], model, reuse=True)
    assert not (tmp_path / "scan0.dense.ply").exists() and not (tmp_path / "scan0.stages.npz").exists()


def test_a_folder_that_cannot_be_made_is_named(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileError, match=r"Cannot write .*file"):
        fit_into(tmp_path / "file" / "out", make_jobs(scans[:1]), model)


def test_all_states_are_told_when_fits_run_here(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    told: list[int] = []
    (record,) = fit_into(tmp_path, make_jobs(scans[:1]), model, on_state=lambda s: told.append(s.phase))
    assert len(told) == len(record.history)


def test_a_second_run_into_the_same_folder_is_refused(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    def another(*_: object) -> None:
        with pytest.raises(FileError, match="another run of shapespace"):
            fit_into(tmp_path, make_jobs(scans[1:]), model)

    fit_into(tmp_path, make_jobs(scans[:1]), model, on_done=another)
    fit_into(tmp_path, make_jobs(scans[1:]), model)
    assert len(table(tmp_path)) == 3 and not list(tmp_path.glob(".*"))


def test_a_surface_of_another_fit_is_not_kept(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    """As a run that was killed between two files, or two runs at once, may leave it."""
    other = tmp_path / "other"
    fit_into(tmp_path, make_jobs(scans[:1]), model)
    fit_into(other, make_jobs(scans[:1]), model, replace(CONFIG, max_iterations=2))
    good = (tmp_path / "scan0.fitted.ply").read_bytes()
    (other / "scan0.fitted.ply").replace(tmp_path / "scan0.fitted.ply")
    (record,) = fit_into(tmp_path, make_jobs(scans[:1]), model, reuse=True)
    assert (tmp_path / "scan0.fitted.ply").read_bytes() == good
    assert record.id.encode() in good[:300]


def test_a_folder_that_goes_away_is_one_sentence(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    def gone(*_: object) -> None:
        shutil.rmtree(tmp_path / "out")

    with pytest.raises(FileError, match=r"Cannot write .*the folder cannot be made there"):
        fit_into(tmp_path / "out", make_jobs(scans), model, on_done=gone)


def test_half_written_files_of_killed_runs_go(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    code = f"""
import os, pathlib
from shapespace.fit.iteration_state import IcpState
from shapespace.io.files import atomic_path
with atomic_path(pathlib.Path({str(tmp_path)!r}) / "scan0.fitted.ply") as path:
    path.write_bytes(b"half")
    os._exit(9)
"""
    subprocess.run([sys.executable, "-c", code])
    assert len(list(tmp_path.glob(".shapespace-*"))) == 1
    with atomic_path(tmp_path / "live.ply") as writing:
        fit_into(tmp_path, make_jobs(scans[:1]), model)
        assert [path.name for path in tmp_path.glob(".*")] == [writing.name], "of a process that lives it stays"


def test_a_run_tells_what_is_kept_and_what_is_done_anew(model: ShapeModel, scans: list[Path], tmp_path: Path) -> None:
    plans: list[Plan] = []
    for given, config in ((scans[:1], CONFIG), (scans, CONFIG), (scans[1:], FitConfig(max_iterations=2))):
        fit_into(tmp_path, make_jobs(given), model, config, reuse=True, on_plan=plans.append)
    assert plans == [Plan(0, 0, 1), Plan(1, 0, 2), Plan(0, 2, 0)]
    assert not list(plans[0].sentences())
    assert "1 of 3" in next(plans[1].sentences()) and "2 of 2" in next(plans[2].sentences())
